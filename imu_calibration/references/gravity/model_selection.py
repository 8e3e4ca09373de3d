"""
Test of every effect on a recording by hand.

The search of a diagnosis, on poses and turns instead of windows on a table.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.rows import Rows
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
from imu_calibration.references.gravity.pose_residual import unexplained_by_hand
from imu_calibration.references.gravity.pose_rows import SearchParameters, build_rows, gravity_turns
from imu_calibration.references.rows.row_evidence import RowEvidence
from imu_calibration.references.rows.row_search import ChoiceWithout, RowProblem, choose_effects
from imu_calibration.selection.questions import (
    Question,
    lacking_temperature,
    sort_effects,
    time_constants,
)
from imu_calibration.selection.selected_effects import SelectedEffects, SelectionSettings
from imu_calibration.selection.unexplained import Unexplained

MIN_SPARE_POSES = 3
"""Least number of poses beyond the nine parameters of the accelerometer."""
MIN_FOLD_POSES = 9 + MIN_SPARE_POSES
"""With fewer poses none can be held out."""


class ExtendedBaseline(NamedTuple):
    """The model of a baseline with further effects, and its parameters."""

    model: HandModel
    values: np.ndarray
    """Parameters, shape (n,)."""
    earth_rate: float
    """The Earth's rate about the vertical, rad/s."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HandInvestigation(SelectedEffects):
    """Result of a search for effects in a recording by hand, before its report."""

    # The amplitudes of an effect are few, and a requested effect remains in the model.
    settings: ClassVar[SelectionSettings] = SelectionSettings(
        joint_test=False, judge_requested=False
    )
    baseline: HandCalibration
    """The calibration under diagnosis."""
    problem: RowProblem
    """Rows of poses and turns, with the search on them."""
    held_out: Sequence[ChoiceWithout]
    """The complete search, repeated without each part of the poses."""
    constants: np.ndarray
    """Time constants of the warm-ups under test, s."""
    turns: Sequence[TurnData]
    """Turns of the rows."""

    @property
    def param_names(self) -> Sequence[str]:
        """Names of the parameters of the baseline."""
        return self.baseline.param_names

    @property
    def baseline_model(self) -> SensorModel:
        """The model that the search extends."""
        return self.baseline.model

    @property
    def point_of_named(self) -> Mapping[str, np.ndarray]:
        """Warm-up -> values at which its columns are linearised."""
        return self.point(self.problem, self.named)

    def unexplained_rests(self) -> dict[str, Unexplained]:
        """Return `unexplained`; it is small."""
        return self.unexplained

    @cached_property
    def unexplained(self) -> dict[str, Unexplained]:
        """Sensor -> the residual that no finding explains."""
        evidence = self.problem.evidence
        used = self.search.indices(self.named)
        return {
            sensor: unexplained_by_hand(self.baseline, evidence, used=used, sensor=sensor)
            for sensor in SENSORS
        }

    def point(self, problem: RowProblem, chosen: Sequence[Question]) -> dict[str, np.ndarray]:
        """
        Return the values at which the columns of the chosen warm-ups are linearised, by name.

        They are the amplitudes, estimated from the rows of `problem`, and the time constant.
        """
        fit = problem.search.values(chosen)
        point = {}
        for question in chosen:
            if '@' in question.label:  # a warm-up, with the number of its time constant
                number = int(question.label.split('@')[1])
                amplitudes = fit[list(question.parameters)]
                point[question.name] = np.append(amplitudes, self.constants[number])
        return point

    def extended(self, problem: RowProblem, chosen: Sequence[Question]) -> ExtendedBaseline:
        """
        Return the model of the baseline and the chosen effects, with its parameters.

        `problem` has the rows for the estimate, those of this investigation or fewer.
        """
        hand = self.baseline
        point = self.point(problem, chosen)
        # Changes of the baseline's parameters, the Earth's rate, then values of the effects.
        fit = problem.search.values(chosen)
        n_baseline = hand.hand_model.size
        extended = hand.model
        for question in chosen:
            extended = extended.with_effect(question.sensor, question.name)
        extended = replace(extended, point={**hand.model.point, **point})
        model = replace(hand.hand_model, model=extended)
        values = extended.start_from(hand.model, hand.values + fit[:n_baseline])
        for question in chosen:
            if question.name not in point:  # warm-ups start at the point
                values[extended.slices[question.effect.key]] = fit[list(question.parameters)]
        return ExtendedBaseline(model, values, fit[n_baseline])


def investigate_by_hand(
    data: HandData, options: HandOptions = HandOptions(), solved: HandCalibration | None = None
) -> HandInvestigation:
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
    solved : HandCalibration, optional
        The solution of these data with `options`, which is the baseline if its effects are those.

    Raises
    ------
    NotObservableError
        With too few poses to hold any out.

    """
    poses = data.poses
    if len(poses) < MIN_FOLD_POSES:
        raise too_few_poses(len(poses))

    # Baseline: the given solution, unless it has an added g-sensitivity, or other effects.
    requested = options.model
    baseline = solved
    if baseline is None or (baseline.model.accelerometer, baseline.model.gyroscope) != (
        requested.accelerometer,
        requested.gyroscope,
    ):
        explicit = replace(
            options, accelerometer=requested.accelerometer, gyroscope=requested.gyroscope
        )
        baseline = solve_by_hand(data, explicit)

    # Effects that can be tested, and their columns.
    follows_gravity = shown(g_sensitivity_evidence(poses))
    effects, not_testable = sort_effects(
        baseline.model, lambda effect: _why_not(effect, poses, data.turns, follows_gravity)
    )
    constants = time_constants(float(poses.time[-1]))
    blocks, space = build_rows(baseline, data.turns, effects, constants=constants)
    # Including fixed parameters and the Earth's rate: their uncertainty is no finding.
    base = tuple(range(baseline.hand_model.size + 1))
    questions = _questions(effects, blocks, space, base)
    for name in sorted({effect.name for effect in effects} - {each.name for each in questions}):
        not_testable.append(
            {
                'effect': name,
                'why': 'in these poses bias and matrix imitate it',
                'needs': 'more poses, in steps of 30 degrees about each axis',
            }
        )
    problem = RowProblem(blocks, space.prior_sd, questions, baseline=base)
    chosen = choose_effects(problem)
    return HandInvestigation(
        baseline=baseline,
        problem=problem,
        named=chosen.named,
        held_out=chosen.held_out,
        not_testable=not_testable,
        constants=constants,
        turns=gravity_turns(data.turns),
        unstable=chosen.unstable,
    )


def too_few_poses(count: int) -> NotObservableError:
    """Return the error of a recording with so few poses that none can be held out."""
    return NotObservableError(
        f'a diagnosis by hand needs at least {MIN_FOLD_POSES} poses held still, so that some can be'
        f' held out, {count} were found; hold the IMU still in more attitudes',
        code='too_few_poses',
    )


def _why_not(
    effect: Effect, poses: Poses, turns: Sequence[TurnData], follows_gravity: bool
) -> tuple[str, str] | None:
    """
    Return (reason, remedy) where an effect cannot be tested by hand; None where it can.

    `follows_gravity`: whether the g-sensitivity is significant (`g_sensitivity.shown`).
    """
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
    span = None if poses.temperature_c is None else float(np.ptp(poses.temperature_c))
    why = lacking_temperature(effect, span)
    if why:
        return why
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
    blocks: Sequence[Rows],
    space: SearchParameters,
    base: Sequence[int],
) -> list[Question]:
    """
    Return a question for each effect, of a warm-up for each time constant.

    An effect that is collinear with the parameters `base` in these poses has none.
    """
    by_name = {effect.name: effect for effect in effects}
    questions = []
    evidence = RowEvidence(blocks, space.prior_sd, {}, baseline=base)
    for label, part in space.parts.items():
        name = label.split('@')[0]
        parameters = tuple(range(part.start, part.stop))
        rank = evidence.rank(parameters, base)
        if rank:
            # The time constant of a warm-up is a further degree of freedom.
            freedom = rank + ('@' in label)
            questions.append(Question(by_name[name], parameters, freedom, label))
    return questions
