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
        self.motions = 0
        self.position: np.ndarray | None = None
        """Where the joints were seen last."""
        self.ignored: dict[str, int] = {}
        """Joint -> number of joint states that were ignored because its position was not finite."""
        self._time = 0.0
        self._heard = -np.inf
        self._advanced = -np.inf
        self._watch: PathWatch | None = None
        self._rested_at: np.ndarray | None = None
        self._rested_since = self._settling_since = 0.0
        self._stopped: tuple[float, float] | None = None
        self._slow = True

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
            and self._time - self._rested_since >= self.settings.settling_time
            and not self.awaits_stop
        )

    @property
    def awaits_stop(self) -> bool:
        """
        Whether a stopped motion may still begin, or continue after a rest.

        A controller may need `stall_patience` to execute a command, by its clock and by ours: a
        rest before that is no evidence.
        """
        if self._stopped is None:
            return False
        return (
            min(self._time - self._stopped[0], self._heard - self._stopped[1])
            < self.settings.stall_patience
        )

    def is_silent(self, now: float) -> bool:
        """Whether the time since the last joint state exceeds `silence`, by a steady clock."""
        return now - self._heard > self.settings.silence

    def stamp_fault(self, now: float) -> str:
        """
        Return a line if joint states arrive with unchanged stamps, '' otherwise.

        The stamps have not changed for `silence`.
        """
        constant = self._heard - self._advanced
        if self.is_silent(now) or not constant > self.settings.silence:
            return ''
        return (
            f'the stamps of the joint states must advance, they have not for {constant:.1f} s while'
            ' messages arrive: stopped; correct the clock of their publisher'
        )

    def start(self) -> None:
        """Allow motions, once the joints rest; the first one will be slow."""
        self._slow, self._rested_at = True, None
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
        points = points.ordered(self.joint_names).slowed(
            self.settings.first_speed if self._slow else 1.0
        )
        self._require_within_limits(points)
        is_small = np.all(
            np.abs(points.position - self.position)
            <= self.first_reach + MAX_REST_MOVEMENT * self.tolerance
        )
        self._watch, self._slow = (
            PathWatch(self.position, points, self.tolerance),
            self._slow and bool(is_small),
        )
        self.motions += 1
        self._become(DriveState.MOVING, words)
        return points

    def _require_within_limits(self, points):
        assert self.position is not None
        path = trajectory_from(rest_at(self.position[None]), points)
        beyond, speed, acceleration = limit_excess(path, self.limits)
        # A joint whose encoder reads slightly outside its range may return into it.
        outside = np.maximum(self.limits.lower - self.position, self.position - self.limits.upper)
        beyond -= max(float(np.max(outside)), 0.0)
        if (
            beyond > LIMIT_ROUNDING
            or max(speed, acceleration) > 1.0 + LIMIT_ROUNDING
            or points.acceleration is None
        ):
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
        # The driver ros2_control publishes NaN until the hardware was read.
        if not np.all(np.isfinite(position)):
            for joint in np.flatnonzero(~np.isfinite(position)):
                self.ignored[self.joint_names[joint]] = (
                    self.ignored.get(self.joint_names[joint], 0) + 1
                )
            return False
        # After a clock step backwards the wait starts again.
        if self._stopped is not None and time < self._time:
            self._stopped = time, now
        if time != self._time or self.position is None:
            self._advanced = now
        self._time, self._heard, self.position = time, now, np.asarray(position, float)
        if self.is_driving and (trouble := self.stamp_fault(now)):
            return self.stop(trouble)
        self._note_rest()
        if self._watch is None or not self.is_driving:
            return False
        trouble = self._beyond(position, rate)
        if trouble:
            return self.stop(trouble)
        if self.state is DriveState.MOVING:
            self._watch.observe(time, self.position, now=now)
            trouble = self._straying()
            if trouble:
                return self.stop(trouble)
            if self._watch.at_end:
                self._rested_at = self.position
                self._rested_since = time
                self._settling_since = time
                self._become(DriveState.SETTLING, self.reason)
            return False
        return self._settle()

    def tick(self, now: float) -> bool:
        """Check the time limits; return whether all joints must stop."""
        if self.is_driving and self.is_silent(now):
            return self.stop(
                f'no usable joint state for {now - self._heard:.1f} s: stopped; see that joint'
                ' states are published' + self.ignored_words()
            )
        return False

    def ignored_words(self) -> str:
        """
        Return the joints without finite positions and the number of ignored states.

        The number is that of ignored joint states, in brackets. The result is '' for none.
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
            self._stopped = self._time, self._heard
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
        self.state, self.reason = state, reason

    def _beyond(self, position, rate):
        """Return the fault of joint positions and speeds, '' for none."""
        assert self.position is not None
        over = (
            np.maximum(self.limits.lower - position, position - self.limits.upper) - self.tolerance
        )
        if np.max(over) > 0:
            joint = int(np.argmax(over))
            return (
                f'joint {self._place_of(joint, position)} is beyond its range: stopped; see the'
                ' limits in the description of the joints'
            )
        fast = np.where(np.isfinite(rate), np.abs(rate), 0.0) / self.limits.speed
        if np.max(fast) > OVERSPEED:
            joint = int(np.argmax(fast))
            return (
                f'joint {self.joint_names[joint]} turns at {fast[joint]:.2f} times its largest'
                ' speed: stopped; see the limits in the description of the joints and in the'
                ' controller'
            )
        return ''

    def _straying(self):
        """Return the fault of path tracking, '' for none."""
        watch = self._watch
        # Called only during a motion.
        assert watch is not None
        if watch.has_strayed:
            joint = watch.suspect()
            return (
                f'joint {self._place_of(joint, self.position)} does not follow: the joints are'
                f' {self._amount(joint, watch.deviation.max() * watch.tolerance[joint])} from their'
                ' path: stopped; see whether something holds it'
            )
        if watch.has_stalled_for <= self.settings.stall_patience:
            return ''
        if not watch.has_begun:
            return (
                f'nothing moved for {watch.waited:.1f} s after a trajectory was sent: stopped; the'
                ' controller refused it or does not listen, see its log'
            )
        return (
            f'joint {self.joint_names[watch.suspect()]} has made no progress for {watch.waited:.1f}'
            ' s: stopped; see whether something holds it'
        )

    def _note_rest(self):
        """Restart the timer when the joints have moved, or their clock was set back."""
        if (
            self._rested_at is None
            or self._time < self._rested_since
            or np.any(np.abs(self.position - self._rested_at) > MAX_REST_MOVEMENT * self.tolerance)
        ):
            self._rested_at, self._rested_since = self.position, self._time

    def _settle(self):
        """Wait for rest; return whether all joints must stop."""
        if self.rests:
            self._watch = None
            self._become(DriveState.MEASURING, self.reason)
        elif self._time - self._settling_since > self.settings.settling_patience:
            return self.stop(
                f'the joints do not rest within {self.settings.settling_patience:g} s: stopped;'
                ' find the cause of the motion'
            )
        return False

    def _place_of(self, joint, position):
        return f'{self.joint_names[joint]}, at {self._amount(joint, position[joint])},'

    def _amount(self, joint, value):
        return f'{value / DEG:.1f} deg' if self.limits.turns[joint] else f'{1000.0 * value:.1f} mm'
