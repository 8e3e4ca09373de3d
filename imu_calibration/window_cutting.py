"""From samples with phases to windows: short runs are joined, settling and knocks kept out, long windows cut."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.joint_motion import JointMotion
from imu_calibration.joint_phases import MOVING, STEADY, STILL
from imu_calibration.samples import _Columns

UNUSED, STATIC, SPIN, DYNAMIC = 0, 1, 2, 3
_KINDS = ('unused', 'static', 'spin', 'dynamic')


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of samples of one kind, without gaps."""

    kind: str
    """'static', 'spin', 'dynamic' or 'unused'."""
    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    time: np.ndarray
    """Seconds since the session's first IMU sample, shape (n,); goes on where a clock was set back."""
    force_s: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Measured angular rate, rad/s, shape (n, 3)."""
    motion: JointMotion
    """The joints at the IMU's stamps; one row for 'static': mean position, and rates of zero unless the joints clearly creep."""
    temperature_c: np.ndarray | None = None
    """Temperature at the samples, degrees Celsius, shape (n,), or None."""
    reason: str = ''
    """Why the window is 'unused'."""

    def __len__(self):
        return len(self.time)

    @property
    def period(self):
        """Median sampling period, s; 0 for one sample."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @property
    def noise_sd(self):
        """White noise of specific force and angular rate from second differences, shape (2, 3); smooth motion drops out."""
        second = np.diff(np.stack([self.force_s, self.rate_s]), 2, axis=1)
        return second.std(axis=1) / np.sqrt(6) if second.shape[1] > 1 else np.full((2, 3), np.nan)


@dataclass(frozen=True, eq=False)
class PhasedSamples(_Columns):
    """IMU samples with what the joints do at that time."""

    stamp_ns: np.ndarray
    """Header stamps, shape (n,)."""
    time: np.ndarray
    """Session time, s, shape (n,)."""
    force_s: np.ndarray
    """Shape (n, 3)."""
    rate_s: np.ndarray
    """Shape (n, 3)."""
    position: np.ndarray
    """Joint angles, shape (n, n_joints); the three below are their derivatives, zero where the joints rest."""
    joint_rate: np.ndarray
    """Shape (n, n_joints)."""
    acceleration: np.ndarray
    """Shape (n, n_joints)."""
    jerk: np.ndarray
    """Shape (n, n_joints)."""
    temperature_c: np.ndarray
    """NaN where unknown, shape (n,)."""
    phase: np.ndarray
    """STILL, STEADY or MOVING, shape (n,)."""
    quiet: np.ndarray
    """Whether the IMU is as quiet as at rest, shape (n,)."""
    after_gap: np.ndarray
    """Whether a window cannot go on from the sample before, shape (n,)."""
    after_loss: np.ndarray
    """Whether the joints were unknown just before, shape (n,)."""


class WindowCutter:
    """
    Turns samples, in order and in any pieces, into windows; holds back a few window lengths at most.

    Decides in three steps, each of which waits only for what it needs:
    runs of one phase that are too short for it become motion, samples get a kind, runs of one kind become windows.
    """

    def __init__(self, settings, short_rest, keep_unused=False):
        self.counts = {}
        self._settings, self._short_rest, self._keep_unused = settings, short_rest, keep_unused
        self._waiting = None
        self._phase_before = None
        self._disturbed = self._ramped = -np.inf
        self._open = None

    @property
    def n_waiting(self):
        """Samples held."""
        return (0 if self._waiting is None else len(self._waiting)) + (0 if self._open is None else len(self._open[0]))

    def push(self, samples, final=False):
        """Take the next samples (or None) and return the windows that are complete; with `final` all that is left."""
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
        """Return the samples whose phase is final, and that phase; keep the rest waiting."""
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
        """Cut whole windows off a run while it is twice as long as a window, open or not: so arrival plays no role."""
        windows, longest = [], self._settings.window_maximum
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
        """Return the windows of a whole run of one kind, cut into equal pieces of at most the longest length."""
        length = samples.time[-1] - samples.time[0]
        pieces = max(1, int(np.ceil(length / self._settings.window_maximum)))
        bounds = np.linspace(0, len(samples), pieces + 1).astype(int)
        windows = []
        for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
            windows += self._finished(samples.select(slice(start, stop)), kind[0], reason[0])
        return windows

    def _finished(self, samples, kind, reason):
        settings = self._settings
        least = {UNUSED: 0.0, STATIC: settings.static_minimum, SPIN: settings.spin_minimum, DYNAMIC: settings.dynamic_minimum}[kind]
        n = len(samples)
        length = (samples.time[-1] - samples.time[0]) * n / max(n - 1, 1)
        if length < least or (kind != UNUSED and n < _LEAST_SAMPLES):
            kind, reason = UNUSED, _TOO_SHORT
        key = _REASONS[reason] if kind == UNUSED else _KINDS[kind]
        self.counts[key] = self.counts.get(key, 0) + n
        return [_window(samples, kind, reason)] if kind != UNUSED or self._keep_unused else []


_REASONS = ('', 'settling', 'not quiet', 'turn-on', 'too short')
_SETTLING, _NOT_QUIET, _TURN_ON, _TOO_SHORT = 1, 2, 3, 4
_LEAST_SAMPLES = 5


def _runs(value, broken):
    """Return starts and stops of runs of equal values that are not broken."""
    begins = np.concatenate([[True], (value[1:] != value[:-1]) | broken[1:]])
    starts = np.flatnonzero(begins)
    return starts, np.append(starts[1:], len(value))


def _between_motion(k, before, original, after_gap, stop):
    follows = k + 1 < len(original) and not after_gap[stop]
    return before[k] in (STEADY, MOVING) and follows


def _window(samples, kind, reason):
    temperature = None if np.isnan(samples.temperature_c).any() else samples.temperature_c
    motion = _mean_motion(samples) if kind == STATIC else JointMotion(samples.time, samples.position, samples.joint_rate, samples.acceleration, samples.jerk)
    return Window(_KINDS[kind], samples.stamp_ns, samples.time, samples.force_s, samples.rate_s, motion, temperature, _REASONS[reason])


def _mean_motion(samples):
    """Return one row: the mean position and, when a straight line explains the readings and noise does not, its slope."""
    mean = samples.position.mean(axis=0)
    some = slice(None, None, max(1, len(samples) // 500))  # the levels are averages over 0.2 s, so these say as much as all
    time, position = samples.time[some] - samples.time[some].mean(), samples.position[some] - mean
    slope = time @ position / max(time @ time, 1e-12)
    rest = (position - time[:, None] * slope).std(axis=0)
    distance = np.abs(slope) * (time[-1] - time[0])
    # one encoder step in mid-window is 1.5 steps of distance and a quarter of a step of scatter: no creep
    slope = np.where((distance > 8 * rest) & (distance > 1e-6), slope, 0.0)
    zero = np.zeros((1, len(mean)))
    return JointMotion(samples.time.mean(keepdims=True), mean[None], slope[None], zero, zero)
