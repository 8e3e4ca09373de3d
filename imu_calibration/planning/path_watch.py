"""Distance of the joints from the commanded path, independent of their speed along it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from imu_calibration.kinematics.joint_motion import rest_at
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from imu_calibration.simulation.table_controller import trajectory_from

PATH_STEP_SECONDS = 0.01
"""Step of the instants at which the path is evaluated, s."""
MAX_LEAD_SECONDS = 0.1
"""Largest progress in excess of the elapsed time between two joint states, s: stamps jitter."""
DEAD_BAND = 0.5
"""
Places of the path as near as this, in tolerances, fit alike: turning points of swings look the same
from both sides, and arms sag.
"""
MIN_PACE = 0.05
"""Least share of its speed at which a path is thought to be followed."""
MIN_BEGUN_MOVEMENT = 0.4
"""Movement from which joints count as moving, in tolerances."""
STALLED_SECONDS = 1.0
"""Seconds of motion that identify a joint that does not move."""
MAX_REST_RATE = 0.05
"""Largest rate at which a path counts as at rest, in tolerances per second."""


LATENESS_TIE = 1e-3
"""
Of joints that are equally late, the one that has moved least is named; after a motion there and
back all may be where they began.
"""


@dataclass(frozen=True, eq=False)
class _Path:
    """A trajectory at n instants, at most `PATH_STEP_SECONDS` apart."""

    time: np.ndarray
    """Instants since the start, s, shape (n,)."""
    place: np.ndarray
    """Positions of the joints, in tolerances, shape (n, n_joints)."""
    rests: np.ndarray
    """Whether the path rests at each instant, shape (n,)."""
    rest_end: np.ndarray
    """First instant from each one on at which the path moves, or the last; indices, shape (n,)."""

    @classmethod
    def make(cls, start: np.ndarray, points: TrajectoryPoints, tolerance: np.ndarray) -> '_Path':
        """Return the path through `points`; `start` and `tolerance` as for `PathWatch`."""
        n_steps = max(int(np.ceil(points.duration / PATH_STEP_SECONDS)), 1)
        time = np.linspace(0.0, points.duration, n_steps + 1)
        trajectory = trajectory_from(rest_at(np.asarray(start, float)[None]), points)
        place = trajectory.at(time).position / tolerance
        # By positions: the rate of the spline may vanish where an oscillation reverses.
        moved = np.max(np.abs(np.diff(place, axis=0, prepend=place[:1])), axis=1)
        rests = moved < MAX_REST_RATE * PATH_STEP_SECONDS
        # Of the instants with motion, in order, the first that is not before each instant.
        moving = np.append(np.flatnonzero(~rests), n_steps)
        rest_end = moving[np.searchsorted(moving, np.arange(n_steps + 1))]
        return cls(time, place, rests, rest_end)

    def reachable(self, instant: int, elapsed: float) -> slice:
        """
        Return the instants at which joints may be `elapsed` s after the one at `instant`.

        They are never behind it. Joints may end a rest before the scheduled time, so that the time
        counts from its end.
        """
        latest = self.time[self.rest_end[instant]] + elapsed + MAX_LEAD_SECONDS
        stop = np.searchsorted(self.time, latest, side='right')
        return slice(instant, max(stop, instant + 1))


class PathWatch:
    """
    Follows joints along a trajectory.

    The clock does not determine the position: a controller may lag, and scale its speed. The
    progress is the point where on the path they are, never backwards and never faster than the
    clock; while the path rests, the clock counts.

    Parameters
    ----------
    start : ndarray, shape (n_joints,)
        Where the joints rest.
    points : TrajectoryPoints
    tolerance : ndarray, shape (n_joints,)
        Largest distance of each joint from the path.

    """

    def __init__(self, start: np.ndarray, points: TrajectoryPoints, tolerance: np.ndarray):
        self._path = _Path.make(start, points, tolerance)
        self.tolerance = np.asarray(tolerance, float)
        self._instant = 0
        """Instant of the path at which the joints are, an index."""
        self._start = np.asarray(start, float) / tolerance
        """Where the joints rested before, in tolerances."""
        self._last_time: float | None = None
        """Time of the joints at the last position, s; None before the first one."""
        self._steady_now = 0.0
        """Steady time of the last position, s."""
        self._advanced_at = 0.0
        """Steady time of the last progress, s."""
        # The pace is the ratio of both, over the progress in motion so far.
        self._path_seconds = 0.0
        """Time of the path, s."""
        self._joint_seconds = 0.0
        """Time of the joints, s."""
        self._remainder = 0.0
        """Expected progress that is less than a step, s of the time of the path."""
        self._recent: deque = deque([(0.0, self._start)])
        """(time of the joints, position in tolerances) in the last `STALLED_SECONDS`."""
        self._largest_movement = np.zeros(len(start))
        """Largest distance of each joint from its start, in tolerances."""
        self.has_begun = False
        """Whether the joints have left their start."""
        self.waited = 0.0
        """Seconds of their clock since the last progress of the joints along an unfinished path."""
        self.deviation = np.zeros(len(start))
        """Distance of each joint from the path, in tolerances."""

    @property
    def progress(self) -> float:
        """Progress of the joints along the path, s of the time of the path."""
        return float(self._path.time[self._instant])

    @property
    def at_end(self) -> bool:
        """Whether the joints have reached the last point of the path."""
        return self._instant == len(self._path.time) - 1

    @property
    def pace(self) -> float:
        """Speed of the joints along the path as a share of the speed of the path."""
        if self._joint_seconds <= 0:
            return 1.0
        return float(np.clip(self._path_seconds / self._joint_seconds, MIN_PACE, 1.0))

    @property
    def has_stalled_for(self) -> float:
        """
        Seconds without progress of the joints, scaled to the speed of the path.

        By their clock or by the steady one, the smaller time: a simulated clock that runs faster
        gives the controller less time than its stamps show.
        """
        return min(self.waited, self._steady_now - self._advanced_at) * self.pace

    def observe(self, time: float, position: np.ndarray, *, now: float) -> None:
        """Process joint positions at `time`, s of their clock, and `now`, s of a steady clock."""
        elapsed = 0.0 if self._last_time is None else max(time - self._last_time, 0.0)
        self._last_time = time
        place = position / self.tolerance
        self._remember(time, place)
        path = self._path
        before = self._instant
        path_rests = path.rests[before]

        # 1. Expected time of the path. During a rest of the path it does not follow from positions
        #    and passes at the pace of the joints. A remainder below a step is kept; otherwise a
        #    slow pace would never end a rest.
        pace = self.pace if path_rests else 1.0
        expected = self.progress + self._remainder + elapsed * pace

        # 2. Of the reachable instants whose places fit, the one nearest to the expected time.
        ahead = path.reachable(before, elapsed)
        distance = np.max(np.abs(path.place[ahead] - place), axis=1)
        fits = np.flatnonzero(distance <= max(DEAD_BAND, np.min(distance)))
        nearest = np.argmin(np.abs(path.time[ahead][fits] - expected))
        self._instant += int(fits[nearest])
        remainder = expected - self.progress
        self._remainder = float(np.clip(remainder, -PATH_STEP_SECONDS, PATH_STEP_SECONDS))
        self.deviation = np.abs(path.place[self._instant] - place)

        # 3. Pace, from scheduled and elapsed time in motion, and the time without progress.
        advances = self._instant > before or self.at_end
        if advances and not path_rests and self.has_begun:
            self._path_seconds += float(path.time[self._instant] - path.time[before])
            self._joint_seconds += elapsed + self.waited
        self._steady_now = now
        self.waited = 0.0 if advances else self.waited + elapsed
        if self.waited == 0.0:
            self._advanced_at = now

    def _remember(self, time: float, place: np.ndarray) -> None:
        """Update the distances from the start and the recent positions, in tolerances."""
        self._largest_movement = np.maximum(self._largest_movement, np.abs(place - self._start))
        self.has_begun = self.has_begun or bool(np.max(self._largest_movement) > MIN_BEGUN_MOVEMENT)
        self._recent.append((time, place))
        while len(self._recent) > 2 and time - self._recent[0][0] > STALLED_SECONDS:
            self._recent.popleft()

    @property
    def has_strayed(self) -> bool:
        """Whether a joint has left the path."""
        return bool(np.max(self.deviation) > 1.0)

    def hindered_joint(self) -> int:
        """
        Return the joint whose recent motion is smallest, compared with the commanded motion.

        After a deviation the commanded motion is that before the present point of the path, in a
        stall that after it.
        """
        n_steps = int(STALLED_SECONDS * self.pace / PATH_STEP_SECONDS) + 1
        place = self._recent[-1][1]
        if self.has_strayed:
            before = self._path.place[max(self._instant - n_steps, 0) : self._instant + 1]
            commanded = np.ptp(before, axis=0)
        else:
            # Distance to the following path: of joints with equal motion, a joint that has arrived
            # is not the cause.
            ahead = self._path.place[self._instant : self._instant + n_steps + 1]
            commanded = np.max(np.abs(ahead - place), axis=0)
        moved = np.ptp(np.array([place for _, place in self._recent]), axis=0)
        return int(np.argmax(commanded - moved - LATENESS_TIE * self._largest_movement))
