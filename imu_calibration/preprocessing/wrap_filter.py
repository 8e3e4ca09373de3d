"""Readings that wrap around at the end of the range of the converter, with the turn around them."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import ImuSamples

LEAST_WRAP = np.array([20.0] * 3 + [3.0] * 3)
"""Smallest step, m/s^2 and rad/s: ranges of +-2 g and +-125 deg/s wrap by 39 and 4.4."""
LEAST_SLOPE = np.array([1000.0] * 3 + [150.0] * 3)
"""Smallest slope of the step, m/s^3 and rad/s^2: no motion with smooth neighbours is as steep."""
LARGEST_SUM_SHARE = 0.3
"""Largest sum of the readings on both sides, as a share of the step: both are at an end."""
NEIGHBOUR_SHARE = 0.1
"""Largest step between neighbours, as a share of the step: two steps on each side."""
END_SHARE = 1.05
"""Largest earlier reading of the sensor, as a share of the end of the range, for scaled axes."""
BACKWARD_SHARE = 0.02
"""Largest movement away from the end of the range before the step, as a share of it, for noise."""
LONGEST_WRAP_NS = 3 * 10**9
"""A reading that wraps returns within this time."""
MARGIN_NS = 150 * 10**6
"""Left out after the return, so that the hole is a gap: no motion is interpolated across it."""
WRAP_REACH = 3
"""Last readings that wait: the steps between them lack one of the two later neighbours."""
KEPT_NEIGHBOURS = 4
"""Decided samples that are kept as neighbours of the next ones."""


EARLIEST_NS = np.iinfo(np.int64).min
"""A stamp before all others."""


@dataclass(frozen=True)
class WrappedSpan:
    """The part of a stream in which one column has wrapped around."""

    column: int
    """Force x, y, z, then rate x, y, z."""
    first_ns: int
    """First wrapped reading."""
    return_ns: int
    """First reading within the range again."""


class WrapFilter:
    """
    Removes the parts of a stream in which a reading has wrapped around.

    A converter of n bits continues at the other end of its range instead of clipping: a step of
    exactly twice the range between two readings at opposite ends, with smooth neighbours that move
    towards the end, and the opposite step when the motion slows down. Everything between both steps
    is removed. No reading before is beyond this end, which distinguishes it from a sensor that is
    shaken within a larger range. The result does not depend on the division into pieces.
    """

    def __init__(self) -> None:
        self.dropped = 0
        """Samples removed so far."""
        self._begin()

    def _begin(self) -> None:
        """Begin a stream."""
        # The newest samples: decided ones, which are neighbours, and then those without a decision.
        self._newest: ImuSamples | None = None
        self._n_decided = 0
        # End of the newest wrapped part, with its margin.
        self._until_ns = EARLIEST_NS
        # Of each column, the last step that ended a wrapped part.
        self._returned_ns = np.full(6, EARLIEST_NS)
        # Of force and rate, the largest reading before the buffered ones.
        self._largest = np.zeros(2)

    def push(self, samples: ImuSamples) -> list[ImuSamples]:
        """Return the samples with a decision; those after a step are buffered until it returns."""
        samples = samples.after(self._newest)
        self._newest = samples
        spans, open_ns = self._spans(samples)
        stop = max(len(samples) - WRAP_REACH, 0)
        if open_ns is not None:
            stop = min(stop, int(np.searchsorted(samples.stamp_ns, open_ns)))
        return self._pass_on(stop, spans)

    def finish(self) -> list[ImuSamples]:
        """Return the buffered samples, and begin a new stream."""
        passed = []
        if self._newest is not None:
            spans, _ = self._spans(self._newest)
            passed = self._pass_on(len(self._newest), spans)
        self._begin()
        return passed

    def _pass_on(self, stop: int, spans: list[WrappedSpan]) -> list[ImuSamples]:
        """Return the undecided samples before row `stop` that are outside of all spans."""
        if stop <= self._n_decided:
            return []
        assert self._newest is not None
        # 1. Decide: without the spans and the margins after them.
        part = self._newest.select(slice(self._n_decided, stop))
        wrapped = part.stamp_ns <= self._until_ns
        for span in spans:
            # A span that begins in the undecided samples is found again with the next piece.
            if span.first_ns > part.stamp_ns[-1]:
                continue
            until_ns = span.return_ns + MARGIN_NS
            wrapped |= (part.stamp_ns >= span.first_ns) & (part.stamp_ns <= until_ns)
            self._until_ns = max(self._until_ns, until_ns)
            self._returned_ns[span.column] = span.return_ns
        self.dropped += int(np.count_nonzero(wrapped))
        # 2. Drop decided samples that are no neighbours of later ones. Their largest readings are
        #    needed further.
        first = max(stop - KEPT_NEIGHBOURS, 0)
        if first:
            dropped = self._newest.select(slice(0, first))
            self._largest = largest_so_far(dropped, self._largest)[-1]
        self._newest = self._newest.select(slice(first, None))
        self._n_decided = stop - first
        if wrapped.all():
            return []
        return [part.select(~wrapped) if wrapped.any() else part]

    def _spans(self, samples: ImuSamples) -> tuple[list[WrappedSpan], int | None]:
        """
        Return the list of `WrappedSpan`, and the stamp of the first step that may still return, ns.
        """
        row, column, up = wrap_steps(samples, self._largest)
        is_new = samples.stamp_ns[row] > self._returned_ns[column]
        row, column, up = row[is_new], column[is_new], up[is_new]
        spans = []
        open_steps = []
        for number in np.unique(column):
            is_in_column = column == number
            stamp_ns = samples.stamp_ns[row[is_in_column]]
            returns_ns, open_ns = _returns(stamp_ns, up[is_in_column])
            for first_ns, return_ns in returns_ns:
                spans.append(WrappedSpan(int(number), int(first_ns), int(return_ns)))
            # A step at the end may still return.
            if open_ns is not None and samples.stamp_ns[-1] - open_ns < LONGEST_WRAP_NS:
                open_steps.append(int(open_ns))
        return spans, min(open_steps, default=None)


def _returns(stamp_ns: np.ndarray, up: np.ndarray) -> tuple[list[tuple[int, int]], int | None]:
    """
    Return the stamps (step, opposite step) of one column, ns; and that of a last single step.

    Parameters
    ----------
    stamp_ns : array, shape (n,)
        Stamps of the steps, increasing.
    up : array of bool, shape (n,)
        Whether the reading increases.

    """
    pairs = []
    k = 0
    while k + 1 < len(stamp_ns):
        opposite = up[k + 1] != up[k]
        if opposite and stamp_ns[k + 1] - stamp_ns[k] < LONGEST_WRAP_NS:
            pairs.append((stamp_ns[k], stamp_ns[k + 1]))
            k += 2
        else:
            k += 1
    return pairs, stamp_ns[k] if k < len(stamp_ns) else None


def largest_so_far(samples: ImuSamples, before: np.ndarray) -> np.ndarray:
    """
    Return the largest reading of each sensor up to each sample.

    Parameters
    ----------
    samples : ImuSamples
    before : ndarray, shape (2,)
        Of force and rate, before these samples.

    Returns
    -------
    ndarray, shape (n, 2)

    """
    sizes = [np.abs(values).max(axis=1) for values in (samples.force_s, samples.rate_s)]
    return np.maximum(np.maximum.accumulate(np.column_stack(sizes), axis=0), before)


def wrap_steps(
    samples: ImuSamples, largest: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the steps that are those of a converter which wraps around.

    Parameters
    ----------
    samples : ImuSamples
    largest : ndarray, shape (2,)
        Largest reading of force and rate before these samples.

    Returns
    -------
    row : ndarray of int, shape (n,)
        First reading after each step.
    column : ndarray of int, shape (n,)
        Force x, y, z, then rate x, y, z.
    up : ndarray of bool, shape (n,)
        Whether the reading increases.

    """
    values = np.hstack([samples.force_s, samples.rate_s])
    step = np.diff(values, axis=0)
    row, column = np.nonzero(np.abs(step) > LEAST_WRAP)
    # With two steps before and after, which are compared.
    is_inside = (row >= 2) & (row + 2 < len(step))
    row, column = row[is_inside], column[is_inside]
    if not len(row):
        return row, column, np.zeros(0, bool)
    size = step[row, column]
    before = values[row, column]
    after = values[row + 1, column]
    earlier = step[row - 1, column]
    later = step[row + 1, column]
    sizes = np.abs(size)
    seconds = np.diff(samples.stamp_ns)[row] * 1e-9
    # Both readings are at the ends of the range.
    wraps = np.abs(before + after) < LARGEST_SUM_SHARE * sizes
    # A step that is too steep for motion, with smooth neighbours.
    wraps &= sizes > LEAST_SLOPE[column] * seconds
    neighbours = np.maximum(np.abs(earlier), np.abs(later))
    wraps &= neighbours < NEIGHBOUR_SHARE * sizes
    for further in (step[row - 2, column], step[row + 2, column]):
        # The next neighbour is smooth too, or the opposite step where two readings are wrapped.
        distance = np.minimum(np.abs(further), np.abs(further + size))
        wraps &= distance < NEIGHBOUR_SHARE * sizes
    # Before the step the reading moves towards the end of the range.
    wraps &= earlier * np.sign(size) < BACKWARD_SHARE * sizes
    # The end of the range: no reading of this sensor up to row + 3, the last one compared above, is
    # beyond it. It lies at most one smooth step beyond both readings.
    end = np.maximum(np.abs(before), np.abs(after)) + neighbours
    wraps &= largest_so_far(samples, largest)[row + 3, column // 3] < END_SHARE * end
    return row[wraps] + 1, column[wraps], size[wraps] > 0
