"""
Smooth joint motion put together from segments.

Rests, moves, ramps, spins and oscillations, with exact derivatives.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.motion_limits import MotionLimits, free_limits
from imu_calibration.kinematics.table import Table

# Smooth steps from 0 to 1 and their derivatives, lowest power first. A position blended by the
# septic and a rate blended by the quintic both have continuous position, rate, acceleration and
# jerk where segments meet.
_SEPTIC = np.polynomial.Polynomial([0, 0, 0, 0, 35, -84, 70, -20])
_QUINTIC = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
_POSITION_STEP = [_SEPTIC.deriv(order) for order in range(4)]
_RATE_STEP = [_QUINTIC.integ(), *(_QUINTIC.deriv(order) for order in range(3))]
PEAK_RATE_OF_MOVE = 2.1875
"""Largest rate of a move, in units of distance over duration."""
PEAK_ACCELERATION_OF_MOVE = 7.5132
"""Largest acceleration of a move, in units of distance over duration squared."""
SHORTEST_MOVE = 0.5
"""No move or ramp is shorter, s."""
SHORTEST_DWELL = 0.8
"""Rests and spins cut to less than this share would be too short for windows."""
PEAK_ACCELERATION_OF_RAMP = 1.875
"""Largest acceleration of a ramp, in units of change of rate over duration."""


@dataclass(frozen=True, eq=False)
class Segment:
    """
    A stretch of motion of all joints.

    With the smooth steps Q (quintic) and S (septic) from 0 to 1, the duration T and u = t / T::

        position = start + rate_from t + (rate_to - rate_from) T integral Q du + shift S(u)
                   + envelope(t) sum amplitude sin(2 pi frequency t + phase)
        envelope = S(t / fade) - S(1 - (T - t) / fade)      with arguments limited to 0 to 1
    """

    kind: str
    """'rest', 'move', 'ramp', 'spin' or 'oscillation'."""
    duration: float
    """Length, s."""
    start: np.ndarray
    """Joint positions at the start, rad, shape (n_joints,)."""
    rate_from: np.ndarray
    """Joint rates at the start, rad/s, shape (n_joints,)."""
    rate_to: np.ndarray
    """Joint rates at the end, rad/s, shape (n_joints,)."""
    shift: np.ndarray
    """Distance of a move, rad, shape (n_joints,)."""
    amplitude: np.ndarray | None = None
    """Amplitudes of the sines, rad, shape (n_sines, n_joints)."""
    frequency: np.ndarray | None = None
    """Their frequencies, Hz, same shape."""
    phase: np.ndarray | None = None
    """Their phases at the start, rad, same shape."""
    fade: float = 0.0
    """Time over which the sines fade in and out, s; at most half the duration."""

    @property
    def end(self) -> np.ndarray:
        """Joint positions at the end, rad, shape (n_joints,)."""
        return self.start + self.shift + 0.5 * (self.rate_from + self.rate_to) * self.duration

    def at(self, time: np.ndarray) -> np.ndarray:
        """
        Return position, rate, acceleration and jerk at `time` since the start of the segment.

        Shape (4, n, n_joints).
        """
        motion = np.zeros((4, len(time), len(self.start)))
        motion[0] = self.start + time[:, None] * self.rate_from
        motion[1] = self.rate_from
        self._add_steps(motion, time)
        if self.amplitude is not None:
            self._add_sines(motion, time)
        return motion

    def _add_steps(self, motion: np.ndarray, time: np.ndarray) -> None:
        """
        Add change of rate and shift to position and derivatives, shape (4, n, n_joints).

        Each derivative by t of ``change T integral Q(t / T)`` and ``shift S(t / T)`` adds 1 / T.
        """
        share = time / self.duration
        change = self.rate_to - self.rate_from
        if change.any():
            for order in range(4):
                scale = change * self.duration ** (1 - order)
                motion[order] += np.outer(_RATE_STEP[order](share), scale)
        if self.shift.any():
            for order in range(4):
                scale = self.shift * self.duration**-order
                motion[order] += np.outer(_POSITION_STEP[order](share), scale)

    def _add_sines(self, motion: np.ndarray, time: np.ndarray) -> None:
        """
        Add the sines with their envelope to position and derivatives, shape (4, n, n_joints).

        By Leibniz: ``(e w)^(m) = sum_i binomial(m, i) e^(m - i) w^(i)``.
        """
        # The envelope and its derivatives.
        rise = np.clip(time / self.fade, 0.0, 1.0)
        fall = np.clip((time - self.duration) / self.fade + 1.0, 0.0, 1.0)
        envelope = []
        for order, step in enumerate(_POSITION_STEP):
            envelope.append((step(rise) - step(fall)) * self.fade**-order)
        # A segment has all three, or none.
        assert self.amplitude is not None
        assert self.frequency is not None and self.phase is not None
        for amplitude, frequency, phase in zip(
            self.amplitude, self.frequency, self.phase, strict=True
        ):
            omega = 2.0 * np.pi * frequency
            angle = np.outer(time, omega) + phase
            sine = amplitude * np.sin(angle)
            cosine = amplitude * np.cos(angle) * omega
            waves = [sine, cosine, -sine * omega**2, -cosine * omega**2]
            for order in range(4):
                for inner in range(order + 1):
                    motion[order] += (
                        math.comb(order, inner) * envelope[order - inner][:, None] * waves[inner]
                    )


@dataclass(frozen=True, eq=False)
class Profile:
    """A named motion of all joints, at rest before its start and after its end."""

    name: str
    """Name in the registry."""
    segments: tuple[Segment, ...]
    """Segments in the order of time."""
    joint_names: tuple[str, ...] | None = None
    """Joints in column order, when the profile is tied to a table."""
    table: dict | None = None
    """Description of the table that the profile is made for (as in the table's YAML), or None."""

    def table_moved(self, given: Table) -> Table:
        """Return the table of the profile if it has one, otherwise `given`."""
        return given if self.table is None else Table.from_mapping(self.table)

    @property
    def edges(self) -> np.ndarray:
        """Start of every segment and the end of the last, s, shape (n_segments + 1,)."""
        return np.concatenate([[0.0], np.cumsum([segment.duration for segment in self.segments])])

    @property
    def duration(self) -> float:
        """Length, s."""
        return float(self.edges[-1])

    def at(self, time: np.ndarray) -> JointMotion:
        """
        Return the joints' motion at any times.

        Parameters
        ----------
        time : array, shape (n,)
            Seconds since the start, in any order; the joints rest outside ``[0, duration]``.

        Returns
        -------
        JointMotion

        """
        time = np.atleast_1d(np.asarray(time, float))
        motion = self._evaluate(np.clip(time, 0.0, self.duration))
        return JointMotion(time, *motion)

    def _evaluate(self, time: np.ndarray) -> np.ndarray:
        """
        Return position, rate, acceleration and jerk at times within the profile, (4, n, n_joints).
        """
        if np.any(time[1:] < time[:-1]):
            order = np.argsort(time, kind='stable')
            motion = np.empty((4, len(time), len(self.segments[0].start)))
            motion[:, order] = self._evaluate(time[order])
            return motion

        # Segment k has the times cuts[k]:cuts[k + 1].
        edges = self.edges
        cuts = [0, *np.searchsorted(time, edges[1:-1]), len(time)]
        motion = np.empty((4, len(time), len(self.segments[0].start)))
        for k, segment in enumerate(self.segments):
            inside = slice(cuts[k], cuts[k + 1])
            if cuts[k + 1] > cuts[k]:
                motion[:, inside] = segment.at(time[inside] - edges[k])
        return motion

    def find(self, kind: str) -> np.ndarray:
        """Return (start, end) of every segment of a kind, s, shape (n, 2)."""
        edges = self.edges
        spans = []
        for k, segment in enumerate(self.segments):
            if segment.kind == kind:
                spans.append((edges[k], edges[k + 1]))
        return np.array(spans).reshape(-1, 2)


class MotionBuilder:
    """
    Writes segments one after the other, each starting where the last one ended.

    Angles are in degrees here, in radians in the segments. For sliding joints, use the methods with
    SI units. Each method returns the builder, so that calls can be chained.
    """

    def __init__(
        self,
        n_joints: int,
        dwell: float = 1.0,
        limits: MotionLimits | None = None,
        *,
        start: np.ndarray | None = None,
    ):
        """
        Start at rest at zero, or at the positions `start`.

        `dwell` stretches rests, spins and oscillations, the limits (`MotionLimits`) time moves and
        ramps.
        """
        self.segments: tuple[Segment, ...] = ()
        """The segments so far."""
        self.dwell = dwell
        self.limits = limits or free_limits(n_joints)
        self.home = np.clip(np.zeros(n_joints), self.limits.lower, self.limits.upper)
        """Zero, or the nearest position within the limits, shape (n_joints,)."""
        self._position = self.home if start is None else np.asarray(start, float)
        """Position at the end of the last segment, rad or m, shape (n_joints,)."""

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self._position)

    def rest(self, duration: float) -> 'MotionBuilder':
        """Rest for `duration` times dwell, s."""
        return self._append('rest', duration * self.dwell)

    def rest_at_home(self, duration: float) -> 'MotionBuilder':
        """Rest at zero, or at the nearest position within the limits."""
        return self.move_to(self.home).rest(duration)

    def move(self, angles_deg: ArrayLike, shortest: bool = True) -> 'MotionBuilder':
        """
        Move to the joint angles (NaN: do not move that joint), of which the first are repeated.

        When `shortest`, each endless joint moves by less than half a turn.
        """
        angles = np.resize(np.asarray(angles_deg, float), self.n_joints)
        return self.move_to(np.radians(angles), shortest)

    def move_to(self, target: np.ndarray, shortest: bool = True) -> 'MotionBuilder':
        """
        Move to joint positions in rad and m (NaN: do not move that joint).

        When `shortest`, each endless joint moves by less than half a turn.
        """
        shift = np.where(np.isnan(target), 0.0, target - self._position)
        if shortest:
            wrapped = (shift + np.pi) % (2.0 * np.pi) - np.pi
            shift = np.where(self.limits.endless, wrapped, shift)
        distance = np.abs(shift)
        if np.max(distance) < 1e-9:
            return self
        return self._append('move', move_time(distance, self.limits), shift=shift)

    def spin(self, rates_deg: ArrayLike, duration: float) -> 'MotionBuilder':
        """
        Turn at each of the rates in `rates_deg`, shape (n_rates, n_joints), then stop.

        Each rate is constant for `duration` times dwell, s.
        """
        last = np.zeros(self.n_joints)
        for rate in np.radians(np.atleast_2d(np.asarray(rates_deg, float))):
            self._ramp(last, rate)
            self._append('spin', duration * self.dwell, rate, rate)
            last = rate
        return self._ramp(last, np.zeros(self.n_joints))

    def oscillate(
        self,
        amplitude_deg: ArrayLike,
        frequency: ArrayLike,
        duration: float,
        *,
        phase: ArrayLike = 0.0,
        fade: float | None = None,
    ) -> 'MotionBuilder':
        """
        Swing every joint by sums of sines for `duration` times dwell, s.

        Amplitude, frequency (Hz) and phase (rad) have shape (n_sines, n_joints) or (n_joints,).
        `fade` is as in `Segment`; by default the longest period.
        """
        return self.swing(np.radians(amplitude_deg), frequency, duration, phase=phase, fade=fade)

    def swing(
        self,
        amplitude: np.ndarray,
        frequency: ArrayLike,
        duration: float,
        *,
        phase: ArrayLike = 0.0,
        fade: float | None = None,
    ) -> 'MotionBuilder':
        """Swing every joint as `oscillate`, with amplitudes in rad and m."""
        amplitude = np.atleast_2d(np.asarray(amplitude, float))
        frequency = np.broadcast_to(np.asarray(frequency, float), amplitude.shape)
        phase = np.broadcast_to(np.asarray(phase, float), amplitude.shape)
        duration = duration * self.dwell
        if fade is None:
            fade = 1.0 / np.min(frequency[amplitude != 0.0])
        fade = min(0.5 * duration, fade)
        return self._append(
            'oscillation',
            duration,
            amplitude=amplitude,
            frequency=frequency,
            phase=phase,
            fade=fade,
        )

    def _ramp(self, rate_from: np.ndarray, rate_to: np.ndarray) -> 'MotionBuilder':
        """Change the rates of the joints within the limits of acceleration, rad/s."""
        change = np.max(np.abs(rate_to - rate_from) / self.limits.acceleration)
        if change == 0.0:
            return self
        return self._append(
            'ramp', max(SHORTEST_MOVE, PEAK_ACCELERATION_OF_RAMP * change), rate_from, rate_to
        )

    def _append(
        self,
        kind: str,
        duration: float,
        rate_from: np.ndarray | None = None,
        rate_to: np.ndarray | None = None,
        shift: np.ndarray | None = None,
        **sines: Any,
    ) -> 'MotionBuilder':
        """Append a Segment from the present position; None: zeros, `sines`: its other fields."""
        zero = np.zeros(self.n_joints)
        segment = Segment(
            kind=kind,
            duration=float(duration),
            start=self._position,
            rate_from=zero if rate_from is None else rate_from,
            rate_to=zero if rate_to is None else rate_to,
            shift=zero if shift is None else shift,
            **sines,
        )
        self.segments += (segment,)
        self._position = segment.end
        return self


def move_time(distance: np.ndarray, limits: MotionLimits) -> float:
    """Return the duration of a move within the limits by `distance`, shape (n_joints,), s."""
    by_speed = np.max(PEAK_RATE_OF_MOVE * distance / limits.speed)
    by_acceleration = np.sqrt(np.max(PEAK_ACCELERATION_OF_MOVE * distance / limits.acceleration))
    return float(max(SHORTEST_MOVE, by_speed, by_acceleration))


def stretch(build: Callable, duration: float) -> tuple[Segment, ...]:
    """
    Return the segments of `build(dwell)` with the dwell that makes them last `duration` seconds.

    Raises
    ------
    InputError
        When `duration` is below the time of moves and ramps with the shortest dwells.

    """
    # The length is linear in the dwell: `change` is its slope.
    length = sum(segment.duration for segment in build(1.0))
    change = sum(segment.duration for segment in build(2.0)) - length
    shortest = length - (1.0 - SHORTEST_DWELL) * change
    if duration < shortest - 1e-6:
        raise InputError(
            f'duration must be at least {shortest:.0f} s for this profile, got {duration:g} s;'
            ' choose more or another profile',
            code='too_short',
        )
    return build(1.0 + (duration - length) / change)
