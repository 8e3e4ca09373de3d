"""Stamps of samples: period, losses, counted clocks, and times of samples."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.text_enum import StrEnum


class Stamping(StrEnum):
    """Use of a stretch of stamps."""

    REGULAR = 'regular'
    """
    Steps of a clock, or integer multiples where samples were lost: the stamps are used unchanged.
    """
    COUNTED = 'counted'
    """
    Steps scatter about a line through the number of the sample: times are computed from that line.
    """
    IRREGULAR = 'irregular'
    """Steps scatter and follow no line: the stamps are the best estimate of the sampling times."""


REGULAR, COUNTED, IRREGULAR = Stamping
MIN_REGULAR_STEP, MAX_REGULAR_STEP = 0.5, 1.5
"""A step between these many periods is a regular one."""
WHOLE_STEP_SHARE = 0.1
"""
A longer step within this share of a period of an integer number of periods is regular too: samples
were lost.
"""
MAX_IRREGULAR_SHARE = 0.05
"""Largest share of irregular steps."""
MOST_LOST = 4
"""Largest number of lost samples per received one; beyond it the usual step is not the period."""
LAG = 64
"""
Lag, in samples, at which the variance of stamp differences is compared with the variance at lag
one.
"""
DRIFTING = 16.0
"""
Ratio of these variances from which the steps are independent of one another, so that the stamps
diverge from every line.

It is about 1 for jitter about a line, `LAG` for independent steps, and below 11 for packets of up
to 100 samples.
"""
PAUSE_NS = 1_000_000_000
"""A longer step is a pause; counting restarts after it."""
SKEWED = 0.35
"""
Largest share of the range of times of arrival below their median: 0.5 of symmetric jitter, 0.17 of
exponential lateness.
"""
PACKET = 1.5
"""Samples received together, on average, from which stamps are those of packets."""
MIN_PERIOD_STEPS = 16
"""Fewest steps for an estimate of the period."""


@dataclass(frozen=True)
class StampLine:
    """Distribution of stamps about a line through the number of the sample."""

    word: Stamping
    """Use of the stamps."""
    period_ns: float
    """Sampling period, ns."""
    low_ns: float = 0.0
    """Smallest distance of a stamp from the line of the sampling times, ns (2 % quantile)."""
    high_ns: float = 0.0
    """Largest distance, ns (98 % quantile)."""
    at_once: float = 1.0
    """Samples received together, on average."""

    @property
    def arrivals(self) -> bool:
        """Whether the stamps are times of arrival, which can only be late."""
        return self.low_ns >= 0 and self.high_ns > 0

    def __str__(self) -> str:
        if self.word == REGULAR:
            return f'stamps are regular at {1e9 / self.period_ns:.4g} Hz'
        # With lost samples the other periods are those of received messages, not of the driver.
        if self.word == IRREGULAR:
            return 'the steps between stamps scatter and follow no clock'
        if self.at_once >= PACKET:
            return (
                f'stamps are times of arrival, about {self.at_once:.0f} samples at once; regular'
                ' times are drawn through them'
            )
        return (
            f'stamps scatter by {1e-6 * (self.high_ns - self.low_ns):.3g} ms about a clock; regular'
            ' times are drawn through them'
        )


def describe_stamps(stamp_ns: np.ndarray) -> StampLine | None:
    """
    Return the StampLine of the stamps of one stretch in the order of arrival.

    None when they are too few.

    Parameters
    ----------
    stamp_ns : ndarray of int64, shape (n,)
        Without repeated messages; at least 256 are required to separate counted from irregular
        stamps.

    """
    step = np.diff(stamp_ns)
    step = step[np.abs(step) <= PAUSE_NS]
    if len(step) < MIN_PERIOD_STEPS:
        return None
    # Regular steps. Exchanged neighbours are no error of the stamps.
    sorted_step = np.diff(np.sort(stamp_ns))
    sorted_step = sorted_step[sorted_step <= PAUSE_NS]
    line = _regular_line(sorted_step, float(np.median(sorted_step)))
    if line is not None or len(stamp_ns) < 4 * LAG:
        return line

    # Steps that scatter about a line: their sums over many steps do not diverge.
    period = float(step.mean())
    lagged = (stamp_ns[LAG:] - stamp_ns[:-LAG]).astype(float)
    lagged = lagged[np.abs(lagged - LAG * period) <= PAUSE_NS]
    resolution = float(np.min(sorted_step[sorted_step > 0], initial=PAUSE_NS))
    lagged = _without_losses(lagged, resolution)
    if period > 0 and len(lagged) and lagged.var() <= DRIFTING * step.var():
        line = _counted_line(stamp_ns, step, float(lagged.mean()) / LAG)
        if line.period_ns >= 1.0:
            return line

    # Where more than half of the samples are lost the median step is two periods.
    line = _regular_line(sorted_step, float(np.quantile(sorted_step, 0.1)))
    return line or StampLine(IRREGULAR, max(period, 1.0))


def _regular_line(step: np.ndarray, usual: float) -> StampLine | None:
    """
    Return the line of regular stamps, or None if too many steps are no multiples of a period.

    The period is the mean step, divided by the number of periods in each.

    Parameters
    ----------
    step : array, shape (n,)
        ns.
    usual : float
        First estimate of the period, ns.

    """
    if usual <= 0 or regular_share(step, usual) < 1 - MAX_IRREGULAR_SHARE:
        return None
    n_periods = np.rint(step / usual)
    # A step that is no multiple is one period: the sample is late, and the next step is shorter.
    is_multiple = np.abs(step / usual - n_periods) <= WHOLE_STEP_SHARE
    is_late = (n_periods < MOST_LOST) & ~is_multiple
    n_periods[(step <= MAX_REGULAR_STEP * usual) | is_late] = 1.0
    # Without repeated stamps, and without long gaps, in which the number of periods is uncertain.
    used = (step > 0) & (n_periods <= MOST_LOST)
    return StampLine(REGULAR, float(step[used].sum() / n_periods[used].sum()))


def is_regular(step: np.ndarray, period: float) -> np.ndarray:
    """Return which steps are about one period, bool, shape of `step`."""
    return (step > MIN_REGULAR_STEP * period) & (step <= MAX_REGULAR_STEP * period)


def regular_share(step: np.ndarray, period: float) -> float:
    """
    Return the share of steps consistent with one clock and lost samples.

    0 when more than `MOST_LOST` would be lost.
    """
    n_periods = np.rint(step / period)
    is_multiple = np.abs(step / period - n_periods) <= WHOLE_STEP_SHARE
    is_explained = is_regular(step, period) | ((n_periods >= 2) & is_multiple)
    n_lost = float(np.sum(n_periods[is_explained] - 1, where=n_periods[is_explained] > 1))
    return 0.0 if n_lost > MOST_LOST * len(step) else float(is_explained.mean())


def _without_losses(lagged: np.ndarray, resolution: float) -> np.ndarray:
    """
    Return the stamp differences across `LAG` steps that contain neither lost samples nor a pause.

    These are near their median: within three median deviations, half a period and `resolution`, ns.
    """
    if not len(lagged):
        return lagged
    median = np.median(lagged)
    deviation = np.abs(lagged - median)
    return lagged[deviation <= 3 * np.median(deviation) + 0.5 * median / LAG + resolution]


def _counted_line(stamp_ns: np.ndarray, step: np.ndarray, period: float) -> StampLine:
    """
    Return the line of stamps that scatter about it.

    Through the earliest ones of times of arrival, otherwise through their median.

    Times of arrival keep the order, are late by more than a period, and arrive in packets or with a
    distribution skewed to late stamps. The earliest of symmetric jitter is no sampling time: with 3
    ms (Gaussian) it is 7 ms early and scatters three times as much as the mean.
    """
    number = np.arange(len(stamp_ns))
    residual = (stamp_ns - stamp_ns[0]) - period * number
    residual = residual - np.polynomial.Polynomial.fit(number, residual, 1)(number)
    low, middle, high = np.quantile(residual, (0.02, 0.5, 0.98))
    n_packets = max(int(np.count_nonzero(step > MIN_REGULAR_STEP * period)), 1)
    packet_size = len(step) / n_packets
    is_skewed = middle - low < SKEWED * (high - low)
    are_arrivals = (
        high - low > period and np.all(step >= 0) and (packet_size >= PACKET or is_skewed)
    )
    origin = low if are_arrivals else middle
    at_once = packet_size if are_arrivals else 1.0
    return StampLine(COUNTED, period, low - origin, high - origin, at_once)


LOST_SCATTER = 0.6
"""
Samples were lost at long steps if numbers with lost samples reduce the scatter of the stamps about
a line to this share; jitter of more than a period makes long steps too.
"""
MIN_PART = 3
"""Fewest samples with a clock of their own."""


def misfits(stamp: np.ndarray, times: np.ndarray, period: float, *, arrivals: bool) -> list[slice]:
    """
    Return the parts between gaps in which the stamps fit a clock better than the computed times.

    The clock of a part is ``c_k = period k + offset``, through the mean of its stamps s_k or the
    earliest one. The computed times t_k fit if ``rms(t - c) <= rms(s - c)``.

    Parameters
    ----------
    stamp, times : array, shape (n,)
        Recorded and computed times, ns.
    period : float
        Sampling period, ns.
    arrivals : bool
        Whether stamps are times of arrival, of which the earliest fit.

    """
    if len(stamp) < MIN_PART:
        return [slice(0, len(stamp))]
    parts = _parts_between_gaps(stamp, period)
    period_of_parts = _period_within(parts, stamp, period)
    number = np.arange(len(stamp), dtype=float)
    misfitting = []
    for part in parts:
        offset = stamp[part] - period_of_parts * number[part]
        clock = period_of_parts * number[part] + (offset.min() if arrivals else offset.mean())
        computed_error = np.linalg.norm(times[part] - clock)
        recorded_error = np.linalg.norm(stamp[part] - clock)
        if len(clock) < MIN_PART or computed_error > recorded_error:
            misfitting.append(part)
    return misfitting


def _parts_between_gaps(stamp: np.ndarray, period: float) -> list[slice]:
    """Return the parts of stamps, ns, between long steps at which samples were lost."""
    step = np.diff(stamp)
    # The usual step is that within a packet if it would mean more than MOST_LOST lost samples for
    # each received one.
    usual = float(np.median(step))
    if not _least_period(period) < usual < period:
        usual = period
    long = step > MAX_REGULAR_STEP * usual

    # A long step is a gap where lost samples explain the stamps better than late ones.
    if np.any(long):
        late_scatter = _scatter(np.ones(len(step)), stamp)
        lost_scatter = _scatter(np.where(long, np.rint(step / usual), 1.0), stamp)
        if lost_scatter > LOST_SCATTER * late_scatter:
            long[:] = False
    edges = [0, *(np.flatnonzero(long) + 1), len(stamp)]
    return [slice(int(start), int(stop)) for start, stop in zip(edges, edges[1:])]


def _period_within(parts: list[slice], stamp: np.ndarray, period: float) -> float:
    """
    Return the one period of the stamps within all parts, ns.

    With numbers k and stamps s about their means in each part: ``sum(k s) / sum(k^2)``. Samples of
    a packet have none, and `period` is returned.
    """
    number = np.arange(len(stamp), dtype=float)
    numbers_apart = np.concatenate([number[part] - number[part].mean() for part in parts])
    stamps_apart = np.concatenate([stamp[part] - stamp[part].mean() for part in parts])
    slope = float(numbers_apart @ stamps_apart / max(numbers_apart @ numbers_apart, 1.0))
    return slope if slope >= _least_period(period) else period


def _least_period(period: float) -> float:
    """Return the shortest step that is not within a packet."""
    return period / (1 + MOST_LOST)


def _scatter(number_step: np.ndarray, stamp: np.ndarray) -> float:
    """Return the rms of stamps about a line through the numbers of their samples, ns."""
    number = np.append(0.0, np.cumsum(number_step))
    return float(np.std(stamp - np.polyval(np.polyfit(number, stamp, 1), number)))


class TimesInOrder:
    """
    Keeps times in the order of the stamps where recorded and computed times meet.

    A sample recorded after all earlier ones has a later time than all of them. Otherwise it is
    moved behind the latest of them by its recorded distance, or by less where the next time
    requires it.
    """

    def __init__(self) -> None:
        self._latest: np.ndarray = np.full(2, np.iinfo(np.int64).min)
        """Highest recorded stamp and highest time of all samples so far, ns, shape (2,)."""

    def passes(self, stamp_ns: np.ndarray) -> bool:
        """
        Return whether stamps that are used unchanged begin after every time; then record them.

        `stamp_ns` are in order.
        """
        if stamp_ns[0] <= self._latest[1]:
            return False
        self._latest[:] = stamp_ns.max()
        return True

    def push(self, stamp_ns: np.ndarray, times_ns: np.ndarray) -> np.ndarray:
        """
        Return the times in order, int64, shape (n,).

        Parameters
        ----------
        stamp_ns, times_ns : ndarray of int64, shape (n,)
            Recorded stamps and the times chosen for them.

        """
        stamp = np.concatenate([self._latest[:1], stamp_ns])
        times = np.concatenate([self._latest[1:], times_ns])
        earlier_stamp = np.maximum.accumulate(stamp)[:-1]
        earlier_time = np.maximum.accumulate(times)[:-1]
        # Samples that were recorded after all earlier ones, but without a later time. Indices into
        # `stamp` and `times`, which begin with the latest earlier sample.
        moved = np.flatnonzero((stamp_ns > earlier_stamp) & (times_ns <= earlier_time)) + 1
        if len(moved):
            # Each run of successive ones is spread evenly behind the latest time before it.
            for run in np.split(moved, np.flatnonzero(np.diff(moved) > 1) + 1):
                before = times[: run[0]].max()
                # The mean recorded step, or a smaller one that ends before the next time.
                step = (stamp[run[-1]] - stamp[run[0] - 1]) / len(run)
                if run[-1] + 1 < len(times):
                    step = min(step, (times[run[-1] + 1] - before) / (len(run) + 1))
                number = np.arange(1, len(run) + 1)
                times[run] = before + (max(step, 1.0) * number).astype(np.int64)
        self._latest = np.array([stamp.max(), times.max()])
        return times[1:]


CLOCK_BLOCK = LAG
"""Samples that give one point of the clock; the stamps are classified again after as many."""
LOSS_REACH = 32
"""
Samples on both sides of a long step that decide between lost and late samples; packets are smaller.
"""
LOST_PERIOD_SHARE = 0.6
"""
Samples were lost at a long step if the clock is ahead by more than this share of a period after it,
relative to before.
"""
SAME_PERIOD_SHARE = 0.05
"""
A period that has changed by more than this share is another one; smaller changes are averaged.
"""
NEW_WEIGHT = 0.1
"""Weight of a new block in that average."""


class CountedClock:
    """
    Times of samples from their stamps, in order: each block of 64 gives one point.

    The times are interpolated linearly between points.

    The points are those of the earliest stamps where stamps are times of arrival, which can only be
    late, otherwise the means. The result does not depend on the division of the stamps into blocks.

    Parameters
    ----------
    line : StampLine
        Current estimate of the relation of the stamps to the sampling.

    """

    def __init__(self, line: StampLine):
        self._period = line.period_ns
        self._are_arrivals = line.arrivals
        # Samples were lost if the clock is ahead by more than this after a long step, ns.
        self._loss_margin = LOST_PERIOD_SHARE * line.period_ns
        self._loss_margin += 0.0 if line.arrivals else 0.25 * (line.high_ns - line.low_ns)
        # Stamps that are in no block yet, and times that are not returned yet, ns.
        self._waiting_ns = np.zeros(0, np.int64)
        self._ready_ns = [np.zeros(0, np.int64)]
        self._begin()

    def _begin(self) -> None:
        """Reset everything except the period."""
        # First stamp, ns; the stamps, times and points below are relative to it.
        self._origin_ns: int | None = None
        # Number of the next sample, and numbers and stamps of the newest samples, (2, n), at most
        # `LOSS_REACH`.
        self._next_number = 0.0
        self._newest_samples = np.zeros((2, 0))
        # Numbers and stamps of the samples of the newest block; their times need the point of the
        # next block.
        self._block_numbers: np.ndarray | None = None
        self._block_stamps = np.zeros(0)
        # Points of the clock, one for each of the newest blocks: (mean number of its samples, the
        # time of this number, ns).
        self._points: list[tuple[float, float]] = []
        # Last computed time; empty before the first.
        self._last_time = np.zeros(0)

    def push(self, stamp_ns: np.ndarray) -> None:
        """Add stamps in the order of arrival."""
        self._waiting_ns = np.concatenate([self._waiting_ns, stamp_ns])

    def take(self, final: bool = False) -> np.ndarray:
        """
        Return the times that are determined now (all with `final`), int64, ns.

        They are in the order of the stamps.
        """
        # A block needs the next stamps too, which decide whether samples were lost.
        n_needed = 1 if final else CLOCK_BLOCK + LOSS_REACH
        while len(self._waiting_ns) >= n_needed:
            # A block and the stamps ahead of it end at a pause, or where the stamps end.
            steps = np.diff(self._waiting_ns[: CLOCK_BLOCK + LOSS_REACH])
            pauses = np.flatnonzero(steps > PAUSE_NS)
            end = int(pauses[0]) + 1 if len(pauses) else len(self._waiting_ns)
            block_end = min(CLOCK_BLOCK, end)
            ahead_end = min(CLOCK_BLOCK + LOSS_REACH, end)
            self._add_block(self._waiting_ns[:block_end], self._waiting_ns[block_end:ahead_end])
            self._waiting_ns = self._waiting_ns[block_end:]
            # The pause follows this block: counting restarts.
            if len(pauses) and end <= CLOCK_BLOCK:
                self._finish()
        if final:
            self._finish()
        times = np.concatenate(self._ready_ns)
        self._ready_ns = [np.zeros(0, np.int64)]
        return times

    def _add_block(self, stamp_ns: np.ndarray, ahead_ns: np.ndarray) -> None:
        """
        Number a block, compute its point, and compute the times of the block before it.

        `ahead_ns`: the next stamps, which decide whether samples were lost at a long step.
        """
        if self._origin_ns is None:
            self._origin_ns = int(stamp_ns[0])
        stamp = (np.concatenate([stamp_ns, ahead_ns]) - self._origin_ns).astype(float)
        number = self._numbers(stamp, len(stamp_ns))
        stamp = stamp[: len(stamp_ns)]
        self._newest_samples = np.hstack([self._newest_samples, [number, stamp]])[:, -LOSS_REACH:]
        self._next_number = number[-1] + 1
        # A shorter block has no point, because its few samples may all be late.
        if len(number) >= CLOCK_BLOCK // 2 or not self._points:
            offsets = stamp - self._period * number
            offset = offsets.min() if self._are_arrivals else offsets.mean()
            mean_number = float(number.mean())
            self._points.append((mean_number, float(offset + self._period * mean_number)))
        if self._block_numbers is not None:
            self._add_times(self._block_numbers)
            self._update_period()
        self._block_numbers = number
        self._block_stamps = stamp

    def _numbers(self, stamp: np.ndarray, count: int) -> np.ndarray:
        """
        Return the numbers of the first `count` samples, shape (count,).

        They increase by one, and by the number of lost samples at a long step. That is the change
        of ``stamp - period * number`` from the samples before to those from the step on, in
        periods: the earliest of times of arrival, otherwise the median, of `LOSS_REACH` samples.
        """
        central = np.min if self._are_arrivals else np.median
        number = self._next_number + np.arange(len(stamp))
        stamp_before = self._newest_samples[1, -1] if self._newest_samples.shape[1] else stamp[0]
        step = np.diff(stamp, prepend=stamp_before)
        for k in np.flatnonzero(step[:count] > MAX_REGULAR_STEP * self._period):
            # Offsets of the stamps from the clock before the long step: of earlier blocks, then of
            # this one.
            earlier_number, earlier_stamp = self._newest_samples
            earlier_offset = earlier_stamp - self._period * earlier_number
            offset_before = np.append(earlier_offset, stamp[:k] - self._period * number[:k])
            offset_before = offset_before[-LOSS_REACH:]
            if not len(offset_before):
                continue
            after = slice(k, k + LOSS_REACH)
            jump = central(stamp[after] - self._period * number[after]) - central(offset_before)
            if jump > self._loss_margin:
                number[k:] += np.round(jump / self._period)
        return number[:count]

    def _add_times(self, number: np.ndarray) -> None:
        """
        Compute the times of the samples with these numbers, those of the newest block.

        They are on the lines through its point and the points of its neighbours, continued with the
        period. In parts where the stamps fit a clock better, these are used.
        """
        points = np.array(self._points)
        block_length = (CLOCK_BLOCK, CLOCK_BLOCK * self._period)  # samples, ns
        points = np.vstack([points[0] - block_length, points, points[-1] + block_length])
        computed = np.interp(number, points[:, 0], points[:, 1])
        is_recorded = np.zeros(len(computed), bool)
        for part in misfits(
            self._block_stamps, computed, self._period, arrivals=self._are_arrivals
        ):
            is_recorded[part] = True
        times = np.where(is_recorded, self._block_stamps, computed)
        # A computed part may overlap a recorded one, or this block the one before.
        overlaps = bool(np.any(np.diff(np.append(self._last_time, times)) <= 0))
        if overlaps:
            times = self._block_stamps
        # Recorded times are not on the lines, which begin again with the newest point.
        if is_recorded.any() or overlaps:
            self._points = self._points[-1:]
        self._last_time = times[-1:]
        self._ready_ns.append((self._origin_ns or 0) + np.rint(times).astype(np.int64))

    def _update_period(self) -> None:
        """Update the period from the last two points, and keep only these."""
        if len(self._points) < 2:
            return
        (n0, t0), (n1, t1) = self._points[-2:]
        period = (t1 - t0) / (n1 - n0)
        if abs(period - self._period) > SAME_PERIOD_SHARE * self._period:
            self._period = period
        else:
            self._period = self._period + NEW_WEIGHT * (period - self._period)
        self._points = self._points[-2:]

    def _finish(self) -> None:
        """Compute the remaining times, and reset."""
        if self._block_numbers is not None:
            self._add_times(self._block_numbers)
        self._begin()


BLOCKS_PER_REVIEW = 4
"""Counted stamps are reviewed once in this number of blocks."""
STAMP_HISTORY = 4 * LAG
"""Number of stamps for the decision between counted and irregular."""


class SampleTimes:
    """
    Assigns regular times to samples with irregular stamps.

    The result does not depend on the division of the stream into blocks.

    Regular stamps pass unchanged and without delay, except for the first few; they are reviewed
    every 64 samples. Repeated messages (same stamp, same readings) are removed.
    """

    def __init__(self) -> None:
        self.line: StampLine | None = None
        """Relation of the stamps to the sampling; None before it is known."""
        self.n_rebuilt = 0
        """Samples with a computed time."""
        self.n_irregular = 0
        """Samples whose stamps follow no clock."""
        self.n_repeated = 0
        """Repeated messages."""
        # Newest line of each use of the stamps.
        self._line_of_use: dict[Stamping, StampLine] = {}
        # The newest sample, as samples of length one; None before the first.
        self._last_sample: Any = None
        self._begin()

    def _begin(self) -> None:
        """Begin a stretch of the stream; the line and the counts remain."""
        # Whether the use of the stamps is not known yet; the samples are buffered until then.
        self._is_unclassified = True
        # `CountedClock` that computes the times; None while stamps are used unchanged.
        self._counted_clock: Any = None
        # Samples whose times are not determined yet.
        self._buffered: Any = None
        # Newest stamps, at most `STAMP_HISTORY`; the number of samples since the last full block of
        # `CLOCK_BLOCK`, and of full blocks since the use of the stamps was reviewed.
        self._stamps_ns = np.zeros(0, np.int64)
        self._n_since_block = 0
        self._n_since_review = 0
        self._times_in_order = TimesInOrder()

    def push(self, samples: ImuSamples) -> ImuSamples | None:
        """
        Return the samples whose times are determined now, in the order of arrival; None for none.
        """
        if self._pass_if_regular(samples):
            return samples
        samples = self._without_repeated(samples)
        ready = []
        # In parts that end with a block, as the stamps are reviewed after complete blocks.
        while len(samples):
            n_missing = CLOCK_BLOCK - self._n_since_block
            part = samples.select(slice(0, n_missing))
            samples = samples.select(slice(n_missing, None))
            self._add_to_history(part.stamp_ns)
            ready += self._add_part(part)
        return _joined(ready)

    def finish(self) -> ImuSamples | None:
        """Return the buffered samples, and reset."""
        if self._is_unclassified and self._buffered is not None:
            self._set_line(describe_stamps(self._buffered.stamp_ns))
        ready = self._take_buffered(final=True)
        self._begin()
        return _joined(ready)

    def _pass_if_regular(self, samples: ImuSamples) -> bool:
        """
        Return whether the samples can pass unchanged; then record their stamps as passed.

        They can if the stamps are in use unchanged, and each step is about one period. This is the
        usual case, in which the samples need no further tests.
        """
        if self._is_unclassified or self._counted_clock is not None:
            return False
        if self.line is None or not len(samples):
            return False
        # All steps since the last full block, because the next review is of a complete one.
        n_recorded = self._n_since_block + 1
        step = np.diff(np.concatenate([self._stamps_ns[-n_recorded:], samples.stamp_ns]))
        if not np.all(is_regular(step, self.line.period_ns)):
            return False
        if not self._times_in_order.passes(samples.stamp_ns):
            return False
        self._add_to_history(samples.stamp_ns)
        self._last_sample = samples.select(slice(len(samples) - 1, None))
        return True

    def _add_to_history(self, stamp_ns: np.ndarray) -> None:
        """Keep the newest stamps, and count them for the next complete block."""
        self._n_since_block = (self._n_since_block + len(stamp_ns)) % CLOCK_BLOCK
        stamps_ns = np.concatenate([self._stamps_ns, stamp_ns[-STAMP_HISTORY:]])
        self._stamps_ns = stamps_ns[-STAMP_HISTORY:]

    def _without_repeated(self, samples: ImuSamples) -> ImuSamples:
        """Return samples without those that repeat the stamp and the readings of the one before."""
        joined = samples.after(self._last_sample)
        n_before = len(joined) - len(samples)
        self._last_sample = joined.select(slice(len(joined) - 1, None))
        # Sample k + 1 has the stamp of sample k.
        k = np.flatnonzero(joined.stamp_ns[1:] == joined.stamp_ns[:-1])
        has_same_force = np.all(joined.force_s[k] == joined.force_s[k + 1], axis=1)
        has_same_rate = np.all(joined.rate_s[k] == joined.rate_s[k + 1], axis=1)
        repeated = k[has_same_force & has_same_rate] + 1
        if not len(repeated):
            return samples
        self.n_repeated += len(repeated)
        is_kept = np.arange(len(joined)) >= n_before
        is_kept[repeated] = False
        return joined.select(is_kept)

    def _add_part(self, part: ImuSamples) -> list:
        """
        Add a part of a block of `CLOCK_BLOCK` samples; return the samples with their times.

        After a complete block the use of the stamps may be reviewed.
        """
        if self._is_unclassified:
            return self._classify(part)
        ready = self._with_times(part)
        if not self._n_since_block:
            self._n_since_review = (self._n_since_review + 1) % BLOCKS_PER_REVIEW
            # Regular stamps are reviewed when their steps change, counted ones now and then.
            is_due = not self._n_since_review
            if self._counted_clock is None:
                is_due = self._block_differs()
            if is_due:
                ready += self._set_line(describe_stamps(self._stamps_ns))
        return ready

    def _classify(self, part: ImuSamples) -> list:
        """
        Buffer the first samples until the use of their stamps is known, then return them.

        Regular stamps are recognised by the first few, others by `STAMP_HISTORY` samples.
        """
        self._buffered = part.after(self._buffered)
        stamp_ns = self._buffered.stamp_ns
        is_full = len(stamp_ns) >= STAMP_HISTORY
        line = None
        if len(stamp_ns) > MIN_PERIOD_STEPS:
            line = describe_stamps(stamp_ns if is_full else stamp_ns[: MIN_PERIOD_STEPS + 1])
        if line is None and not is_full:
            return []
        self._is_unclassified = False
        self._set_line(line)
        return self._take_buffered()

    def _take_buffered(self, final: bool = False) -> list:
        """Return the buffered samples with their stamps, or the times that are determined now."""
        if self._counted_clock is not None:
            return self._timed_by_clock(final)
        buffered = self._buffered
        self._buffered = None
        return [self._ordered(buffered)]

    def _with_times(self, part: ImuSamples) -> list:
        """Return `part` with its stamps, or the samples whose times the clock determines now."""
        if self._counted_clock is None:
            if self.line is not None and self.line.word == IRREGULAR:
                self.n_irregular += len(part)
            return [self._ordered(part)]
        self._counted_clock.push(part.stamp_ns)
        self._buffered = part.after(self._buffered)
        return self._timed_by_clock()

    def _timed_by_clock(self, final: bool = False) -> list:
        """Return the first buffered samples whose times are determined, all with `final`."""
        times = self._counted_clock.take(final)
        if not len(times):
            return []
        timed = self._buffered.select(slice(0, len(times)))
        self._buffered = self._buffered.select(slice(len(times), None))
        self.n_rebuilt += len(times)
        return [replace(timed, stamp_ns=self._times_in_order.push(timed.stamp_ns, times))]

    def _ordered(self, samples: ImuSamples | None) -> ImuSamples | None:
        """Return samples with their recorded stamps, later than the computed times before them."""
        if samples is None or not len(samples):
            return samples
        times = self._times_in_order.push(samples.stamp_ns, samples.stamp_ns)
        return replace(samples, stamp_ns=times)

    def odd_line(self, count: int) -> StampLine | None:
        """
        Return the newest line of the more frequent kind of irregular stamps.

        None if they are at most the share `MAX_IRREGULAR_SHARE` of `count` samples.
        """
        number, use = max((self.n_rebuilt, COUNTED), (self.n_irregular, IRREGULAR))
        return self._line_of_use.get(use) if number > MAX_IRREGULAR_SHARE * count else None

    def _block_differs(self) -> bool:
        """Return whether the steps of the last block differ from the known clock."""
        if self.line is None:
            return True
        step = np.diff(self._stamps_ns[-CLOCK_BLOCK - 1 :])
        n_irregular = np.count_nonzero(~is_regular(step, self.line.period_ns))
        return bool(n_irregular > MAX_IRREGULAR_SHARE * len(step))

    def _set_line(self, line: StampLine | None) -> list:
        """
        Compute times from now on if stamps are counted according to a line, else use the stamps.

        Return the samples that wait for their times, computed by the clock of the line before; []
        where this clock continues.
        """
        if line is None:
            return []
        line_before = self.line
        self.line = line
        self._line_of_use[line.word] = line
        ready = []
        if self._counted_clock is not None:
            assert line_before is not None  # the clock was made with it
            change = abs(line.period_ns - line_before.period_ns)
            # The clock itself follows small changes of the period.
            if line.word == COUNTED and change <= SAME_PERIOD_SHARE * line_before.period_ns:
                return []
            ready = self._timed_by_clock(final=True)
            self._counted_clock = self._buffered = None
        if line.word == COUNTED:
            self._counted_clock = CountedClock(line)
            if self._buffered is not None:
                self._counted_clock.push(self._buffered.stamp_ns)
        return ready


def _joined(parts: list) -> ImuSamples | None:
    """Return samples joined in order, without empty parts and None; None for none."""
    parts = [part for part in parts if part is not None and len(part)]
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else ImuSamples.concatenate(parts)
