"""Smooth motion through the points of a joint trajectory, as a table's controller would drive it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.errors import InputError
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.simulation.motion_builder import Profile


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """
    Polynomials of degree five between points; at rest after the last.

    Each piece meets position, rate and acceleration at both ends. Where the points give no accelerations they are zero, where they
    give no rates these are zero too: the joints then stop at every point.
    """

    time: np.ndarray
    """Times of the points, s, rising, shape (n,)."""
    position: np.ndarray
    """Angles, rad, shape (n, n_joints)."""
    rate: np.ndarray
    """Rates, rad/s, shape (n, n_joints)."""
    acceleration: np.ndarray
    """Accelerations, rad/s^2, shape (n, n_joints)."""

    @property
    def end(self) -> float:
        """Time of the last point, s."""
        return float(self.time[-1])

    def at(self, time: Sequence[float] | np.ndarray) -> JointMotion:
        """Return the JointMotion at `time`, shape (m,): before the first point as there at rest, after the last at rest."""
        time = np.atleast_1d(np.asarray(time, float))
        inside = np.clip(time, self.time[0], self.time[-1])
        piece = np.clip(np.searchsorted(self.time, inside, side='right') - 1, 0, len(self.time) - 2)
        length = np.diff(self.time)[piece][:, None]
        share = (inside - self.time[piece])[:, None] / length
        coefficients = self._coefficients(piece, length)
        motion = [_polynomial(coefficients, share, order) / length**order for order in range(4)]
        outside = (time < self.time[0]) | (time > self.time[-1])
        for derivative in motion[1:]:
            derivative[outside] = 0.0
        return JointMotion(time, *motion)

    def _coefficients(self, piece, length):
        """Return the six coefficients in the share of the piece, lowest degree first, each shape (m, n_joints)."""
        p0, p1 = self.position[piece], self.position[piece + 1]
        v0, v1 = self.rate[piece] * length, self.rate[piece + 1] * length
        a0, a1 = self.acceleration[piece] * length**2 / 2, self.acceleration[piece + 1] * length**2 / 2
        d, e, f = p1 - p0 - v0 - a0, v1 - v0 - 2 * a0, 2 * (a1 - a0)
        return p0, v0, a0, 10 * d - 4 * e + f / 2, -15 * d + 7 * e - f, 6 * d - 3 * e + f / 2


def _polynomial(coefficients, share, order):
    """Return the derivative of an order of the polynomial, by the share."""
    total = np.zeros_like(coefficients[0])
    for degree, coefficient in enumerate(coefficients):
        if degree >= order:
            factor = np.prod(np.arange(degree - order + 1, degree + 1)) if order else 1.0
            total = total + factor * coefficient * share**(degree - order)
    return total


def trajectory_from(start: JointMotion, time: Sequence[float], position: np.ndarray, *, rate: np.ndarray | None = None,
                    acceleration: np.ndarray | None = None) -> JointTrajectory:
    """
    Return the JointTrajectory from the present motion through points.

    Parameters
    ----------
    start : JointMotion
        One row: where the joints are when the trajectory begins.
    time : array, shape (n,)
        Seconds from the beginning.
    position : array, shape (n, n_joints)
    rate, acceleration : array, optional
        At the points.

    Raises
    ------
    InputError
        When the points do not fit together.

    """
    time, position = np.asarray(time, float), np.asarray(position, float)
    if not len(time) or position.shape != (len(time), start.position.shape[1]):
        raise InputError(f'a trajectory must have points with {start.position.shape[1]} positions each, got {position.shape}; '
                         'name every joint of the table')
    if np.any(np.diff(np.concatenate([[0.0], time])) <= 0):
        raise InputError('the times of a trajectory must rise from above zero, they do not; correct time_from_start')
    rate = np.zeros_like(position) if rate is None else np.asarray(rate, float)
    acceleration = np.zeros_like(position) if acceleration is None else np.asarray(acceleration, float)
    parts = [np.concatenate([getattr(start, name)[:1], points])
             for name, points in (('position', position), ('rate', rate), ('acceleration', acceleration))]
    if not all(np.all(np.isfinite(part)) for part in parts):
        raise InputError('every number of a trajectory must be finite, some are not; correct the points')
    return JointTrajectory(np.concatenate([[0.0], time]) + start.time[0], *parts)


class TableMotion:
    """
    What the table does: a profile, once or again and again, until a trajectory takes over.

    Parameters
    ----------
    profile : Profile or None
        None: rest at zero until a trajectory comes.
    n_joints : int
    repeat : bool
        Whether the profile starts again at its end, from the angles reached.

    """

    def __init__(self, profile: Profile | None, n_joints: int, repeat: bool = False):
        self._profile, self._n_joints, self._repeat = profile, n_joints, repeat
        self._trajectory: JointTrajectory | None = None

    @property
    def end(self) -> float:
        """When the motion ends, s; infinite when it repeats or waits for trajectories."""
        return np.inf if self._profile is None or self._repeat or self._trajectory is not None else self._profile.duration

    def follow(self, now: float, **points: Any) -> None:
        """Let a trajectory take over at the time `now`; the points as for `trajectory_from`."""
        self._trajectory = trajectory_from(self.at(np.array([now])), **points)

    def at(self, time: np.ndarray) -> JointMotion:
        """Return the JointMotion at `time`, shape (m,)."""
        if self._trajectory is not None:
            return self._trajectory.at(time)
        if self._profile is None:
            zero = np.zeros((len(time), self._n_joints))
            return JointMotion(time, zero, zero.copy(), zero.copy(), zero.copy())
        if not self._repeat:
            return self._profile.at(time)
        turns = np.floor(time / self._profile.duration)
        motion = self._profile.at(time - turns * self._profile.duration)
        first, last = self._profile.at(np.array([0.0, self._profile.duration])).position
        return JointMotion(time, motion.position + turns[:, None] * (last - first), motion.rate, motion.acceleration, motion.jerk)
