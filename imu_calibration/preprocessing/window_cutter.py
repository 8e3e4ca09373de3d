"""Windows from samples with phases: short runs are joined, settling and knocks excluded, long windows cut."""

from collections import deque
from math import ceil

import numpy as np

from imu_calibration.core.constants import STANDARD_GRAVITY
from imu_calibration.preprocessing.joint_phases import MOVING, STEADY, STILL
from imu_calibration.preprocessing.window import PhasedSamples, UnusedReason, Window, WindowKind, WindowSettings, make_window

BEST_BIAS, BEST_TIME = 1e-4, 100.0
"""m/s^2 and s: the best accelerometers hold their bias to 10 ug over minutes (a Gauss-Markov process; field figures in `sensor_noise`)."""
PIECE = 0.25
"""Duration of the means from which noise at low frequency is estimated, s: longer than sensor filters."""
LEAST_PIECES = 4
SHORTEST = 5.0
"""Least length of moving windows, s."""


class WanderLimit:
    """
    The longest moving window that the noise at rest allows.

    Over T the sd of the mean of white noise of density d is ``d / sqrt(T)``, of a bias about ``sd sqrt(2 T / time)``. They are equal at
    ``T = d sqrt(time / 2) / sd``; in a longer window, drift biases scale factors and arms. That
    is 80 s at 120 ug/sqrt(Hz), and less than a second at 1 ug/sqrt(Hz). Where the change of gravity during the jitter of the stamps
    exceeds the noise, the reference limits the accuracy, and means over short windows would contain its errors instead.
    """

    def __init__(self) -> None:
        self._densities: deque[float] = deque(maxlen=9)

    def rested(self, samples: PhasedSamples) -> None:
        """Estimate the noise density from a window at rest."""
        period = _period(samples)
        length = int(round(PIECE / period)) if period > 0 else 0
        pieces = len(samples) // length if length else 0
        if pieces >= LEAST_PIECES:
            means = samples.force_s[:pieces * length].reshape(pieces, length, 3).mean(axis=1)
            self._densities.append(float(np.sqrt(np.median(np.diff(means, axis=0).var(axis=0) / 2) * length * period)))

    def pieces(self, samples: PhasedSamples) -> int:
        """Return the number of windows into which motion is cut; one if no rest has occurred yet."""
        if not self._densities or len(samples) < 3:
            return 1
        density = float(np.median(self._densities))
        jitter = np.diff(samples.time, 2).std() / np.sqrt(6)
        if STANDARD_GRAVITY * np.sqrt((samples.rate_s**2).sum(axis=1).mean()) * jitter * np.sqrt(_period(samples)) > density:
            return 1
        longest = max(SHORTEST, density * np.sqrt(BEST_TIME / 2) / BEST_BIAS)
        return ceil((samples.time[-1] - samples.time[0]) / longest)


def _period(samples):
    return (samples.time[-1] - samples.time[0]) / max(len(samples) - 1, 1)


_KINDS, _REASONS = tuple(WindowKind), tuple(UnusedReason)
UNUSED, STATIC, SPIN, DYNAMIC = range(len(_KINDS))
_SETTLING, _NOT_QUIET, _TURN_ON, _TOO_SHORT, _REST_TOO_SHORT = range(1, len(_REASONS))
_LEAST_SAMPLES = 5


class WindowCutter:
    """
    Converts samples, in order and in pieces of any length, to windows; buffers a few window lengths at most.

    Three steps, each with the least delay:
    runs of one phase that are too short for it become motion, samples get a kind, runs of one kind become windows.
    """

    def __init__(self, settings: WindowSettings, short_rest: float, keep_unused: bool = False):
        self.counts = {}
        self._settings, self._short_rest, self._keep_unused = settings, short_rest, keep_unused
        self._waiting = None
        self._phase_before = None
        self._disturbed = self._ramped = -np.inf
        self._open = None
        self._wander = WanderLimit()

    def change(self, settings: WindowSettings, short_rest: float) -> None:
        """Use other settings from now on."""
        self._settings, self._short_rest = settings, short_rest

    @property
    def n_waiting(self) -> int:
        """Samples held."""
        return (0 if self._waiting is None else len(self._waiting)) + (0 if self._open is None else len(self._open[0]))

    def push(self, samples: PhasedSamples | None, final: bool = False) -> list[Window]:
        """Add the next samples (or None) and return the complete windows; with `final` all remaining ones."""
        windows = []
        if self._waiting is not None:
            samples = self._waiting if samples is None else PhasedSamples.concatenate([self._waiting, samples])
            self._waiting = None
        if samples is not None and len(samples):
            windows += self._cut(*self._decided(samples, final))
        if final and self._open is not None:
            windows += self._close(*self._open)
            self._open = None
        return windows

    def _decided(self, samples, final):
        """Return the samples whose phase is final, and that phase; buffer the remaining samples."""
        starts, stops = _runs(samples.phase, samples.after_gap)
        time, settings = samples.time, self._settings
        phase = samples.phase.copy()
        original = samples.phase[starts]
        before = np.concatenate([[-1 if self._phase_before is None else self._phase_before], original[:-1]])
        before[samples.after_gap[starts]] = -1
        decided = len(samples)
        for k, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            is_open = k == len(starts) - 1 and not final
            length = time[stop - 1] - time[start]
            needed = self._short_rest if original[k] == STILL else settings.spin_minimum + (settings.settling if before[k] >= 0 else 0.0)
            goes_on = before[k] == original[k]  # the part before was long enough already
            if original[k] == MOVING or goes_on or length > needed:
                continue
            if is_open:
                decided = start
            elif original[k] == STEADY or _between_motion(k, before, original, samples.after_gap, stop):
                phase[start:stop] = MOVING
        if decided < len(samples):
            self._waiting = samples.select(slice(decided, None))
        if decided:
            self._phase_before = samples.phase[decided - 1]
        return samples.select(slice(0, decided)), phase[:decided]

    def _cut(self, samples, phase):
        if not len(samples):
            return []
        kind, reason = self._kinds(samples, phase)
        after_gap = samples.after_gap.copy()
        if self._open is not None:
            before, kind_before, reason_before = self._open
            samples = PhasedSamples.concatenate([before, samples])
            kind, reason = np.concatenate([kind_before, kind]), np.concatenate([reason_before, reason])
            after_gap = samples.after_gap
        starts, stops = _runs(kind * 8 + reason, after_gap)
        windows = []
        for start, stop in zip(starts, stops, strict=True):
            cut_off, start = self._shed(samples, start, stop, kind[start], reason[start])
            windows += cut_off
            rest = samples.select(slice(start, stop)), kind[start:stop], reason[start:stop]
            if stop < len(samples):
                windows += self._close(*rest)
        self._open = rest
        return windows

    def _shed(self, samples, start, stop, kind, reason):
        """Cut complete windows off a run while it is twice as long as a window, open or not: independent of the time of arrival."""
        windows, longest = [], self._longest(kind)
        while samples.time[stop - 1] - samples.time[start] >= 2 * longest:
            cut = int(np.searchsorted(samples.time, samples.time[start] + longest))
            windows += self._finished(samples.select(slice(start, cut)), kind, reason)
            start = cut
        return windows, start

    def _kinds(self, samples, phase):
        time, settings = samples.time, self._settings
        unknown = samples.after_loss
        calm_rest = (phase == STILL) & samples.quiet & ~unknown
        steady = (phase == STEADY) & ~unknown
        rested = time - self._last_time(time, ~calm_rest, '_disturbed') >= settings.settling
        settled = time - self._last_time(time, ~steady, '_ramped') >= settings.settling
        kind = np.full(len(time), DYNAMIC, np.int8)
        reason = np.zeros(len(time), np.int8)
        for at_phase, good, wanted in ((STILL, rested, STATIC), (STEADY, settled, SPIN)):
            kind[phase == at_phase] = np.where(good[phase == at_phase], wanted, UNUSED)
        reason[kind == UNUSED] = _SETTLING
        reason[(kind == UNUSED) & (phase == STILL) & ~samples.quiet] = _NOT_QUIET
        early = time < settings.turn_on
        kind[early], reason[early] = UNUSED, _TURN_ON
        return kind, reason

    def _last_time(self, time, event, name):
        """Return the time of the last event at or before each sample, and remember the last one under `name`."""
        last = np.maximum.accumulate(np.where(event, time, getattr(self, name)))
        setattr(self, name, last[-1])
        return last

    def _close(self, samples, kind, reason):
        """Return the windows of a complete run of one kind, cut into equal pieces of at most the longest length."""
        length = samples.time[-1] - samples.time[0]
        pieces = max(1, int(np.ceil(length / self._longest(kind[0]))))
        bounds = np.linspace(0, len(samples), pieces + 1).astype(int)
        windows = []
        for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
            windows += self._finished(samples.select(slice(start, stop)), kind[0], reason[0])
        return windows

    def _least(self, kind):
        settings = self._settings
        return {UNUSED: 0.0, STATIC: settings.static_minimum, SPIN: settings.spin_minimum, DYNAMIC: settings.dynamic_minimum}[kind]

    def _longest(self, kind):
        # halves of a window slightly above the longest length must not be below the shortest
        return max(self._settings.window_maximum, 2 * self._least(kind))

    def _finished(self, samples, kind, reason):
        n = len(samples)
        length = (samples.time[-1] - samples.time[0]) * n / max(n - 1, 1)
        if length < self._least(kind) or (kind != UNUSED and n < _LEAST_SAMPLES):
            kind, reason = UNUSED, _REST_TOO_SHORT if kind == STATIC else _TOO_SHORT
        key = _REASONS[reason] if kind == UNUSED else _KINDS[kind]
        self.counts[key] = self.counts.get(key, 0) + n
        if kind == UNUSED and not self._keep_unused:
            return []
        if kind == STATIC:
            self._wander.rested(samples)
        pieces = self._wander.pieces(samples) if kind == DYNAMIC else 1
        bounds = np.linspace(0, n, pieces + 1).astype(int)
        return [make_window(samples.select(slice(start, stop)), _KINDS[kind], _REASONS[reason])
                for start, stop in zip(bounds[:-1], bounds[1:], strict=True)]


def _runs(value, broken):
    """Return starts and stops of runs of equal values that are not broken."""
    begins = np.concatenate([[True], (value[1:] != value[:-1]) | broken[1:]])
    starts = np.flatnonzero(begins)
    return starts, np.append(starts[1:], len(value))


def _between_motion(k, before, original, after_gap, stop):
    follows = k + 1 < len(original) and not after_gap[stop]
    return before[k] in (STEADY, MOVING) and follows


ACCEPTED = (*_KINDS[1:], *_REASONS[1:], 'edge of joints')
"""Counts of complete samples; the last six are excluded from windows on purpose."""


def dropped(counts: dict[str | UnusedReason | WindowKind, int]) -> dict[str, int]:
    """Return the counts of samples that were lost or could not be used, reason -> count, without zeros."""
    return {reason: int(count) for reason, count in sorted(counts.items()) if count and reason not in ACCEPTED}
