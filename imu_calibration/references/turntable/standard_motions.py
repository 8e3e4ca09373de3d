"""Standard motions of the sensor, for the prediction of their information."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.effects.motions import SENSOR_MOTIONS
from imu_calibration.effects.sensor_effects import VIBRATION_VARIANCE
from imu_calibration.kinematics.rotations import Reference, attitudes_with_vertical, rotation
from imu_calibration.kinematics.signal_history import TemperatureSlope, ThermalBranch
from imu_calibration.kinematics.sphere import DIRECTIONS

REST = 5.0
"""Duration of a rest, s."""
MOVE_TIME = 3.0
"""Time from one rest or piece to the next, s."""
MIN_AXIS_COSINE = 0.98
"""Cosine of the angle up to which a joint lies along a sensor axis."""
OTHER_MOUNT = (
    'mount the IMU at a different angle on the joint and record the same motion again, in addition'
    ' to this recording'
)
"""Advice when further motions of a single joint do not help."""
Axis = tuple[int, int, int]
"""A sensor axis."""
Pieces = Callable[[float], list[Reference]]
"""Function of gravity, m/s^2, that returns the pieces of a motion."""


@dataclass(frozen=True)
class Motion:
    """A standard motion of the sensor, to be carried out on the table or by hand."""

    name: str
    """Short name."""
    make: 'Pieces'
    """Function of gravity that returns pieces of the motion, each a Reference."""
    axis: Axis | None = None
    """The sensor axis of the turn; None: several axes, or several attitudes."""

    @property
    def text(self) -> str:
        """Instruction."""
        return SENSOR_MOTIONS[self.name]

    @cached_property
    def seconds(self) -> float:
        """Duration: rests with the move to the next one, and moving pieces."""
        seconds = 0.0
        for piece in self.make(STANDARD_GRAVITY):
            is_rest = len(piece) == 1
            seconds += MOVE_TIME + (REST if is_rest else float(piece.time[-1] - piece.time[0]))
        return seconds


def _turn(
    axis: ArrayLike,
    time: np.ndarray,
    *,
    angle: np.ndarray,
    rate: np.ndarray,
    alpha: np.ndarray,
    gravity: float,
    up: ArrayLike,
    arm: np.ndarray | None = None,
) -> Reference:
    """
    Return the reference of a sensor that turns about its own `axis`.

    Parameters
    ----------
    axis : array, shape (3,)
    time, angle, rate, alpha : array, shape (n,)
        s, rad, rad/s, rad/s^2.
    gravity : float
    up : array, shape (3,)
        The vertical in the sensor at angle zero, of any length.
    arm : array, shape (3,), optional
        Arm from the axis of the turn, m.

    """
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    up = np.asarray(up, float) / np.linalg.norm(up)
    up_s = rotation(-angle[:, None] * axis) @ up
    rate_s = rate[:, None] * axis
    alpha_s = alpha[:, None] * axis
    # f = g + alpha x r + omega x (omega x r)
    force = gravity * up_s
    if arm is not None:
        force = force + np.cross(alpha_s, arm) + np.cross(rate_s, np.cross(rate_s, arm))
    return Reference(
        time=time,
        mat_sn=attitudes_with_vertical(up_s),
        force_s=force,
        rate_s=rate_s,
        alpha_s=alpha_s,
        gravity=gravity,
    )


MOTION_TIME = np.arange(0.0, 30.0, 0.02)
"""Points in time of a moving piece, s."""
FACES_UP = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
"""The six faces turned up, in the sensor frame, shape (6, 3)."""
OSCILLATION_RATE = 2 * np.pi
"""Angular frequency of oscillations, rad/s."""
OSCILLATION_ANGLE = 30 * DEG
"""Amplitude of oscillations, rad."""
OBLIQUE = (0.3, 0.4, 1.0)
"""Default of the vertical in the sensor in oscillations."""


def _spin(
    axis: ArrayLike,
    speeds_deg_s: Sequence[float],
    up: ArrayLike | None = None,
    arm: np.ndarray | None = None,
) -> Pieces:
    """Return the pieces of spins about an axis, which is horizontal if no vertical is given."""
    still = np.zeros(len(MOTION_TIME))

    def make(gravity: float) -> list[Reference]:
        """Return a piece for each speed."""
        pieces = []
        for speed in speeds_deg_s:
            rate = np.full(len(MOTION_TIME), speed * DEG)
            pieces.append(
                _turn(
                    axis,
                    MOTION_TIME,
                    angle=speed * DEG * MOTION_TIME,
                    rate=rate,
                    alpha=still,
                    gravity=gravity,
                    up=np.roll(axis, 1) if up is None else up,
                    arm=arm,
                )
            )
        return pieces

    return make


def _oscillation(axis: ArrayLike, up: ArrayLike | None = None) -> Pieces:
    """Return the pieces of an oscillation ``a sin(w t)`` about an axis."""
    w = OSCILLATION_RATE
    a = OSCILLATION_ANGLE

    def make(gravity: float) -> list[Reference]:
        """Return the oscillation as one piece."""
        return [
            _turn(
                axis,
                MOTION_TIME,
                angle=a * np.sin(w * MOTION_TIME),
                rate=a * w * np.cos(w * MOTION_TIME),
                alpha=-a * w**2 * np.sin(w * MOTION_TIME),
                gravity=gravity,
                up=OBLIQUE if up is None else up,
            )
        ]

    return make


def _rest(up: ArrayLike, number: int, gravity: float) -> Reference:
    """Return a rest: one sample, a minute after the rest before it."""
    zero = np.zeros(1)
    time = zero + 60.0 * number
    return _turn((0, 0, 1), time, angle=zero, rate=zero, alpha=zero, gravity=gravity, up=up)


def _poses(directions: Iterable[np.ndarray], temperatures: Sequence[float] = ()) -> Pieces:
    """Return the pieces of rests with each direction up, once or at each temperature."""

    def make(gravity: float) -> list[Reference]:
        """Return a piece for each rest."""
        rests = [_rest(up, number, gravity) for number, up in enumerate(directions)]
        if not temperatures:
            return rests
        pieces = []
        branch = ThermalBranch()
        slope = TemperatureSlope()
        for step, temperature_c in enumerate(temperatures):
            temperature = np.full(1, temperature_c)
            stamp_ns = np.array([step * len(rests) * 60 * 10**9])
            thermal_branch = branch.of(temperature)
            warming = slope.of(stamp_ns, temperature)
            for rest in rests:
                pieces.append(
                    replace(rest, temperature_c=temperature, branch=thermal_branch, warming=warming)
                )
        return pieces

    return make


def _shaken(gravity: float) -> list[Reference]:
    """Return rests with each face up, quiet and while the sensor is shaken along each axis."""
    rests = [_rest(up, number, gravity) for number, up in enumerate(FACES_UP)]
    pieces = []
    for variance in (np.zeros(3), *VIBRATION_VARIANCE * np.eye(3)):
        pieces += [replace(rest, shaking=variance[None]) for rest in rests]
    return pieces


def _two_axis(gravity: float) -> list[Reference]:
    """
    Return turns at a rate w about one axis of the sensor, which itself turns at w about another.

    The rate about the second axis rotates in the sensor, ``w (cos, -sin)``, with the derivative
    ``-w^2 (sin, cos)``; the vertical rotates with it.
    """
    pieces = []
    w = 200 * DEG
    cos = np.cos(w * MOTION_TIME)
    sin = np.sin(w * MOTION_TIME)
    for inner, outer in ((0, 1), (1, 2), (2, 0)):
        third = 3 - inner - outer  # the remaining one of the axes 0, 1, 2
        rate, alpha, up = np.zeros((3, len(MOTION_TIME), 3))
        rate[:, inner] = w
        rate[:, outer] = w * cos
        rate[:, third] = -w * sin
        alpha[:, outer] = -w * w * sin
        alpha[:, third] = -w * w * cos
        up[:, outer] = cos
        up[:, third] = -sin
        pieces.append(
            Reference(MOTION_TIME, attitudes_with_vertical(up), gravity * up, rate, alpha, gravity)
        )
    return pieces


def _three_speeds(gravity: float) -> list[Reference]:
    """Return spins at three speeds about skewed axes and about the axes of the sensor."""
    pieces = []
    for axis in ((1, 1, 0), (0, 1, 1), (1, 0, 1), *AXIS_DIRECTIONS):
        pieces += _spin(axis, (-200, -100, -50, 50, 100, 200))(gravity)
    return pieces


def _centrifuge(gravity: float) -> list[Reference]:
    """Return fast spins about each axis, the sensor on an arm perpendicular to it."""
    pieces = []
    for axis in np.eye(3):
        pieces += _spin(axis, (-300, 300), arm=0.3 * np.roll(axis, 1))(gravity)
    return pieces


def _rings() -> np.ndarray:
    """Return directions every 15 degrees on the three coordinate circles, shape (72, 3)."""
    angle = np.arange(0, 2 * np.pi, np.pi / 12)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return np.concatenate([np.roll(circle, axis, axis=1) for axis in range(3)])


SPINS = (-200, -100, 100, 200)
"""Speeds of a spin, deg/s."""
AXIS_DIRECTIONS: tuple[Axis, ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def _spins_about(axis: Axis, up: ArrayLike | None = None) -> Motion:
    """Return the motion of spins about an axis of the sensor."""
    return Motion(f'spin_{"xyz"[axis.index(1)]}', _spin(axis, SPINS, up), axis)


def _oscillates_about(axis: Axis, up: ArrayLike | None = None) -> Motion:
    """Return the motion of an oscillation about an axis of the sensor."""
    return Motion(f'oscillate_{"xyz"[axis.index(1)]}', _oscillation(axis, up), axis)


MOTIONS = (
    Motion('static_poses', _poses(DIRECTIONS)),
    Motion('static_dense', _poses(_rings())),
    *(_spins_about(axis) for axis in AXIS_DIRECTIONS),
    Motion('three_speeds', _three_speeds),
    *(_oscillates_about(axis) for axis in AXIS_DIRECTIONS),
    Motion('two_axis', _two_axis),
    Motion('centrifuge', _centrifuge),
    Motion('warm_up', _poses(FACES_UP, (15.0, 25.0, 35.0))),
    Motion('warm_and_cool', _poses(FACES_UP, (20.0, 25.0, 30.0, 25.0, 20.0))),
    Motion('shake', _shaken),
)
"""The motions of `effects.motions.SENSOR_MOTIONS`, in that order."""


def motions_about(axis_s: np.ndarray, up_s: np.ndarray) -> tuple[Motion, ...]:
    """
    Return the motions of a table that turns the sensor about one axis only.

    No motions where that is no axis of the sensor. Gravity has the same direction relative to the
    axis as on the table: for a vertical axis it is constant in the sensor frame.

    Parameters
    ----------
    axis_s, up_s : array, shape (3,)
        Unit vectors of the axis and of the vertical, sensor frame, at any angle of the joint.

    """
    for axis in AXIS_DIRECTIONS:
        cosine = np.dot(axis, axis_s)
        if abs(float(cosine)) > MIN_AXIS_COSINE:
            break
    else:
        return ()
    # Component of the vertical along the axis; the remaining one is along the next axis.
    up_along_axis = float(np.clip(np.dot(axis_s, up_s) * np.sign(cosine), -1.0, 1.0))
    up_across = np.sqrt(1.0 - up_along_axis**2)
    up = up_along_axis * np.array(axis, float) + up_across * np.roll(axis, 1)
    return _motions_about(axis, tuple(up.tolist()))


@lru_cache(maxsize=16)
def _motions_about(axis: Axis, up: tuple[float, ...]) -> tuple[Motion, ...]:
    """Return the same objects for the same axis, as their columns are cached by motion."""
    return _spins_about(axis, up), _oscillates_about(axis, up)


REST_WITH_UP = tuple(Motion('rest', _poses([up])) for up in DIRECTIONS)
"""A rest with each of `DIRECTIONS` up."""
