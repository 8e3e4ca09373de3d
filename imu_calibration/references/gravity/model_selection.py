"""
Test of every effect on a recording by hand.

The search of a diagnosis, on poses and turns instead of windows on a table.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.progress import reported
from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.references.gravity.equations import Poses, TurnData
from imu_calibration.references.gravity.g_sensitivity import g_sensitivity_evidence, shown
from imu_calibration.references.gravity.hand_calibration import (
    HandCalibration,
    HandData,
    solve_by_hand,
)
from imu_calibration.references.gravity.hand_parameters import (
    HandModel,
    HandOptions,
    possible_by_hand,
)
from imu_calibration.references.gravity.pose_evidence import (
    Block,
    HandEvidence,
    HandSpace,
    build_rows,
    gravity_turns,
    unexplained_by_hand,
)
from imu_calibration.selection.evidence import agree
from imu_calibration.selection.explained_share import Explained, pruned
from imu_calibration.selection.gain import OF_MODEL, Gain, gain_of
from imu_calibration.selection.questions import (
    TEMPERATURE_SPAN,
    Question,
    sort_effects,
    time_constants,
)
from imu_calibration.selection.search import Search, SelectedEffects
from imu_calibration.selection.unexplained import Unexplained

OUTER = 12
"""Number of repetitions of the search without some of the poses, to measure the gain on them."""
MIN_SPARE_POSES = 3
"""Least number of poses beyond the nine parameters of the accelerometer."""
MIN_FOLD_POSES = 9 + MIN_SPARE_POSES
"""With fewer poses none can be held out."""


class HandProblem:
    """Rows of a recording, the evidence on a subset of its poses, and the search."""

    def __init__(
        self,
        blocks: Sequence[Block],
        space: HandSpace,
        questions: Sequence[Question],
        *,
        baseline: Sequence[int],
    ):
        smooth = [
            k
            for q in questions
            if q.effect.smooth and not q.effect.time_constant
            for k in q.parameters
        ]
        self.blocks, self.space, self.questions = blocks, space, questions
        self.evidence = HandEvidence(blocks, space, smooth, baseline=baseline)
        self.search = Search(self.evidence, baseline, questions)
        self.explained = Explained(
            self.search, self.evidence.against_noise, self.evidence.numbers, least_part=-np.inf
        )

    def without(self, poses: np.ndarray) -> 'HandProblem':
        """Return the same inquiry without some poses."""
        return HandProblem(
            self._blocks_without(poses), self.space, self.questions, baseline=self.search.baseline
        )

    def _blocks_without(self, poses: np.ndarray) -> list[Block]:
        blocks = [block.select(~np.isin(block.pose, poses)) for block in self.blocks]
        return [block for block in blocks if block.known.size > 3]

    def named(self) -> list[Question]:
        """
        Return the findings: chosen effects of which each explains most of the excess variance.

        Sizes beyond the range of known instruments are tested only for the remaining excess.
        """
        named = list(pruned(self.search.run(), self.explained.share))
        if self.explained.rest(named):
            wide = self.search.asking_any_size()
            known, self.search = self.search, wide
            others = list(pruned(wide.run(), self.explained.share))
            if self.explained.rest(others) < self.explained.rest(named):
                return others
            self.search = known
        return named

    def agrees_in_halves(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether the estimates of an effect from both halves of the poses agree.

        The halves are the poses before and after the middle (`evidence.agree`).

        Effects that are smooth in time differ by nature.
        """
        if question.effect.smooth:
            return True
        used = self.search.indices(chosen)
        poses = np.unique(np.concatenate([block.pose for block in self.blocks]))
        # the chosen effects are no noise here, so they are part of the baseline
        first, second, whole = (
            HandEvidence(self._blocks_without(out), self.space, (), baseline=used).fit(used)
            for out in (*np.array_split(poses, 2), poses[:0])
        )
        return agree((first, second), whole, [used.index(k) for k in question.parameters])

    def gain(
        self,
        held_out: Sequence,
        before: Sequence[Question],
        after: Sequence[Question],
        *,
        sensor: str,
    ) -> Gain:
        """
        Return the Gain of one choice over another on held-out poses.

        The poses are `HandInvestigation.held_out`, held out from both fit and choice.
        """
        block = self.clearest(before, after, sensor)
        pair = [np.full(block.known.shape, np.nan) for _ in range(2)]
        for out, named, smaller in held_out:
            rows = np.isin(block.pose, out)
            for residual, choice in zip(pair, (before, after)):
                allowed = {question.name for question in choice}
                values = smaller.search.values(
                    [question for question in named if question.name in allowed]
                )
                residual[rows] = block.rows[rows, :, -1] - block.rows[rows, :, :-1] @ values
        return gain_of_poses(block, pair)

    def clearest(self, before: Sequence[Question], after: Sequence[Question], sensor: str) -> Block:
        """
        Return the rows of a sensor in which one choice improves most over another.

        The improvement is by cross-validation of the fit.
        """
        squares = [
            [
                np.sum(rest**2)
                for rest in self.evidence.heldout_residuals(self.search.indices(choice))
            ]
            for choice in (before, after)
        ]
        own = [k for k, block in enumerate(self.blocks) if block.sensor == sensor]
        return self.blocks[min(own, key=lambda k: squares[1][k] / max(squares[0][k], 1e-300))]


@dataclass(frozen=True, eq=False)
class HandInvestigation(SelectedEffects):
    """Result of a search, before its report."""

    baseline: HandCalibration
    """The calibration under diagnosis."""
    problem: HandProblem
    """Rows, evidence and search."""
    named: Sequence[Question]
    """Questions that became findings, in the order found."""
    held_out: Sequence
    """
    (poses, findings without them, the inquiry without them), ...: the complete search, repeated.
    """
    not_testable: list[dict]
    """Effects that could not be tested."""
    constants: np.ndarray
    """Time constants of the warm-ups under test, s."""
    turns: Sequence[TurnData]
    """Turns of the rows."""
    unstable: Sequence[Question] = field(default_factory=list)
    """Effects that were rejected because the estimates of the two halves differ significantly."""

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Sensor -> effects for the model."""
        return {
            sensor: tuple(q.name for q in self.adopted if q.sensor == sensor) for sensor in SENSORS
        }

    @cached_property
    def unexplained(self) -> dict[str, Unexplained]:
        """Sensor -> the residual that no finding explains."""
        blocks, evidence, used = (
            self.problem.blocks,
            self.problem.evidence,
            self.search.indices(self.named),
        )
        return {
            sensor: unexplained_by_hand(self.baseline, blocks, evidence, used=used, sensor=sensor)
            for sensor in SENSORS
        }

    def point(self, problem: HandProblem, chosen: Sequence[Question]) -> dict[str, np.ndarray]:
        """
        Return effect -> initial values for its columns, of the warm-ups among the chosen effects.

        From the rows of `problem`.
        """
        fit, warm = (
            problem.search.values(chosen),
            [question for question in chosen if '@' in question.label],
        )
        return {
            q.name: np.append(fit[list(q.parameters)], self.constants[int(q.label.split('@')[1])])
            for q in warm
        }

    def extended(
        self, problem: HandProblem, chosen: Sequence[Question]
    ) -> tuple[HandModel, np.ndarray, float]:
        """
        Return the baseline extended by some effects.

        (model, parameters, the Earth's rate about the vertical, rad/s).

        `problem` has the rows for the estimate, those of this investigation or fewer.
        """
        hand, point, fit = self.baseline, self.point(problem, chosen), problem.search.values(chosen)
        base = hand.model
        names = {
            sensor: getattr(base, sensor) + tuple(q.name for q in chosen if q.sensor == sensor)
            for sensor in SENSORS
        }
        model = replace(
            hand.hand_model, model=replace(base, **names, point={**base.point, **point})
        )
        values = model.model.start_from(base, hand.values + fit[: hand.hand_model.size])
        for question in chosen:
            if question.name not in point:
                values[model.model.slices[question.effect.key]] = fit[list(question.parameters)]
        return model, values, fit[hand.hand_model.size]


def investigate_by_hand(data: HandData, options: HandOptions = HandOptions()) -> HandInvestigation:
    """
    Test every effect that is observable by hand on held-out poses.

    Every pose is held out in turn. The accelerometer is tested with the norm of gravity, the
    gyroscope with the rates at rest and the directions of gravity before and after each turn. Poses
    are few, so variances are estimated too (F tests, losses ``n log(mean square)``), with a bias
    process in addition to the scatter between poses.

    Parameters
    ----------
    data : HandData
        From `gather_by_hand`.
    options : HandOptions
        Reference, tolerances, and the effects of the baseline: by default bias and matrix.

    Raises
    ------
    NotObservableError
        With too few poses to hold any out.

    """
    poses = data.poses
    if len(poses.start) < MIN_FOLD_POSES:
        raise too_few_poses(len(poses.start))
    baseline = solve_by_hand(
        data,
        replace(
            options,
            accelerometer=options.accelerometer or BASE,
            gyroscope=options.gyroscope or BASE,
        ),
    )
    follows_gravity = shown(g_sensitivity_evidence(poses))
    effects, not_testable = sort_effects(
        baseline.model, lambda effect: _why_not(effect, poses, data.turns, follows_gravity)
    )
    constants = time_constants(float(poses.time[-1]))
    blocks, space = build_rows(baseline, data.turns, effects, constants=constants)
    # Including fixed parameters and the Earth's rate: their uncertainty is no finding.
    base = tuple(range(baseline.hand_model.size + 1))
    questions = _questions(effects, blocks, space, base, not_testable)
    problem = HandProblem(blocks, space, questions, baseline=base)
    named = problem.named()
    held_out = _held_out(problem) if named else []
    named = _that_predict(problem, held_out, named)
    unstable = [question for question in named if not problem.agrees_in_halves(named, question)]
    if unstable:
        named = _that_predict(
            problem, held_out, [question for question in named if question not in unstable]
        )
    return HandInvestigation(
        baseline,
        problem,
        named,
        held_out,
        not_testable,
        constants,
        gravity_turns(data.turns),
        unstable,
    )


def too_few_poses(count: int) -> NotObservableError:
    """Return the error of a recording with so few poses that none can be held out."""
    return NotObservableError(
        f'a diagnosis by hand needs at least {MIN_FOLD_POSES} poses held still, so that some can be'
        f' held out, {count} were found; hold the IMU still in more attitudes',
        code='too_few_poses',
    )


def _that_predict(
    problem: HandProblem,
    held_out: Sequence[tuple[np.ndarray, list[Question], HandProblem]],
    named: Sequence[Question],
) -> list[Question]:
    """Return the findings that improve the prediction of poses held out from their choice."""
    named = list(named)
    while named:
        gains = [
            problem.gain(held_out, named[:k], named[: k + 1], sensor=q.sensor)
            for k, q in enumerate(named)
        ]
        poor = [q for q, gain in zip(named, gains) if not gain.ci95[0] > 0]
        if not poor:
            break
        named.remove(poor[-1])
    return named


def _why_not(
    effect: Effect, poses: Poses, turns: Sequence[TurnData], follows_gravity: bool
) -> tuple[str, str] | None:
    if effect.role is Role.LIMIT:
        return (
            'the true values of clipped samples are unknown; turns that reach a limit are excluded',
            'record on a table',
        )
    if 'cooling' in effect.needs:
        return 'the thermal branch is not tracked between poses', 'record on a table'
    if 'vibration' in effect.needs:
        return 'poses by hand are at rest, so that the vibration does not vary', 'record on a table'
    if not possible_by_hand(effect):
        return 'gravity in poses and the turns between them do not show it', 'record on a table'
    if 'temperature' in effect.needs:
        if poses.temperature_c is None:
            return 'no temperature was recorded', 'record imu/temperature'
        span = np.ptp(poses.temperature_c)
        if span < TEMPERATURE_SPAN:
            return (
                f'the temperature changed by {span:.2f} K only',
                'record while the sensor warms up by at least some kelvins',
            )
    if effect.role is Role.CROSS and not follows_gravity:  # the same test as in calibration
        return (
            'rates at rest do not separate it from a bias that moves in time',
            'hold each attitude again later, in a different order',
        )
    moving = effect.sensor == 'gyroscope' and any('rate' in group.uses for group in effect.groups)
    if moving and len(gravity_turns(turns)) < 6:
        return (
            'there are fewer than six turns between poses',
            'turn it by half a turn between poses',
        )
    return None


def _questions(
    effects: Sequence[Effect],
    blocks: Sequence[Block],
    space: HandSpace,
    base: Sequence[int],
    not_testable: list[dict[str, str]],
) -> list[Question]:
    """
    Return the questions.

    An effect that is collinear with the baseline in these poses is moved to `not_testable`.
    """
    by_name, asked = {e.name: e for e in effects}, []
    probe = HandEvidence(blocks, space, (), baseline=base)
    for label, part in space.parts.items():
        name = label.split('@')[0]
        parameters = tuple(range(part.start, part.stop))
        rank = probe.rank(parameters, base)
        if rank:
            asked.append(Question(by_name[name], parameters, rank + ('@' in label), label))
    lacking = sorted(by_name.keys() - {q.name for q in asked})
    not_testable += [
        {
            'effect': name,
            'why': 'in these poses bias and matrix imitate it',
            'needs': 'more poses, in steps of 30 degrees about each axis',
        }
        for name in lacking
    ]
    return asked


def _held_out(problem: HandProblem) -> list[tuple[np.ndarray, list[Question], HandProblem]]:
    """
    Return fold -> (poses, findings without them, evidence without them).

    The complete search, repeated.
    """
    poses = np.unique(np.concatenate([block.pose for block in problem.blocks]))
    found, times = [], min(OUTER, len(poses))
    for number in reported('repeating the search', range(times), times):
        out = poses[number::times]
        smaller = problem.without(out)
        found.append((out, smaller.named(), smaller))
    return found


def gain_of_poses(block: Block, pair: Sequence[np.ndarray], of: str = OF_MODEL) -> Gain:
    """
    Return the Gain from residuals of each row of a block before and after.

    Shape (m, n), resampled by pose.
    """
    place = np.unique(block.pose, return_inverse=True)[1]
    numbers = np.bincount(place) * block.known.shape[1]
    return gain_of(
        block.sensor,
        block.name,
        [(np.bincount(place, (residuals**2).sum(axis=1)), numbers) for residuals in pair],
        of=of,
    )
