"""Standard motions of a table, each one minute long: recommendations for the next recording."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.signal_history import ThermalBranch

REST, WAY = 5.0, 3.0
"""s; a rest, and the time from one rest to the next."""
ALONG = 0.98
"""Cosine of the angle up to which a joint lies along a sensor axis."""
OTHER_MOUNT = 'mount the IMU at a different angle on the joint and record the same motion again, in addition to this recording'
"""Advice when further motions of a single joint do not help."""


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
        return sum(REST + WAY if len(piece) == 1 else float(piece.time[-1] - piece.time[0]) + WAY for piece in self.make(STANDARD_GRAVITY))


def _turn(axis, time, angle, rate, alpha, gravity, up, temperature_c=None, arm=None, branch=None,
          shaking=None):
    """Return the reference of a sensor that turns about its own `axis`; `up` is the vertical in the sensor at angle zero."""
    axis, up = np.asarray(axis, float) / np.linalg.norm(axis), np.asarray(up, float) / np.linalg.norm(up)
    cos, sin = np.cos(angle)[:, None], -np.sin(angle)[:, None]
    up_s = up * cos + np.cross(axis, up) * sin + axis * (axis @ up) * (1 - cos)
    rate_s, alpha_s = rate[:, None] * axis, alpha[:, None] * axis
    force = gravity * up_s
    if arm is not None:
        force = force + np.cross(alpha_s, arm) + np.cross(rate_s, np.cross(rate_s, arm))
    return Reference(time, _attitudes(up_s), force, rate_s, alpha_s, gravity, temperature_c, branch,
                     None if shaking is None else np.tile(shaking, (len(time), 1)))


def _attitudes(up_s):
    """Return attitudes whose third column is the vertical; the heading is arbitrary."""
    other = np.eye(3)[np.argmin(np.abs(up_s), axis=1)]
    first = np.cross(other, up_s)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(up_s, first), up_s], axis=2)


TIME = np.arange(0.0, 30.0, 0.02)
SHAKEN = 0.05
"""Residual variance of a machine's vibration in the band, (m/s^2)^2."""


EDGES = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)]


def _spin(axis, speeds, up=None, arm=None):
    def make(gravity):
        across = np.roll(axis, 1) if up is None else up
        return [_turn(axis, TIME, s * DEG * TIME, np.full(len(TIME), s * DEG), np.zeros(len(TIME)), gravity, across, arm=arm)
                for s in speeds]
    return make


def _oscillation(axis, degrees, hertz, up=None):
    def make(gravity):
        w, a = 2 * np.pi * hertz, degrees * DEG
        return [_turn(axis, TIME, a * np.sin(w * TIME), a * w * np.cos(w * TIME), -a * w**2 * np.sin(w * TIME), gravity,
                      (0.3, 0.4, 1.0) if up is None else up)]
    return make


def _poses(directions, temperatures=(None,)):
    def make(gravity):
        one, way, pieces = np.zeros(1), ThermalBranch(), []
        for t in temperatures:
            warmth = {} if t is None else {'temperature_c': np.full(1, t), 'branch': way.of(np.full(1, t))}
            pieces += [_turn((0, 0, 1), one + 60.0 * k, one, one, one, gravity, up, **warmth) for k, up in enumerate(directions)]
        return pieces
    return make


def _shaken(gravity):
    """Rest in six faces, quiet and while the sensor is shaken along each axis."""
    one, shakes = np.zeros(1), (np.zeros(3), *SHAKEN * np.eye(3))
    return [_turn((0, 0, 1), one + 60.0 * k, one, one, one, gravity, up, shaking=shaking)
            for shaking in shakes for k, up in enumerate(sign * row for row in np.eye(3) for sign in (1, -1))]


def rest_with_up(up: tuple | np.ndarray) -> 'Motion':
    """Return the motion of a rest with one direction of the sensor up."""
    return Motion('rest', 'rest', _poses([tuple(up)]))


def _two_axis(gravity):
    """Turn about an axis that itself turns: rates about two axes at once, with the cross term in the angular acceleration."""
    pieces = []
    for inner, outer in ((0, 1), (1, 2), (2, 0)):
        w = 200 * DEG
        rate, alpha = np.zeros((len(TIME), 3)), np.zeros((len(TIME), 3))
        third = 3 - inner - outer
        rate[:, inner] = w
        rate[:, outer], rate[:, third] = w * np.cos(w * TIME), -w * np.sin(w * TIME)
        alpha[:, outer], alpha[:, third] = -w * w * np.sin(w * TIME), -w * w * np.cos(w * TIME)
        up = np.zeros((len(TIME), 3))
        up[:, outer], up[:, third] = np.cos(w * TIME), -np.sin(w * TIME)
        pieces.append(Reference(TIME, _attitudes(up), gravity * up, rate, alpha, gravity))
    return pieces


def _fine_poses():
    angle = np.arange(0, 2 * np.pi, np.pi / 12)
    rings = [np.roll(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), k, axis=1) for k in range(3)]
    return [tuple(v) for v in np.concatenate(rings)]


SPINS = (-200, -100, 100, 200)
"""Speeds of a spin, deg/s."""
AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def _spins_about(axis, up=None):
    name = 'xyz'[axis.index(1)]
    return Motion(f'spin_{name}', f"spin about the sensor's {name} axis at 100 and 200 deg/s in both senses", _spin(axis, SPINS, up), axis)


def _oscillates_about(axis, up=None):
    name = 'xyz'[axis.index(1)]
    return Motion(f'oscillate_{name}', f"oscillate about the sensor's {name} axis, 30 deg at 1 Hz", _oscillation(axis, 30, 1.0, up), axis)


MOTIONS = (
    Motion('static_poses', 'rest in six faces and twelve edge positions, at several headings', _poses(EDGES)),
    Motion('static_dense', 'rest every 15 degrees on three rings', _poses(_fine_poses())),
    *(_spins_about(axis) for axis in AXES),
    Motion('three_speeds', 'spin about skewed axes at 50, 100 and 200 deg/s in both senses', lambda g: [
        piece for axis in ((1, 1, 0), (0, 1, 1), (1, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1))
        for piece in _spin(axis, (-200, -100, -50, 50, 100, 200))(g)]),
    *(_oscillates_about(axis) for axis in AXES),
    Motion('two_axis', 'turn about two axes at once at 200 deg/s, for each pair of axes', _two_axis),
    Motion('centrifuge', 'spin at 300 deg/s on an arm of 0.3 m, about each axis', lambda g: [
        piece for k in range(3) for piece in _spin(np.eye(3)[k], (-300, 300), arm=0.3 * np.roll(np.eye(3)[k], 1))(g)]),
    Motion('warm_up', 'rest in six faces, cold and warm',
           _poses([tuple(s * np.eye(3)[k]) for k in range(3) for s in (1, -1)], (15.0, 25.0, 35.0))),
    Motion('warm_and_cool', 'rest in six faces while it warms up by ten kelvins, and again while it cools',
           _poses([tuple(s * np.eye(3)[k]) for k in range(3) for s in (1, -1)], (20.0, 25.0, 30.0, 25.0, 20.0))),
    Motion('shake', 'rest in six faces, quiet and while a machine shakes the sensor along each axis', _shaken),
)
"""Standard motions of the sensor; motions of table joints are named by the effects that need them."""


def motions_about(axis_s: np.ndarray, up_s: np.ndarray) -> tuple[Motion, ...]:
    """
    Return the motions of a table that turns the sensor about one axis only: none where that is no axis of the sensor.

    Gravity has the same direction relative to the axis as on the table: for a vertical axis it is constant in the sensor frame.

    Parameters
    ----------
    axis_s, up_s : array, shape (3,)
        Unit vectors of the axis and of the vertical, sensor frame, at any angle of the joint.

    """
    along = [axis for axis in AXES if abs(float(np.dot(axis, axis_s))) > ALONG]
    if not along:
        return ()
    share = float(np.clip(np.dot(axis_s, up_s) * np.sign(np.dot(along[0], axis_s)), -1.0, 1.0))
    up = share * np.array(along[0], float) + np.sqrt(1.0 - share**2) * np.roll(along[0], 1)
    return _spins_about(along[0], tuple(up)), _oscillates_about(along[0], tuple(up))


TABLE_MOTIONS = {
    'turn_about_vertical': 'turn slowly through a full circle about the vertical, resting at several headings',
    'slow_turn': 'turn each joint slowly through full circles, with the sensor mounted at two attitudes',
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz about two axes, in both phases',
    'fast_spin': 'spin slowly up to the fastest rate in both senses',
}
"""Motions that concern the table or the clock; their gain depends on the table and is not predicted."""
ONE_JOINT = {
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz',
    'fast_spin': TABLE_MOTIONS['fast_spin'],
    'slow_turn': 'turn the joint slowly through full circles',
    'warm_up': 'rest in several places, cold and warm',
    'warm_and_cool': 'rest in several places while it warms up by ten kelvins, and again while it cools',
    'shake': 'rest in several places, quiet and while a machine shakes the table',
}
"""The motions that a table of one joint can do; the other ones require a remounted IMU."""
