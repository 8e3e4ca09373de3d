"""Rest in samples: quiet stretches by running variance, and static poses."""

from collections import deque

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, any_within, runs_of
from imu_calibration.preprocessing.window import WindowSettings

SPANS = (0.25, 1.0)
"""
Variances are computed over these times, s: the short one detects a knock, the long one a slow
swing.
"""
QUIETNESS_REACH = 1.3
"""Samples at a larger distance do not change quietness, s."""
BELOW = 0.1
"""Vibration is the part removed by three running means over this time, s: above about 8 Hz."""
STEADY_SECONDS = 0.75
"""
Vibration is steady when it is not above the quiet ratio of its minimum within this time on both
sides, s; a knock is not steady.
"""
_MIN_QUIET_SAMPLES = 10
"""Fewest samples of a span."""
_GRID = 0.01
"""Spans begin and end on this grid, or at every sample of a slow IMU, s."""
_GROWTH = 2.0
"""Largest ratio of the floors of a longer and a shorter span."""
_GUARD = 0.05
"""
Time excluded on both sides of a disturbance, s: its first samples can be in a quiet span.
"""


class QuietFloor:
    """
    Running estimate of the quiet variances.

    The median over the last chunks, so that a noisy one does not set it.
    """

    def __init__(self) -> None:
        # Length of the spans, s -> floors of the newest chunks.
        self._history: dict[float, deque[np.ndarray]] = {}

    def update(self, key: float, value: np.ndarray | None) -> np.ndarray | None:
        """
        Add the floor of one chunk (None: no rest) and return the running one, or None.

        `key`: length of the spans, s.
        """
        history = self._history.setdefault(key, deque(maxlen=9))
        if value is not None:
            history.append(value)
        return np.median(np.array(history), axis=0) if history else None


def quiet_beside_joints(
    force_s: np.ndarray,
    rate_s: np.ndarray,
    period: float,
    *,
    ratio: float,
    longest: float,
    floors: tuple[QuietFloor, QuietFloor],
    resting: np.ndarray,
) -> np.ndarray:
    """
    Return a mask of the samples in a quiet span, or in a vibration of a table with resting joints.

    Resting joints imply rest where the IMU vibrates: a vibration is steady, and means over a tenth
    of a second are as quiet as without it. A hand, a shove and a slow turn change these means; a
    knock is not steady.

    Parameters
    ----------
    force_s, rate_s : array, shape (n, 3)
        Readings in any unit.
    period : float
        Sampling period, s.
    ratio, longest
        As for `quiet_samples`.
    floors : (QuietFloor, QuietFloor)
        Running floors of the readings and of their means.
    resting : array of bool, shape (n,)
        Samples with the joints at rest.

    Returns
    -------
    array of bool, shape (n,)

    """
    cells = Cells(force_s, rate_s, period)
    quiet = quiet_samples(cells, ratio=ratio, longest=longest, floor=floors[0], resting=resting)
    # The means are tested even where they are not needed, because this updates their floor.
    width = 2 * int(round(BELOW / period / 2)) + 1
    means_are_quiet = quiet_samples(
        Cells(low_passed(force_s, width), low_passed(rate_s, width), period),
        ratio=ratio,
        longest=longest,
        floor=floors[1],
        resting=resting,
        spans=SPANS[1:],
    )
    # Not needed: all is quiet where the joints rest, or a slow IMU has no vibration to remove.
    if quiet[resting].all() or width < 3:
        return quiet
    return quiet | (means_are_quiet & _steady(cells, ratio=ratio, resting=resting))


def low_passed(values: np.ndarray, width: int) -> np.ndarray:
    """
    Return the running mean over an odd number of samples, applied three times, shape (n, 3).

    The first and the last value continue beyond the ends.
    """
    half = width // 2
    # Sums of the deviations from one value, so that gravity causes no rounding.
    origin = values[:1]
    means = values - origin
    for _ in range(3):
        sums = _running(np.pad(means, ((half, half), (0, 0)), mode='edge').T)
        means = (sums[:, width:] - sums[:, :-width]).T / width
    return means + origin


def _low_passed_piece(values: np.ndarray, first: int, last: int, width: int) -> np.ndarray:
    """Return `low_passed` of all values, of the samples from `first` to before `last` only."""
    reach = 3 * (width // 2)
    start = max(first - reach, 0)
    return low_passed(values[start : last + reach], width)[first - start : last - start]


def _steady(cells: 'Cells', *, ratio: float, resting: np.ndarray) -> np.ndarray:
    """
    Return a mask of the samples in a short span of steady vibration while the joints rest.

    Its variance is at most ``ratio^2`` times the least one of the spans within `STEADY_SECONDS`.
    """
    from scipy.ndimage import minimum_filter1d  # here, because its import is slow

    width = cells.width(SPANS[0])
    variance = cells.variance(width)
    at_rest = _free_of(~cells.all_of(resting), width)
    around = 2 * int(round(cells.cells_in(STEADY_SECONDS))) + 1
    variance_at_rest = np.where(at_rest[:, None], variance, np.inf)
    least = minimum_filter1d(variance_at_rest, around, axis=0, mode='nearest')
    floor = np.maximum(least, cells.least)
    is_steady = at_rest & np.all(variance <= ratio**2 * floor, axis=1)
    return cells.samples(_covered(is_steady, width))


def quiet_samples(
    cells: 'Cells',
    *,
    ratio: float,
    longest: float,
    floor: QuietFloor,
    resting: np.ndarray | None = None,
    spans: tuple[float, ...] = SPANS,
) -> np.ndarray:
    """
    Return a mask of the samples in a quiet span.

    A span is quiet when the variances of specific force and of angular rate, summed over the axes,
    are below ``ratio^2`` times their floors; a sample is quiet when some quiet span of each length
    contains it.

    Parameters
    ----------
    cells : Cells
        Of the readings.
    ratio : float
        Largest ratio of standard deviations to the quiet ones.
    longest : float
        Spans are not longer than this, s.
    floor : QuietFloor
        Running floor, updated here.
    resting : array of bool, shape (n,), optional
        Samples with the joints at rest; the floor is computed from spans within them. None: from
        the quietest tenth of all.
    spans : tuple of float
        Lengths of the spans, s.

    Returns
    -------
    array of bool, shape (n,)

    """
    at_rest = None if resting is None else cells.all_of(resting)
    quiet = np.ones(len(cells.edges) - 1, bool)
    # Floor of the next shorter spans, of force and rate.
    shorter_floor = np.full(2, np.inf)
    for span in spans:
        width = cells.width(min(span, longest))
        variance = cells.variance(width)
        running_floor = floor.update(span, _chunk_floor(variance, width, at_rest))
        # The floor of this span. At rest the variance hardly grows with the span; otherwise the
        # quietest part was moving as well. Without any rest so far no sample is quiet.
        if running_floor is not None:
            span_floor = np.minimum(running_floor, _GROWTH * shorter_floor)
        elif np.isinf(shorter_floor).all():
            return np.zeros(cells.edges[-1], bool)
        else:
            span_floor = shorter_floor
        shorter_floor = span_floor = np.maximum(span_floor, cells.least)

        is_calm = np.all(variance <= ratio**2 * span_floor, axis=1)
        quiet &= _covered(is_calm, width)
        # A change of attitude between two samples: no quiet span contains it.
        if width > 1 and resting is None:
            across = _covered(is_calm, width - 1)
            quiet[:-1] &= across
            quiet[1:] &= across
    return cells.samples(quiet)


def _chunk_floor(variance: np.ndarray, width: int, at_rest: np.ndarray | None) -> np.ndarray | None:
    """
    Return a low quantile of the variances of disjoint spans of `width` cells, shape (2,).

    Of the spans at rest, None if there are fewer than three; or of all, without `at_rest`.
    """
    disjoint = variance[::width]
    if at_rest is None:
        return np.quantile(disjoint, 0.1, axis=0)
    disjoint = disjoint[_free_of(~at_rest, width)[::width]]
    return np.quantile(disjoint, 0.25, axis=0) if len(disjoint) >= 3 else None


def _free_of(flags: np.ndarray, width: int) -> np.ndarray:
    """Return whether the span of `width` cells from each cell on has no flagged cell."""
    sums = np.append(0, np.cumsum(flags))
    return sums[width:] == sums[:-width]


def least_variance(values: np.ndarray) -> float:
    """
    Return the least variance of readings, (n, 3), summed over the axes.

    It is that of an sd of half a converter step, plus that of an sd of 1e-5 of the readings.
    """
    # The first samples show the step of the converter as well as all of them.
    first = np.ascontiguousarray(values[:4000].T)
    change = np.abs(np.diff(first, axis=1))
    step = np.where(change > 0, change, np.inf).min(axis=1, initial=np.inf)
    step = np.where(np.isfinite(step), step, 0.0)
    return np.sum(step**2 / 4) + 3 * (1e-5 * np.abs(first).max(initial=1e-2)) ** 2


class Cells:
    """
    Sums over cells of samples, from which variances over any span of cells follow.

    Parameters
    ----------
    force_s, rate_s : array, shape (n, 3)
        Readings in any unit.
    period : float
        Sampling period, s.

    """

    def __init__(self, force_s: np.ndarray, rate_s: np.ndarray, period: float):
        n = len(force_s)
        self._period = period
        # Samples of a cell.
        self._size = max(1, min(int(_GRID / period), n))
        self.edges = np.append(np.arange(0, n - self._size + 1, self._size), n)
        """First sample of each cell, and the number of samples; the last cell has the remainder."""
        self.least = np.array([least_variance(values) for values in (force_s, rate_s)])
        """Least variance of force and rate, axes added, shape (2,)."""
        # Of force and rate: running sums over the cells of the deviations of each axis from its
        # mean, (3, n_cells + 1), and of their squares, axes added, (n_cells + 1,).
        self._sums: list[tuple[np.ndarray, np.ndarray]] = []
        for values in (force_s, rate_s):
            sums = []
            squares = np.zeros(len(self.edges) - 1)
            # `reduceat` sums from each edge to before the next one. One axis at a time, because a
            # long recording is large.
            for axis in values.T:
                centred = axis - axis.mean()
                sums.append(np.add.reduceat(centred, self.edges[:-1]))
                squares += np.add.reduceat(np.square(centred, out=centred), self.edges[:-1])
            self._sums.append((_running(np.array(sums)), _running(squares)))

    def cells_in(self, seconds: float) -> float:
        """Return the number of cells in a time."""
        return seconds / self._period / self._size

    def width(self, seconds: float) -> int:
        """Return the number of cells of a span, at least that of `_MIN_QUIET_SAMPLES`."""
        least = int(np.ceil(_MIN_QUIET_SAMPLES / self._size))
        return min(max(least, int(round(self.cells_in(seconds)))), len(self.edges) - 1)

    def variance(self, width: int) -> np.ndarray:
        """
        Return the variances of force and rate over `width` cells from each cell on, axes added.

        Shape (n_spans, 2).
        """
        count = self.edges[width:] - self.edges[:-width]
        variances = []
        for sums, squares in self._sums:
            total = sums[:, width:] - sums[:, :-width]
            square = squares[width:] - squares[:-width]
            deviation = np.maximum(square - np.einsum('ij,ij->j', total, total) / count, 0.0)
            variances.append(deviation / np.maximum(count - 1, 1))
        return np.stack(variances, axis=1)

    def all_of(self, flags: np.ndarray) -> np.ndarray:
        """Return the cells in which all samples are flagged."""
        return np.logical_and.reduceat(flags, self.edges[:-1])

    def samples(self, mask: np.ndarray) -> np.ndarray:
        """Return the samples of the cells of a mask, without a margin at its ends."""
        margin = int(np.ceil(self.cells_in(_GUARD)))
        return np.repeat(shrunk_mask(mask, margin), np.diff(self.edges))


def _running(values: np.ndarray) -> np.ndarray:
    """Return the sums of the values before each place along the last axis, shape (..., n + 1)."""
    sums = np.zeros(values.shape[:-1] + (values.shape[-1] + 1,), values.dtype)
    np.cumsum(values, axis=-1, out=sums[..., 1:])
    return sums


def _covered(is_calm: np.ndarray, width: int) -> np.ndarray:
    """
    Return for each cell whether one of the calm spans of `width` cells contains it.

    `is_calm`: whether the span from each cell on is calm, shape (n_cells - width + 1,).
    """
    padded = np.concatenate([is_calm, np.zeros(width - 1, bool)])
    return any_within(padded, width - 1, 0)


def shrunk_mask(mask: np.ndarray, margin: int) -> np.ndarray:
    """
    Return `mask` without the cells within `margin` cells of a False one.

    Cells beyond the ends count as True.
    """
    return ~any_within(~mask, margin, margin)


_TURNING_SD = 30.0
"""
A mean rate that differs from the usual one by this many noise sds and a hundredth of the largest
rate is a steady turn, not a bias.
"""

_STEP_SPAN = 0.5
"""Duration of the means whose differences show a transition from rest to a slow turn, s."""
_ENOUGH = 6
"""Fewest intervals for the scatter of their mean rates."""
_SCATTERS = 8.0
"""
A mean rate that differs from both neighbours by this many times the scatter (at least the noise of
one sample) is a turn.
"""

_LEAVES = 5.0
"""
A low-passed reading that differs from the mean of the middle half by more than this many sds
belongs to the turn before or after.
"""

_LARGEST_GROWTH = 4.0
"""Bias wander over a long rest adds less variance than this."""


def find_still(imu: ImuSamples, settings: WindowSettings = WindowSettings()) -> list[slice]:
    """
    Find the intervals of rest from IMU data only.

    Compares short-time variances with the quietest tenth of the recording, so any unit is allowed,
    also counts. The first `settling` seconds of an interval are excluded, except at the start of
    the recording; steady turns and intervals shorter than `static_minimum` are not reported.

    Parameters
    ----------
    imu : ImuSamples
        Cleaned samples (`BlockCleaner`): finite, stamps not going backwards.
    settings : WindowSettings

    Returns
    -------
    list of slice
        Sample ranges, in order.

    Raises
    ------
    InputError
        When a sample is not finite or a stamp goes backwards.

    """
    step = np.diff(imu.stamp_ns)
    if not (np.isfinite(imu.force_s).all() and np.isfinite(imu.rate_s).all()):
        raise InputError(
            'samples must be finite to search for rest, got NaN or infinite values; drop them'
            ' first',
            code='not_finite',
        )
    if np.any(step < 0):
        raise InputError(
            'stamps must not decrease in the search for rest, got a backward step; clean the stream'
            ' first',
            code='stamps_backwards',
        )
    if not np.any(step > 0):
        return []
    period = np.median(step[step > 0]) / 1e9
    quiet = quiet_samples(
        Cells(imu.force_s, imu.rate_s, period),
        ratio=settings.quiet_ratio,
        longest=settings.static_minimum,
        floor=QuietFloor(),
    )
    rests = []
    for rest in _intervals(imu.stamp_ns, quiet, period, settings):
        if _keeps_attitude(imu.force_s[rest], period):
            rests.append(rest)
    rests = _at_one_rate(imu.rate_s, rests, period, settings.static_minimum)
    rests = _trimmed(imu, rests, period, settings.static_minimum)
    return _not_turning(imu.rate_s, rests)


def _intervals(
    stamp_ns: np.ndarray, quiet: np.ndarray, period: float, settings: WindowSettings
) -> list[slice]:
    """Return the quiet stretches without gaps, after `settling`, that are long enough."""
    time = (stamp_ns - stamp_ns[0]) / 1e9
    intervals = []
    for first, stop in runs_of(quiet, np.diff(time) > max(settings.gap, 5 * period)):
        start = first
        if first > 0:
            start = int(np.searchsorted(time, time[first] + settings.settling))
        if start < stop and time[stop - 1] - time[start] + period >= settings.static_minimum:
            intervals.append(slice(int(start), int(stop)))
    return intervals


def _keeps_attitude(force: np.ndarray, period: float) -> bool:
    """
    Return whether the scatter over the interval equals the scatter over short spans.

    Under vibration, slow turns are quiet.
    """
    width = min(max(10, int(round(SPANS[0] / period))), len(force))
    spans = force[: len(force) // width * width].reshape(-1, width, 3)
    span_variance = np.mean(spans.var(axis=1, ddof=1).sum(axis=1)) + least_variance(force)
    return force.var(axis=0).sum() <= _LARGEST_GROWTH * span_variance


def _at_one_rate(
    rate: np.ndarray, rests: list[slice], period: float, shortest: float
) -> list[slice]:
    """
    Divide intervals at transitions from rest to a slow turn; drop parts shorter than `shortest` s.

    There the mean rate over `_STEP_SPAN` changes by more than the noise of a sample and more than a
    thousandth of the largest rate.
    """
    if not rests:
        return rests
    noise = np.median([rate[rest].std(axis=0) for rest in rests], axis=0)
    median = np.array([np.median(axis) for axis in rate.T])
    least_change = np.maximum(noise, 1e-3 * _farthest(rate, median))
    width = max(10, int(round(_STEP_SPAN / period)))
    parts = []
    for rest in rests:
        n_means = (rest.stop - rest.start) // width
        averaged = rate[rest.start : rest.start + n_means * width]
        means = averaged.reshape(n_means, width, 3).mean(axis=1)
        is_change = np.any(np.abs(np.diff(means, axis=0)) > least_change, axis=1)
        changes = rest.start + width * (np.flatnonzero(is_change) + 1)
        edges = [rest.start, *changes, rest.stop]
        for start, stop in zip(edges, edges[1:]):
            if (stop - start) * period >= shortest or len(edges) == 2:
                parts.append(slice(int(start), int(stop)))
    return parts


def _farthest(values: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return ``max |values - centre|`` of each column."""
    return np.maximum(values.max(axis=0) - centre, centre - values.min(axis=0))


def _trimmed(imu: ImuSamples, rests: list[slice], period: float, shortest: float) -> list[slice]:
    """
    Return intervals without the slow begin and end of turns; drop those shorter than `shortest` s.

    A turn begins below the noise of the samples, but shows in the low-passed readings.
    """
    width = 2 * int(round(BELOW / period / 2)) + 1
    if rests:
        for values in (imu.force_s, imu.rate_s):
            rests = _without_turns(values, rests, width)
    return [rest for rest in rests if (rest.stop - rest.start) * period >= shortest]


def _without_turns(values: np.ndarray, rests: list[slice], width: int) -> list[slice]:
    """
    Return intervals up to the low-passed readings that differ from the middle half significantly.

    The limit is `_LEAVES` sds of the low-passed readings, over `width` samples, in the middle half
    of the interval or of the median interval.
    """
    # Of each interval: first and last sample of its middle half, squared deviations from the mean
    # there, axes added, and the variance there.
    middles = []
    squared_deviations = []
    variances = []
    for rest in rests:
        _, middle_start, _, middle_stop, _ = np.linspace(rest.start, rest.stop, 5).astype(int)
        readings = _low_passed_piece(values, rest.start, rest.stop, width)
        middle = slice(middle_start - rest.start, middle_stop - rest.start)
        squares = (readings - readings[middle].mean(axis=0)) ** 2
        middles.append((middle_start, middle_stop))
        squared_deviations.append(np.sum(squares, axis=1))
        variances.append(np.mean(squares[middle]))
    variance = np.maximum(
        np.maximum(variances, np.median(variances)), least_variance(values) / 3 / width
    )

    trimmed = []
    for k, rest in enumerate(rests):
        middle_start, middle_stop = middles[k]
        turns = rest.start + np.flatnonzero(squared_deviations[k] > 3 * _LEAVES**2 * variance[k])
        start = turns[turns < middle_start].max(initial=rest.start - 1) + 1
        stop = turns[turns >= middle_stop].min(initial=rest.stop)
        trimmed.append(slice(int(start), int(stop)))
    return trimmed


def _not_turning(rate: np.ndarray, rests: list[slice]) -> list[slice]:
    """Return the intervals without slow steady turns, whose mean rate differs significantly."""
    if len(rests) < 2:
        return rests
    means = np.array([rate[rest].mean(axis=0) for rest in rests])
    noise = np.median([rate[rest].std(axis=0) for rest in rests], axis=0)
    median = np.median(means, axis=0)
    limit = np.maximum(_TURNING_SD * noise, 0.01 * _farthest(rate, median))
    keep = np.all(np.abs(means - median) <= limit, axis=1)
    # An isolated deviation from both neighbours, which lie on one side; the drift of warming biases
    # is smooth. Of a steady drift both steps are equal, and half their difference is zero.
    if len(rests) >= _ENOUGH:
        step = np.diff(means, axis=0)
        smaller_step = np.minimum(np.abs(step[:-1]), np.abs(step[1:]))
        isolated = np.minimum(smaller_step, 0.5 * np.abs(step[1:] - step[:-1]))
        # Sd of one mean from the median of the absolute differences of two.
        scatter = np.median(np.abs(step), axis=0) / (0.6745 * np.sqrt(2))
        keep[1:-1] &= np.all(isolated <= np.maximum(_SCATTERS * scatter, noise), axis=1)
    return [rest for rest, kept in zip(rests, keep, strict=True) if kept]
