"""Allan deviation of samples, and the curve of a recording."""

from collections.abc import Callable, Sequence
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
from imu_calibration.core.samples import BlockSource
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner

FULL = 65536
"""Largest number of samples per mean for which every position counts."""
PRESENT = 0.9
"""Smallest share of the samples of a mean that must be there."""
PER_OCTAVE = 2


def averaging_factors(n_samples: int, per_octave: int = PER_OCTAVE) -> np.ndarray:
    """
    Return the numbers of samples per mean at which the variance is computed.

    They are integers in rising order for the variance of `n_samples`.

    Spaced evenly in the logarithm, up to half of the samples. Beyond `FULL` they are multiples of a
    power of two, as the halved rates need.
    """
    if n_samples < 2:
        return np.zeros(0, np.int64)
    steps = np.arange(int(per_octave * np.log2(n_samples / 2)) + 1)
    wanted = 2.0 ** (steps / per_octave)
    unit = 2 ** _octaves_beyond(wanted)
    return np.unique(np.rint(wanted / unit).astype(np.int64) * unit)


def _octaves_beyond(factor):
    """Return the number of halvings of the rate that reduce a factor below `FULL`, integers."""
    return np.maximum(np.ceil(np.log2(np.maximum(factor, 1) / FULL) - 1e-9), 0).astype(np.int64)


class AllanSums:
    """
    Sums of squared second differences, added block by block over stretches without a break.

    Parameters
    ----------
    factors : ndarray of int, shape (n_scales,)
        From `averaging_factors`.
    n_columns : int
        Number of sensor axes.

    """

    def __init__(self, factors: np.ndarray, n_columns: int):
        self.factors = np.asarray(factors, np.int64)
        self.squares = np.zeros((len(factors), n_columns))
        self.terms = np.zeros(len(factors), np.int64)
        self.lengths: list[int] = []
        self._until: list[tuple[np.ndarray, np.ndarray]] = [
            (self.squares.copy(), self.terms.copy())
        ]
        levels = _octaves_beyond(self.factors)
        self._levels = [
            _Level(np.flatnonzero(levels == k), self.factors[levels == k] >> k, n_columns)
            for k in range(int(levels.max(initial=0)) + 1)
        ]
        self._offset, self._length = None, 0

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
            if not present.any():
                return
            self._offset = values[present][:1000].mean(axis=0)
        self._length += len(values)
        rows = np.ascontiguousarray((values - self._offset).T)
        rows[:, ~present] = 0.0
        counts = present.astype(float)
        for k, level in enumerate(self._levels):
            if k:
                rows, counts = level.halved(rows, counts)
            if not rows.shape[1]:
                return
            level.push(rows, counts, 2.0**k, self.squares, self.terms)

    def end_stretch(self) -> None:
        """Close the stretch; the next one is independent of it."""
        if self._length:
            self.lengths.append(self._length)
            self._until.append((self.squares.copy(), self.terms.copy()))
        self._offset, self._length = None, 0
        for level in self._levels:
            level.forget()

    def by_stretch(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the variances of each stretch and their numbers of terms.

        The shapes are (n_stretches, n_scales, n_columns) for the variances and (n_stretches,
        n_scales) for the numbers of terms.
        """
        squares, terms = (np.diff(np.array(values), axis=0) for values in zip(*self._until))
        return squares / (2.0 * np.maximum(terms, 1)[:, :, None]), terms.astype(float)

    def variance(self) -> np.ndarray:
        """Return the Allan variances, shape (n_scales, n_columns); NaN without a term."""
        with np.errstate(invalid='ignore', divide='ignore'):
            return self.squares / (2.0 * self.terms[:, None])


class _Level:
    """
    Second differences at one rate: `factors` in samples of that rate, results to the rows `index`.
    """

    def __init__(self, index, factors, n_columns):
        self.index, self.factors = index, factors
        self.reach = 2 * int(factors.max(initial=1))
        self.n_columns = n_columns
        self.forget()

    def forget(self):
        """Begin anew."""
        self.sums, self.counts = np.zeros((self.n_columns, 1)), np.zeros(1)
        self.odd = np.zeros((self.n_columns, 0)), np.zeros(0)

    def halved(self, rows, counts):
        """
        Return sums of pairs of samples and the share of each that is present.

        A sample without a mate waits.
        """
        rows, counts = (np.concatenate(pair, axis=-1) for pair in zip(self.odd, (rows, counts)))
        n = len(counts) // 2 * 2
        self.odd = rows[:, n:], counts[n:]
        return rows[:, 0:n:2] + rows[:, 1:n:2], 0.5 * (counts[0:n:2] + counts[1:n:2])

    def push(self, rows, counts, size, squares, terms):
        """
        Add the second differences that end in the new samples.

        Each new sample is the sum of `size` original ones.
        """
        old = self.sums.shape[1]
        self.sums = np.concatenate([self.sums, self.sums[:, -1:] + np.cumsum(rows, axis=1)], axis=1)
        self.counts = np.concatenate([self.counts, self.counts[-1] + np.cumsum(counts)])
        whole = self.counts[-1] - self.counts[0] == len(self.counts) - 1
        for where, m in zip(self.index, self.factors):
            first = max(old, 2 * m)
            if first >= self.sums.shape[1]:
                continue
            if whole:
                last, middle, begin = (
                    self.sums[:, first - k : self.sums.shape[1] - k] for k in (0, m, 2 * m)
                )
                difference = last - 2.0 * middle
                difference += begin
            else:
                difference = self._with_holes(first, m)
            squares[where] += np.einsum('ij,ij->i', difference, difference) / (m * size) ** 2
            terms[where] += difference.shape[1]
        self._shorten()

    def _with_holes(self, first, m):
        """
        Return m times the differences of neighbouring means of the samples that are there.

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

    def _shorten(self):
        """Keep the sums that later differences need, from the first sample kept."""
        if self.sums.shape[1] > self.reach + 1:
            kept = slice(-self.reach - 1, None)
            self.sums, self.counts = (
                self.sums[:, kept] - self.sums[:, kept][:, :1],
                self.counts[kept] - self.counts[kept][0],
            )


MAX_STEP_JITTER = 0.2
"""
Largest typical departure of steps from the period, in periods, up to which a single step is
believed.
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
        self._last_ns: int | None = None

    def steps(self, stamp_ns: np.ndarray) -> np.ndarray:
        """
        Return for each sample the number of periods since the one before, at least 1, shape (n,).

        The first of a stretch counts 1.
        """
        before = stamp_ns[0] - round(self._period_ns) if self._last_ns is None else self._last_ns
        step = np.diff(stamp_ns, prepend=before) / self._period_ns
        self._last_ns = int(stamp_ns[-1])
        if np.median(np.abs(step - 1.0)) <= MAX_STEP_JITTER:
            return np.maximum(np.rint(step), 1).astype(np.int64)
        return 1 + _lost(step)


def _lost(step):
    """Return how many samples were lost before each, from persistent delays."""
    lost = np.zeros(len(step), np.int64)
    windows = len(step) // STAMP_WINDOW_SAMPLES
    if windows < 2:
        return lost
    late = np.cumsum(step - 1.0)
    middle = np.median(
        late[: windows * STAMP_WINDOW_SAMPLES].reshape(windows, STAMP_WINDOW_SAMPLES), axis=1
    )
    for k in np.flatnonzero(np.diff(middle) > 0.75):
        longest = (k * STAMP_WINDOW_SAMPLES) + int(
            np.argmax(step[k * STAMP_WINDOW_SAMPLES : (k + 2) * STAMP_WINDOW_SAMPLES])
        )
        lost[longest] += round(middle[k + 1] - middle[k])
    return lost


def spread(values: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values, present) with a row for every period: missing samples are zero and not present.
    """
    place = np.cumsum(steps) - 1
    if place[-1] == len(values) - 1:
        return values, np.ones(len(values), bool)
    grid = np.zeros((place[-1] + 1, values.shape[1]))
    present = np.zeros(place[-1] + 1, bool)
    grid[place], present[place] = values, True
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
    """The same with the trends left in, shape (n_scales, 6)."""
    lengths: tuple[int, ...]
    """Samples of each part."""
    parts: tuple[Parts, ...]
    """The variances of each part, one for each axis."""
    faults: ReadingFaults = NO_FAULTS
    """What makes the white noise of the readings appear larger than that of the sensor."""

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
    """Subtracted from the samples."""

    trends: tuple[tuple[AxisTrend, ...], ...]
    """Trends of each of the six axes."""
    reference: TrendReference
    """Where they begin."""
    temperature: tuple[np.ndarray, np.ndarray] | None
    """Time (s since the beginning of the recording) and degrees Celsius."""

    def at(self, time: np.ndarray) -> np.ndarray | None:
        """Return the trends of all axes at instants, shape (n, 6); None without any."""
        if not any(self.trends):
            return None
        warmth = None if self.temperature is None else np.interp(time, *self.temperature)
        total = np.zeros((len(time), len(self.trends)))
        for axis, trends in enumerate(self.trends):
            for trend in trends:
                total[:, axis] += trend.at(time, warmth, self.reference)
        return total


class Sink(Protocol):
    """Accumulates the samples of the parts at rest, on the grid of their period."""

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a part, shape (n, 6), and the mask of those present."""

    def end_stretch(self) -> None:
        """Close the part."""


@dataclass(frozen=True, eq=False)
class RestReader:
    """Reads the parts at rest of a recording."""

    source: BlockSource
    """The recording."""
    parts: list[list[StillPart]]
    """For each epoch of the clock, in order."""
    period: float
    """Time between samples, s."""
    detrending: Detrending
    """Subtracted from the samples."""
    time_of: Callable[[int, np.ndarray], np.ndarray]
    """``time_of(epoch, stamp_ns)``: s since the beginning of the recording."""
    nominal: RawReadings | None = None
    """For recordings in volts or counts."""

    def read(self, *bare: Sink, raw: Sequence[Sink] = ()) -> RestOutliers:
        """
        Push the samples of each part into the sinks `bare` and `raw`.

        The samples in `bare` are without trends and the samples in `raw` are unchanged. Returns the
        search for outliers, which were replaced.
        """
        outliers = RestOutliers()
        for (epoch, _), pieces in groupby(self._pieces(outliers), key=itemgetter(0, 1)):
            grid = SampleGrid(self.period)
            for *_, imu in pieces:
                values = np.concatenate([imu.force_s, imu.rate_s], axis=1)
                steps = grid.steps(imu.stamp_ns)
                trend = self.detrending.at(self.time_of(epoch, imu.stamp_ns))
                flat = spread(values if trend is None else values - trend, steps)
                for sink in bare:
                    sink.push(*flat)
                for sink in raw:
                    sink.push(*spread(values, steps))
            for sink in (*bare, *raw):
                sink.end_stretch()
        return outliers

    def _pieces(self, outliers):
        """Yield (epoch, number of the part, accepted samples)."""
        bounds = []  # ns, shape (n_parts, 2) for each epoch
        for parts in self.parts:
            ends = [(part.first_ns, part.end_ns) for part in parts]
            bounds.append(np.array(ends, np.int64).reshape(-1, 2))
        cleaner = BlockCleaner(nominal=self.nominal, one_sensor=True)
        for cleaned in without_outliers(cleaner.all_of(self.source), outliers):
            for epoch, imu in cleaned.imu:
                for number, (first, last) in enumerate(
                    np.searchsorted(imu.stamp_ns, bounds[epoch]).tolist()
                ):
                    if last > first:
                        yield epoch, number, imu.select(slice(first, last))

    def curve(self) -> AllanCurve:
        """Return the Allan variances of the parts."""
        longest = max(part.seconds for part in chain.from_iterable(self.parts))
        factors = averaging_factors(round(longest / self.period))
        bare = AllanSums(factors, 6)
        faults = FaultSearch()
        raw = AllanSums(factors, 6) if any(self.detrending.trends) else None
        outliers = self.read(bare, raw=(faults,) if raw is None else (raw, faults))
        usable = bare.terms > 0
        variance, terms = (values[:, usable] for values in bare.by_stretch())
        parts = tuple(Parts(variance[:, :, axis], terms) for axis in range(variance.shape[2]))
        return AllanCurve(
            self.period,
            bare.factors[usable],
            bare.variance()[usable],
            (raw or bare).variance()[usable],
            tuple(bare.lengths),
            parts,
            faults.result(outliers.share),
        )
