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
_GRID = 0.01  # s: spans begin and end on this grid, or at every sample of a slow IMU
_GROWTH = 2.0
_GUARD = 0.05  # s excluded on both sides of a disturbance: its first samples can be in a quiet span


class QuietFloor:
    """
    Running estimate of the quiet variances.

    The median over the last chunks, so that a noisy one does not set it.
    """

    def __init__(self) -> None:
        self._history = {}

    def update(self, key: float, value: np.ndarray | None) -> np.ndarray | None:
        """Add the floor of one chunk (None: no rest) and return the running one, or None."""
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
    width = 2 * int(round(BELOW / period / 2)) + 1
    below = quiet_samples(
        Cells(low_passed(force_s, width), low_passed(rate_s, width), period),
        ratio=ratio,
        longest=longest,
        floor=floors[1],
        resting=resting,
        spans=SPANS[1:],
    )
    if quiet[resting].all() or width < 3:
        return quiet
    return quiet | (below & _steady(cells, ratio=ratio, resting=resting))


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


def _low_passed_piece(values, first, last, width):
    """Return `low_passed` of all values, from `first` to before `last`."""
    reach = 3 * (width // 2)
    start = max(first - reach, 0)
    return low_passed(values[start : last + reach], width)[first - start : last - start]


def _steady(cells, *, ratio, resting):
    """
    Return a mask of the samples in a short span at rest with minimal variance.

    The variance of the span is about the minimum of the spans around.
    """
    from scipy.ndimage import minimum_filter1d  # here, because its import is slow

    width = cells.width(SPANS[0])
    variance = cells.variance(width)
    at_rest = _free_of(~cells.all_of(resting), width)
    around = 2 * int(round(cells.cells_in(STEADY_SECONDS))) + 1
    least = minimum_filter1d(
        np.where(at_rest[:, None], variance, np.inf), around, axis=0, mode='nearest'
    )
    floor = np.maximum(least, cells.least)
    return cells.samples(_covered(at_rest & np.all(variance <= ratio**2 * floor, axis=1), width))


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
    shorter = np.full(2, np.inf)
    for span in spans:
        width = cells.width(min(span, longest))
        variance = cells.variance(width)
        limit = floor.update(span, _chunk_floor(variance, width, at_rest))
        if limit is None and np.isinf(shorter).all():
            return np.zeros(cells.edges[-1], bool)
        # at rest the variance hardly grows with the span; otherwise the quietest part was moving as
        # well
        shorter = limit = np.maximum(
            shorter if limit is None else np.minimum(limit, _GROWTH * shorter), cells.least
        )
        calm = np.all(variance <= ratio**2 * limit, axis=1)
        quiet &= _covered(calm, width)
        # A change of attitude between two samples: no quiet span contains it.
        if width > 1 and resting is None:
            across = _covered(calm, width - 1)
            quiet[:-1] &= across
            quiet[1:] &= across
    return cells.samples(quiet)


def _chunk_floor(variance, width, at_rest):
    separate = variance[::width]
    if at_rest is None:
        return np.quantile(separate, 0.1, axis=0)
    separate = separate[_free_of(~at_rest, width)[::width]]
    return np.quantile(separate, 0.25, axis=0) if len(separate) >= 3 else None


def _free_of(busy, width):
    """Return whether the span of `width` cells from each cell on has no busy cell."""
    sums = np.concatenate([[0], np.cumsum(busy)])
    return sums[width:] == sums[:-width]


def least_variance(values: np.ndarray) -> float:
    """
    Return the least variance, summed over axes.

    Of half a converter step, or of 1e-5 of the readings.
    """
    some = np.ascontiguousarray(values[:4000].T)
    change = np.abs(np.diff(some, axis=1))
    step = np.where(change > 0, change, np.inf).min(axis=1, initial=np.inf)
    step = np.where(np.isfinite(step), step, 0.0)
    return np.sum(step**2 / 4) + 3 * (1e-5 * np.abs(some).max(initial=1e-2)) ** 2


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
        self._size = max(1, min(int(_GRID / period), n))
        # The last cell has the remainder.
        self.edges = np.append(np.arange(0, n - self._size + 1, self._size), n)
        self.least = np.array([least_variance(values) for values in (force_s, rate_s)])
        """Of force and rate."""
        self._sums = []
        for values in (force_s, rate_s):
            sums = []
            squares = np.zeros(len(self.edges) - 1)
            for axis in values.T:  # one at a time: a long recording is large
                centred = axis - axis.mean()
                sums.append(np.add.reduceat(centred, self.edges[:-1]))
                squares += np.add.reduceat(np.square(centred, out=centred), self.edges[:-1])
            self._sums.append((_running(np.array(sums)), _running(squares)))

    def cells_in(self, seconds: float) -> float:
        """Return the number of cells in a time."""
        return seconds / self._period / self._size

    def width(self, seconds: float) -> int:
        """Return the number of cells of a span, at least that of `_MIN_QUIET_SAMPLES`."""
        return min(
            max(int(np.ceil(_MIN_QUIET_SAMPLES / self._size)), int(round(self.cells_in(seconds)))),
            len(self.edges) - 1,
        )

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
            variances.append(
                np.maximum(square - np.einsum('ij,ij->j', total, total) / count, 0.0)
                / np.maximum(count - 1, 1)
            )
        return np.stack(variances, axis=1)

    def all_of(self, flags: np.ndarray) -> np.ndarray:
        """Return the cells in which all samples are flagged."""
        return np.logical_and.reduceat(flags, self.edges[:-1])

    def samples(self, mask: np.ndarray) -> np.ndarray:
        """Return the samples of the cells of a mask, without a margin at its ends."""
        return np.repeat(
            shrunk_mask(mask, int(np.ceil(self.cells_in(_GUARD)))), np.diff(self.edges)
        )


def _running(values):
    sums = np.zeros(values.shape[:-1] + (values.shape[-1] + 1,), values.dtype)
    np.cumsum(values, axis=-1, out=sums[..., 1:])
    return sums


def _covered(calm, width):
    """Return for each cell whether one of the calm spans of `width` cells contains it."""
    padded = np.concatenate([calm, np.zeros(width - 1, bool)])
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
    found = []
    for piece in _intervals(imu.stamp_ns, quiet, period, settings):
        if _keeps_attitude(imu.force_s[piece], period):
            found.append(piece)
    found = _at_one_rate(imu.rate_s, found, period, settings.static_minimum)
    return _not_turning(imu.rate_s, _trimmed(imu, found, period, settings.static_minimum))


def _intervals(stamp_ns, quiet, period, settings):
    time = (stamp_ns - stamp_ns[0]) / 1e9
    found = []
    for first, stop in runs_of(quiet, np.diff(time) > max(settings.gap, 5 * period)):
        start = first if first == 0 else int(np.searchsorted(time, time[first] + settings.settling))
        if start < stop and time[stop - 1] - time[start] + period >= settings.static_minimum:
            found.append(slice(int(start), int(stop)))
    return found


def _keeps_attitude(force, period):
    """
    Return whether the scatter over the interval equals the scatter over short spans.

    Under vibration, slow turns are quiet.
    """
    width = min(max(10, int(round(SPANS[0] / period))), len(force))
    pieces = force[: len(force) // width * width].reshape(-1, width, 3)
    local = np.mean(pieces.var(axis=1, ddof=1).sum(axis=1)) + least_variance(force)
    return force.var(axis=0).sum() <= _LARGEST_GROWTH * local


def _at_one_rate(rate, found, period, shortest):
    """
    Divide intervals where the rate changes by its noise and a thousandth of the largest.

    A transition from rest to a slow turn.
    """
    if not found:
        return found
    noise = np.median([rate[piece].std(axis=0) for piece in found], axis=0)
    least = np.maximum(
        noise, 1e-3 * _farthest(rate, np.array([np.median(axis) for axis in rate.T]))
    )
    width = max(10, int(round(_STEP_SPAN / period)))
    parts = []
    for piece in found:
        count = (piece.stop - piece.start) // width
        means = (
            rate[piece.start : piece.start + count * width].reshape(count, width, 3).mean(axis=1)
        )
        steps = np.flatnonzero(np.any(np.abs(np.diff(means, axis=0)) > least, axis=1)) + 1
        edges = [piece.start, *(piece.start + width * steps), piece.stop]
        parts += [
            slice(int(a), int(b))
            for a, b in zip(edges, edges[1:])
            if (b - a) * period >= shortest or len(edges) == 2
        ]
    return parts


def _farthest(values, centre):
    """Return ``max |values - centre|`` of each column."""
    return np.maximum(values.max(axis=0) - centre, centre - values.min(axis=0))


def _trimmed(imu, found, period, shortest):
    """
    Trim both ends of intervals where the low-passed readings exceed the scatter of the middle.

    A turn begins below the noise.
    """
    first = np.array([piece.start for piece in found], int)
    last = np.array([piece.stop for piece in found], int)
    width = 2 * int(round(BELOW / period / 2)) + 1
    for values in (imu.force_s, imu.rate_s) if found else ():
        slow = [_low_passed_piece(values, a, b, width) for a, b in zip(first, last)]
        middles = [
            slice(*(np.linspace(a, b, 5).astype(int)[1:4:2] - a)) for a, b in zip(first, last)
        ]
        centres = [piece[middle].mean(axis=0) for piece, middle in zip(slow, middles)]
        spread = [
            np.mean((piece[middle] - centre) ** 2)
            for piece, middle, centre in zip(slow, middles, centres)
        ]
        spread = np.maximum(
            np.maximum(spread, np.median(spread)), least_variance(values) / 3 / width
        )
        for k, (piece, middle, centre) in enumerate(zip(slow, middles, centres)):
            off = np.sum((piece - centre) ** 2, axis=1) > 3 * _LEAVES**2 * spread[k]
            before = off[: middle.start]
            after = off[middle.stop :]
            start = first[k]
            last[k] = start + middle.stop + int(np.argmax(after)) if after.any() else last[k]
            first[k] = (
                start + middle.start - int(np.argmax(before[::-1])) if before.any() else start
            )
    return [slice(int(a), int(b)) for a, b in zip(first, last) if (b - a) * period >= shortest]


def _not_turning(rate, found):
    """
    Exclude intervals whose mean rate differs significantly from their neighbours.

    Slow and steady turns.
    """
    if len(found) < 2:
        return found
    means = np.array([rate[piece].mean(axis=0) for piece in found])
    noise = np.median([rate[piece].std(axis=0) for piece in found], axis=0)
    usual = np.median(means, axis=0)
    limit = np.maximum(_TURNING_SD * noise, 0.01 * _farthest(rate, usual))
    keep = np.all(np.abs(means - usual) <= limit, axis=1)
    # An isolated deviation from both neighbours; the drift of warming biases is smooth.
    if len(found) >= _ENOUGH:
        step = np.diff(means, axis=0)
        alone = np.minimum(
            np.minimum(np.abs(step[:-1]), np.abs(step[1:])), 0.5 * np.abs(step[1:] - step[:-1])
        )
        scatter = np.median(np.abs(step), axis=0) / (0.6745 * np.sqrt(2))
        keep[1:-1] &= np.all(alone <= np.maximum(_SCATTERS * scatter, noise), axis=1)
    return [piece for piece, kept in zip(found, keep, strict=True) if kept]
