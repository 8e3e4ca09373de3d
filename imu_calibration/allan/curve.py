"""Allan deviation of samples, and the curve of a recording."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from operator import itemgetter
from typing import Protocol

import numpy as np

from imu_calibration.allan.outliers import RestOutliers, without_outliers
from imu_calibration.allan.reading_faults import NO_FAULTS, FaultSearch, ReadingFaults
from imu_calibration.allan.still_parts import StillPart
from imu_calibration.allan.trends import AxisTrend, Parts, TrendReference
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import BlockSource, ImuSamples
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner

FULL = 65536
"""Largest number of samples per mean for which every position counts."""
PRESENT = 0.9
"""Least share of the samples of a mean that must be present."""
PER_OCTAVE = 2
"""Averaging times per octave."""


def averaging_factors(n_samples: int, per_octave: int = PER_OCTAVE) -> np.ndarray:
    """
    Return the numbers of samples per mean at which the variance is computed.

    They are rising integers, spaced evenly in the logarithm, from 1 to half of `n_samples`. Beyond
    `FULL` they are multiples of a power of two, for the halved rates.
    """
    if n_samples < 2:
        return np.zeros(0, np.int64)
    steps = np.arange(int(per_octave * np.log2(n_samples / 2)) + 1)
    even = 2.0 ** (steps / per_octave)
    unit = 2 ** _octaves_beyond(even)
    return np.unique(np.rint(even / unit).astype(np.int64) * unit)


def _octaves_beyond(factor: np.ndarray) -> np.ndarray:
    """Return the numbers of halvings of the rate that reduce factors to at most `FULL`."""
    # 1e-9: a rounding error at a power of two adds no halving.
    return np.maximum(np.ceil(np.log2(np.maximum(factor, 1) / FULL) - 1e-9), 0).astype(np.int64)


class AllanSums:
    """
    Sums of squared second differences, added block by block over stretches without a break.

    With the mean m_k of `factor` samples from sample k on, a term is ``(m_(k + factor) - m_k)^2``,
    and the Allan variance is half the mean of the terms. Memory is limited by halving the rate for
    factors above `FULL`.

    Parameters
    ----------
    factors : ndarray of int, shape (n_scales,)
        From `averaging_factors`.
    n_columns : int
        Number of sensor axes.

    """

    def __init__(self, factors: np.ndarray, n_columns: int):
        self.factors = np.asarray(factors, np.int64)
        # Sums of terms, and their numbers.
        self.squares = np.zeros((len(factors), n_columns))
        self.terms = np.zeros(len(factors), np.int64)
        # Samples of each complete stretch, missing ones included.
        self.lengths: list[int] = []
        # (squares, terms) before the first stretch and after each complete one.
        self._at_ends: list[tuple[np.ndarray, np.ndarray]] = [
            (self.squares.copy(), self.terms.copy())
        ]
        # Level k has the factors that need k halvings of the rate.
        halvings = _octaves_beyond(self.factors)
        self._levels = []
        for k in range(int(halvings.max(initial=0)) + 1):
            of_level = halvings == k
            level = _Level(np.flatnonzero(of_level), self.factors[of_level] >> k, n_columns)
            self._levels.append(level)
        # Level of the readings in the present stretch, subtracted against rounding, and its length.
        self._offset: np.ndarray | None = None
        self._length = 0

    def push(self, values: np.ndarray, present: np.ndarray | None = None) -> None:
        """
        Add the next samples of the stretch.

        Parameters
        ----------
        values : ndarray, shape (n, n_columns)
            Readings at equal steps of time.
        present : ndarray of bool, shape (n,), optional
            False where a sample is missing; its value does not count.

        """
        if not len(values):
            return
        present = np.ones(len(values), bool) if present is None else present
        if self._offset is None:
            # The stretch begins with a sample that is present.
            if not present.any():
                return
            # The level of its first samples, a thousand at most.
            self._offset = values[present][:1000].mean(axis=0)
        self._length += len(values)
        rows = np.ascontiguousarray((values - self._offset).T)
        rows[:, ~present] = 0.0
        counts = present.astype(float)
        for k, level in enumerate(self._levels):
            if k:
                rows, counts = level.halved(rows, counts)
            # No pair is complete: nothing new for this rate and all lower ones.
            if not rows.shape[1]:
                return
            level.push(rows, counts, 2.0**k, self.squares, self.terms)

    def end_stretch(self) -> None:
        """Close the stretch; the next one is independent of it."""
        if self._length:
            self.lengths.append(self._length)
            self._at_ends.append((self.squares.copy(), self.terms.copy()))
        self._offset = None
        self._length = 0
        for level in self._levels:
            level.reset()

    def by_stretch(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (variances of each stretch, their numbers of terms).

        The shapes are (n_stretches, n_scales, n_columns) and (n_stretches, n_scales).
        """
        squares = np.diff(np.array([squares for squares, _ in self._at_ends]), axis=0)
        terms = np.diff(np.array([terms for _, terms in self._at_ends]), axis=0)
        return squares / (2.0 * np.maximum(terms, 1)[:, :, None]), terms.astype(float)

    def variance(self) -> np.ndarray:
        """Return the Allan variances, shape (n_scales, n_columns); NaN without a term."""
        with np.errstate(invalid='ignore', divide='ignore'):
            return self.squares / (2.0 * self.terms[:, None])


class _Level:
    """
    Second differences at one rate, which is the sampling rate halved k times.

    Parameters
    ----------
    index : ndarray of int
        Rows of the results of this level in those of `AllanSums`.
    factors : ndarray of int
        Samples of this rate per mean, for each of these rows.
    n_columns : int
        Number of sensor axes.

    """

    def __init__(self, index: np.ndarray, factors: np.ndarray, n_columns: int):
        self.index = index
        self.factors = factors
        # Samples before a new one that its differences need.
        self.reach = 2 * int(factors.max(initial=1))
        self.n_columns = n_columns
        self.reset()

    def reset(self) -> None:
        """Begin a new stretch."""
        # Cumulative sums of readings and of present samples, from before the first sample kept on.
        self.sums = np.zeros((self.n_columns, 1))
        self.counts = np.zeros(1)
        # The last sample of the rate before (sum, presence) while its pair is incomplete.
        self.odd_rows = np.zeros((self.n_columns, 0))
        self.odd_counts = np.zeros(0)

    def halved(self, rows: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (sums of pairs of samples, share of each pair that is present).

        The samples are those of the rate before, shape (n_columns, n); a last one without a pair is
        kept for the next call.
        """
        rows = np.concatenate([self.odd_rows, rows], axis=-1)
        counts = np.concatenate([self.odd_counts, counts], axis=-1)
        n = len(counts) // 2 * 2
        self.odd_rows = rows[:, n:]
        self.odd_counts = counts[n:]
        return rows[:, 0:n:2] + rows[:, 1:n:2], 0.5 * (counts[0:n:2] + counts[1:n:2])

    def push(
        self,
        rows: np.ndarray,
        counts: np.ndarray,
        size: float,
        squares: np.ndarray,
        terms: np.ndarray,
    ) -> None:
        """
        Add the second differences that end in the new samples to `squares` and `terms`.

        With the cumulative sums S, m times the difference of means that ends in sample k is ``S(k)
        - 2 S(k - m) + S(k - 2 m)``.

        Parameters
        ----------
        rows : ndarray, shape (n_columns, n)
            New samples of this rate, zero where missing; each is a sum of `size` original ones.
        counts : ndarray, shape (n,)
            Share of each sample that is present.
        size : float
        squares : ndarray, shape (n_scales, n_columns)
            Sums of `AllanSums`, changed in place.
        terms : ndarray, shape (n_scales,)
            Numbers of `AllanSums`, changed in place.

        """
        # Column k of the sums includes k samples; the new ones begin at column `n_before`.
        n_before = self.sums.shape[1]
        self.sums = np.concatenate([self.sums, self.sums[:, -1:] + np.cumsum(rows, axis=1)], axis=1)
        self.counts = np.concatenate([self.counts, self.counts[-1] + np.cumsum(counts)])
        end = self.sums.shape[1]
        all_present = self.counts[-1] - self.counts[0] == len(self.counts) - 1
        for row, m in zip(self.index, self.factors):
            # The first new sample with 2 m samples up to it.
            first = max(n_before, 2 * m)
            if first >= end:
                continue
            if all_present:
                middle = self.sums[:, first - m : end - m]
                difference = self.sums[:, first:end] - 2.0 * middle
                difference += self.sums[:, first - 2 * m : end - 2 * m]
            else:
                difference = self._with_holes(first, m)
            squares[row] += np.einsum('ij,ij->i', difference, difference) / (m * size) ** 2
            terms[row] += difference.shape[1]
        self._shorten()

    def _with_holes(self, first: int, m: int) -> np.ndarray:
        """
        Return m times the differences of neighbouring means of the samples that are present.

        With the cumulative sums S and numbers N of the samples, at each sample k from `first` on::

            later mean   = (S(k) - S(k - m)) / (N(k) - N(k - m))
            earlier mean = (S(k - m) - S(k - 2 m)) / (N(k - m) - N(k - 2 m))

        """
        end = self.sums.shape[1]
        middle = slice(first - m, end - m)
        before = slice(first - 2 * m, end - 2 * m)
        n_later = self.counts[..., first:end] - self.counts[..., middle]
        n_earlier = self.counts[..., middle] - self.counts[..., before]
        sum_later = self.sums[..., first:end] - self.sums[..., middle]
        sum_earlier = self.sums[..., middle] - self.sums[..., before]
        usable = np.minimum(n_later, n_earlier) >= PRESENT * m
        later = sum_later[:, usable] / n_later[usable]
        earlier = sum_earlier[:, usable] / n_earlier[usable]
        return m * (later - earlier)

    def _shorten(self) -> None:
        """Keep the sums that later differences need, less the first of them against rounding."""
        if self.sums.shape[1] > self.reach + 1:
            kept = slice(-self.reach - 1, None)
            self.sums = self.sums[:, kept] - self.sums[:, kept][:, :1]
            self.counts = self.counts[kept] - self.counts[kept][0]


MAX_STEP_JITTER = 0.2
"""
Largest median deviation of steps from the period, in periods, at which a long step is a lost
sample.
"""
STAMP_WINDOW_SAMPLES = 64
"""Samples over which irregular stamps are averaged."""


class SampleGrid:
    """
    Counts the periods between samples of one stretch.

    Parameters
    ----------
    period : float
        Typical time between samples, s.

    """

    def __init__(self, period: float):
        self._period_ns = period * 1e9
        # Stamp of the last sample; None at the beginning of the stretch.
        self._last_ns: int | None = None

    def steps(self, stamp_ns: np.ndarray) -> np.ndarray:
        """
        Return the number of periods before each sample, at least 1, shape (n,).

        It is 1 for the first sample of a stretch.
        """
        before = stamp_ns[0] - round(self._period_ns) if self._last_ns is None else self._last_ns
        step = np.diff(stamp_ns, prepend=before) / self._period_ns
        self._last_ns = int(stamp_ns[-1])
        # Steps of a clock: long ones have lost samples. Otherwise losses delay all later stamps.
        if np.median(np.abs(step - 1.0)) <= MAX_STEP_JITTER:
            return np.maximum(np.rint(step), 1).astype(np.int64)
        return 1 + _n_lost(step)


def _n_lost(step: np.ndarray) -> np.ndarray:
    """
    Return the number of lost samples before each sample of irregular stamps, shape (n,).

    A loss delays all later stamps. The median delay of each window of samples shows it; it is
    assigned to the longest step of both windows.

    Parameters
    ----------
    step : ndarray, shape (n,)
        Steps between stamps, in periods.

    """
    lost = np.zeros(len(step), np.int64)
    size = STAMP_WINDOW_SAMPLES
    n_windows = len(step) // size
    if n_windows < 2:
        return lost
    delay = np.cumsum(step - 1.0)
    median_delay = np.median(delay[: n_windows * size].reshape(n_windows, size), axis=1)
    # Nearly a whole period later from one window to the next: less is jitter.
    for k in np.flatnonzero(np.diff(median_delay) > 0.75):
        first = k * size
        longest = first + int(np.argmax(step[first : first + 2 * size]))
        lost[longest] += round(median_delay[k + 1] - median_delay[k])
    return lost


def on_grid(values: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values, present) with a row for every period: missing samples are zero and not present.

    `steps` are the numbers of periods before each sample (`SampleGrid.steps`).
    """
    place = np.cumsum(steps) - 1
    if place[-1] == len(values) - 1:
        return values, np.ones(len(values), bool)
    grid = np.zeros((place[-1] + 1, values.shape[1]))
    present = np.zeros(place[-1] + 1, bool)
    grid[place] = values
    present[place] = True
    return grid, present


@dataclass(frozen=True, eq=False)
class AllanCurve:
    """Allan variances of six axes: force x, y, z, then rate x, y, z."""

    period: float
    """Time between samples, s."""
    factors: np.ndarray
    """Samples per mean, shape (n_scales,)."""
    variance: np.ndarray
    """Allan variances, shape (n_scales, 6)."""
    raw: np.ndarray
    """Allan variances without subtraction of trends, shape (n_scales, 6)."""
    lengths: tuple[int, ...]
    """Samples of each part."""
    parts: tuple[Parts, ...]
    """The variances of each part, one for each axis."""
    faults: ReadingFaults = NO_FAULTS
    """Faults by which the white noise of the readings exceeds that of the sensor."""

    @property
    def tau(self) -> np.ndarray:
        """Averaging times, s."""
        return self.factors * self.period

    @property
    def seconds(self) -> float:
        """Time at rest, s."""
        return sum(self.lengths) * self.period


@dataclass(frozen=True, eq=False)
class Detrending:
    """Trends that are subtracted from the samples."""

    trends: tuple[tuple[AxisTrend, ...], ...]
    """Trends of each of the six axes."""
    reference: TrendReference
    """Time and temperature at which they are zero or begin."""
    temperature: tuple[np.ndarray, np.ndarray] | None
    """Time (s since the beginning of the recording) and degrees Celsius; None without."""

    def at(self, time: np.ndarray) -> np.ndarray | None:
        """Return the trends of all axes at times, s, shape (n, 6); None without trends."""
        if not any(self.trends):
            return None
        temperature_c = None if self.temperature is None else np.interp(time, *self.temperature)
        total = np.zeros((len(time), len(self.trends)))
        for axis, trends in enumerate(self.trends):
            for trend in trends:
                total[:, axis] += trend.at(time, temperature_c, self.reference)
        return total


class Sink(Protocol):
    """Accumulates the samples of the parts at rest, on the grid of their period."""

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a part, shape (n, 6), and the mask of the present samples."""

    def end_stretch(self) -> None:
        """Close the part."""


@dataclass(frozen=True, eq=False)
class RestReader:
    """Reads the parts at rest of a recording."""

    source: BlockSource
    """The recording."""
    parts: list[list[StillPart]]
    """Parts of each epoch of the clock, in order."""
    period: float
    """Time between samples, s."""
    detrending: Detrending
    """Trends to subtract."""
    time_of: Callable[[int, np.ndarray], np.ndarray]
    """``time_of(epoch, stamp_ns)``: s since the beginning of the recording."""
    nominal: RawReadings | None = None
    """Nominal sensor, for recordings in volts or counts."""

    def read(self, *detrended: Sink, raw: Sequence[Sink] = ()) -> RestOutliers:
        """
        Push the samples of each part into sinks, and return the search that replaced outliers.

        The sinks `detrended` receive the samples without trends, `raw` the samples with trends.
        """
        outliers = RestOutliers()
        # All pieces of a part at rest follow each other.
        for (epoch, _), pieces in groupby(self._pieces(outliers), key=itemgetter(0)):
            grid = SampleGrid(self.period)
            for _, imu in pieces:
                values = np.concatenate([imu.force_s, imu.rate_s], axis=1)
                steps = grid.steps(imu.stamp_ns)
                trend = self.detrending.at(self.time_of(epoch, imu.stamp_ns))
                without_trend = on_grid(values if trend is None else values - trend, steps)
                for sink in detrended:
                    sink.push(*without_trend)
                for sink in raw:
                    sink.push(*on_grid(values, steps))
            for sink in (*detrended, *raw):
                sink.end_stretch()
        return outliers

    def _pieces(self, outliers: RestOutliers) -> Iterator[tuple[tuple[int, int], ImuSamples]]:
        """Yield ((epoch, number of a part), accepted samples of the part in the next block)."""
        bounds = []  # ns, shape (n_parts, 2) for each epoch
        for parts in self.parts:
            ends = [(part.first_ns, part.end_ns) for part in parts]
            bounds.append(np.array(ends, np.int64).reshape(-1, 2))
        cleaner = BlockCleaner(nominal=self.nominal, one_sensor=True)
        for cleaned in without_outliers(cleaner.all_of(self.source), outliers):
            for epoch, imu in cleaned.imu:
                rows_of_parts = np.searchsorted(imu.stamp_ns, bounds[epoch]).tolist()
                for number, (first, last) in enumerate(rows_of_parts):
                    if last > first:
                        yield (epoch, number), imu.select(slice(first, last))

    def curve(self) -> AllanCurve:
        """Return the Allan variances of the parts, at averaging times with at least one term."""
        longest = max(part.seconds for part in chain.from_iterable(self.parts))
        factors = averaging_factors(round(longest / self.period))
        detrended = AllanSums(factors, 6)
        faults = FaultSearch()
        raw = detrended
        raw_sinks: list[Sink] = [faults]
        if any(self.detrending.trends):
            raw = AllanSums(factors, 6)
            raw_sinks.append(raw)
        outliers = self.read(detrended, raw=raw_sinks)
        usable = detrended.terms > 0
        variance, terms = detrended.by_stretch()
        variance = variance[:, usable]
        terms = terms[:, usable]
        parts = tuple(Parts(variance[:, :, axis], terms) for axis in range(variance.shape[2]))
        return AllanCurve(
            period=self.period,
            factors=detrended.factors[usable],
            variance=detrended.variance()[usable],
            raw=raw.variance()[usable],
            lengths=tuple(detrended.lengths),
            parts=parts,
            faults=faults.result(outliers.share),
        )
