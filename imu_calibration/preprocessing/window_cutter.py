"""Phases of the joints (rest, constant rate, motion), and windows cut in them."""

from collections import Counter, deque
from enum import IntEnum
from math import ceil
from typing import Any

import numpy as np
from scipy.special import ndtri

from imu_calibration.core.samples import any_within, runs_of
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.kinematics.joint_curve import fit_joint_curve
from imu_calibration.kinematics.joint_motion import JointMotion, encoder_step
from imu_calibration.preprocessing.window import (
    PhasedSamples,
    UnusedReason,
    Window,
    WindowKind,
    WindowSettings,
    make_window,
)


class Phase(IntEnum):
    """Phase of the joints at a reading."""

    STILL = 0
    """All of them rest."""
    STEADY = 1
    """All rates are constant, and one joint turns."""
    MOVING = 2
    """Any other motion."""
    LOST = 3
    """Unknown."""


STILL, STEADY, MOVING, LOST = Phase
RATE_SPAN = 0.2
"""Rates are slopes over this time, s: long enough for encoders, short against `settling`."""
LONGEST_SPAN = 1.0
"""A rest or a steady turn must show over this time (or the shortest window, if that is less), s."""
PHASE_REACH = RATE_SPAN / 2 + LONGEST_SPAN
"""Readings at a larger distance do not change a phase, s."""


def joint_phases(
    time: np.ndarray,
    position: np.ndarray,
    settings: WindowSettings,
    *,
    noise_rad: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the phase of each joint reading of a stretch without gaps.

    At rest: every slope over 0.2 s, and at least one slope over a second that contains the reading,
    is below `static_rate` plus errors of noise and encoder steps (four standard deviations; 1.5
    steps over the span). Steady: within at least one second that contains the reading the rates
    over 0.2 s change by less than `spin_rate_variation` of their middle, or by less than
    `static_rate`, and the readings show no ripple about them.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, increasing.
    position : array, shape (n, n_joints)
        Joint angles without jumps by whole turns, rad.
    settings : WindowSettings
    noise_rad : float, optional
        Known noise or resolution of the encoders, rad.

    Returns
    -------
    phase : array of int8, shape (n,)
        STILL, STEADY or MOVING.
    level : array, shape (n, n_joints)
        Positions averaged over 0.2 s, rad.

    """
    period = np.median(np.diff(time)) if len(time) > 1 else 1.0
    rows = np.ascontiguousarray(position.T)
    step, noise = (values[:, None] for values in _resolution(rows, noise_rad))
    half = _half_width(RATE_SPAN, period, 2)
    rate, level, ripple = _slopes(time, rows, half)
    still = _slow(rate, settings.static_rate, half, period, step, noise)
    if still.any():
        long_half = _half_width(min(LONGEST_SPAN, settings.static_minimum), period, half)
        long_rate, _, _ = _slopes(time, rows, long_half)
        still &= _widened(
            _slow(long_rate, settings.static_rate, long_half, period, step, noise), long_half
        )
    if still.all():
        return np.full(len(time), STILL, np.int8), level.T
    noise = np.maximum(
        np.maximum(noise, step / np.sqrt(12)), _white_noise(rows, 0.5, ~still)[:, None]
    )
    steady_half = _half_width(min(LONGEST_SPAN, settings.spin_minimum), period, half)
    steady = _steady(
        rate, settings, steady_half, 4 * noise * _slope_gain(half, period), ripple, half, 3 * noise
    )
    return np.where(still, STILL, np.where(steady, STEADY, MOVING)).astype(np.int8), level.T


def _resolution(rows, noise_rad):
    """Return the step of the encoders and the noise of the readings, both (n_joints,), rad."""
    step = np.array([encoder_step(row) for row in rows])
    # the lower quartile: if a quarter of the readings are at rest, it contains neither jitter nor
    # jerk
    return step, np.maximum(noise_rad or 0.0, _white_noise(rows, 0.25))


def _white_noise(rows, quantile, chosen=None):
    """
    Return the noise of the readings from a quantile of their fourth differences, (n_joints,).

    Smooth motion drops out.
    """
    fourth = np.abs(np.diff(rows, 4, axis=1))
    fourth = fourth if chosen is None else fourth[:, chosen[2:-2]]
    if fourth.shape[1] < 12:
        return np.zeros(len(rows))
    return np.quantile(fourth, quantile, axis=1) / (ndtri((1 + quantile) / 2) * np.sqrt(70))


def _half_width(span, period, least):
    return max(least, int(round(span / period / 2)))


def _slope_gain(half, period):
    """Return the standard deviation of a slope over ``2 half + 1`` readings for noise of one."""
    n = 2 * half + 1
    return np.sqrt(12 / n) / (n * period)


def _slow(rate, static_rate, half, period, step, noise):
    allowed = (
        static_rate + 4 * noise * _slope_gain(half, period) + 1.5 * step / ((2 * half + 1) * period)
    )
    return np.all(np.abs(rate) <= allowed, axis=0)


def _steady(rate, settings, half, allowance, ripple, ripple_half, noise):
    from scipy.ndimage import (  # here, because its import is slow
        maximum_filter1d,
        minimum_filter1d,
        uniform_filter1d,
    )

    size = 2 * half + 1
    high = maximum_filter1d(rate, size, axis=1, mode='nearest')
    low = minimum_filter1d(rate, size, axis=1, mode='nearest')
    change = np.maximum(settings.spin_rate_variation * np.abs(high + low) / 2, settings.static_rate)
    # a rate that swings by `change` within the span moves the readings by this
    swing = change * RATE_SPAN / (2 * np.pi)
    rough = np.sqrt(
        np.maximum(uniform_filter1d(ripple**2, 2 * ripple_half + 1, axis=1, mode='nearest'), 0.0)
    )
    even = maximum_filter1d(rough - swing, size, axis=1, mode='nearest') <= noise
    return _widened(np.all((high - low <= change + 2 * allowance) & even, axis=0), half)


def _widened(mask, half):
    return any_within(mask, half, half)


def _slopes(time, rows, half):
    """
    Return least-squares slopes, means, and the residuals of the readings.

    The slopes and means are over ``2 half + 1`` readings, fewer at the ends.
    """
    n = len(time)
    half = min(half, n - 1)
    place = np.arange(n)
    count = np.minimum(place + half + 1, n) - np.maximum(place - half, 0)
    middle = rows.mean(axis=1, keepdims=True)
    t = time - time.mean()
    p = rows - middle
    sum_t, sum_tt = _window_sums(np.stack([t, t * t]), half)
    sum_p = _window_sums(p, half)
    sum_tp = _window_sums(p * t, half)
    spread = np.maximum(sum_tt - sum_t**2 / count, 1e-18)
    slope = (sum_tp - sum_t * sum_p / count) / spread
    return slope, sum_p / count + middle, p - sum_p / count - slope * (t - sum_t / count)


def _window_sums(rows, half):
    n = rows.shape[1]
    sums = np.empty((len(rows), n + 2 * half + 1))
    sums[:, : half + 1] = 0.0
    np.cumsum(rows, axis=1, out=sums[:, half + 1 : half + 1 + n])
    sums[:, half + 1 + n :] = sums[:, half + n, None]
    return sums[:, 2 * half + 1 :] - sums[:, :n]


LEAST_READINGS = 4
"""Fewest readings for an estimate of the motion."""


class JointRun:
    """Joint readings without gaps."""

    def __init__(
        self,
        time: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
        *,
        settings: WindowSettings,
        noise_rad: float | None,
    ):
        self.time = time
        self.position = position
        self.velocity = velocity
        self.phase, self.level = joint_phases(time, position, settings, noise_rad=noise_rad)
        self._moving = time[self.phase != STILL]
        self.step = np.array([encoder_step(column) for column in position.T])

    def covered(self, time: np.ndarray, before: bool, after: bool) -> np.ndarray:
        """
        Return a mask of the instants between the readings.

        Where the joints rest, also of those within two periods of the first or last reading.
        """
        reach = 2 * np.median(np.diff(self.time))
        low = self.time[0] - (reach if before and self.phase[0] == STILL else 0.0)
        high = self.time[-1] + (reach if after and self.phase[-1] == STILL else 0.0)
        return (time >= low) & (time <= high)

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the phase (if equal at both neighbours, otherwise moving) and the level at instants.
        """
        right = np.minimum(np.searchsorted(self.time, time), len(self.time) - 1)
        left = np.maximum(right - 1, 0)
        phase = np.where(self.phase[left] == self.phase[right], self.phase[right], MOVING)
        level = np.stack([np.interp(time, self.time, column) for column in self.level.T], axis=1)
        return phase.astype(np.int8), level

    def near_motion(self, time: np.ndarray, distance: float) -> np.ndarray:
        """
        Return a mask of the instants near a reading with moving joints.

        The instants are between the readings and within `distance` of one with moving joints.
        """
        if not len(self._moving):
            return np.zeros(len(time), bool)
        right = np.searchsorted(self._moving, time)
        ahead = self._moving[np.minimum(right, len(self._moving) - 1)]
        behind = self._moving[np.maximum(right - 1, 0)]
        near = np.minimum(np.abs(ahead - time), np.abs(time - behind)) <= distance
        return near & (time >= self.time[0]) & (time <= self.time[-1])

    def curve(self, time: np.ndarray, overlap: float, noise_rad: float | None) -> JointMotion:
        """Return the `JointMotion` of a smooth curve at instants."""
        first, stop = np.searchsorted(self.time, [time[0] - overlap, time[-1] + overlap])
        first = max(0, min(first, len(self.time) - LEAST_READINGS))
        stop = min(len(self.time), max(stop, LEAST_READINGS))
        piece = slice(first, stop)
        velocity = None if np.isnan(self.velocity[piece]).all() else self.velocity[piece]
        return fit_joint_curve(
            self.time[piece], self.position[piece], velocity, noise_sd=noise_rad
        ).at(time)


BEST_BIAS, BEST_TIME = 1e-4, 100.0
"""
m/s^2 and s: the best accelerometers hold their bias to 10 ug over minutes (a Gauss-Markov process;
field figures in `sensor_noise`).
"""
PIECE_SECONDS = 0.25
"""
Duration of the means from which noise at low frequency is estimated, s: longer than sensor filters.
"""
MIN_NOISE_PIECES = 4
MIN_MOVING_SECONDS = 5.0
"""Least length of moving windows, s."""


class WanderLimit:
    """
    The longest moving window that the noise at rest allows.

    Over T the sd of the mean of white noise of density d is ``d / sqrt(T)``, of a bias about ``sd
    sqrt(2 T / time)``. They are equal at ``T = d sqrt(time / 2) / sd``; in a longer window, drift
    biases scale factors and arms. That is 80 s at 120 ug/sqrt(Hz), and less than a second at 1
    ug/sqrt(Hz). Where the change of gravity during the jitter of the stamps exceeds the noise, the
    reference limits the accuracy, and means over short windows would contain its errors instead.
    """

    def __init__(self) -> None:
        self._densities: deque[float] = deque(maxlen=9)

    def rested(self, samples: PhasedSamples) -> None:
        """Estimate the noise density from a window at rest."""
        period = _period(samples)
        length = int(round(PIECE_SECONDS / period)) if period > 0 else 0
        pieces = len(samples) // length if length else 0
        if pieces >= MIN_NOISE_PIECES:
            means = samples.force_s[: pieces * length].reshape(pieces, length, 3).mean(axis=1)
            self._densities.append(
                float(np.sqrt(np.median(np.diff(means, axis=0).var(axis=0) / 2) * length * period))
            )

    def pieces(self, samples: PhasedSamples) -> int:
        """
        Return the number of windows into which motion is cut; one if no rest has occurred yet.
        """
        if not self._densities or len(samples) < 3:
            return 1
        density = float(np.median(self._densities))
        jitter = np.diff(samples.time, 2).std() / np.sqrt(6)
        if (
            STANDARD_GRAVITY
            * np.sqrt((samples.rate_s**2).sum(axis=1).mean())
            * jitter
            * np.sqrt(_period(samples))
            > density
        ):
            return 1
        longest = max(MIN_MOVING_SECONDS, density * np.sqrt(BEST_TIME / 2) / BEST_BIAS)
        return ceil((samples.time[-1] - samples.time[0]) / longest)


def _period(samples):
    return (samples.time[-1] - samples.time[0]) / max(len(samples) - 1, 1)


_USES: tuple[Any, ...] = (*tuple(WindowKind)[1:], *tuple(UnusedReason)[1:])
_STATIC, _SPIN, _DYNAMIC, _SETTLING, _NOT_QUIET, _TURN_ON, _TOO_SHORT, _REST_TOO_SHORT = range(
    len(_USES)
)
_MIN_WINDOW_SAMPLES = 5


class WindowCutter:
    """
    Converts samples, in order and in pieces of any length, to windows.

    Buffers a few window lengths at most.

    Three steps, each with the least delay:
    runs of one phase that are too short for it become motion, samples get a use, runs of one use
    become windows or are unused.
    """

    def __init__(self, settings: WindowSettings, short_rest: float, keep_unused: bool = False):
        self.counts = Counter()
        self._settings = settings
        self._short_rest = short_rest
        self._keep_unused = keep_unused
        self._waiting = None
        self._phase_before = None
        self._disturbed = self._ramped = -np.inf
        self._open: tuple[Any, Any] | None = None
        self._wander = WanderLimit()

    def change(self, settings: WindowSettings, short_rest: float) -> None:
        """Use other settings from now on."""
        self._settings, self._short_rest = settings, short_rest

    @property
    def n_waiting(self) -> int:
        """Samples held."""
        return (0 if self._waiting is None else len(self._waiting)) + (
            0 if self._open is None else len(self._open[0])
        )

    def push(self, samples: PhasedSamples | None, final: bool = False) -> list[Window]:
        """
        Add the next samples (or None) and return the complete windows.

        With `final` all remaining ones.
        """
        windows = []
        if self._waiting is not None:
            samples = (
                self._waiting
                if samples is None
                else PhasedSamples.concatenate([self._waiting, samples])
            )
            self._waiting = None
        if samples is not None and len(samples):
            windows += self._cut(*self._decided(samples, final))
        if final and self._open is not None:
            windows += self._close(*self._open)
            self._open = None
        return windows

    def _decided(self, samples, final):
        """Return the samples whose phase is final, and that phase; buffer the remaining samples."""
        starts, stops = _runs(samples.phase, samples.after_gap).T
        time, settings = samples.time, self._settings
        phase = samples.phase.copy()
        original = samples.phase[starts]
        before = np.concatenate(
            [[-1 if self._phase_before is None else self._phase_before], original[:-1]]
        )
        before[samples.after_gap[starts]] = -1
        decided = len(samples)
        for k, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            is_open = k == len(starts) - 1 and not final
            length = time[stop - 1] - time[start]
            needed = (
                self._short_rest
                if original[k] == STILL
                else settings.spin_minimum + (settings.settling if before[k] >= 0 else 0.0)
            )
            goes_on = before[k] == original[k]  # the part before was long enough already
            if original[k] == MOVING or goes_on or length > needed:
                continue
            if is_open:
                decided = start
            elif original[k] == STEADY or (
                before[k] in (STEADY, MOVING)
                and k + 1 < len(original)
                and not samples.after_gap[stop]
            ):
                phase[start:stop] = MOVING
        if decided < len(samples):
            self._waiting = samples.select(slice(decided, None))
        if decided:
            self._phase_before = samples.phase[decided - 1]
        return samples.select(slice(0, decided)), phase[:decided]

    def _cut(self, samples, phase):
        if not len(samples):
            return []
        use = self._uses(samples, phase)
        if self._open is not None:
            before, use_before = self._open
            samples = PhasedSamples.concatenate([before, samples])
            use = np.append(np.full(len(before), use_before), use)
        windows = []
        for start, stop in _runs(use, samples.after_gap):
            cut_off, start = self._shed(samples, start, stop, use[start])
            windows += cut_off
            rest = samples.select(slice(start, stop)), use[start]
            if stop < len(samples):
                windows += self._close(*rest)
        self._open = rest
        return windows

    def _shed(self, samples, start, stop, use):
        """
        Cut complete windows off a run while it is twice as long as a window, open or not.

        Independent of the time of arrival.
        """
        windows = []
        longest = self._longest(use)
        while samples.time[stop - 1] - samples.time[start] >= 2 * longest:
            cut = int(np.searchsorted(samples.time, samples.time[start] + longest))
            windows += self._finished(samples.select(slice(start, cut)), use)
            start = cut
        return windows, start

    def _uses(self, samples, phase):
        time, settings = samples.time, self._settings
        unknown = samples.after_loss
        calm_rest = (phase == STILL) & samples.quiet & ~unknown
        steady = (phase == STEADY) & ~unknown
        rested = time - self._last_time(time, ~calm_rest, '_disturbed') >= settings.settling
        settled = time - self._last_time(time, ~steady, '_ramped') >= settings.settling
        use = np.full(len(time), _DYNAMIC)
        for at_phase, good, wanted in ((STILL, rested, _STATIC), (STEADY, settled, _SPIN)):
            use[phase == at_phase] = np.where(good[phase == at_phase], wanted, _SETTLING)
        use[(use == _SETTLING) & (phase == STILL) & ~samples.quiet] = _NOT_QUIET
        use[time < settings.turn_on] = _TURN_ON
        return use

    def _last_time(self, time, event, name):
        """
        Return the time of the last event at or before each sample.

        The last one is remembered under `name`.
        """
        last = np.maximum.accumulate(np.where(event, time, getattr(self, name)))
        setattr(self, name, last[-1])
        return last

    def _close(self, samples, use):
        """
        Return the windows of a complete run of one use, cut into equal pieces.

        The pieces are of at most the longest length.
        """
        pieces = max(1, ceil((samples.time[-1] - samples.time[0]) / self._longest(use)))
        windows = []
        for part in _equal_parts(samples, pieces):
            windows += self._finished(part, use)
        return windows

    def _least(self, use):
        settings = self._settings
        return {
            _STATIC: settings.static_minimum,
            _SPIN: settings.spin_minimum,
            _DYNAMIC: settings.dynamic_minimum,
        }.get(use, 0.0)

    def _longest(self, use):
        # halves of a window slightly above the longest length must not be below the shortest
        return max(self._settings.window_maximum, 2 * self._least(use))

    def _finished(self, samples, use):
        n = len(samples)
        length = (samples.time[-1] - samples.time[0]) * n / max(n - 1, 1)
        if length < self._least(use) or (use <= _DYNAMIC and n < _MIN_WINDOW_SAMPLES):
            use = _REST_TOO_SHORT if use == _STATIC else _TOO_SHORT
        self.counts[_USES[use]] += n
        if use > _DYNAMIC:
            return (
                [make_window(samples, WindowKind.UNUSED, _USES[use])] if self._keep_unused else []
            )
        if use == _STATIC:
            self._wander.rested(samples)
        pieces = self._wander.pieces(samples) if use == _DYNAMIC else 1
        return [make_window(part, _USES[use]) for part in _equal_parts(samples, pieces)]


def _equal_parts(samples, count):
    bounds = np.linspace(0, len(samples), count + 1).astype(int)
    return [
        samples.select(slice(start, stop))
        for start, stop in zip(bounds[:-1], bounds[1:], strict=True)
    ]


def _runs(value, broken):
    """Return (start, stop) of runs of equal values that are not broken before a sample."""
    return runs_of(np.ones(len(value)), (value[1:] != value[:-1]) | broken[1:])


ACCEPTED = (*_USES, 'edge of joints')
"""Counts of complete samples; the last six are excluded from windows on purpose."""


def dropped(counts: dict[str | UnusedReason | WindowKind, int]) -> dict[str, int]:
    """
    Return the counts of samples that were lost or could not be used, reason -> count.

    Without zeros.
    """
    found = {}
    for reason, count in sorted(counts.items()):
        if count and reason not in ACCEPTED:
            found[reason] = int(count)
    return found
