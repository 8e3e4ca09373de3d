"""Stamps from a counter that overflows: the steps back are removed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

COUNTER_BITS = (16, 24, 31, 32)
"""Widths of counters of time."""
TICKS_NS = (1, 1_000, 1_000_000)
"""Usual ticks: ns, us, ms."""
LEAST_STEP_NS = 1_000_000_000
"""A smaller step back is a late sample."""


def sizes_of_counters(ticks_ns: Sequence[float]) -> tuple[int, ...]:
    """Return the sizes of the steps back at an overflow, ns, in order, for these ticks."""
    sizes = {round(2**bits * tick) for bits, tick in product(COUNTER_BITS, ticks_ns)}
    return tuple(sorted(size for size in sizes if size > LEAST_STEP_NS))


SIZES_NS = sizes_of_counters(TICKS_NS)
"""Sizes of the steps back at an overflow, ns: from 4.3 s to 50 days."""
LOST_PERIODS = 5
"""An overflow may coincide with the loss of so many samples."""
PERIOD_STEPS = 20
"""The period is the median of the first steps forward; before, no overflow is removed."""
LONGEST_GAP_NS, GAP_SHARE = 60_000_000_000, 0.02
"""
Longest gap that an overflow may coincide with where the counter is known, ns and as a share of its
size: a restart in it would look alike.
"""
LEAST_EQUAL_STEPS = 2
"""Steps back of one size from which on it is the size of a counter, whatever its width and tick."""


@dataclass(frozen=True, eq=False)
class CounterStamps:
    """Stamps without overflows."""

    stamp_ns: np.ndarray
    """ns, int64, shape (n,)."""
    n_overflows: int
    """Number of overflows that were removed."""
    size_ns: int
    """
    Size of the counter, ns; 0 where it does not overflow. A gap may be longer by multiples of it.
    """

    def without(self, places: np.ndarray, sizes_ns: ArrayLike) -> 'CounterStamps':
        """Return the stamps without an overflow of a size, ns, after each of some samples."""
        if not len(places):
            return self
        shift = np.zeros(len(self.stamp_ns), np.int64)
        shift[places + 1] = sizes_ns
        return CounterStamps(
            self.stamp_ns + np.cumsum(shift),
            self.n_overflows + len(places),
            int(shift[places[-1] + 1]),
        )


def longer_gaps(size_ns: int, n_gaps: int) -> str:
    """Return how much longer gaps may be than they seem; '' where no gap is that long."""
    if not n_gaps or not 0 < size_ns <= LONGEST_GAP_NS:
        return ''
    return f', gaps may be longer by multiples of {size_ns / 1e9:.4g} s'


def overflow_size(step_ns: int, period_ns: float, sizes_ns: Sequence[int] = SIZES_NS) -> int:
    """
    Return the size of the counter whose overflow explains a step between stamps, ns; 0 for none.

    The step forward that remains without the overflow is at most `LOST_PERIODS` periods.
    """
    for size in sizes_ns:
        if 0 < step_ns + size <= LOST_PERIODS * period_ns:
            return size
    return 0


class OverflowSearch:
    """Removes overflows of the stamps of one stream; its division into pieces has no influence."""

    def __init__(self, tick_ns: float = 1.0) -> None:
        self.sizes_ns = sizes_of_counters((*TICKS_NS, tick_ns))
        """Sizes of the steps back at an overflow, ns."""
        self.count = 0
        """Overflows until now."""
        self.size_ns = 0
        """Size of the counter, ns; 0 before the first overflow."""
        # Sum of the sizes of all overflows, which is added to later stamps.
        self._shift_ns = 0
        # Last returned stamp, and the first steps forward, up to `PERIOD_STEPS`, ns.
        self._last_ns: int | None = None
        self._first_steps = np.zeros(0, np.int64)

    def removed(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the next stamps without overflows, ns, shape (n,)."""
        stamps = stamp_ns + self._shift_ns
        first = stamps[0] if self._last_ns is None else self._last_ns
        steps = np.diff(stamps, prepend=first)

        # The period from the first steps forward of the stream.
        is_forward = steps > 0
        n_before = len(self._first_steps)
        new_steps = steps[is_forward][: PERIOD_STEPS - n_before]
        self._first_steps = np.concatenate([self._first_steps, new_steps])
        period_ns = float(np.median(self._first_steps)) if len(self._first_steps) else 0.0

        for place in np.flatnonzero(steps < -LEAST_STEP_NS):
            # A step back within them is no overflow: the period is not known yet.
            if n_before + np.count_nonzero(is_forward[:place]) < PERIOD_STEPS:
                continue
            size = overflow_size(int(steps[place]), period_ns, self.sizes_ns)
            if not size and self.count >= LEAST_EQUAL_STEPS and -steps[place] < self.size_ns:
                # The counter overflows in a gap, whose length is known up to multiples of its size.
                size = self.size_ns
            if size:
                stamps[place:] += size
                self._shift_ns += size
                self.count += 1
                self.size_ns = size
        self._last_ns = int(stamps[-1])
        return stamps


def without_overflows(
    stamp_ns: np.ndarray, tick_ns: float = 1.0, counter_ns: np.ndarray | None = None
) -> CounterStamps:
    """
    Return all stamps of a recording without overflows.

    In addition to the known widths, any step back that recurs with one size, to a few periods, is
    the overflow of a counter.

    Parameters
    ----------
    stamp_ns : ndarray, shape (n,)
        Stamps, ns.
    tick_ns : float
        Tick of the counter, in addition to the usual ones.
    counter_ns : ndarray, shape (n,), optional
        Readings of the counter itself, ns, where they are known: an overflow in a gap leads from
        its end to its beginning.

    """
    search = OverflowSearch(tick_ns)
    stamps = CounterStamps(search.removed(stamp_ns), search.count, search.size_ns)
    if search.count >= LEAST_EQUAL_STEPS:
        stamps = _without_overflows_in_gaps(stamps)
    elif counter_ns is not None:
        places = np.flatnonzero(np.diff(stamps.stamp_ns) < -LEAST_STEP_NS)
        sizes_ns = np.zeros(len(places), np.int64)
        for k, place in enumerate(places):
            sizes_ns[k] = _size_in_gap(counter_ns[place], counter_ns[place + 1], search.sizes_ns)
        is_overflow = sizes_ns > 0
        stamps = stamps.without(places[is_overflow], sizes_ns[is_overflow])
    return _without_unknown_counter(stamps)


def _without_overflows_in_gaps(stamps: CounterStamps) -> CounterStamps:
    """
    Return stamps without the overflows in gaps of nearly the size of the counter, which is known.

    They leave a small step back. After a late sample the stamps return, after an overflow they
    continue from there.
    """
    stamp_ns = stamps.stamp_ns
    steps = np.diff(stamp_ns)
    period = np.median(steps[steps > 0])
    # Stamp k + 1 is a step back from stamp k, and stamp k + 2 is still before stamp k.
    back = np.flatnonzero(steps[:-1] < -LOST_PERIODS * period)
    continues = back[stamp_ns[back + 2] < stamp_ns[back]]
    return stamps.without(continues, np.full(len(continues), stamps.size_ns))


def _without_unknown_counter(stamps: CounterStamps) -> CounterStamps:
    """Return stamps without steps back that are all equal and begin at one end of a counter."""
    steps = np.diff(stamps.stamp_ns)
    forward = steps[steps > 0]
    back = np.flatnonzero(steps < -LEAST_STEP_NS)
    if not len(forward) or len(back) < LEAST_EQUAL_STEPS:
        return stamps
    # A step back is the period less the size of the counter.
    period = np.median(forward)
    sizes = period - steps[back]
    size = np.median(sizes)
    has_one_size = np.abs(sizes - size) < LOST_PERIODS * period
    has_one_end = np.abs(np.diff(stamps.stamp_ns[back])) < LOST_PERIODS * period
    if not has_one_size.all() or not has_one_end.all():
        return stamps
    return replace(stamps.without(back, np.round(sizes)), size_ns=round(float(size)))


def _size_in_gap(before_ns: int, after_ns: int, sizes_ns: Sequence[int]) -> int:
    """Return the size of the counter that overflows between two of its readings; 0 for none."""
    for size in sizes_ns:
        longest_gap = min(LONGEST_GAP_NS, GAP_SHARE * size)
        if before_ns < size and size - before_ns + after_ns < longest_gap:
            return size
    return 0
