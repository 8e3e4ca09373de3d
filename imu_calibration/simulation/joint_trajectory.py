"""The spline that a joint trajectory controller lays through the points of a trajectory."""

from dataclasses import dataclass
from functools import cached_property
from math import perm

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.motion_limits import MotionLimits
from imu_calibration.kinematics.trajectory_points import TrajectoryPoints

PEAK_ACCELERATION_OF_BRAKING = 1.5
"""Largest acceleration while a joint brakes, in units of its rate over the duration."""
SHORTEST_BRAKING = 1e-3
"""Least braking time, s."""


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """
    Polynomials between points, at rest before the first and after the last.

    As in joint_trajectory_controller: of degree five where the points give velocities and accelerations, of degree three with only
    velocities, straight lines with only positions, so that the velocity jumps at every point.
    """

    time: np.ndarray
    """Times of the points, s, rising, shape (n,), n at least 2."""
    position: np.ndarray
    """Angles, rad, shape (n, n_joints)."""
    rate: np.ndarray | None = None
    """Rates, rad/s, shape (n, n_joints)."""
    acceleration: np.ndarray | None = None
    """Accelerations, rad/s^2, shape (n, n_joints)."""

    @property
    def end(self) -> float:
        """Time of the last point, s."""
        return float(self.time[-1])

    def at(self, time: np.ndarray) -> JointMotion:
        """Return the JointMotion at `time`, shape (m,): before the first point as there at rest, after the last at rest."""
        time = np.atleast_1d(np.asarray(time, float))
        inside = np.clip(time, self.time[0], self.time[-1])
        piece = np.clip(np.searchsorted(self.time, inside, side='right') - 1, 0, len(self.time) - 2)
        length = np.diff(self.time)[piece][:, None]
        share = (inside - self.time[piece])[:, None] / length
        coefficients = [coefficient[piece] for coefficient in self._coefficients]
        powers = [share**degree for degree in range(len(coefficients))]
        motion = [_polynomial(coefficients, powers, order) / length**order for order in range(4)]
        outside = (time < self.time[0]) | (time > self.time[-1])
        for derivative in motion[1:]:
            derivative[outside] = 0.0
        return JointMotion(time, *motion)

    @cached_property
    def _coefficients(self):
        """Coefficients in the share of the piece, lowest degree first, each shape (n - 1, n_joints)."""
        length, p0, d = np.diff(self.time)[:, None], self.position[:-1], np.diff(self.position, axis=0)
        if self.rate is None:
            return p0, d
        v0, v1 = self.rate[:-1] * length, self.rate[1:] * length
        if self.acceleration is None:
            return p0, v0, 3 * d - 2 * v0 - v1, v0 + v1 - 2 * d
        a0, a1 = self.acceleration[:-1] * length**2 / 2, self.acceleration[1:] * length**2 / 2
        d, e, f = d - v0 - a0, v1 - v0 - 2 * a0, 2 * (a1 - a0)
        return p0, v0, a0, 10 * d - 4 * e + f / 2, -15 * d + 7 * e - f, 6 * d - 3 * e + f / 2


def _polynomial(coefficients, powers, order):
    """Return the derivative of an order of the polynomial, by the share, of which `powers` are."""
    total = np.zeros_like(coefficients[0])
    for degree in range(order, len(coefficients)):
        total = total + perm(degree, order) * coefficients[degree] * powers[degree - order]
    return total


def trajectory_from(start: JointMotion, points: TrajectoryPoints) -> JointTrajectory:
    """
    Return the JointTrajectory from the present motion through points.

    Parameters
    ----------
    start : JointMotion
        One row: where the joints are when the trajectory begins.
    points : TrajectoryPoints
        At least one, the joints in the order of `start`.

    Raises
    ------
    InputError
        When the points do not fit together.

    """
    if not len(points) or points.position.shape[1] != start.position.shape[1]:
        raise InputError(f'a trajectory must have points with {start.position.shape[1]} positions each, got {points.position.shape}; '
                         'name every joint of the table')
    parts = {name: np.concatenate([getattr(start, name)[:1], values]) for name, values in points.columns().items()}
    return JointTrajectory(np.concatenate([[0.0], points.time]) + start.time[0], **parts)


def braking_from(start: JointMotion, limits: MotionLimits) -> JointTrajectory:
    """Return the braking trajectory within the acceleration limits, or with more acceleration if the range ends before."""
    position, rate = start.position[0], start.rate[0]
    wanted = float(np.max(PEAK_ACCELERATION_OF_BRAKING * np.abs(rate) / limits.acceleration))
    room = np.where(rate > 0, limits.upper - position, position - limits.lower)
    ends = room[(rate != 0) & (room > 0)] / np.abs(rate[(rate != 0) & (room > 0)])
    duration = max(min([wanted, *2.0 * ends]), SHORTEST_BRAKING)
    return JointTrajectory(start.time[0] + np.array([0.0, duration]), np.stack([position, position + 0.5 * rate * duration]),
                           np.stack([rate, 0.0 * rate]), np.zeros((2, len(rate))))


def excess(trajectory: JointTrajectory, limits: MotionLimits, step: float = 0.005) -> tuple[float, float, float]:
    """
    Return the excess of a trajectory over limits.

    Positions beyond the range (rad or m; at most 0 within it), and the largest speed and acceleration in units of theirs. Velocity jumps of
    straight lines are ignored.
    """
    count = max(int(np.ceil((trajectory.end - trajectory.time[0]) / step)), 20)
    motion = trajectory.at(np.union1d(np.linspace(trajectory.time[0], trajectory.end, count + 1), trajectory.time))
    beyond = np.maximum(limits.lower - motion.position, motion.position - limits.upper)
    speed, acceleration = np.abs(motion.rate) / limits.speed, np.abs(motion.acceleration) / limits.acceleration
    return float(np.max(beyond)), float(np.max(speed)), float(np.max(acceleration))
