"""A simulated controller of joints and its trajectories."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import setting, text_setting
from imu_calibration.kinematics.joint_motion import JointMotion, rest_at
from imu_calibration.kinematics.motion_limits import MotionLimits, TrajectoryPoints, free_limits
from imu_calibration.simulation.motion_builder import Profile

PEAK_ACCELERATION_OF_BRAKING = 1.5
"""Largest acceleration while a joint brakes, in units of its rate over the duration."""
SHORTEST_BRAKING = 1e-3
"""Least braking time, s."""


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """
    Polynomials between points, at rest before the first and after the last.

    As in joint_trajectory_controller: of degree five where the points give velocities and
    accelerations, of degree three with only velocities, straight lines with only positions, so that
    the velocity jumps at every point.
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
        """
        Return the JointMotion at `time`, shape (m,).

        Outside the points the joints rest at the position of the first or the last one.
        """
        time = np.atleast_1d(np.asarray(time, float))
        inside = np.clip(time, self.time[0], self.time[-1])
        motion = [self._curve(inside, order) for order in range(4)]
        outside = (time < self.time[0]) | (time > self.time[-1])
        for derivative in motion[1:]:
            derivative[outside] = 0.0
        return JointMotion(time, *motion)

    @cached_property
    def _curve(self) -> Any:
        """The polynomials (PPoly), each by the quantities that are given at both of its ends."""
        from scipy.interpolate import BPoly, PPoly  # here, because its import is slow

        derivatives = [self.position]
        for values in (self.rate, self.acceleration):
            if values is not None:
                derivatives.append(values)
        bernstein = BPoly.from_derivatives(self.time, np.stack(derivatives, axis=1))
        return PPoly.from_bernstein_basis(bernstein)


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
        raise InputError(
            f'a trajectory must have points with {start.position.shape[1]} positions each, got'
            f' {points.position.shape}; name every joint of the table'
        )
    # The present motion is the first point.
    columns = {}
    for name, values in points.columns().items():
        columns[name] = np.concatenate([getattr(start, name)[:1], values])
    return JointTrajectory(np.concatenate([[0.0], points.time]) + start.time[0], **columns)


def braking_from(start: JointMotion, limits: MotionLimits) -> JointTrajectory:
    """
    Return the braking trajectory: within the acceleration limits, or faster to stay in the range.

    A joint with the rate w that brakes in the duration T moves by ``w T / 2``.
    """
    position = start.position[0]
    rate = start.rate[0]
    duration = float(np.max(PEAK_ACCELERATION_OF_BRAKING * np.abs(rate) / limits.acceleration))
    room = np.where(rate > 0, limits.upper - position, position - limits.lower)
    can_hit = (rate != 0) & (room > 0)
    longest = 2.0 * (room[can_hit] / np.abs(rate[can_hit]))
    duration = max(min([duration, *longest]), SHORTEST_BRAKING)
    return JointTrajectory(
        time=start.time[0] + np.array([0.0, duration]),
        position=np.stack([position, position + 0.5 * rate * duration]),
        rate=np.stack([rate, 0.0 * rate]),
        acceleration=np.zeros((2, len(rate))),
    )


def limit_excess(
    trajectory: JointTrajectory, limits: MotionLimits, step: float = 0.005
) -> tuple[float, float, float]:
    """
    Return (position beyond the range, largest speed, largest acceleration) of a trajectory.

    The position is in rad or m, at most 0 within the range; speed and acceleration are in units of
    their limits. They are evaluated every `step` s, without the velocity jumps of straight lines.
    """
    n_steps = max(int(np.ceil((trajectory.end - trajectory.time[0]) / step)), 20)
    grid = np.linspace(trajectory.time[0], trajectory.end, n_steps + 1)
    motion = trajectory.at(np.union1d(grid, trajectory.time))
    beyond = np.maximum(limits.lower - motion.position, motion.position - limits.upper)
    speed = np.abs(motion.rate) / limits.speed
    acceleration = np.abs(motion.acceleration) / limits.acceleration
    return float(np.max(beyond)), float(np.max(speed)), float(np.max(acceleration))


LIMIT_ROUNDING = 1e-6
"""Tolerance of a trajectory beyond a limit, relative to it."""
KEPT_MOTIONS = 8
"""Motions kept in memory; queries look back by less."""


@dataclass(frozen=True)
class ControllerSettings:
    """Execution of a trajectory by the joints, and their faults."""

    limits: str = text_setting(
        'treatment of a trajectory beyond range, speed or acceleration of the joints: refuse, slow'
        ' (it is slowed to the limits; beyond the range it is refused) or none (it is followed)',
        'trajectories are not followed, or further and faster than the joints can',
        default='refuse',
        choices=('refuse', 'slow', 'none'),
    )
    lag: float = setting(
        0.0,
        's',
        'delay of the joints relative to a trajectory',
        (0.0, 10.0),
        'measured joints are late',
    )
    speed_scaling: float = setting(
        1.0,
        '1',
        'share of their speed at which trajectories are followed',
        (0.01, 1.0),
        'motions last longer than commanded',
    )
    refuse_after: int = setting(
        -1,
        '1',
        'trajectories that are followed before every further one is refused; -1: all are followed',
        (-1, 1_000_000),
        'trajectories are not followed',
    )
    stall_joint: str = text_setting(
        'joint that stalls',
        'no joint stalls, or another one',
    )
    stall_time: float = setting(
        0.0,
        's',
        'simulated time at which it stalls',
        (0.0, 1e7),
        'the joint moves on, or never moved',
    )


class TableController:
    """
    Motion of the table at any time: a profile, once or repeated, until a trajectory replaces it.

    Parameters
    ----------
    profile : Profile or None
        None: rest until a trajectory arrives.
    joint_names : sequence of str
        Joints in the order of the columns.
    limits : MotionLimits, optional
        Default: joints without an end.
    settings : ControllerSettings
    repeat : bool
        Whether the profile starts again at its end, from the angles reached.

    Raises
    ------
    InputError
        When a setting has an unknown value.

    """

    def __init__(
        self,
        profile: Profile | None,
        joint_names: tuple[str, ...],
        *,
        limits: MotionLimits | None = None,
        settings: ControllerSettings = ControllerSettings(),
        repeat: bool = False,
    ):
        self.joint_names = tuple(joint_names)
        self.limits = limits or free_limits(len(joint_names))
        self.settings = settings
        if settings.stall_joint and settings.stall_joint not in self.joint_names:
            raise InputError(
                f"setting 'stall_joint' must be one of {', '.join(self.joint_names)}, got"
                f" '{settings.stall_joint}'; name one",
                code='joint_unknown',
            )
        self._profile = profile
        self._repeat = repeat
        self._n_followed = 0
        """Number of accepted trajectories."""
        self._home = np.clip(np.zeros(len(joint_names)), self.limits.lower, self.limits.upper)
        """Position at rest without a profile: zero, or the nearest one in the range."""
        self._started: list[tuple[float, JointTrajectory]] = []
        """The last `KEPT_MOTIONS` trajectories with their beginnings, s."""
        self._stalling: JointTrajectory | None = None
        """Braking trajectory from the stall on, of which one joint is used; None before."""

    @property
    def end(self) -> float:
        """Time at which the motion ends, s; infinite if it repeats or waits for trajectories."""
        if self._profile is None or self._repeat or self._started:
            return np.inf
        return self._profile.duration

    def follow(self, now: float, points: TrajectoryPoints) -> None:
        """
        Start a trajectory that arrives at the time `now`; without points the joints brake and rest.

        Raises
        ------
        InputError
            When it is refused; the joints then continue their present motion.

        """
        points = points.ordered(self.joint_names)
        begin = now + self.settings.lag
        start = self._commanded(np.array([begin]))
        if not len(points):
            self._start(begin, braking_from(start, self.limits))
            return
        if 0 <= self.settings.refuse_after <= self._n_followed:
            raise InputError(
                f'the controller accepts at most {self.settings.refuse_after} trajectories, by its'
                ' parameter',
                code='trajectory_count',
            )
        points = points.slowed(self.settings.speed_scaling)
        trajectory = trajectory_from(start, points)
        if self.settings.limits != 'none':
            trajectory = self._within_limits(start, points, trajectory)
        self._n_followed += 1
        self._start(begin, trajectory)

    def _start(self, begin: float, trajectory: JointTrajectory) -> None:
        """Follow a trajectory from the time `begin` on, s."""
        self._started = [*self._started, (begin, trajectory)][-KEPT_MOTIONS:]

    def _within_limits(
        self, start: JointMotion, points: TrajectoryPoints, trajectory: JointTrajectory
    ) -> JointTrajectory:
        """
        Return the trajectory through `points`, slowed to the limits where the settings say so.

        Raises an InputError where it exceeds the range, or speed and acceleration if it must not be
        slowed.
        """
        beyond, speed, acceleration = limit_excess(trajectory, self.limits)
        if beyond > LIMIT_ROUNDING:
            raise InputError(
                'a trajectory must stay within the range of the joints, it exceeds it by'
                f' {beyond:.3g} rad or m; see the limits in the description of the table',
                code='joint_range',
            )
        # A motion that is slower by this factor keeps both limits: the acceleration falls with its
        # square.
        slowing = max(speed, np.sqrt(acceleration))
        if slowing <= 1.0 + LIMIT_ROUNDING:
            return trajectory
        if self.settings.limits == 'refuse':
            raise InputError(
                'a trajectory must keep to speed and acceleration of the joints, it reaches'
                f' {speed:.2f} times the one and {acceleration:.2f} times the other; give it more'
                ' time',
                code='joint_limits',
            )
        return trajectory_from(start, points.slowed(1.0 / slowing))

    def at(self, time: np.ndarray) -> JointMotion:
        """Return the JointMotion at `time`, shape (m,)."""
        time = np.atleast_1d(np.asarray(time, float))
        motion = self._commanded(time)
        is_after_stall = time > self.settings.stall_time
        if not self.settings.stall_joint or not is_after_stall.any():
            return motion
        if self._stalling is None:
            stall_start = self._commanded(np.array([self.settings.stall_time]))
            self._stalling = braking_from(stall_start, self.limits)
        column = self.joint_names.index(self.settings.stall_joint)
        stalled = self._stalling.at(time[is_after_stall])
        for name in ('position', 'rate', 'acceleration', 'jerk'):
            getattr(motion, name)[is_after_stall, column] = getattr(stalled, name)[:, column]
        return motion

    def _commanded(self, time: np.ndarray) -> JointMotion:
        """Return the motion of the joints if none of them stalled, at times of shape (m,)."""
        begins = np.array([begin for begin, _ in self._started])
        # Index of the last trajectory that began before each time; -1: the profile.
        index = np.searchsorted(begins, time, side='right') - 1
        motion = np.zeros((4, len(time), len(self.joint_names)))
        for k in np.unique(index):
            is_now = index == k
            if k < 0:
                now = self._profile_motion(time[is_now])
            else:
                _, trajectory = self._started[k]
                now = trajectory.at(time[is_now])
            motion[:, is_now] = now.position, now.rate, now.acceleration, now.jerk
        return JointMotion(time, *motion)

    def _profile_motion(self, time: np.ndarray) -> JointMotion:
        """Return the motion of the joints before the first trajectory, at times of shape (m,)."""
        if self._profile is None:
            return replace(rest_at(np.tile(self._home, (len(time), 1))), time=time)
        if not self._repeat:
            return self._profile.at(time)
        # Each repetition starts from the position at the end of the previous one.
        n_complete = np.floor(time / self._profile.duration)
        motion = self._profile.at(time - n_complete * self._profile.duration)
        first, last = self._profile.at(np.array([0.0, self._profile.duration])).position
        position = motion.position + n_complete[:, None] * (last - first)
        return replace(motion, time=time, position=position)
