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
    """Sampling period."""
    low_ns: float = 0.0
    """Smallest distance of a stamp from the line of the sampling times."""
    high_ns: float = 0.0
    """Largest distance."""
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
    in_order = np.diff(np.sort(stamp_ns))  # exchanged neighbours are no error of the stamps
    in_order = in_order[in_order <= PAUSE_NS]
    line = _regular(in_order, float(np.median(in_order)))
    if line is not None or len(stamp_ns) < 4 * LAG:
        return line
    period = float(step.mean())
    apart = (stamp_ns[LAG:] - stamp_ns[:-LAG]).astype(float)
    apart = apart[np.abs(apart - LAG * period) <= PAUSE_NS]
    apart = _without_losses(apart, float(np.min(in_order[in_order > 0], initial=PAUSE_NS)))
    if period > 0 and len(apart) and apart.var() <= DRIFTING * step.var():
        line = _line(stamp_ns, step, float(apart.mean()) / LAG)
        if line.period_ns >= 1.0:
            return line
    # Where more than half of the samples are lost the usual step is two periods.
    return _regular(in_order, float(np.quantile(in_order, 0.1))) or StampLine(
        IRREGULAR, max(period, 1.0)
    )


def _regular(step: np.ndarray, usual: float) -> StampLine | None:
    if usual <= 0 or regular_share(step, usual) < 1 - MAX_IRREGULAR_SHARE:
        return None
    number = np.rint(step / usual)
    # the sample is late, and the next one earlier
    number[
        (step <= MAX_REGULAR_STEP * usual)
        | ((number < MOST_LOST) & (np.abs(step / usual - number) > WHOLE_STEP_SHARE))
    ] = 1.0
    used = (step > 0) & (number <= MOST_LOST)
    return StampLine(REGULAR, float(step[used].sum() / number[used].sum()))


def is_regular(step: np.ndarray, period: float) -> np.ndarray:
    """Return whether steps are regular ones."""
    return (step > MIN_REGULAR_STEP * period) & (step <= MAX_REGULAR_STEP * period)


def regular_share(step: np.ndarray, period: float) -> float:
    """
    Return the share of steps consistent with one clock and lost samples.

    0 when more than `MOST_LOST` would be lost.
    """
    number = np.rint(step / period)
    whole = np.abs(step / period - number)
    good = is_regular(step, period) | ((number >= 2) & (whole <= WHOLE_STEP_SHARE))
    lost = float(np.sum(number[good] - 1, where=number[good] > 1))
    return 0.0 if lost > MOST_LOST * len(step) else float(good.mean())


def _without_losses(apart: np.ndarray, resolution: float) -> np.ndarray:
    """
    Return the differences across `LAG` steps.

    Without the ones that contain lost samples or a pause.
    """
    off = np.abs(apart - np.median(apart)) if len(apart) else apart
    return (
        apart[off <= 3 * np.median(off) + 0.5 * np.median(apart) / LAG + resolution]
        if len(apart)
        else apart
    )


def _line(stamp_ns: np.ndarray, step: np.ndarray, period: float) -> StampLine:
    """
    Return the line of stamps near it.

    Through the earliest ones of times of arrival, otherwise through their median.

    Times of arrival keep the order, are late by more than a period, and arrive in packets or with a
    distribution skewed to late stamps. The earliest of symmetric jitter is no sampling time: with 3
    ms (Gaussian) it is 7 ms early and scatters three times as much as the mean.
    """
    number = np.arange(len(stamp_ns))
    residual = (stamp_ns - stamp_ns[0]) - period * number
    residual = residual - np.polynomial.Polynomial.fit(number, residual, 1)(number)
    low, middle, high = np.quantile(residual, (0.02, 0.5, 0.98))
    at_once = len(step) / max(int(np.count_nonzero(step > MIN_REGULAR_STEP * period)), 1)
    skewed = middle - low < SKEWED * (high - low)
    arrivals = high - low > period and np.all(step >= 0) and (at_once >= PACKET or skewed)
    origin = low if arrivals else middle
    return StampLine(COUNTED, period, low - origin, high - origin, at_once if arrivals else 1.0)


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
    own_period = _period_within(parts, stamp, period)
    number = np.arange(len(stamp), dtype=float)
    found = []
    for part in parts:
        late = stamp[part] - own_period * number[part]
        clock = own_period * number[part] + (late.min() if arrivals else late.mean())
        computed_error = np.linalg.norm(times[part] - clock)
        recorded_error = np.linalg.norm(stamp[part] - clock)
        if len(clock) < MIN_PART or computed_error > recorded_error:
            found.append(part)
    return found


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
    own_period = float(numbers_apart @ stamps_apart / max(numbers_apart @ numbers_apart, 1.0))
    return own_period if own_period >= _least_period(period) else period


def _least_period(period: float) -> float:
    """Return the shortest step that is not within a packet."""
    return period / (1 + MOST_LOST)


def _scatter(number_step: np.ndarray, stamp: np.ndarray) -> float:
    """Return the rms of stamps about a line through the numbers of their samples, ns."""
    number = np.concatenate([[0.0], np.cumsum(number_step)])
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
        """The highest recorded stamp and the highest time, ns."""

    def passes(self, stamp_ns: np.ndarray) -> bool:
        """Take stamps that are used unchanged; return whether the first is after every time."""
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
        back = np.flatnonzero((stamp_ns > earlier_stamp) & (times_ns <= earlier_time)) + 1
        if len(back):
            for run in np.split(back, np.flatnonzero(np.diff(back) > 1) + 1):
                before = times[: run[0]].max()
                # as far apart as recorded, and before the next time
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
FOLLOW = 0.05
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
        self._period, self._arrivals = line.period_ns, line.arrivals
        self._margin = LOST_PERIOD_SHARE * line.period_ns + (
            0.0 if line.arrivals else 0.25 * (line.high_ns - line.low_ns)
        )
        self._raw = np.zeros(0, np.int64)
        self._times = [np.zeros(0, np.int64)]
        self._begin()

    def _begin(self) -> None:
        """Reset everything except the period."""
        self._origin_ns: int | None = None
        self._stamp = self._told = np.zeros(0)
        self._next = 0.0
        self._before = np.zeros((2, 0))
        self._block: np.ndarray | None = None
        self._points: list[tuple[float, float]] = []

    def push(self, stamp_ns: np.ndarray) -> None:
        """Add stamps in the order of arrival."""
        self._raw = np.concatenate([self._raw, stamp_ns])

    def take(self, final: bool = False) -> np.ndarray:
        """
        Return the times that are determined now (all with `final`), int64, ns.

        They are in the order of the stamps.
        """
        while len(self._raw) >= CLOCK_BLOCK + LOSS_REACH or (final and len(self._raw)):
            pause = np.flatnonzero(np.diff(self._raw[: CLOCK_BLOCK + LOSS_REACH]) > PAUSE_NS)
            end = len(self._raw) if not len(pause) else int(pause[0]) + 1
            self._work(
                self._raw[: min(CLOCK_BLOCK, end)],
                self._raw[min(CLOCK_BLOCK, end) : min(CLOCK_BLOCK + LOSS_REACH, end)],
            )
            self._raw = self._raw[min(CLOCK_BLOCK, end) :]
            if len(pause) and end <= CLOCK_BLOCK:
                self._finish()
        if final:
            self._finish()
        times, self._times = np.concatenate(self._times), [np.zeros(0, np.int64)]
        return times

    def _work(self, stamp_ns: np.ndarray, ahead_ns: np.ndarray) -> None:
        """Number a block, compute its point, and compute the times of the block before it."""
        if self._origin_ns is None:
            self._origin_ns = int(stamp_ns[0])
        stamp = (np.concatenate([stamp_ns, ahead_ns]) - self._origin_ns).astype(float)
        number = self._numbered(stamp, len(stamp_ns))
        stamp = stamp[: len(stamp_ns)]
        self._before = np.stack(
            [np.concatenate([self._before[0], number]), np.concatenate([self._before[1], stamp])]
        )[:, -LOSS_REACH:]
        self._next = number[-1] + 1
        # The few samples of a shorter one may all be late.
        if len(number) >= CLOCK_BLOCK // 2 or not self._points:
            late = stamp - self._period * number
            usual = late.min() if self._arrivals else late.mean()
            self._points.append((float(number.mean()), float(usual + self._period * number.mean())))
        if self._block is not None:
            self._tell(self._block)
            self._follow()
        self._block, self._stamp = number, stamp

    def _numbered(self, stamp: np.ndarray, count: int) -> np.ndarray:
        """
        Return the numbers of the first `count` samples.

        Increments of one, plus the number of samples lost at a long step.
        """
        middle = np.min if self._arrivals else np.median
        number = self._next + np.arange(len(stamp))
        step = np.diff(stamp, prepend=self._before[1, -1] if self._before.shape[1] else stamp[0])
        for k in np.flatnonzero(step[:count] > MAX_REGULAR_STEP * self._period):
            past = np.concatenate(
                [
                    self._before[1] - self._period * self._before[0],
                    stamp[:k] - self._period * number[:k],
                ]
            )[-LOSS_REACH:]
            if len(past):
                jump = middle(
                    stamp[k : k + LOSS_REACH] - self._period * number[k : k + LOSS_REACH]
                ) - middle(past)
                number[k:] += np.round(jump / self._period) if jump > self._margin else 0.0
        return number[:count]

    def _tell(self, number: np.ndarray) -> None:
        """Compute the times of a block, from its point and the points of its neighbours."""
        points = np.array(self._points)
        ends = (
            points[0] - (CLOCK_BLOCK, CLOCK_BLOCK * self._period),
            points[-1] + (CLOCK_BLOCK, CLOCK_BLOCK * self._period),
        )
        points = np.vstack([ends[0], points, ends[1]])
        times = np.interp(number, points[:, 0], points[:, 1])
        recorded = np.zeros(len(times), bool)
        for part in misfits(self._stamp, times, self._period, arrivals=self._arrivals):
            recorded[part] = True
        mixed = np.where(recorded, self._stamp, times)
        if np.any(np.diff(np.append(self._told, mixed)) <= 0):
            # a computed part beside a recorded one, or this block and the one before, overlap
            mixed = self._stamp
        if recorded.any() or mixed is self._stamp:
            times = mixed
            self._points = self._points[-1:]
        self._told = times[-1:]
        self._times.append((self._origin_ns or 0) + np.rint(times).astype(np.int64))

    def _follow(self) -> None:
        """Update the period; keep the last two points."""
        if len(self._points) < 2:
            return
        (n0, t0), (n1, t1) = self._points[-2:]
        period = (t1 - t0) / (n1 - n0)
        self._period = (
            period
            if abs(period - self._period) > FOLLOW * self._period
            else self._period + NEW_WEIGHT * (period - self._period)
        )
        self._points = self._points[-2:]

    def _finish(self) -> None:
        """Compute the remaining times, and reset."""
        if self._block is not None:
            self._tell(self._block)
        self._begin()


RARE = 4
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
        """Relation of the stamps to the sampling, as far as known."""
        self.n_rebuilt = self.n_irregular = self.n_repeated = 0
        """Samples with a computed time; samples whose stamps follow no clock; repeated messages."""
        self._odd_lines: dict[Stamping, StampLine] = {}
        self._last: Any = None
        self._begin()

    def _begin(self) -> None:
        self._learning = True
        self._clock: Any = None
        self._held: Any = None
        self._history, self._unseen, self._reviewed = np.zeros(0, np.int64), 0, 0
        self._order = TimesInOrder()

    def push(self, samples: ImuSamples) -> ImuSamples | None:
        """
        Return the samples whose times are determined now, in the order of arrival; None for none.
        """
        if self._pass(samples):
            return samples
        samples = self._without_repeated(samples)
        ready = []
        while len(samples):
            part = samples.select(slice(0, CLOCK_BLOCK - self._unseen))
            samples = samples.select(slice(CLOCK_BLOCK - self._unseen, None))
            self._unseen = (self._unseen + len(part)) % CLOCK_BLOCK
            self._history = np.concatenate([self._history, part.stamp_ns])[-STAMP_HISTORY:]
            ready += self._take(part)
        return _joined(ready)

    def finish(self) -> ImuSamples | None:
        """Return the buffered samples, and reset."""
        if self._learning and self._held is not None:
            self._judge(describe_stamps(self._held.stamp_ns))
        ready = (
            self._counted(final=True) if self._clock is not None else [self._ordered(self._held)]
        )
        self._begin()
        return _joined(ready)

    def _pass(self, samples: ImuSamples) -> bool:
        """
        Return whether all steps agree with the known clock: the usual case, without further tests.
        """
        if self._learning or self._clock is not None or self.line is None or not len(samples):
            return False
        # The complete block of the next review.
        step = np.diff(np.concatenate([self._history[-self._unseen - 1 :], samples.stamp_ns]))
        if not np.all(is_regular(step, self.line.period_ns)):
            return False
        if not self._order.passes(samples.stamp_ns):
            return False
        self._unseen = (self._unseen + len(samples)) % CLOCK_BLOCK
        self._history = np.concatenate([self._history, samples.stamp_ns[-STAMP_HISTORY:]])[
            -STAMP_HISTORY:
        ]
        self._last = samples.select(slice(len(samples) - 1, None))
        return True

    def _without_repeated(self, samples: ImuSamples) -> ImuSamples:
        joined = samples if self._last is None else ImuSamples.concatenate([self._last, samples])
        at = np.flatnonzero(joined.stamp_ns[1:] == joined.stamp_ns[:-1])
        same = at[
            np.all(joined.force_s[at] == joined.force_s[at + 1], axis=1)
            & np.all(joined.rate_s[at] == joined.rate_s[at + 1], axis=1)
        ]
        self._last = joined.select(slice(len(joined) - 1, None))
        if not len(same):
            return samples
        self.n_repeated += len(same)
        new = np.arange(len(joined)) >= len(joined) - len(samples)
        new[same + 1] = False
        return joined.select(new)

    def _take(self, part: ImuSamples) -> list:
        """Add a block or a part of one; return the samples that are ready."""
        if self._learning:
            self._held = part if self._held is None else ImuSamples.concatenate([self._held, part])
            stamp_ns = self._held.stamp_ns
            some = stamp_ns[: MIN_PERIOD_STEPS + 1] if len(stamp_ns) < STAMP_HISTORY else stamp_ns
            line = describe_stamps(some) if len(stamp_ns) > MIN_PERIOD_STEPS else None
            if line is None and len(stamp_ns) < STAMP_HISTORY:
                return []
            self._learning = False
            return self._judge(line) + self._on(None)
        ready = self._on(part)
        if not self._unseen:
            self._reviewed = (self._reviewed + 1) % RARE
            if self._odd() if self._clock is None else not self._reviewed:
                ready += self._judge(describe_stamps(self._history))
        return ready

    def _on(self, part: ImuSamples | None) -> list:
        """Return the held samples and a further part, unchanged or with times from the clock."""
        if self._clock is None:
            held, self._held = self._held, None
            self.n_irregular += (
                len(part or ()) if self.line is not None and self.line.word == IRREGULAR else 0
            )
            return [self._ordered(held), self._ordered(part)]
        if part is not None:
            self._clock.push(part.stamp_ns)
            self._held = part if self._held is None else ImuSamples.concatenate([self._held, part])
        return self._counted()

    def _counted(self, final: bool = False) -> list:
        """Return the samples at the front whose times are determined."""
        times = self._clock.take(final)
        if not len(times):
            return []
        timed, self._held = (
            self._held.select(slice(0, len(times))),
            self._held.select(slice(len(times), None)),
        )
        self.n_rebuilt += len(times)
        return [replace(timed, stamp_ns=self._order.push(timed.stamp_ns, times))]

    def _ordered(self, samples: ImuSamples | None) -> ImuSamples | None:
        """Return samples with their recorded stamps, later than the computed times before them."""
        if samples is None or not len(samples):
            return samples
        times = self._order.push(samples.stamp_ns, samples.stamp_ns)
        return replace(samples, stamp_ns=times)

    def odd_line(self, count: int) -> StampLine | None:
        """
        Return the relation of the irregular stamps to the sampling.

        It is returned when it concerns more than a few of `count` samples.
        """
        number, word = max((self.n_rebuilt, COUNTED), (self.n_irregular, IRREGULAR))
        return self._odd_lines.get(word) if number > MAX_IRREGULAR_SHARE * count else None

    def _odd(self) -> bool:
        """Return whether the steps of the last block differ from the known clock."""
        if self.line is None:
            return True
        step = np.diff(self._history[-CLOCK_BLOCK - 1 :])
        return bool(
            np.count_nonzero(~is_regular(step, self.line.period_ns))
            > MAX_IRREGULAR_SHARE * len(step)
        )

    def _judge(self, line: StampLine | None) -> list:
        """Start or stop counting according to the stamps; return the samples that become ready."""
        if line is None:
            return []
        before, self.line = self.line, line
        self._odd_lines[line.word] = line
        changed = (
            before is not None
            and abs(line.period_ns - before.period_ns) > FOLLOW * before.period_ns
        )
        if (line.word == COUNTED) == (self._clock is not None) and not (
            changed and self._clock is not None
        ):
            return []
        ready = []
        if self._clock is not None:
            ready, self._clock = self._counted(final=True), None
            if line.word != COUNTED:
                return ready
        self._clock = CountedClock(line)
        if self._held is not None:
            self._clock.push(self._held.stamp_ns)
        return ready


def _joined(parts: list) -> ImuSamples | None:
    parts = [part for part in parts if part is not None and len(part)]
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else ImuSamples.concatenate(parts)
