"""The second pass: the Allan variances of the parts at rest, without trends, on the grid of the sampling period, at constant memory."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from imu_calibration.allan.deviation import AllanSums, averaging_factors
from imu_calibration.allan.still_parts import StillPart
from imu_calibration.allan.trends import AxisTrend, Parts, TrendReference
from imu_calibration.core.samples import NominalScaling, SampleBlock
from imu_calibration.preprocessing.block_cleaning import BlockCleaner

REGULAR = 0.2
"""Largest typical departure of steps from the period, in periods, up to which a single step is believed."""
WINDOW = 64
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

    def begin(self) -> None:
        """Begin a new stretch."""
        self._last_ns = None

    def steps(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return for each sample the number of periods since the one before, at least 1, shape (n,); the first of a stretch counts 1."""
        before = stamp_ns[0] - round(self._period_ns) if self._last_ns is None else self._last_ns
        step = np.diff(stamp_ns, prepend=before) / self._period_ns
        self._last_ns = int(stamp_ns[-1])
        if np.median(np.abs(step - 1.0)) <= REGULAR:
            return np.maximum(np.rint(step), 1).astype(np.int64)
        return 1 + _lost(step)


def _lost(step):
    """Return how many samples were lost before each, from persistent delays."""
    lost = np.zeros(len(step), np.int64)
    windows = len(step) // WINDOW
    if windows < 2:
        return lost
    late = np.cumsum(step - 1.0)
    middle = np.median(late[:windows * WINDOW].reshape(windows, WINDOW), axis=1)
    for k in np.flatnonzero(np.diff(middle) > 0.75):
        longest = (k * WINDOW) + int(np.argmax(step[k * WINDOW:(k + 2) * WINDOW]))
        lost[longest] += round(middle[k + 1] - middle[k])
    return lost


def spread(values: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (values, present) with a row for every period: missing samples are zero and not present."""
    place = np.cumsum(steps) - 1
    if place[-1] == len(values) - 1:
        return values, np.ones(len(values), bool)
    grid, present = np.zeros((place[-1] + 1, values.shape[1])), np.zeros(place[-1] + 1, bool)
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
        columns = [sum((trend.at(time, warmth, self.reference) for trend in trends), np.zeros(len(time))) for trends in self.trends]
        return np.column_stack(columns)


class Sink(Protocol):
    """Accumulates the samples of the parts at rest, on the grid of their period."""

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a part, shape (n, 6), and the mask of those present."""

    def end_stretch(self) -> None:
        """Close the part."""


@dataclass(frozen=True, eq=False)
class RestReader:
    """Reads the parts at rest of a recording."""

    source: Callable[[], Iterable[SampleBlock]]
    """Returns the blocks of the recording, from the beginning at each call."""
    parts: list[list[StillPart]]
    """For each epoch of the clock, in order."""
    period: float
    """Time between samples, s."""
    detrending: Detrending
    """Subtracted from the samples."""
    time_of: Callable[[int, np.ndarray], np.ndarray]
    """``time_of(epoch, stamp_ns)``: s since the beginning of the recording."""
    nominal: NominalScaling | None = None
    """For recordings in volts or counts."""

    def read(self, *bare: Sink, raw: Sink | None = None) -> None:
        """Push the samples of each part without trends into the sinks `bare`, and unchanged into `raw`."""
        reader = _PartReader(bare, raw, self.period, self.detrending)
        for cleaned in BlockCleaner(nominal=self.nominal).all_of(self.source()):
            for epoch, imu in cleaned.imu:
                reader.push(epoch, imu, self.parts[epoch], self.time_of)
        reader.close()

    def curve(self) -> AllanCurve:
        """Return the Allan variances of the parts."""
        factors = averaging_factors(max(round(part.seconds / self.period) for of_epoch in self.parts for part in of_epoch))
        bare, raw = AllanSums(factors, 6), AllanSums(factors, 6) if any(self.detrending.trends) else None
        self.read(bare, raw=raw)
        usable = bare.terms > 0
        variance, terms = (values[:, usable] for values in bare.by_stretch())
        parts = tuple(Parts(variance[:, :, axis], terms) for axis in range(variance.shape[2]))
        return AllanCurve(self.period, bare.factors[usable], bare.variance()[usable], (raw or bare).variance()[usable],
                          tuple(bare.lengths), parts)


class _PartReader:
    """Splits accepted samples into parts and pushes them into the sinks."""

    def __init__(self, bare, raw, period, detrending):
        self._bare, self._raw, self._detrending = bare, raw, detrending
        self._grid, self._open = SampleGrid(period), None

    def push(self, epoch, imu, parts, time_of):
        """Add accepted samples of an epoch."""
        if not len(imu):
            return
        begin, end = int(imu.stamp_ns[0]), int(imu.stamp_ns[-1])
        for k, part in enumerate(parts):
            if part.end_ns <= begin or part.first_ns > end:
                continue
            if self._open != (epoch, k):
                self.close()
                self._open = (epoch, k)
            first, last = np.searchsorted(imu.stamp_ns, (part.first_ns, part.end_ns))
            if last > first:
                self._take(imu.select(slice(first, last)), lambda stamps: time_of(epoch, stamps))

    def _take(self, imu, time_of):
        values = np.concatenate([imu.force_s, imu.rate_s], axis=1)
        steps = self._grid.steps(imu.stamp_ns)
        trend = self._detrending.at(time_of(imu.stamp_ns))
        grid, present = spread(values if trend is None else values - trend, steps)
        for sink in self._bare:
            sink.push(grid, present)
        if self._raw is not None:
            self._raw.push(*spread(values, steps))

    def close(self):
        """Close the open part."""
        self._grid.begin()
        for sink in filter(None, (*self._bare, self._raw)):
            sink.end_stretch()
