"""
Next attitude by hand.

The planner for plan, terminal, status, picture and the motions that a calibration requests.

The gain of a step is the decrease of the excess (logarithms of standard deviations over
tolerances), its cost the duration in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from imu_calibration.calibration.coverage import sd_excess, share_gained
from imu_calibration.core.units import DEG
from imu_calibration.document.rest_noise import motions_at_rest
from imu_calibration.effects.base import AXES, SENSORS, Role
from imu_calibration.effects.motions import ALL_MOTIONS
from imu_calibration.estimation.solution import LACKING, MOVED_REMEDY, TURNS_REMEDY, remedy
from imu_calibration.kinematics.rotations import cross, skew, unit_rows
from imu_calibration.kinematics.sphere import DIRECTIONS
from imu_calibration.references.gravity.equations import SCATTER_SD, Poses, tangent
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.pose_solver import CONTRADICTED_TURNS

HOLD_TIME = 3.0
"""s; hold time after which a pose certainly counts."""
TURN_BEGINS, TURN_RATE = 0.5, 60.0 * DEG
"""s, rad/s; time to begin and to end a turn, and its rate."""
TURNED = 0.35
"""
rad, 20 degrees: smaller turns between two poses carry little information about the gyroscope and
are easily made wrong.
"""
ROUNDED = 15
"""deg, rounding of a turn in instructions."""


@dataclass(frozen=True, eq=False)
class HandStep:
    """A turn to an attitude, and a rest there."""

    up: np.ndarray
    """Direction of the sensor that points up then, unit vector, shape (3,)."""
    axis: np.ndarray | None = None
    """
    Axis of the sensor to turn about, counter-clockwise seen from its tip; None: from anywhere.
    """
    angle: float = 0.0
    """Angle of the turn, rad."""

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return (
            HOLD_TIME + TURN_BEGINS + (0.5 * np.pi if self.axis is None else self.angle) / TURN_RATE
        )

    @property
    def is_turn(self) -> bool:
        """Whether the turn is large enough to count."""
        return self.axis is not None and self.angle > TURNED

    @property
    def kind(self) -> str:
        """'turn' or 'pose'."""
        return 'turn' if self.is_turn else 'pose'

    @property
    def details(self) -> dict[str, Any]:
        """Numbers of the step for plan.yaml."""
        found: dict[str, Any] = {'up': [float(f'{c:.6g}') for c in self.up]}
        if self.axis is not None and self.is_turn:
            found |= {
                'turn_axis': [float(f'{c:.6g}') for c in self.axis],
                'turn_deg': round(float(np.degrees(self.angle)), 1),
            }
        return found

    @property
    def words(self) -> str:
        """Instruction."""
        hold = f'hold it still with {direction_words(self.up)} up'
        if not self.is_turn:
            return hold
        about = DIRECTIONS[int(np.argmax(DIRECTIONS @ self.axis))]
        return (
            f'turn it by {round(self.angle / DEG / ROUNDED) * ROUNDED} deg about its'
            f' {direction_words(about)} axis and {hold}'
        )


def direction_words(up: np.ndarray) -> str:
    """Return the name of a standard direction: '+x -z'."""
    return ' '.join(f'{"+" if c > 0 else "-"}{a}' for c, a in zip(up, AXES) if abs(c) > 1e-9)


def shortest_turn(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, float]:
    """
    Return (axis in the sensor frame, angle) of the shortest turn of the sensor.

    The turn brings `end` up where `start` was.
    """
    about = cross(end[:, None], start[:, None])[:, 0]
    size = np.linalg.norm(about)
    angle = float(np.arctan2(size, start @ end))
    return (about / size if size > 1e-6 else tangent(start[None])[0, :, 0]), angle


def turn_rows(start: np.ndarray | None, end: np.ndarray) -> np.ndarray:
    """
    Return the design of the shortest turn between two directions up.

    It is the design for the gyroscope's matrix, shape (2, 9), of the turn from one direction up to
    another.
    """
    if start is None:
        return np.zeros((2, 9))
    about, angle = shortest_turn(start, end)
    if angle < TURNED:
        return np.zeros((2, 9))
    across = tangent(end[None])[0].T
    return (across @ skew(end) @ _rotation_slopes(about, angle)).reshape(2, 9)


def steps_from(up: np.ndarray | None) -> tuple[tuple[HandStep, ...], np.ndarray]:
    """
    Return the step to each of `DIRECTIONS`.

    By the shortest turn from the current one, and the `turn_rows` of each, shape (26, 2, 9).
    """
    return _steps_from(None if up is None else tuple(up.tolist()))


@lru_cache(maxsize=256)  # plans revisit the same directions
def _steps_from(up: tuple[float, ...] | None) -> tuple[tuple[HandStep, ...], np.ndarray]:
    start = None if up is None else np.array(up)
    steps = tuple(
        HandStep(to) if start is None else HandStep(to, *shortest_turn(start, to))
        for to in DIRECTIONS
    )
    rows = np.array([turn_rows(start, to) for to in DIRECTIONS])
    rows.flags.writeable = False
    return steps, rows


def _rotation_slopes(about: np.ndarray, angle: float = np.pi) -> np.ndarray:
    """
    Return the derivative of the rotation error by the gyroscope's matrix.

    It is in the turned frame, near the identity, and has shape (3, 9).
    """
    cross = skew(about)
    # integral over the turn of the remaining rotation, C(angle - t)
    to_come = (
        angle * np.outer(about, about)
        + np.sin(angle) * (np.eye(3) - np.outer(about, about))
        - (1 - np.cos(angle)) * cross
    )
    return -np.einsum('ip,q->ipq', to_come, about).reshape(3, 9)


TREMBLING, CREEPING = 1.5e-3, 5e-4
"""
m/s^2, rad/s (0.03 deg/s); expected sd of the means of a pose from noise, trembling and creeping
hands, before it is estimated.
"""
GOAL_SHARE = 0.85
"""
Share of the tolerance as goal: the scatter of some twenty poses and turns, a part of every standard
deviation, is known to a sixth.
"""
MOST_PLANNED_STEPS = 60
MIN_POSE_GAIN = 1e-3
"""
Poses with a smaller relative gain are not planned; other information is required, such as the
gravity.
"""
WEIGHTS = (0.0, 1.0)
"""Exponents of the seconds of a step in its choice: `foretold` tries both."""
EXCESS = 3.0
"""
Ratio of the scatter of poses or turns to the one that noise and a quiet hand explain, above which
the model or the mount is in error.
"""
UNKNOWN_SHARE = 0.5
"""Share of its prior sd above which the attitudes do not determine a parameter."""
WARMING = ('warm_up', 'warm_and_cool', 'shake')
"""Motions that change time, temperature or vibration, not the attitude."""
SERVES = 0.5
"""
Share of the best gain per second for one sensor from which the next step of the common plan is
recommended for it too.
"""


@dataclass(frozen=True, eq=False)
class HandKnowledge:
    """Current information of a session by hand, and the expected information of one more pose."""

    model: HandModel
    """The parameters."""
    values: np.ndarray
    """Their values, or the nominal ones, shape (n,)."""
    information: np.ndarray
    """Of the data so far, shape (n, n)."""
    tolerances: np.ndarray
    """Goal, shape (n,)."""
    pose_sd: float
    """Expected sd of one pose, m/s^2."""
    drift_sd: float
    """The same for the bias of the gyroscope, rad/s."""
    turn_sd: float
    """The same for a turn, rad."""
    up: np.ndarray | None
    """Current vertical in the sensor frame, shape (3,); None: unknown."""

    def norms(self, ups: np.ndarray) -> np.ndarray:
        """
        Return the design of the length of gravity at rest in several directions, shape (k, n).

        It depends on the values, not on the information.
        """
        bias, matrix, *_ = self.model.linear(self.values)
        forces = bias + self.model.gravity * ups @ matrix.T
        # temperature and time at the reference point: one more pose there has no information about
        # thermal effects
        count = len(ups)
        warmth = np.full(count, self.model.model.temperature_ref_c)
        return self.model.norm_rows(
            self.values, forces, time=np.zeros(count), temperature_c=warmth
        )[1]

    def after(self, norms: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """
        Return the information after a turn to each of several directions and a rest there.

        With their `norms` (k, n) and `turn_rows` (k, 2, 9).
        """
        rows = self.rows(norms, turns)
        return self.information + rows.transpose(0, 2, 1) @ rows

    def rows(self, norms: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """
        Return the design of poses in sd, shape (k, 6, n).

        From lengths of gravity (k, n), rates at rest, turns (k, 2, 9).
        """
        rows = np.zeros((len(norms), 6, self.model.size))
        rows[:, 0] = norms / self.pose_sd
        rows[:, 1:4, self.model.gyro_bias] = np.eye(3) / self.drift_sd
        rows[:, 4:6, self.model.gyro_matrix] = turns / self.turn_sd
        return rows

    def sd(self, information: np.ndarray) -> np.ndarray:
        """Return the standard deviations with some information; leading axes are kept."""
        inverse = np.linalg.inv(information + np.diag(1 / self.model.priors**2))
        return np.sqrt(np.diagonal(inverse, axis1=-2, axis2=-1))

    def missing(
        self, information: np.ndarray, only: Sequence[int] | slice = slice(None)
    ) -> np.ndarray:
        """
        Return the remaining `excess` of all or some parameters given some information.

        Leading axes are kept.
        """
        return sd_excess(self.sd(information)[..., only], self.tolerances[only])

    def best(
        self,
        only: Sequence[int] | slice = slice(None),
        *,
        weight: float = 1.0,
        norms: np.ndarray | None = None,
    ) -> tuple[HandStep, np.ndarray, np.ndarray]:
        """
        Return (best step, gains of `DIRECTIONS`, information after the step).

        The step is the one with the largest gain per second. The gain of each of `DIRECTIONS` is
        relative.

        only : sequence of int, optional
            Parameters for which the gain is computed; by default all.
        weight : float
            Exponent of the seconds; 0: they do not count.
        norms : ndarray, shape (26, n), optional
            `norms` of `DIRECTIONS`, where they are known.

        """
        steps, turns = steps_from(self.up)
        information = self.after(self.norms(DIRECTIONS) if norms is None else norms, turns)
        worth = share_gained(
            float(self.missing(self.information, only)), self.missing(information, only)
        )
        if self.up is not None:
            worth[DIRECTIONS @ self.up > np.cos(TURNED)] = 0.0  # the current attitude
        place = int(np.argmax(worth / np.array([step.seconds for step in steps]) ** weight))
        return steps[place], worth, information[place]

    def then(self, step: HandStep) -> HandKnowledge:
        """Return the knowledge after a step."""
        return replace(
            self,
            information=self.after(self.norms(step.up[None]), turn_rows(self.up, step.up)[None])[0],
            up=step.up,
        )


def foretold(knowledge: HandKnowledge) -> list[HandStep]:
    """
    Return the steps still needed.

    The shorter of the plans with and without the seconds of each step in its choice.

    The largest gain per second is not always the shortest plan: it begins with small turns, after
    which more remains to be done.
    """
    plans = [_rollout(knowledge, weight) for weight in WEIGHTS]
    return min(plans, key=lambda plan: (plan[1], sum(step.seconds for step in plan[0])))[0]


def _rollout(knowledge: HandKnowledge, weight: float) -> tuple[list[HandStep], float]:
    """Return (the steps by greedy choice, the remaining excess)."""
    steps: list[HandStep] = []
    norms = knowledge.norms(DIRECTIONS)
    while float(knowledge.missing(knowledge.information)) > 0 and len(steps) < MOST_PLANNED_STEPS:
        step, worth, information = knowledge.best(weight=weight, norms=norms)
        if worth.max() < MIN_POSE_GAIN:
            break
        steps.append(step)
        knowledge = replace(knowledge, information=information, up=step.up)
    return steps, round(float(knowledge.missing(knowledge.information)), 9)


def missing_motion(hand: HandCalibration) -> tuple[dict, ...]:
    """
    Return the undetermined parameters and the needs of each undetermined sensor.

    The values are {'parameters': {name: sd over tolerance}, 'needs': the step that helps most} for
    each sensor that is not fully determined. Where no motion helps, it is the remedy for the cause
    (`_without_motion`).

    Recommended is the next step of the common plan, shown in the picture, if it serves the sensor;
    otherwise the best step for the sensor.
    """
    absent = hand.hand_model.absent
    lacking: dict[str, dict[str, float]] = {}
    remedies: dict[tuple[str, str], dict[str, float]] = {}
    excesses = None if 'accelerometer' in absent else _Excesses.of(hand)
    for index, name in enumerate(hand.param_names):
        sensor = name.partition('.')[0]
        if hand.statuses[index] not in LACKING or sensor in absent:
            continue
        in_tolerances = float(hand.judged_sd[index] / hand.tolerances[index])
        without_motion = ''
        if excesses is not None:
            without_motion = _without_motion(hand, index, excesses)
        if without_motion:
            remedies.setdefault((sensor, without_motion), {})[name] = in_tolerances
        else:
            lacking.setdefault(sensor, {})[name] = in_tolerances
    # No motion determines more without gravity in the readings.
    if 'accelerometer' in absent:
        return tuple(
            {'parameters': names, 'needs': 'record the accelerometer of the same board as well'}
            for names in lacking.values()
        )
    knowledge = knowledge_after(hand)
    parts = {}  # sensor -> places of its parameters, in the order of the sensors
    for sensor in SENSORS:
        if sensor in lacking:
            parts[sensor] = [hand.param_names.index(name) for name in lacking[sensor]]
    plan = foretold(knowledge)[:1] if parts else []

    def gain(part: list[int], step: HandStep) -> float:
        """Return the excess of some parameters that a step removes in a second."""
        before = knowledge.missing(knowledge.information, part)
        after = knowledge.missing(knowledge.then(step).information, part)
        return float(before - after) / step.seconds

    found = []
    for sensor, part in parts.items():
        own = knowledge.best(part)[0]
        best = next((step for step in plan if gain(part, step) >= SERVES * gain(part, own)), own)
        found.append({'parameters': lacking[sensor], 'needs': best.words})
    found += [{'parameters': names, 'needs': text} for (_, text), names in remedies.items()]
    return tuple(found)


def _without_motion(hand: HandCalibration, index: int, excesses: '_Excesses') -> str:
    """
    Return what determines a parameter if another attitude does not; '' if it does.

    An effect in time or temperature needs these to change. Otherwise the remedy is that of the
    cause: the standard deviations follow from the scatter of poses and turns, so that a misfit of
    the model enlarges them as noise would (`EXCESS`).
    """
    model, terms = hand.hand_model, hand.terms
    for effect in hand.model.effects:
        own = hand.model.slices[effect.key]
        if own.start <= index < own.stop and effect.motion[0] in WARMING:
            return ALL_MOTIONS[effect.motion[0]]

    bias = hand.model.part('gyroscope', Role.OFFSET)
    of_turns = hand.param_names[index].startswith('gyroscope') and index not in range(
        bias.start, bias.stop
    )
    # A turn is compared with the directions of gravity before and after it, so that a moved
    # accelerometer spoils it as well.
    used_sensors = SENSORS if of_turns else (hand.param_names[index].partition('.')[0],)
    if motions_at_rest(hand.statistics, used_sensors):
        return MOVED_REMEDY

    # More turns are left out as well where most of them contradict gravity.
    contradicted = hand.statistics['left_out'].get(CONTRADICTED_TURNS, 0)
    if of_turns and contradicted > hand.statistics['turns']:
        return TURNS_REMEDY

    # A parameter that the attitudes do not determine needs other attitudes for any scatter.
    if hand.judged_sd[index] > UNKNOWN_SHARE * model.priors[index]:
        return ''
    if hand.param_names[index].startswith('accelerometer'):
        excess = excesses.pose
    elif of_turns:
        # Poses in error also spoil the directions before and after a turn.
        excess = max(excesses.pose, excesses.turn)
    else:
        excess = excesses.bias
    return remedy(terms, index, hand.tolerances[index], excess=excess if excess > EXCESS else 1.0)


@dataclass(frozen=True)
class _Excesses:
    """Scatter of poses and turns over that of noise and a quiet hand (`TREMBLING`, `CREEPING`)."""

    pose: float
    """Of the specific force of a pose."""
    bias: float
    """Of the gyroscope's bias in a pose."""
    turn: float
    """Of the angle of a turn."""

    @classmethod
    def of(cls, hand: HandCalibration) -> '_Excesses':
        statistics = hand.statistics
        sd_force, sd_bias, sd_turn = SCATTER_SD
        force_noise = np.sqrt(np.mean(hand.poses.force_sem**2))
        rate_noise = np.sqrt(np.mean(hand.poses.rate_sem**2))

        def ratio(scatter: float, quiet: float, noise: float) -> float:
            return float(np.hypot(scatter, noise) / np.hypot(quiet, noise))

        return cls(
            ratio(statistics['pose_scatter_sd'], np.hypot(sd_force, TREMBLING), force_noise),
            ratio(statistics['drift_scatter_sd'], np.hypot(sd_bias, CREEPING), rate_noise),
            ratio(statistics['turn_scatter_sd'], sd_turn, 0.0),
        )


def knowledge_at_first(
    model: HandModel,
    tolerances: np.ndarray,
    *,
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    poses: Poses | None = None,
) -> HandKnowledge:
    """
    Return the HandKnowledge before the first solution.

    From the poses only, at nominal values and with the default scatter.

    Parameters
    ----------
    model : HandModel
    tolerances : ndarray, shape (n,)
    noise : tuple
        Contribution of the sensor noise to a pose (m/s^2), to its mean rate (rad/s) and to a turn
        (rad).
    poses : Poses, optional
        Poses so far.

    """
    scatter = np.hypot(SCATTER_SD, (TREMBLING, CREEPING, 0.0))
    pose_sd, drift_sd, turn_sd = (
        float(np.hypot(*pair)) for pair in zip(scatter, noise, strict=True)
    )
    knowledge = HandKnowledge(
        model,
        model.nominal,
        np.zeros((model.size, model.size)),
        GOAL_SHARE * tolerances,
        pose_sd,
        drift_sd,
        turn_sd,
        None,
    )
    if poses is None:
        return knowledge
    ups = ups_of(poses)
    # No turn before the first pose.
    turns = np.array(
        [turn_rows(start, end) for start, end in zip([None, *ups[:-1]], ups, strict=True)]
    )
    rows = knowledge.rows(model.norm_rows(model.nominal, poses.force)[1], turns)
    return replace(knowledge, information=np.einsum('kri,krj->ij', rows, rows), up=ups[-1])


def knowledge_after(hand: HandCalibration) -> HandKnowledge:
    """
    Return the HandKnowledge of a solution.

    Its information, reduced by the growth of its standard deviations beyond noise.
    """
    model = hand.hand_model
    statistics = hand.statistics
    poses = hand.poses
    expected = np.sqrt(np.diag(np.linalg.inv(hand.information + np.diag(1 / model.priors**2))))
    known = expected < UNKNOWN_SHARE * model.priors
    wider = max(1.0, float(np.max(np.where(known, hand.judged_sd / expected, 0.0))))
    pose_sd = np.hypot(np.sqrt(np.mean(poses.force_sem**2)), statistics['pose_scatter_sd'])
    drift_sd = np.hypot(np.sqrt(np.mean(poses.rate_sem**2)), statistics['drift_scatter_sd'])
    turn_sd = max(statistics['turn_scatter_sd'], 1e-4)
    return HandKnowledge(
        model,
        hand.values,
        hand.information / wider**2,
        GOAL_SHARE * hand.tolerances,
        float(wider * pose_sd),
        float(wider * drift_sd),
        float(wider * turn_sd),
        ups_of(poses)[-1],
    )


def ups_of(poses: Poses | None) -> np.ndarray:
    """Return the directions that were up, unit vectors, shape (k, 3)."""
    return np.zeros((0, 3)) if poses is None else unit_rows(poses.force)
