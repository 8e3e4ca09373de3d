"""
The driver: one motion after another, monitored by the measured joint states.

Each fault stops all joints with one sentence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.settings import setting
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.core.units import DEG
from imu_calibration.kinematics.joint_motion import rest_at
from imu_calibration.kinematics.motion_limits import MotionLimits, TrajectoryPoints
from imu_calibration.planning.path_watch import PathWatch
from imu_calibration.simulation.table_controller import (
    LIMIT_ROUNDING,
    limit_excess,
    trajectory_from,
)

OVERSPEED = 1.25
"""
Measured speed in units of the limit from which the joints are stopped; rates from encoders are
noisy.
"""
MAX_REST_MOVEMENT = 0.1
"""Tolerances by which joints that rest may move: encoders are noisy, arms sag."""


class DriveState(StrEnum):
    """States of a driver."""

    IDLE = 'idle'
    """No motion has been requested."""
    MOVING = 'moving'
    """The joints follow a trajectory."""
    SETTLING = 'settling'
    """The joints have reached its end and vibrations decay."""
    MEASURING = 'measuring'
    """The joints rest, and the calibration reads the new windows."""
    STOPPED = 'stopped'
    """A fault or a stop request."""
    DONE = 'done'
    """The plan is complete."""


@dataclass(frozen=True)
class DriverSettings:
    """Tolerances on the path and on times."""

    following_tolerance: float = setting(
        0.05,
        'rad',
        'largest distance of a rotating joint from its path, independent of delay '
        'and speed; beyond it all stop',
        (1e-4, 1.0),
        'too small: stops without a reason; too large: late',
        live=True,
    )
    following_tolerance_m: float = setting(
        0.01, 'm', 'the same for a joint that slides', (1e-5, 0.5), 'as above', live=True
    )
    stall_patience: float = setting(
        3.0,
        's',
        'joints without progress for this time, by their clock and by ours, have stalled, or the'
        ' trajectory was refused; after a stop in mid-motion the next one waits for so long, since'
        ' the stop may be as late',
        (0.2, 60.0),
        'too small: a controller that is slow to begin is called refusing',
        live=True,
    )
    silence: float = setting(
        1.0,
        's',
        'all joints stop after this time without joint states',
        (0.1, 60.0),
        'too small: stops when the machine is busy',
        live=True,
    )
    settling_time: float = setting(
        0.5,
        's',
        'the joints must have rested for so long before the next motion',
        (0.0, 60.0),
        'too small: decaying vibration is measured',
        live=True,
    )
    settling_patience: float = setting(
        20.0,
        's',
        'all joints stop if they do not rest within this time',
        (0.5, 600.0),
        'too small: a soft arm is called restless',
        live=True,
    )
    first_reach: float = setting(
        0.1,
        'rad',
        'the very first motion turns each joint by at most this and back; 0: none',
        (0.0, 1.0),
        'too small: a wrong sign or joint is not noticed',
        live=True,
    )
    first_reach_m: float = setting(
        0.01, 'm', 'the same for a joint that slides', (0.0, 0.5), 'as above', live=True
    )
    first_speed: float = setting(
        0.3,
        '1',
        'share of its speed at which motions after a start are made, up to the first one that is'
        ' larger than first_reach',
        (0.01, 1.0),
        'too large: a wrong table is noticed at full speed',
        live=True,
    )


class Driver:
    """
    Accepts motions, returns trajectories to send, and monitors the joints.

    Parameters
    ----------
    joint_names : sequence of str
        Joints in the order of the columns.
    limits : MotionLimits
    settings : DriverSettings

    """

    def __init__(
        self,
        joint_names: tuple[str, ...],
        limits: MotionLimits,
        settings: DriverSettings = DriverSettings(),
    ):
        self.joint_names = tuple(joint_names)
        self.limits = limits
        self.change(settings)
        self.state = DriveState.IDLE
        self.reason = 'no motion before start'
        """Cause of the state, or the motion that is made, as text."""
        self.motions = 0
        """Motions that were begun."""
        self.position: np.ndarray | None = None
        """Where the joints were seen last."""
        self.ignored: dict[str, int] = {}
        """Joint -> number of joint states that were ignored because its position was not finite."""
        # Times of the joints are by their stamps, "steady" ones by the clock of this process; s.
        self._stamp = 0.0
        """Stamp of the last joint state."""
        self._heard_at = -np.inf
        """Steady time of the last joint state."""
        self._advanced_at = -np.inf
        """Steady time of the last joint state with another stamp than the one before."""
        self._watch: PathWatch | None = None
        """Progress along the present trajectory; None without one."""
        self._rested_at: np.ndarray | None = None
        """Position near which the joints rest since `_rested_since`; None: not known."""
        self._rested_since = 0.0
        """Stamp since which the joints rest."""
        self._settling_since = 0.0
        """Stamp at which the joints reached the end of the trajectory."""
        self._last_stop: tuple[float, float] | None = None
        """(stamp, steady time) of the last stop in mid-motion; None without one."""
        self._next_is_slow = True
        """Whether the next motion is slow, because none larger than `first_reach` was made."""

    def change(self, settings: DriverSettings) -> None:
        """Use other settings from now on; speed and tolerances from the next motion on."""
        self.settings = settings
        self.tolerance = np.where(
            self.limits.turns, settings.following_tolerance, settings.following_tolerance_m
        )

    @property
    def first_reach(self) -> np.ndarray:
        """Excursion of the first motion, rad or m, shape (n_joints,)."""
        return np.where(self.limits.turns, self.settings.first_reach, self.settings.first_reach_m)

    @property
    def is_driving(self) -> bool:
        """Whether the driver has commanded a motion that may be in progress."""
        return self.state in (DriveState.MOVING, DriveState.SETTLING)

    @property
    def progress(self) -> float:
        """Progress along the path, s of the time of the path; 0 without a motion."""
        return 0.0 if self._watch is None else self._watch.progress

    @property
    def rests(self) -> bool:
        """Whether the joints have rested for the settling time and no command is pending."""
        return (
            self._rested_at is not None
            and self._stamp - self._rested_since >= self.settings.settling_time
            and not self.awaits_stop
        )

    @property
    def awaits_stop(self) -> bool:
        """
        Whether a stopped motion may still begin, or continue after a rest.

        A controller may need `stall_patience` to execute a command, by its clock and by ours: a
        rest before that is no evidence.
        """
        if self._last_stop is None:
            return False
        seconds = min(self._stamp - self._last_stop[0], self._heard_at - self._last_stop[1])
        return seconds < self.settings.stall_patience

    def is_silent(self, now: float) -> bool:
        """Whether the time since the last joint state exceeds `silence`, by a steady clock."""
        return now - self._heard_at > self.settings.silence

    def stamp_fault(self, now: float) -> str:
        """
        Return a line if joint states arrive whose stamps have not changed for `silence`, else ''.
        """
        constant = self._heard_at - self._advanced_at
        if self.is_silent(now) or not constant > self.settings.silence:
            return ''
        return (
            f'the stamps of the joint states must advance, they have not for {constant:.1f} s while'
            ' messages arrive: stopped; correct the clock of their publisher'
        )

    def start(self) -> None:
        """Allow motions, once the joints rest; the first one will be slow."""
        self._next_is_slow = True
        self._rested_at = None
        self._become(DriveState.IDLE, 'started')

    def begin(self, points: TrajectoryPoints, words: str, now: float) -> TrajectoryPoints:
        """
        Return the trajectory of a motion from the present joint positions.

        Parameters
        ----------
        points : TrajectoryPoints
        words : str
            Description of the motion.
        now : float
            Seconds of a steady clock.

        Raises an InputError if no motion is allowed at present, or the motion exceeds a limit.
        """
        if self.state not in (DriveState.IDLE, DriveState.MEASURING):
            raise InputError(
                'a motion may begin if the joints rest and no fault is present, the state is'
                f' {self.state}: {self.reason}; start anew',
                code='wrong_state',
            )
        if self.position is None or self.is_silent(now):
            raise InputError(
                'joint states are needed before a motion, none were received; publish them',
                code='no_joint_states',
            )
        if not self.rests:
            raise InputError(
                'the joints must rest before a motion begins, they have just moved; start again'
                ' when they rest',
                code='joints_moving',
            )
        speed_share = self.settings.first_speed if self._next_is_slow else 1.0
        points = points.ordered(self.joint_names).slowed(speed_share)
        self._require_within_limits(points)
        small_excursion = self.first_reach + MAX_REST_MOVEMENT * self.tolerance
        is_small = np.all(np.abs(points.position - self.position) <= small_excursion)
        self._watch = PathWatch(self.position, points, self.tolerance)
        # Motions are slow up to and including the first one that is larger.
        self._next_is_slow = self._next_is_slow and bool(is_small)
        self.motions += 1
        self._become(DriveState.MOVING, words)
        return points

    def _require_within_limits(self, points: TrajectoryPoints) -> None:
        """Raise InputError for a trajectory beyond a limit, or without accelerations."""
        assert self.position is not None
        path = trajectory_from(rest_at(self.position[None]), points)
        beyond, speed, acceleration = limit_excess(path, self.limits)
        # An encoder may read slightly outside the range: its joint may return into it.
        outside = np.maximum(self.limits.lower - self.position, self.position - self.limits.upper)
        beyond -= max(float(np.max(outside)), 0.0)
        leaves_range = beyond > LIMIT_ROUNDING
        is_too_fast = max(speed, acceleration) > 1.0 + LIMIT_ROUNDING
        if leaves_range or is_too_fast or points.acceleration is None:
            raise InputError(
                'a motion must have accelerations and stay within the limits of the joints, it'
                f' leaves the range by {max(beyond, 0.0):.3g} rad or m and reaches {speed:.3f} of'
                f' the speed and {acceleration:.3f} of the acceleration; it is not sent',
                code='joint_limits',
            )

    def observe(self, time: float, position: np.ndarray, rate: np.ndarray, *, now: float) -> bool:
        """
        Process one joint state; return whether all joints must stop.

        A position that is not finite makes the message count as ignored, a rate that is not finite
        as missing.

        Parameters
        ----------
        time : float
            Of the joint state's stamp, s.
        position, rate : ndarray, shape (n_joints,)
            NaN where the message has no rates.
        now : float
            Seconds of a steady clock.

        """
        # 1. The message. The driver ros2_control publishes NaN until the hardware was read.
        if not np.all(np.isfinite(position)):
            for joint in np.flatnonzero(~np.isfinite(position)):
                name = self.joint_names[joint]
                self.ignored[name] = self.ignored.get(name, 0) + 1
            return False
        # After a clock step backwards the wait starts again.
        if self._last_stop is not None and time < self._stamp:
            self._last_stop = time, now
        if time != self._stamp or self.position is None:
            self._advanced_at = now
        self._stamp = time
        self._heard_at = now
        self.position = np.asarray(position, float)
        fault = self.stamp_fault(now) if self.is_driving else ''
        if fault:
            return self.stop(fault)
        self._note_rest()
        if self._watch is None or not self.is_driving:
            return False

        # 2. Faults of a commanded motion, or of the joints that settle after it.
        fault = self._limit_fault(position, rate)
        if not fault and self.state is DriveState.MOVING:
            self._watch.observe(time, self.position, now=now)
            fault = self._tracking_fault()
        if fault:
            return self.stop(fault)

        # 3. From the motion to settling at its end, from there to measuring at rest.
        if self.state is DriveState.SETTLING:
            return self._settle()
        if self._watch.at_end:
            self._rested_at = self.position
            self._rested_since = time
            self._settling_since = time
            self._become(DriveState.SETTLING, self.reason)
        return False

    def tick(self, now: float) -> bool:
        """Check the time limits; return whether all joints must stop."""
        if self.is_driving and self.is_silent(now):
            return self.stop(
                f'no usable joint state for {now - self._heard_at:.1f} s: stopped; see that joint'
                ' states are published' + self.ignored_words()
            )
        return False

    def ignored_words(self) -> str:
        """
        Return the joints without finite positions and their ignored states, in brackets, or ''.
        """
        counts = ', '.join(f'{name} {count}' for name, count in self.ignored.items())
        return f' (ignored because a position was not finite: {counts})' if counts else ''

    def refused(self, why: str) -> bool:
        """
        Record that the controller rejected or aborted the goal.

        Return whether all joints must stop.
        """
        return self.is_driving and self.stop(f'the controller does not follow: {why}')

    def stop(self, why: str) -> bool:
        """Stop for a reason, from any state; return True."""
        if self.state is DriveState.MOVING:
            self._last_stop = self._stamp, self._heard_at
        self._watch = None
        self._become(DriveState.STOPPED, why)
        return True

    def wait(self, why: str) -> None:
        """Rest until the next motion is requested."""
        self._watch = None
        self._become(DriveState.IDLE, why)

    def finish(self, why: str) -> None:
        """The plan is complete."""
        self._watch = None
        self._become(DriveState.DONE, why)

    def _become(self, state: DriveState, reason: str) -> None:
        """Enter a state for a reason."""
        self.state = state
        self.reason = reason

    def _limit_fault(self, position: np.ndarray, rate: np.ndarray) -> str:
        """Return the fault of joint positions or speeds beyond the limits, '' for none."""
        assert self.position is not None
        outside = np.maximum(self.limits.lower - position, position - self.limits.upper)
        excess = outside - self.tolerance
        if np.max(excess) > 0:
            joint = int(np.argmax(excess))
            return (
                f'joint {self._place_of(joint, position)} is beyond its range: stopped; see the'
                ' limits in the description of the joints'
            )
        speed_share = np.where(np.isfinite(rate), np.abs(rate), 0.0) / self.limits.speed
        if np.max(speed_share) > OVERSPEED:
            joint = int(np.argmax(speed_share))
            return (
                f'joint {self.joint_names[joint]} turns at {speed_share[joint]:.2f} times its'
                ' largest'
                ' speed: stopped; see the limits in the description of the joints and in the'
                ' controller'
            )
        return ''

    def _tracking_fault(self) -> str:
        """Return the fault of joints that leave their path or do not advance on it, '' for none."""
        watch = self._watch
        # Called only during a motion.
        assert watch is not None and self.position is not None
        if watch.has_strayed:
            joint = watch.hindered_joint()
            distance = watch.deviation.max() * watch.tolerance[joint]
            return (
                f'joint {self._place_of(joint, self.position)} does not follow: the joints are'
                f' {self._amount(joint, distance)} from their path: stopped; see whether something'
                ' holds it'
            )
        if watch.has_stalled_for <= self.settings.stall_patience:
            return ''
        if not watch.has_begun:
            return (
                f'nothing moved for {watch.waited:.1f} s after a trajectory was sent: stopped; the'
                ' controller refused it or does not listen, see its log'
            )
        name = self.joint_names[watch.hindered_joint()]
        return (
            f'joint {name} has made no progress for {watch.waited:.1f} s: stopped; see whether'
            ' something holds it'
        )

    def _note_rest(self) -> None:
        """Restart the timer of rest when the joints have moved, or their clock was set back."""
        if (
            self._rested_at is None
            or self._stamp < self._rested_since
            or np.any(np.abs(self.position - self._rested_at) > MAX_REST_MOVEMENT * self.tolerance)
        ):
            self._rested_at = self.position
            self._rested_since = self._stamp

    def _settle(self) -> bool:
        """Begin to measure once the joints rest; return whether all joints must stop."""
        if self.rests:
            self._watch = None
            self._become(DriveState.MEASURING, self.reason)
        elif self._stamp - self._settling_since > self.settings.settling_patience:
            return self.stop(
                f'the joints do not rest within {self.settings.settling_patience:g} s: stopped;'
                ' find the cause of the motion'
            )
        return False

    def _place_of(self, joint: int, position: np.ndarray) -> str:
        """Return the name of a joint and its position as text."""
        return f'{self.joint_names[joint]}, at {self._amount(joint, position[joint])},'

    def _amount(self, joint: int, value: float) -> str:
        """Return an angle (rad) or length (m) of a joint as text in degrees or millimetres."""
        return f'{value / DEG:.1f} deg' if self.limits.turns[joint] else f'{1000.0 * value:.1f} mm'
