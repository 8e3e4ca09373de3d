"""By hand: which attitude to hold next, and how long it will take until everything is determined, foretold from information alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.by_hand.advice import direction_words, rotation_slopes
from imu_calibration.by_hand.equations import Poses, tangent
from imu_calibration.by_hand.model import GYRO_BIAS, GYRO_MATRIX, HandModel, unpack
from imu_calibration.by_hand.options import ByHandSettings, HandOptions
from imu_calibration.by_hand.result import HandResult
from imu_calibration.by_hand.status import Findings
from imu_calibration.calibration.coverage import DIRECTIONS, Coverage, Step, excess, share_gained
from imu_calibration.calibration.status import DETERMINED
from imu_calibration.effects.named_models import BASE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.reference.reference_motion import skew

HOLD, MOVE = 3.0, 2.0
"""s; how long a pose is held until it counts for sure, and what a person takes from one to the next."""
TREMBLING, CREEPING = 1.5e-3, 5e-4
"""m/s^2, rad/s (0.03 deg/s); what noise and a hand that trembles and creeps leave in the means of such a pose, before that is known."""
MARGIN = 0.85
"""Of the tolerance, aimed at: the scatter of some twenty poses and turns, which enters every standard deviation, is known to a sixth."""
MOST_STEPS = 60
LEAST_GAIN = 1e-3
"""Poses that take less than this off what is missing do not end; something else must come, such as the gravity."""
TURNED = 0.35
"""rad, 20 degrees: smaller turns between two poses tell the gyroscope little and are easily made wrong."""


@dataclass(frozen=True, eq=False)
class HandKnowledge:
    """What is known by hand so far, and what one more pose is expected to be worth."""

    model: HandModel
    """The parameters."""
    values: np.ndarray
    """Their values, or the nominal ones, shape (n,)."""
    information: np.ndarray
    """Of the data so far, shape (n, n)."""
    tolerances: np.ndarray
    """What is aimed at, shape (n,)."""
    pose_sd: float
    """What one pose is good for, m/s^2."""
    drift_sd: float
    """The same for the bias of the gyroscope, rad/s."""
    turn_sd: float
    """The same for a turn, rad."""
    up: np.ndarray
    """What is up now, shape (3,)."""

    def after(self, ups: np.ndarray) -> np.ndarray:
        """Return the information after going to each of some directions and resting there, shape (k, n, n)."""
        bias, matrix, *_ = unpack(self.values)
        forces = bias + self.model.gravity * ups @ matrix.T
        # temperature and time as at the reference point: one more pose there says nothing of thermal effects
        count = len(ups)
        norms = self.model.norm_rows(self.values, forces, time=np.zeros(count), temperature_c=np.full(count, self.model.model.temperature_ref_c))[1]
        rows = self.rows(norms, [_turn_rows(self.up, to) for to in ups])
        return self.information + np.einsum('kri,krj->kij', rows, rows)

    def rows(self, norms: np.ndarray, turns: Sequence[np.ndarray]) -> np.ndarray:
        """Return what poses say of the parameters, in standard deviations, shape (k, 6, n): lengths of gravity (k, n), rates at rest, turns (k, 2, 9)."""
        rows = np.zeros((len(norms), 6, self.model.size))
        rows[:, 0] = norms / self.pose_sd
        rows[:, 1:4, GYRO_BIAS] = np.eye(3) / self.drift_sd
        rows[:, 4:6, GYRO_MATRIX] = np.array(turns) / self.turn_sd
        return rows

    def missing(self, information: np.ndarray) -> np.ndarray:
        """Return the `excess` that stays with some information; leading axes are kept."""
        inverse = np.linalg.inv(information + np.diag(1 / self.model.priors**2))
        return excess(np.sqrt(np.diagonal(inverse, axis1=-2, axis2=-1)), self.tolerances)

    def best(self) -> tuple[int, np.ndarray, np.ndarray]:
        """Return (the best of `DIRECTIONS`, the share of what is missing that each would give, the information after each)."""
        information = self.after(DIRECTIONS)
        worth = share_gained(float(self.missing(self.information)), self.missing(information))
        worth[DIRECTIONS @ self.up > np.cos(TURNED)] = 0.0   # it is there already
        return int(np.argmax(worth)), worth, information


def _turn_rows(start, end):
    """Return what the shortest turn from one direction up to another shows of the gyroscope's matrix, shape (2, 9)."""
    about, angle = shortest_turn(start, end)
    if angle < TURNED:
        return np.zeros((2, 9))
    across = tangent(end[None])[0].T
    return (across @ skew(end) @ rotation_slopes(about, angle)).reshape(2, 9)


def shortest_turn(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (axis in the sensor frame, angle) of the shortest turn of the sensor that brings `end` up where `start` was."""
    about = np.cross(end, start)
    size = np.linalg.norm(about)
    angle = float(np.arctan2(size, start @ end))
    return (about / size if size > 1e-6 else tangent(start[None])[0, :, 0]), angle


def foretold(knowledge: HandKnowledge) -> list[int]:
    """Return the indices into `DIRECTIONS` of the poses that are still needed, the most useful first each time."""
    steps, missing = [], float(knowledge.missing(knowledge.information))
    while missing > 0 and len(steps) < MOST_STEPS:
        index, worth, information = knowledge.best()
        if worth[index] < LEAST_GAIN:
            break
        steps.append(index)
        knowledge = replace(knowledge, information=information[index], up=DIRECTIONS[index])
        missing = float(knowledge.missing(knowledge.information))
    return steps


def knowledge_of(found: Findings, result: HandResult | None, options: HandOptions) -> HandKnowledge:
    """
    Return the HandKnowledge of a session.

    Before the first solution only the poses count, at nominal values and with the scatter of the settings. After it the information is that of
    the solution, less what its standard deviations have grown by beyond noise.
    """
    last = np.array([0.0, 0.0, 1.0]) if found.poses is None else _ups(found.poses)[-1]
    if result is None:
        return _at_first(found.poses, options, last)
    hand = result.hand
    model, statistics = hand.model, hand.statistics
    tolerances = MARGIN * model.tolerances(options.tolerances)
    sd = dict(zip(hand.param_names, hand.sd, strict=True))
    own = np.array([sd.get(name, 0.0) for name in model.param_names])
    expected = np.sqrt(np.diag(np.linalg.inv(hand.information + np.diag(1 / model.priors**2))))
    known = expected < 0.5 * model.priors
    wider = max(1.0, float(np.max(np.where(known, own / expected, 0.0))))**2
    poses = hand.poses
    return HandKnowledge(model, hand.state.values, hand.information / wider, tolerances,
                         float(np.hypot(np.sqrt(np.mean(poses.force_sem**2)), statistics['pose_scatter_sd'])) * np.sqrt(wider),
                         float(np.hypot(np.sqrt(np.mean(poses.rate_sem**2)), statistics['drift_scatter_sd'])) * np.sqrt(wider),
                         max(float(statistics['turn_scatter_sd']), 1e-4) * np.sqrt(wider), last)


def _at_first(poses: Poses | None, options: HandOptions, last: np.ndarray) -> HandKnowledge:
    model = HandModel(SensorModel(options.accelerometer or BASE, options.gyroscope or BASE, catalogue=options.catalogue), options.gravity)
    settings: ByHandSettings = options.settings
    knowledge = HandKnowledge(model, model.nominal, np.zeros((model.size, model.size)), MARGIN * model.tolerances(options.tolerances),
                              float(np.hypot(settings.pose_scatter, TREMBLING)), float(np.hypot(settings.drift_scatter, CREEPING)), settings.turn_scatter, last)
    if poses is None:
        return knowledge
    ups = _ups(poses)
    turns = [_turn_rows(start, end) for start, end in zip(ups[:-1], ups[1:], strict=True)]
    rows = knowledge.rows(model.norm_rows(model.nominal, poses.force)[1], [np.zeros((2, 9)), *turns])   # nothing leads to the first pose
    return replace(knowledge, information=np.einsum('kri,krj->ij', rows, rows))


def _ups(poses: Poses | None) -> np.ndarray:
    """Return the directions that were up, unit vectors, shape (k, 3)."""
    return np.zeros((0, 3)) if poses is None else poses.force / np.linalg.norm(poses.force, axis=1, keepdims=True)


def hand_coverage(found: Findings, result: HandResult | None, options: HandOptions, *, frame_id: str = '') -> Coverage:
    """Return the Coverage of a session by hand: the cells, the next pose with the turn that leads to it, and the seconds that are left."""
    seen = _ups(found.poses)
    up = None if found.poses is None else seen[-1]
    knowledge = knowledge_of(found, result, options)
    steps = [] if result is not None and set(result.hand.statuses) == {DETERMINED} else foretold(knowledge)
    if not steps:
        return Coverage(np.zeros(len(DIRECTIONS)), seen, up, Step(''), 0.0, frame_id=frame_id)
    _, worth, _ = knowledge.best()
    target = DIRECTIONS[steps[0]]
    axis, angle = shortest_turn(knowledge.up, target)
    return Coverage(worth, seen, up, Step(f'hold it still with {direction_words(target)} up', target, axis, angle), len(steps) * (HOLD + MOVE),
                    frame_id=frame_id)
