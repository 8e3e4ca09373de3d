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
from typing import Any, NamedTuple

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
        # From anywhere a quarter turn is assumed.
        angle = 0.5 * np.pi if self.axis is None else self.angle
        return HOLD_TIME + TURN_BEGINS + angle / TURN_RATE

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
        details: dict[str, Any] = {'up': [float(f'{c:.6g}') for c in self.up]}
        if self.axis is not None and self.is_turn:
            details['turn_axis'] = [float(f'{c:.6g}') for c in self.axis]
            details['turn_deg'] = round(float(np.degrees(self.angle)), 1)
        return details

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
    Return (axis in the sensor frame, angle in rad) of the shortest turn of the sensor.

    Before the turn the direction `start` of the sensor points up, after it the direction `end`.
    """
    axis_times_sine = cross(end[:, None], start[:, None])[:, 0]
    sine = np.linalg.norm(axis_times_sine)
    angle = float(np.arctan2(sine, start @ end))
    if sine > 1e-6:
        return axis_times_sine / sine, angle
    # Parallel or opposite directions: any axis orthogonal to them.
    return tangent(start[None])[0, :, 0], angle


def turn_rows(start: np.ndarray | None, end: np.ndarray) -> np.ndarray:
    """
    Return the rows of the shortest turn from `start` up to `end` up, shape (2, 9).

    They are the columns of the matrix M of the gyroscope, row by row, in the equation that compares
    rotated gravity with gravity after the turn (`equations.GravityRows`)::

        rows = T' [end x] dpsi/dM,    T = tangent(end)

    Zero without a first direction, and for turns too small to count.
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
    Return (steps to each of `DIRECTIONS`, their `turn_rows`, shape (26, 2, 9)).

    Each step is the shortest turn from the current direction `up`; None: from anywhere.
    """
    return _steps_from(None if up is None else tuple(up.tolist()))


@lru_cache(maxsize=256)  # plans revisit the same directions
def _steps_from(up: tuple[float, ...] | None) -> tuple[tuple[HandStep, ...], np.ndarray]:
    """Return `steps_from` of a direction that can be the key of a cache."""
    start = None if up is None else np.array(up)
    steps = []
    for end in DIRECTIONS:
        steps.append(HandStep(end) if start is None else HandStep(end, *shortest_turn(start, end)))
    rows = np.array([turn_rows(start, end) for end in DIRECTIONS])
    rows.flags.writeable = False  # all callers share the array
    return tuple(steps), rows


def _rotation_slopes(axis: np.ndarray, angle: float) -> np.ndarray:
    """
    Return the derivative of the rotation error of a turn by the gyroscope's matrix, shape (3, 9).

    For a turn at unit rate about the axis a, near ``M = 1``, in the frame after the turn, with the
    rotation ``C(s) = exp(-s [a x])`` over the angle s::

        psi = -integral C(angle - t) dM a dt = -(integral of C from 0 to angle) dM a
    """
    projector = np.outer(axis, axis)
    integral = (
        angle * projector
        + np.sin(angle) * (np.eye(3) - projector)
        - (1 - np.cos(angle)) * skew(axis)
    )
    return -np.einsum('ip,q->ipq', integral, axis).reshape(3, 9)


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
class StepChoice:
    """The best next step, and the gains of all directions."""

    step: HandStep
    """The step with the largest gain per second."""
    gains: np.ndarray
    """Share of the excess that a rest in each of `DIRECTIONS` removes, 0 to 1, shape (26,)."""
    information: np.ndarray
    """Information after the step, shape (n, n)."""


@dataclass(frozen=True, eq=False)
class HandKnowledge:
    """Current information of a session by hand, and the expected information of one more pose."""

    model: HandModel
    """The parameters."""
    values: np.ndarray
    """Their values, or the nominal ones, shape (n,)."""
    information: np.ndarray
    """Inverse covariance from the data so far, without priors, shape (n, n)."""
    tolerances: np.ndarray
    """Standard deviations that are the goal, shape (n,)."""
    pose_sd: float
    """Expected sd of the specific force of one pose, m/s^2."""
    drift_sd: float
    """Expected sd of the gyroscope's bias in one pose, rad/s."""
    turn_sd: float
    """Expected sd of the angle of one turn, rad."""
    up: np.ndarray | None
    """Current vertical in the sensor frame, shape (3,); None: unknown."""

    def norm_columns(self, ups: np.ndarray) -> np.ndarray:
        """
        Return minus the derivative of ``|true force|`` at rest by all parameters, shape (k, n).

        `ups` are the directions that point up in each of the k poses. The derivative depends on the
        values of the parameters, not on the information.
        """
        linear = self.model.linear(self.values)
        forces = linear.force_bias + self.model.gravity * ups @ linear.force_matrix.T
        # At the reference time and temperature the columns of thermal effects are zero: one more
        # pose has no information about them.
        count = len(ups)
        reference_c = np.full(count, self.model.model.temperature_ref_c)
        _, columns = self.model.norm_rows(
            self.values, forces, time=np.zeros(count), temperature_c=reference_c
        )
        return columns

    def information_after(self, norm_columns: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """
        Return the information after one more turn and rest, for each of k directions, (k, n, n).

        `norm_columns` (k, n) and `turns` (k, 2, 9; `turn_rows`) belong to the directions.
        """
        rows = self.step_rows(norm_columns, turns)
        return self.information + rows.transpose(0, 2, 1) @ rows

    def step_rows(self, norm_columns: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """
        Return the rows of k steps in units of their expected sd, shape (k, 6, n).

        Row 0 is the length of gravity at rest, from `norm_columns` (k, n); rows 1 to 3 are the
        rates at rest, which measure the bias; rows 4 and 5 the turn, from `turns` (k, 2, 9).
        """
        rows = np.zeros((len(norm_columns), 6, self.model.size))
        rows[:, 0] = norm_columns / self.pose_sd
        rows[:, 1:4, self.model.gyro_bias] = np.eye(3) / self.drift_sd
        rows[:, 4:6, self.model.gyro_matrix] = turns / self.turn_sd
        return rows

    def sd(self, information: np.ndarray) -> np.ndarray:
        """Return the sds of the parameters, (..., n), given information (..., n, n)."""
        inverse = np.linalg.inv(information + np.diag(1 / self.model.priors**2))
        return np.sqrt(np.diagonal(inverse, axis1=-2, axis2=-1))

    def excess(
        self, information: np.ndarray, parameters: Sequence[int] | slice = slice(None)
    ) -> np.ndarray:
        """Return `sd_excess` of the parameters, shape (...), given information (..., n, n)."""
        return sd_excess(self.sd(information)[..., parameters], self.tolerances[parameters])

    def best(
        self,
        parameters: Sequence[int] | slice = slice(None),
        *,
        seconds_exponent: float = 1.0,
        norm_columns: np.ndarray | None = None,
    ) -> StepChoice:
        """
        Return the step to one of `DIRECTIONS` with the largest ``gain / seconds**exponent``.

        parameters : sequence of int, optional
            Parameters for which the gain is computed; by default all.
        seconds_exponent : float
            Exponent of the duration of a step; 0: it does not count.
        norm_columns : ndarray, shape (26, n), optional
            `norm_columns` of `DIRECTIONS`, where they are known.

        """
        if norm_columns is None:
            norm_columns = self.norm_columns(DIRECTIONS)
        steps, turns = steps_from(self.up)
        information = self.information_after(norm_columns, turns)
        current_excess = float(self.excess(self.information, parameters))
        gains = share_gained(current_excess, self.excess(information, parameters))
        if self.up is not None:
            gains[DIRECTIONS @ self.up > np.cos(TURNED)] = 0.0  # the current attitude
        seconds = np.array([step.seconds for step in steps])
        index = int(np.argmax(gains / seconds**seconds_exponent))
        return StepChoice(steps[index], gains, information[index])

    def then(self, step: HandStep) -> HandKnowledge:
        """Return the knowledge after a step."""
        columns = self.norm_columns(step.up[None])
        turn = turn_rows(self.up, step.up)[None]
        return replace(self, information=self.information_after(columns, turn)[0], up=step.up)


def foretold(knowledge: HandKnowledge) -> list[HandStep]:
    """
    Return the steps still needed, chosen one by one by their gain.

    Of the choices by ``gain`` and by ``gain / seconds`` (`WEIGHTS`) the one with the smaller
    remaining excess is returned, if equal the shorter one. The largest gain per second is not
    always the shortest plan: it begins with small turns, after which more steps are needed.
    """
    plans = [_rollout(knowledge, exponent) for exponent in WEIGHTS]

    def excess_then_seconds(plan: tuple[list[HandStep], float]) -> tuple[float, float]:
        steps, excess = plan
        return excess, sum(step.seconds for step in steps)

    best_steps, _ = min(plans, key=excess_then_seconds)
    return best_steps


def _rollout(knowledge: HandKnowledge, seconds_exponent: float) -> tuple[list[HandStep], float]:
    """Return (the steps by greedy choice, the remaining excess)."""
    steps: list[HandStep] = []
    norm_columns = knowledge.norm_columns(DIRECTIONS)
    while float(knowledge.excess(knowledge.information)) > 0 and len(steps) < MOST_PLANNED_STEPS:
        choice = knowledge.best(seconds_exponent=seconds_exponent, norm_columns=norm_columns)
        if choice.gains.max() < MIN_POSE_GAIN:
            break
        steps.append(choice.step)
        knowledge = replace(knowledge, information=choice.information, up=choice.step.up)
    # Rounded, so that plans of equal excess compare equal.
    return steps, round(float(knowledge.excess(knowledge.information)), 9)


def missing_motion(hand: HandCalibration) -> tuple[dict, ...]:
    """
    Return the undetermined parameters with the motion or remedy that determines them.

    One item for each sensor that another attitude determines, then one for each sensor and remedy
    where none does (`_without_motion`): {'parameters': {name: sd over tolerance}, 'needs': text}.

    The recommended step is the next one of the common plan, shown in the picture, if it serves the
    sensor; otherwise the best step for the sensor.
    """
    absent = hand.hand_model.absent
    undetermined = {}  # name -> sd over tolerance
    for name, status, sd, tolerance in zip(
        hand.param_names, hand.statuses, hand.judged_sd, hand.tolerances
    ):
        if status in LACKING and name.partition('.')[0] not in absent:
            undetermined[name] = float(sd / tolerance)
    if not undetermined:
        return ()
    # No motion determines more without gravity in the readings.
    if 'accelerometer' in absent:
        needs = 'record the accelerometer of the same board as well'
        return ({'parameters': undetermined, 'needs': needs},)

    # Those of each sensor that need a motion, and those of each remedy.
    excesses = _Excesses.of_solution(hand)
    lacking: dict[str, dict[str, float]] = {}
    remedies: dict[tuple[str, str], dict[str, float]] = {}
    for name, in_tolerances in undetermined.items():
        sensor = name.partition('.')[0]
        text = _without_motion(hand, hand.param_names.index(name), excesses)
        if text:
            remedies.setdefault((sensor, text), {})[name] = in_tolerances
        else:
            lacking.setdefault(sensor, {})[name] = in_tolerances
    knowledge = knowledge_after(hand)
    plan = foretold(knowledge)[:1] if lacking else []

    def gain_rate(parameters: list[int], step: HandStep) -> float:
        """Return the decrease of the excess of the parameters by a step, per second."""
        before = knowledge.excess(knowledge.information, parameters)
        after = knowledge.excess(knowledge.then(step).information, parameters)
        return float(before - after) / step.seconds

    # The step for each sensor, then the remedies.
    needs = []
    for sensor in SENSORS:
        if sensor not in lacking:
            continue
        parameters = [hand.param_names.index(name) for name in lacking[sensor]]
        recommended = knowledge.best(parameters).step
        least_rate = SERVES * gain_rate(parameters, recommended)
        if plan and gain_rate(parameters, plan[0]) >= least_rate:
            recommended = plan[0]
        needs.append({'parameters': lacking[sensor], 'needs': recommended.words})
    needs += [{'parameters': names, 'needs': text} for (_, text), names in remedies.items()]
    return tuple(needs)


def _without_motion(hand: HandCalibration, index: int, excesses: '_Excesses') -> str:
    """
    Return the remedy for an undetermined parameter that no attitude determines; '' if one does.

    An effect in time or temperature needs these to change. Otherwise the remedy is that of the
    cause: the standard deviations follow from the scatter of poses and turns, so that a misfit of
    the model enlarges them as noise would (`EXCESS`).
    """
    for effect in hand.model.effects:
        parameters = hand.model.slices[effect.key]
        if parameters.start <= index < parameters.stop and effect.motion[0] in WARMING:
            return ALL_MOTIONS[effect.motion[0]]

    # The bias of the gyroscope is determined at rest, its other parameters by turns.
    name = hand.param_names[index]
    is_bias = hand.model.mask(lambda effect: effect.role is Role.OFFSET)[index]
    of_turns = name.startswith('gyroscope') and not is_bias
    # A turn is compared with the directions of gravity before and after it, so that a moved
    # accelerometer spoils it as well.
    used_sensors = SENSORS if of_turns else (name.partition('.')[0],)
    if motions_at_rest(hand.statistics, used_sensors):
        return MOVED_REMEDY

    # More turns are left out as well where most of them contradict gravity.
    contradicted = hand.statistics['left_out'].get(CONTRADICTED_TURNS, 0)
    if of_turns and contradicted > hand.statistics['turns']:
        return TURNS_REMEDY

    # A parameter that the attitudes do not determine needs other attitudes for any scatter.
    if hand.judged_sd[index] > UNKNOWN_SHARE * hand.hand_model.priors[index]:
        return ''
    if name.startswith('accelerometer'):
        excess = excesses.pose
    elif of_turns:
        # Poses in error also spoil the directions before and after a turn.
        excess = max(excesses.pose, excesses.turn)
    else:
        excess = excesses.bias
    if excess <= EXCESS:
        excess = 1.0
    return remedy(hand.terms, index, hand.tolerances[index], excess=excess)


@dataclass(frozen=True)
class _Excesses:
    """
    Ratio of the scatter of poses and turns to that of a quiet hand (`TREMBLING`, `CREEPING`).

    Both scatters include the noise of the means.
    """

    pose: float
    """Of the specific force of a pose."""
    bias: float
    """Of the gyroscope's bias in a pose."""
    turn: float
    """Of the angle of a turn."""

    @classmethod
    def of_solution(cls, hand: HandCalibration) -> '_Excesses':
        """Return the ratios of a solution."""
        statistics = hand.statistics
        sd_force, sd_bias, sd_turn = SCATTER_SD
        force_noise = np.sqrt(np.mean(hand.poses.force_sem**2))
        rate_noise = np.sqrt(np.mean(hand.poses.rate_sem**2))

        def ratio(scatter: float, quiet: float, noise: float) -> float:
            """Return the ratio of two sds, each with the noise added."""
            return float(np.hypot(scatter, noise) / np.hypot(quiet, noise))

        return cls(
            ratio(statistics['pose_scatter_sd'], np.hypot(sd_force, TREMBLING), force_noise),
            ratio(statistics['drift_scatter_sd'], np.hypot(sd_bias, CREEPING), rate_noise),
            ratio(statistics['turn_scatter_sd'], sd_turn, 0.0),
        )


class NoiseOfMeans(NamedTuple):
    """Standard deviations from the noise of the samples."""

    force: float = 0.0
    """Of the mean force of a pose, m/s^2."""
    rate: float = 0.0
    """Of its mean rate, rad/s."""
    turn: float = 0.0
    """Of the angle of a turn, rad."""


def knowledge_at_first(
    model: HandModel,
    tolerances: np.ndarray,
    *,
    noise: NoiseOfMeans = NoiseOfMeans(),
    poses: Poses | None = None,
) -> HandKnowledge:
    """
    Return the HandKnowledge before the first solution.

    It has the information of the poses so far, at the nominal values and with the default scatter.

    Parameters
    ----------
    model : HandModel
    tolerances : ndarray, shape (n,)
    noise : NoiseOfMeans
    poses : Poses, optional
        Poses so far.

    """
    scatter = np.hypot(SCATTER_SD, (TREMBLING, CREEPING, 0.0))
    pose_sd, drift_sd, turn_sd = np.hypot(scatter, noise).tolist()
    knowledge = HandKnowledge(
        model,
        values=model.nominal,
        information=np.zeros((model.size, model.size)),
        tolerances=GOAL_SHARE * tolerances,
        pose_sd=pose_sd,
        drift_sd=drift_sd,
        turn_sd=turn_sd,
        up=None,
    )
    if poses is None:
        return knowledge
    ups = ups_of(poses)
    turns = np.zeros((len(ups), 2, 9))  # no turn before the first pose
    for pose in range(1, len(ups)):
        turns[pose] = turn_rows(ups[pose - 1], ups[pose])
    _, norm_columns = model.norm_rows(model.nominal, poses.force)
    rows = knowledge.step_rows(norm_columns, turns)
    return replace(knowledge, information=np.einsum('kri,krj->ij', rows, rows), up=ups[-1])


def knowledge_after(hand: HandCalibration) -> HandKnowledge:
    """
    Return the HandKnowledge of a solution.

    Its sds exceed those of its information by the terms beyond noise. The largest of these factors
    divides the information and enlarges the expected sds of poses and turns.
    """
    model = hand.hand_model
    statistics = hand.statistics
    poses = hand.poses
    noise_sd = np.sqrt(np.diag(np.linalg.inv(hand.information + np.diag(1 / model.priors**2))))
    is_determined = noise_sd < UNKNOWN_SHARE * model.priors
    sd_factor = max(1.0, float(np.max(np.where(is_determined, hand.judged_sd / noise_sd, 0.0))))
    pose_sd = np.hypot(np.sqrt(np.mean(poses.force_sem**2)), statistics['pose_scatter_sd'])
    drift_sd = np.hypot(np.sqrt(np.mean(poses.rate_sem**2)), statistics['drift_scatter_sd'])
    turn_sd = max(statistics['turn_scatter_sd'], 1e-4)
    return HandKnowledge(
        model,
        values=hand.values,
        information=hand.information / sd_factor**2,
        tolerances=GOAL_SHARE * hand.tolerances,
        pose_sd=float(sd_factor * pose_sd),
        drift_sd=float(sd_factor * drift_sd),
        turn_sd=float(sd_factor * turn_sd),
        up=ups_of(poses)[-1],
    )


def ups_of(poses: Poses | None) -> np.ndarray:
    """Return the directions that were up, unit vectors, shape (k, 3)."""
    return np.zeros((0, 3)) if poses is None else unit_rows(poses.force)
