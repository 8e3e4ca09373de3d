"""Observability of parameters in standard motions."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.effects.sensor_effects import VIBRATION_VARIANCE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import Reference, rotation
from imu_calibration.kinematics.signal_history import ThermalBranch

REST, WAY = 5.0, 3.0
"""s; a rest, and the time from one rest to the next."""
MIN_AXIS_COSINE = 0.98
"""Cosine of the angle up to which a joint lies along a sensor axis."""
OTHER_MOUNT = (
    'mount the IMU at a different angle on the joint and record the same motion again, in addition'
    ' to this recording'
)
"""Advice when further motions of a single joint do not help."""


def sd_excess(sd: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """
    Return the excess of standard deviations over their tolerances.

    ``sum log max(sd / tolerance, 1)``; leading axes are kept.
    """
    return np.log(np.maximum(sd / tolerances, 1.0)).sum(axis=-1)


def share_gained(before: float, after: np.ndarray) -> np.ndarray:
    """Return the share of the excess that is removed, 0 to 1."""
    return np.clip((before - after) / before, 0.0, 1.0) if before > 0 else np.zeros_like(after)


@dataclass(frozen=True)
class Motion:
    """A standard motion of the sensor, to be carried out on the table or by hand."""

    name: str
    """Short name."""
    text: str
    """Instruction."""
    make: Callable[[float], Sequence[Reference]]
    """Function of gravity that returns pieces of the motion, each a Reference."""
    axis: tuple | None = None
    """The sensor axis of the turn; None: several axes, or several attitudes."""

    @property
    def seconds(self) -> float:
        """Duration: rests with the move to the next one, and moving pieces."""
        return sum(
            REST + WAY if len(piece) == 1 else float(piece.time[-1] - piece.time[0]) + WAY
            for piece in self.make(STANDARD_GRAVITY)
        )


def _turn(
    axis,
    time,
    angle,
    rate,
    alpha,
    gravity,
    up,
    temperature_c=None,
    arm=None,
    branch=None,
    shaking=None,
):
    """
    Return the reference of a sensor that turns about its own `axis`.

    `up` is the vertical in the sensor at angle zero.
    """
    axis, up = (
        np.asarray(axis, float) / np.linalg.norm(axis),
        np.asarray(up, float) / np.linalg.norm(up),
    )
    up_s = rotation(-angle[:, None] * axis) @ up
    rate_s, alpha_s = rate[:, None] * axis, alpha[:, None] * axis
    force = gravity * up_s
    if arm is not None:
        force = force + np.cross(alpha_s, arm) + np.cross(rate_s, np.cross(rate_s, arm))
    return Reference(
        time,
        _attitudes(up_s),
        force,
        rate_s,
        alpha_s,
        gravity,
        temperature_c,
        branch,
        None if shaking is None else np.tile(shaking, (len(time), 1)),
    )


def _attitudes(up_s):
    """Return attitudes whose third column is the vertical; the heading is arbitrary."""
    other = np.eye(3)[np.argmin(np.abs(up_s), axis=1)]
    first = np.cross(other, up_s)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(up_s, first), up_s], axis=2)


MOTION_TIME = np.arange(0.0, 30.0, 0.02)
DIRECTIONS = np.array(
    [np.array(d) / np.linalg.norm(d) for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
)
"""Six faces, twelve edges and eight corners turned up, in the sensor frame, shape (26, 3)."""
FACES_UP = [sign * row for row in np.eye(3) for sign in (1, -1)]
"""The six faces turned up, in the sensor frame."""


def _spin(axis, speeds, up=None, arm=None):
    def make(gravity):
        across = np.roll(axis, 1) if up is None else up
        return [
            _turn(
                axis,
                MOTION_TIME,
                s * DEG * MOTION_TIME,
                np.full(len(MOTION_TIME), s * DEG),
                np.zeros(len(MOTION_TIME)),
                gravity,
                across,
                arm=arm,
            )
            for s in speeds
        ]

    return make


def _oscillation(axis, up=None):
    def make(gravity):
        w, a = 2 * np.pi, 30 * DEG
        return [
            _turn(
                axis,
                MOTION_TIME,
                a * np.sin(w * MOTION_TIME),
                a * w * np.cos(w * MOTION_TIME),
                -a * w**2 * np.sin(w * MOTION_TIME),
                gravity,
                (0.3, 0.4, 1.0) if up is None else up,
            )
        ]

    return make


def _poses(directions, temperatures=(None,)):
    def make(gravity):
        one, way, pieces = np.zeros(1), ThermalBranch(), []
        for t in temperatures:
            warmth = (
                {}
                if t is None
                else {'temperature_c': np.full(1, t), 'branch': way.of(np.full(1, t))}
            )
            pieces += [
                _turn((0, 0, 1), one + 60.0 * k, one, one, one, gravity, up, **warmth)
                for k, up in enumerate(directions)
            ]
        return pieces

    return make


def _shaken(gravity):
    """Rest in six faces, quiet and while the sensor is shaken along each axis."""
    one, shakes = np.zeros(1), (np.zeros(3), *VIBRATION_VARIANCE * np.eye(3))
    return [
        _turn((0, 0, 1), one + 60.0 * k, one, one, one, gravity, up, shaking=shaking)
        for shaking in shakes
        for k, up in enumerate(FACES_UP)
    ]


def rest_with_up(up: np.ndarray) -> 'Motion':
    """Return the motion of a rest with one direction of the sensor up."""
    return Motion('rest', 'rest', _poses([up]))


def _two_axis(gravity):
    """
    Turn about an axis that itself turns.

    Rates about two axes at once, with the cross term in the angular acceleration.
    """
    pieces = []
    for inner, outer in ((0, 1), (1, 2), (2, 0)):
        w = 200 * DEG
        rate, alpha = np.zeros((len(MOTION_TIME), 3)), np.zeros((len(MOTION_TIME), 3))
        third = 3 - inner - outer
        rate[:, inner] = w
        rate[:, outer], rate[:, third] = w * np.cos(w * MOTION_TIME), -w * np.sin(w * MOTION_TIME)
        alpha[:, outer], alpha[:, third] = (
            -w * w * np.sin(w * MOTION_TIME),
            -w * w * np.cos(w * MOTION_TIME),
        )
        up = np.zeros((len(MOTION_TIME), 3))
        up[:, outer], up[:, third] = np.cos(w * MOTION_TIME), -np.sin(w * MOTION_TIME)
        pieces.append(Reference(MOTION_TIME, _attitudes(up), gravity * up, rate, alpha, gravity))
    return pieces


def _fine_poses():
    angle = np.arange(0, 2 * np.pi, np.pi / 12)
    return np.concatenate(
        [
            np.roll(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), k, axis=1)
            for k in range(3)
        ]
    )


SPINS = (-200, -100, 100, 200)
"""Speeds of a spin, deg/s."""
AXIS_DIRECTIONS = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def _spins_about(axis, up=None):
    name = 'xyz'[axis.index(1)]
    return Motion(
        f'spin_{name}',
        f"spin about the sensor's {name} axis at 100 and 200 deg/s in both senses",
        _spin(axis, SPINS, up),
        axis,
    )


def _oscillates_about(axis, up=None):
    name = 'xyz'[axis.index(1)]
    return Motion(
        f'oscillate_{name}',
        f"oscillate about the sensor's {name} axis, 30 deg at 1 Hz",
        _oscillation(axis, up),
        axis,
    )


MOTIONS = (
    Motion(
        'static_poses',
        'rest in six faces and twelve edge positions, at several headings',
        _poses(DIRECTIONS),
    ),
    Motion('static_dense', 'rest every 15 degrees on three rings', _poses(_fine_poses())),
    *(_spins_about(axis) for axis in AXIS_DIRECTIONS),
    Motion(
        'three_speeds',
        'spin about skewed axes at 50, 100 and 200 deg/s in both senses',
        lambda g: [
            piece
            for axis in ((1, 1, 0), (0, 1, 1), (1, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))
            for piece in _spin(axis, (-200, -100, -50, 50, 100, 200))(g)
        ],
    ),
    *(_oscillates_about(axis) for axis in AXIS_DIRECTIONS),
    Motion(
        'two_axis', 'turn about two axes at once at 200 deg/s, for each pair of axes', _two_axis
    ),
    Motion(
        'centrifuge',
        'spin at 300 deg/s on an arm of 0.3 m, about each axis',
        lambda g: [
            piece
            for k in range(3)
            for piece in _spin(np.eye(3)[k], (-300, 300), arm=0.3 * np.roll(np.eye(3)[k], 1))(g)
        ],
    ),
    Motion('warm_up', 'rest in six faces, cold and warm', _poses(FACES_UP, (15.0, 25.0, 35.0))),
    Motion(
        'warm_and_cool',
        'rest in six faces while it warms up by ten kelvins, and again while it cools',
        _poses(FACES_UP, (20.0, 25.0, 30.0, 25.0, 20.0)),
    ),
    Motion(
        'shake',
        'rest in six faces, quiet and while a machine shakes the sensor along each axis',
        _shaken,
    ),
)
"""
Standard motions of the sensor; motions of table joints are named by the effects that need them.
"""


def motions_about(axis_s: np.ndarray, up_s: np.ndarray) -> tuple[Motion, ...]:
    """
    Return the motions of a table that turns the sensor about one axis only.

    None where that is no axis of the sensor.

    Gravity has the same direction relative to the axis as on the table: for a vertical axis it is
    constant in the sensor frame.

    Parameters
    ----------
    axis_s, up_s : array, shape (3,)
        Unit vectors of the axis and of the vertical, sensor frame, at any angle of the joint.

    """
    along = [axis for axis in AXIS_DIRECTIONS if abs(float(np.dot(axis, axis_s))) > MIN_AXIS_COSINE]
    if not along:
        return ()
    share = float(np.clip(np.dot(axis_s, up_s) * np.sign(np.dot(along[0], axis_s)), -1.0, 1.0))
    up = share * np.array(along[0], float) + np.sqrt(1.0 - share**2) * np.roll(along[0], 1)
    return _spins_about(along[0], tuple(up)), _oscillates_about(along[0], tuple(up))


TABLE_MOTIONS = {
    'turn_about_vertical': (
        'turn slowly through a full circle about the vertical, resting at several headings'
    ),
    'slow_turn': (
        'turn each joint slowly through full circles, with the sensor mounted at two attitudes'
    ),
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz about two axes, in both phases',
    'fast_spin': 'spin slowly up to the fastest rate in both senses',
}
"""
Motions that concern the table or the clock; their gain depends on the table and is not predicted.
"""
ALL_MOTIONS = {motion.name: motion.text for motion in MOTIONS} | TABLE_MOTIONS
"""Name -> instruction."""
ONE_JOINT = {
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz',
    'fast_spin': TABLE_MOTIONS['fast_spin'],
    'slow_turn': 'turn the joint slowly through full circles',
    'warm_up': 'rest in several places, cold and warm',
    'warm_and_cool': (
        'rest in several places while it warms up by ten kelvins, and again while it cools'
    ),
    'shake': 'rest in several places, quiet and while a machine shakes the table',
}
"""The motions that a table of one joint can do; the other ones require a remounted IMU."""


def added_information(
    model: SensorModel,
    values: np.ndarray,
    noise: dict[str, NoiseModel],
    *,
    motion: Motion,
    gravity: float,
) -> np.ndarray:
    """
    Return the information matrix that one minute of a standard motion would add.

    Shape (n_params, n_params).

    Each piece counts as one window at 100 Hz with the noise and the between-window scatter of this
    session.
    """
    total = np.zeros((len(values), len(values)))
    slopes = {sensor: coefficient_jacobian(model, sensor, values) for sensor in SENSORS}
    for piece in motion.make(gravity):
        for sensor in SENSORS:
            total += _piece_information(model.layout(sensor), slopes[sensor], noise[sensor], piece)
    return total


def _piece_information(layout, dc, noise, piece):
    design = np.concatenate(
        [_columns(layout, name, rows, piece) for name, rows in layout.rows.items()], axis=1
    )
    static = len(piece) == 1
    count = 500.0 if static else 2.0 * len(piece)
    mean = design.mean(axis=0)
    within = (design - mean).T @ (design - mean) * (0.0 if static else 2.0)
    information = np.zeros((dc.shape[2], dc.shape[2]))
    for axis in range(3):
        rows = mean @ dc[:, axis]
        variance = noise.low_variance[axis]
        information += np.outer(rows, rows) / (
            variance / count + noise.offset_sd**2 + noise.bias_variance
        )
        information += dc[:, axis].T @ within @ dc[:, axis] / variance
    return information


def _columns(layout, name, rows, piece):
    """
    Return the columns of a group.

    Zeros where the motion has no temperature or no joints, and for columns of a warp.
    """
    group = layout.groups.get(name)
    unknown = (
        group is None
        or (piece.temperature_c is None and 'temperature' in group.uses)
        or (piece.motion is None and bool(group.uses & {'joint angle', 'joint rate'}))
    )
    return (
        np.zeros((len(piece), rows.stop - rows.start))
        if unknown
        else group.columns(piece, layout.point)
    )


def tolerance_scaled_singular_values(information: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """
    Return the singular values of the scaled design, descending.

    The design has its parameters in units of their tolerance.

    A value of one means that the direction is determined to one tolerance; below one it is weak.
    Rank is no sufficient criterion.
    """
    scaled = information * np.outer(tolerances, tolerances)
    return np.sqrt(np.clip(scipy.linalg.eigvalsh((scaled + scaled.T) / 2)[::-1], 0, None))


def weak_directions(
    covariance: np.ndarray, tolerances: np.ndarray, names: Sequence[str], *, limit: int = 6
) -> list[dict[str, float]]:
    """
    Return the directions in which the standard deviation exceeds the tolerance, worst first.

    Returns
    -------
    list of dict
        {name: weight}, the weights in tolerances, members below 0.2 of the largest left out.

    """
    scaled = covariance / np.outer(tolerances, tolerances)
    variances, vectors = scipy.linalg.eigh((scaled + scaled.T) / 2)
    found = []
    for variance, vector in sorted(zip(variances, vectors.T), key=lambda pair: -pair[0]):
        if variance <= 1.0 or len(found) >= limit:
            break
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        strong = np.abs(vector) >= 0.2 * np.max(np.abs(vector))
        found.append(
            {names[k]: round(float(vector[k]), 3) for k in np.flatnonzero(strong).tolist()}
        )
    return found


def needed_motions(
    solution: Solution,
    tolerances: np.ndarray,
    gravity: float,
    *,
    prior_sd: np.ndarray,
    possible: Sequence[Motion] | None = None,
) -> dict[str, tuple[str, float]]:
    """
    Return the most helpful standard motion for each undetermined parameter.

    It is the motion that reduces the standard deviation of the parameter most.

    Every motion of the catalogue is tried: its information is added, and the predicted standard
    errors are compared with the tolerances. A table that turns the sensor about one axis only can
    do few of them (`possible`): where none of these would help, the IMU must be remounted.

    Returns
    -------
    dict
        Parameter name -> (motion text, predicted standard deviation).

    """
    lacking = np.flatnonzero(solution.sd > tolerances)
    if not len(lacking):
        return {}
    base = solution.information + np.diag(1 / prior_sd**2)
    before, predicted = _sd_of(base), {}
    for motion in MOTIONS if possible is None else possible:
        total = base + added_information(
            solution.model, solution.values, solution.noise, motion=motion, gravity=gravity
        )
        predicted[motion] = _sd_of(total) * np.maximum(
            solution.sd / before, 1.0
        )  # the model error remains
    return {
        solution.param_names[k]: _best(solution, k, predicted, one_joint=possible is not None)
        for k in lacking
    }


def _sd_of(information):
    return np.sqrt(np.clip(np.diag(inverse_normal(information)), 1e-300, None))


def _best(solution, index, predicted, one_joint):
    """
    Return (text, predicted sd) of the best motion.

    Where none helps, another mount or the motion of the effect, and NaN.
    """
    motion = min(predicted, key=lambda m: predicted[m][index], default=None)
    if motion is not None and predicted[motion][index] <= 0.7 * solution.sd[index]:
        return motion.text, float(predicted[motion][index])
    if one_joint:
        return OTHER_MOUNT, float('nan')
    owner = next(
        e for e in solution.model.effects if solution.param_names[index] in e.param_names()
    )
    return ALL_MOTIONS[owner.motion[0]], float('nan')
