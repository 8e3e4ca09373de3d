"""Phases of the joints (rest, constant rate, motion), and windows cut in them."""

from collections import Counter, deque
from dataclasses import dataclass
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
    step = np.array([encoder_step(row) for row in rows])[:, None]
    # The lower quartile: if a quarter of the readings are at rest, it contains neither jitter nor
    # jerk.
    noise = np.maximum(noise_rad or 0.0, _white_noise(rows, 0.25))[:, None]

    # Rest: the slopes over 0.2 s, and those over a second near the reading, are small.
    half = _half_width(RATE_SPAN, period, 2)
    lines = _LineFits.of(time, rows, half)
    level = lines.mean.T
    still = _is_slow(lines, settings.static_rate, period, step, noise)
    if still.any():
        long_half = _half_width(min(LONGEST_SPAN, settings.static_minimum), period, half)
        long_lines = _LineFits.of(time, rows, long_half)
        is_slow = _is_slow(long_lines, settings.static_rate, period, step, noise)
        still &= any_within(is_slow, long_half, long_half)
    if still.all():
        return np.full(len(time), STILL, np.int8), level

    # Turn at a constant rate. In motion the steps of the encoders are noise too, and white noise is
    # that of the readings in motion.
    noise = np.maximum(
        np.maximum(noise, step / np.sqrt(12)), _white_noise(rows, 0.5, ~still)[:, None]
    )
    steady_half = _half_width(min(LONGEST_SPAN, settings.spin_minimum), period, half)
    steady = _is_steady(lines, settings, steady_half, period, noise)
    return np.where(still, STILL, np.where(steady, STEADY, MOVING)).astype(np.int8), level


def _white_noise(rows: np.ndarray, quantile: float, chosen: np.ndarray | None = None) -> np.ndarray:
    """
    Return the sd of the white noise of each joint from its fourth differences, rad, (n_joints,).

    Smooth motion cancels in them, and white noise has 70 times its variance. Their sd is computed
    from a quantile of their absolute values, for a normal distribution.

    Parameters
    ----------
    rows : array, shape (n_joints, n)
        Readings, rad.
    quantile : float
        Small where most readings contain other errors.
    chosen : array of bool, shape (n,), optional
        Readings that are used; by default all.

    """
    fourth = np.abs(np.diff(rows, 4, axis=1))
    if chosen is not None:
        fourth = fourth[:, chosen[2:-2]]
    if fourth.shape[1] < 12:
        return np.zeros(len(rows))
    return np.quantile(fourth, quantile, axis=1) / (ndtri((1 + quantile) / 2) * np.sqrt(70))


def _half_width(span: float, period: float, least: int) -> int:
    """Return half the number of readings in `span` s, at least `least`."""
    return max(least, int(round(span / period / 2)))


def _slope_gain(half: int, period: float) -> float:
    """Return the sd of a slope over ``2 half + 1`` readings for noise of one, 1/s."""
    n = 2 * half + 1
    return np.sqrt(12 / n) / (n * period)


@dataclass(frozen=True, eq=False)
class _LineFits:
    """Straight lines fitted to the readings around each reading, for each joint."""

    half: int
    """A line is fitted to ``2 half + 1`` readings, fewer at the ends."""
    slope: np.ndarray
    """rad/s, shape (n_joints, n)."""
    mean: np.ndarray
    """Mean of these readings, rad, shape (n_joints, n)."""
    residual: np.ndarray
    """Reading in the middle minus its line, rad, shape (n_joints, n)."""

    @classmethod
    def of(cls, time: np.ndarray, rows: np.ndarray, half: int) -> '_LineFits':
        """
        Fit the lines of readings `rows`, rad, shape (n_joints, n), at times, shape (n,).

        With sums over the N readings of a line::

            slope = (sum t p - sum t sum p / N) / (sum t^2 - (sum t)^2 / N)
        """
        n = len(time)
        n_side = min(half, n - 1)
        index = np.arange(n)
        count = np.minimum(index + n_side + 1, n) - np.maximum(index - n_side, 0)
        # Relative to the means, against rounding.
        origin = rows.mean(axis=1, keepdims=True)
        t = time - time.mean()
        p = rows - origin
        sum_t, sum_tt = _window_sums(np.stack([t, t * t]), n_side)
        sum_p = _window_sums(p, n_side)
        sum_tp = _window_sums(p * t, n_side)
        time_squares = np.maximum(sum_tt - sum_t**2 / count, 1e-18)
        slope = (sum_tp - sum_t * sum_p / count) / time_squares
        residual = p - sum_p / count - slope * (t - sum_t / count)
        return cls(half, slope, sum_p / count + origin, residual)


def _is_slow(
    lines: _LineFits, static_rate: float, period: float, step: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """
    Return where the slopes of all joints are those of a rest, bool, shape (n,).

    Allowed are `static_rate`, four sd of a slope for `noise`, and 1.5 encoder steps over the span
    of a line; `step` and `noise` in rad, shape (n_joints, 1).
    """
    allowed = (
        static_rate
        + 4 * noise * _slope_gain(lines.half, period)
        + 1.5 * step / ((2 * lines.half + 1) * period)
    )
    return np.all(np.abs(lines.slope) <= allowed, axis=0)


def _is_steady(
    lines: _LineFits, settings: WindowSettings, half: int, period: float, noise: np.ndarray
) -> np.ndarray:
    """
    Return where the rates of all joints are constant, bool, shape (n,).

    A reading is in a steady turn if one of the spans of ``2 half + 1`` readings that contain it is
    steady: the slopes in the span vary by less than the settings allow plus their noise, and the
    rms of the residuals of the lines is explained by `noise`, rad, shape (n_joints, 1).
    """
    from scipy.ndimage import (  # here, because its import is slow
        maximum_filter1d,
        minimum_filter1d,
        uniform_filter1d,
    )

    size = 2 * half + 1
    slope_error = 4 * noise * _slope_gain(lines.half, period)
    high = maximum_filter1d(lines.slope, size, axis=1, mode='nearest')
    low = minimum_filter1d(lines.slope, size, axis=1, mode='nearest')
    change = np.maximum(settings.spin_rate_variation * np.abs(high + low) / 2, settings.static_rate)
    is_constant = high - low <= change + 2 * slope_error

    # A rate that swings by `change` within the span of a line moves the readings by `swing`, which
    # is allowed in addition to the noise.
    swing = change * RATE_SPAN / (2 * np.pi)
    mean_square = uniform_filter1d(lines.residual**2, 2 * lines.half + 1, axis=1, mode='nearest')
    rms = np.sqrt(np.maximum(mean_square, 0.0))
    is_even = maximum_filter1d(rms - swing, size, axis=1, mode='nearest') <= 3 * noise
    return any_within(np.all(is_constant & is_even, axis=0), half, half)


def _window_sums(rows: np.ndarray, half: int) -> np.ndarray:
    """Return the sums of each row over ``2 half + 1`` values about each one, fewer at the ends."""
    # Running sums, with zeros before the first value and the total after the last one, so that the
    # sum about value k is sums[k + 2 half + 1] - sums[k].
    n = rows.shape[1]
    sums = np.empty((len(rows), n + 2 * half + 1))
    sums[:, : half + 1] = 0.0
    np.cumsum(rows, axis=1, out=sums[:, half + 1 : half + 1 + n])
    sums[:, half + 1 + n :] = sums[:, half + n, None]
    return sums[:, 2 * half + 1 :] - sums[:, :n]


LEAST_READINGS = 4
"""Fewest readings for an estimate of the motion."""


class JointRun:
    """
    Joint readings without gaps, with their phases.

    Parameters
    ----------
    time : array, shape (n,)
        Session time, s.
    position, velocity : array, shape (n, n_joints)
        rad, rad/s; a velocity is NaN where it is unknown.
    settings : WindowSettings
    noise_rad : float or None
        Known noise of the encoders, rad.

    """

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
        """Phase at each reading, shape (n,), and positions averaged over 0.2 s, (n, n_joints)."""
        self.step = np.array([encoder_step(column) for column in position.T])
        """Steps of the encoders, rad, zero where none are visible, shape (n_joints,)."""
        # Times of the readings with moving joints, s.
        self._moving_time = time[self.phase != STILL]

    def covered(self, time: np.ndarray, before: bool, after: bool) -> np.ndarray:
        """
        Return a mask of the instants between the readings, shape of `time`.

        With `before` (`after`) also of those up to two periods before the first (after the last)
        reading, if the joints rest there.
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
        Return a mask of the instants between the readings and near one with moving joints.

        Near: at most `distance` s from it.
        """
        if not len(self._moving_time):
            return np.zeros(len(time), bool)
        right = np.searchsorted(self._moving_time, time)
        ahead = self._moving_time[np.minimum(right, len(self._moving_time) - 1)]
        behind = self._moving_time[np.maximum(right - 1, 0)]
        near = np.minimum(np.abs(ahead - time), np.abs(time - behind)) <= distance
        return near & (time >= self.time[0]) & (time <= self.time[-1])

    def curve(self, time: np.ndarray, overlap: float, noise_rad: float | None) -> JointMotion:
        """
        Return the motion at increasing instants by a smooth curve through the readings.

        Through those up to `overlap` s before and after the instants, at least `LEAST_READINGS`.
        """
        first, stop = np.searchsorted(self.time, [time[0] - overlap, time[-1] + overlap])
        first = max(0, min(first, len(self.time) - LEAST_READINGS))
        stop = min(len(self.time), max(stop, LEAST_READINGS))
        piece = slice(first, stop)
        velocity = None if np.isnan(self.velocity[piece]).all() else self.velocity[piece]
        curve = fit_joint_curve(
            self.time[piece], self.position[piece], velocity, noise_sd=noise_rad
        )
        return curve.at(time)


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
"""Fewest means for an estimate of the noise."""
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
        # Noise densities of the specific force in the newest rests, m/s^2/sqrt(Hz).
        self._densities: deque[float] = deque(maxlen=9)

    def add_rest(self, samples: PhasedSamples) -> None:
        """
        Estimate the noise density d from a window at rest: ``d^2 = T v``, median of the axes.

        The variance v is that of means over T, half the variance of the differences of neighbouring
        means, in which drift cancels.
        """
        period = _period(samples)
        size = int(round(PIECE_SECONDS / period)) if period > 0 else 0  # samples of a mean
        n_means = len(samples) // size if size else 0
        if n_means < MIN_NOISE_PIECES:
            return
        means = samples.force_s[: n_means * size].reshape(n_means, size, 3).mean(axis=1)
        variance = np.median(np.diff(means, axis=0).var(axis=0) / 2)
        self._densities.append(float(np.sqrt(variance * size * period)))

    def n_windows(self, samples: PhasedSamples) -> int:
        """
        Return the number of windows into which samples of motion are cut, at least 1.

        It is 1 before the first rest, and where the errors of the reference exceed the noise.
        """
        if not self._densities or len(samples) < 3:
            return 1
        density = float(np.median(self._densities))
        # Error of the reference as a density: gravity turns by rate * jitter between samples. The
        # second differences of independent errors of stamps have six times their variance.
        jitter = np.diff(samples.time, 2).std() / np.sqrt(6)
        rms_rate = np.sqrt((samples.rate_s**2).sum(axis=1).mean())
        jitter_density = STANDARD_GRAVITY * rms_rate * jitter * np.sqrt(_period(samples))
        if jitter_density > density:
            return 1
        longest = max(MIN_MOVING_SECONDS, density * np.sqrt(BEST_TIME / 2) / BEST_BIAS)
        return ceil((samples.time[-1] - samples.time[0]) / longest)


def _period(samples: PhasedSamples) -> float:
    """Return the mean step of the times, s."""
    return (samples.time[-1] - samples.time[0]) / max(len(samples) - 1, 1)


_USES: tuple[Any, ...] = (*tuple(WindowKind)[1:], *tuple(UnusedReason)[1:])
"""Uses of a sample: the kinds of windows, then the reasons for none. Arrays hold their indices."""
_STATIC, _SPIN, _DYNAMIC, _SETTLING, _NOT_QUIET, _TURN_ON, _TOO_SHORT, _REST_TOO_SHORT = range(
    len(_USES)
)
_MIN_WINDOW_SAMPLES = 5
"""Fewest samples of a window."""
_NO_PHASE = -1
"""In place of the phase before a run that begins a recording or follows a gap."""


class WindowCutter:
    """
    Converts samples, in order and in pieces of any length, to windows.

    Buffers a few window lengths at most.

    Three steps, each with the least delay:
    runs of one phase that are too short for it become motion, samples get a use, runs of one use
    become windows or are unused.

    Parameters
    ----------
    settings : WindowSettings
    short_rest : float
        A shorter rest between motions is part of the motion, s.
    keep_unused : bool
        Also return windows of kind 'unused'.

    """

    def __init__(self, settings: WindowSettings, short_rest: float, keep_unused: bool = False):
        self.counts = Counter()
        """Use (a window kind or an `UnusedReason`) -> samples of finished runs."""
        self._settings = settings
        self._short_rest = short_rest
        self._keep_unused = keep_unused
        # Step 1. Samples of the newest run of one phase while it is too short, because it may
        # continue; and the phase of the sample before them.
        self._undecided: PhasedSamples | None = None
        self._phase_before: int | None = None
        # Step 2. Times of the newest samples that are not in a calm rest, not in a steady turn, s:
        # `settling` counts from them.
        self._not_resting_time = -np.inf
        self._not_steady_time = -np.inf
        # Step 3. The newest run of samples of one use, which may continue: (samples, index of the
        # use in `_USES`); and the longest window with motion.
        self._open_run: tuple[PhasedSamples, int] | None = None
        self._wander_limit = WanderLimit()

    def change(self, settings: WindowSettings, short_rest: float) -> None:
        """Use other settings from now on."""
        self._settings = settings
        self._short_rest = short_rest

    @property
    def n_buffered(self) -> int:
        """Number of samples that are not in a window or counted as unused yet."""
        n_undecided = 0 if self._undecided is None else len(self._undecided)
        n_open = 0 if self._open_run is None else len(self._open_run[0])
        return n_undecided + n_open

    def push(self, samples: PhasedSamples | None, final: bool = False) -> list[Window]:
        """
        Add the next samples (or None) and return the complete windows.

        With `final` all remaining ones.
        """
        windows = []
        if samples is None:
            samples = self._undecided
        else:
            samples = samples.after(self._undecided)
        self._undecided = None
        if samples is not None and len(samples):
            phase = self._final_phases(samples, final)
            n_final = len(phase)
            if n_final < len(samples):
                self._undecided = samples.select(slice(n_final, None))
            if n_final:
                self._phase_before = samples.phase[n_final - 1]
                windows += self._cut(samples.select(slice(0, n_final)), phase)
        if final and self._open_run is not None:
            windows += self._close(*self._open_run)
            self._open_run = None
        return windows

    def _final_phases(self, samples: PhasedSamples, final: bool) -> np.ndarray:
        """
        Return the phases of the first samples, as many as are decided, with short runs as MOVING.

        Undecided is a short run at the end, unless the samples are the `final` ones.
        """
        # Runs of one phase, and the phase before each of them.
        starts, stops = _runs(samples.phase, samples.after_gap).T
        time = samples.time
        settings = self._settings
        run_phase = samples.phase[starts]
        first_before = _NO_PHASE if self._phase_before is None else self._phase_before
        phase_before = np.append(first_before, run_phase[:-1])
        phase_before[samples.after_gap[starts]] = _NO_PHASE

        phase = samples.phase.copy()
        for k, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            # Motion, or the continuation of a run that was long enough.
            if run_phase[k] in (MOVING, phase_before[k]):
                continue
            # A steady turn settles after another phase, before its shortest window begins.
            needed = self._short_rest
            if run_phase[k] == STEADY:
                needed = settings.spin_minimum
                if phase_before[k] != _NO_PHASE:
                    needed += settings.settling
            if time[stop - 1] - time[start] > needed:
                continue

            # A short run: at the end it is undecided, a steady turn becomes motion.
            is_last = k + 1 == len(starts)
            if is_last and not final:
                return phase[:start]
            # A short rest next to a gap or an end stays a rest, because it may have been longer.
            between_motions = (
                phase_before[k] in (STEADY, MOVING) and not is_last and not samples.after_gap[stop]
            )
            if run_phase[k] == STEADY or between_motions:
                phase[start:stop] = MOVING
        return phase

    def _cut(self, samples: PhasedSamples, phase: np.ndarray) -> list[Window]:
        """Return the windows completed by samples with their final phases; store the open run."""
        use = self._uses(samples, phase)
        if self._open_run is not None:
            open_samples, open_use = self._open_run
            samples = samples.after(open_samples)
            use = np.append(np.full(len(open_samples), open_use), use)
        windows = []
        for start, stop in _runs(use, samples.after_gap):
            # Windows are cut off the run while it is twice as long as one, whether it is complete
            # or not: the cuts do not depend on the pieces in which the samples arrive.
            run_use = use[start]
            longest = self._longest(run_use)
            while samples.time[stop - 1] - samples.time[start] >= 2 * longest:
                cut = int(np.searchsorted(samples.time, samples.time[start] + longest))
                windows += self._finished(samples.select(slice(start, cut)), run_use)
                start = cut
            run = samples.select(slice(start, stop))
            if stop < len(samples):
                windows += self._close(run, run_use)
            else:
                self._open_run = run, run_use
        return windows

    def _uses(self, samples: PhasedSamples, phase: np.ndarray) -> np.ndarray:
        """Return the use of each sample with its final phase, indices of `_USES`, shape (n,)."""
        time = samples.time
        settings = self._settings
        known_before = ~samples.after_loss
        calm_rest = (phase == STILL) & samples.quiet & known_before
        steady = (phase == STEADY) & known_before

        # Samples of rests and steady turns settle first.
        not_resting_time = _last_time(time, ~calm_rest, self._not_resting_time)
        not_steady_time = _last_time(time, ~steady, self._not_steady_time)
        self._not_resting_time = not_resting_time[-1]
        self._not_steady_time = not_steady_time[-1]
        rest_settled = time - not_resting_time >= settings.settling
        turn_settled = time - not_steady_time >= settings.settling

        use = np.full(len(time), _DYNAMIC)
        use[phase == STILL] = np.where(rest_settled[phase == STILL], _STATIC, _SETTLING)
        use[phase == STEADY] = np.where(turn_settled[phase == STEADY], _SPIN, _SETTLING)
        use[(use == _SETTLING) & (phase == STILL) & ~samples.quiet] = _NOT_QUIET
        use[time < settings.turn_on] = _TURN_ON
        return use

    def _close(self, samples: PhasedSamples, use: int) -> list[Window]:
        """
        Return the windows of a complete run of samples with the same `use`, an index of `_USES`.

        The run is cut into equal pieces, none of which exceeds the longest length.
        """
        n_pieces = max(1, ceil((samples.time[-1] - samples.time[0]) / self._longest(use)))
        windows = []
        for part in _equal_parts(samples, n_pieces):
            windows += self._finished(part, use)
        return windows

    def _shortest(self, use: int) -> float:
        """Return the shortest length of a window with this `use`, an index of `_USES`, s."""
        shortest = {
            _STATIC: self._settings.static_minimum,
            _SPIN: self._settings.spin_minimum,
            _DYNAMIC: self._settings.dynamic_minimum,
        }
        return shortest.get(use, 0.0)

    def _longest(self, use: int) -> float:
        """Return the longest length of a window with this `use`, an index of `_USES`, s."""
        # Halves of a window slightly above the longest length must not be below the shortest.
        return max(self._settings.window_maximum, 2 * self._shortest(use))

    def _finished(self, samples: PhasedSamples, use: int) -> list[Window]:
        """
        Count the samples of a complete piece and return its windows: one, several for motion.

        An unused piece, or one that is too short for a window, has none unless those are kept.
        `use` is the index of its use in `_USES`.
        """
        n = len(samples)
        # The last sample lasts a period too.
        seconds = (samples.time[-1] - samples.time[0]) * n / max(n - 1, 1)
        # The first uses, up to _DYNAMIC, are the kinds of windows.
        has_too_few = use <= _DYNAMIC and n < _MIN_WINDOW_SAMPLES
        if seconds < self._shortest(use) or has_too_few:
            use = _REST_TOO_SHORT if use == _STATIC else _TOO_SHORT
        self.counts[_USES[use]] += n
        if use > _DYNAMIC:
            if not self._keep_unused:
                return []
            return [make_window(samples, WindowKind.UNUSED, _USES[use])]

        # Rests show the noise, which limits the length of windows with motion.
        if use == _STATIC:
            self._wander_limit.add_rest(samples)
        n_windows = self._wander_limit.n_windows(samples) if use == _DYNAMIC else 1
        return [make_window(part, _USES[use]) for part in _equal_parts(samples, n_windows)]


def _last_time(time: np.ndarray, event: np.ndarray, earlier: float) -> np.ndarray:
    """Return the time of the last event at or before each sample; `earlier`: before them all."""
    return np.maximum.accumulate(np.where(event, time, earlier))


def _equal_parts(samples: PhasedSamples, count: int) -> list[PhasedSamples]:
    """Return the samples in `count` parts of equal length, in order."""
    bounds = np.linspace(0, len(samples), count + 1).astype(int)
    parts = []
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        parts.append(samples.select(slice(start, stop)))
    return parts


def _runs(value: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """
    Return (start, stop) of runs of equal values that are not broken before a sample, (n_runs, 2).
    """
    return runs_of(np.ones(len(value)), (value[1:] != value[:-1]) | broken[1:])


ACCEPTED = (*_USES, 'edge of joints')
"""Counts of complete samples; the last six are excluded from windows on purpose."""


def dropped(counts: dict[str | UnusedReason | WindowKind, int]) -> dict[str, int]:
    """
    Return the counts of samples that were lost or could not be used, reason -> count.

    Without zeros.
    """
    lost = {}
    for reason, count in sorted(counts.items()):
        if count and reason not in ACCEPTED:
            lost[reason] = int(count)
    return lost
