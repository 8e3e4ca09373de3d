"""The second reading: the Allan variances of what is at rest, trends taken out, at constant memory."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from imu_calibration.allan.between_parts import Parts
from imu_calibration.allan.deviation import AllanSums, averaging_factors
from imu_calibration.allan.sample_grid import SampleGrid, spread
from imu_calibration.allan.still_parts import StillPart
from imu_calibration.allan.trends import AxisTrend, TrendReference
from imu_calibration.samples import NominalScaling, SampleBlock
from imu_calibration.segmentation.block_cleaning import BlockCleaner


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
    """What is subtracted from the samples."""

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


def read_curve(blocks: Iterable[SampleBlock], parts: list[list[StillPart]], period: float, *, detrending: Detrending,
               time_of: Callable[[int, np.ndarray], np.ndarray], nominal: NominalScaling | None = None) -> AllanCurve:
    """
    Read the parts at rest and return their Allan variances.

    Parameters
    ----------
    blocks : iterable of SampleBlock
    parts : list of list of StillPart
        For each epoch of the clock, in order.
    period : float
        Time between samples, s.
    detrending : Detrending
    time_of : callable
        ``time_of(epoch, stamp_ns)``: s since the beginning of the recording.
    nominal : NominalScaling, optional
        For recordings in volts or counts.

    """
    longest = max(round(part.seconds / period) for of_epoch in parts for part in of_epoch)
    reader = _PartReader(averaging_factors(longest), period, detrending)
    for cleaned in BlockCleaner(nominal=nominal).all_of(blocks):
        for epoch, imu in cleaned.imu:
            reader.push(epoch, imu, parts[epoch], time_of)
    return reader.curve()


class _PartReader:
    """Hands the samples of each part to the sums, as they are and without trends."""

    def __init__(self, factors, period, detrending):
        self._period, self._detrending = period, detrending
        self._bare = AllanSums(factors, 6)
        self._raw = AllanSums(factors, 6) if any(detrending.trends) else self._bare
        self._grid, self._open = SampleGrid(period), None

    def push(self, epoch, imu, parts, time_of):
        """Take accepted samples of an epoch."""
        if not len(imu):
            return
        begin, end = int(imu.stamp_ns[0]), int(imu.stamp_ns[-1])
        for k, part in enumerate(parts):
            if part.end_ns <= begin or part.first_ns > end:
                continue
            if self._open != (epoch, k):
                self._close()
                self._open = (epoch, k)
            first, last = np.searchsorted(imu.stamp_ns, (part.first_ns, part.end_ns))
            if last > first:
                self._take(imu.select(slice(first, last)), lambda stamps: time_of(epoch, stamps))

    def _take(self, imu, time_of):
        values = np.concatenate([imu.force_s, imu.rate_s], axis=1)
        steps = self._grid.steps(imu.stamp_ns)
        trend = self._detrending.at(time_of(imu.stamp_ns))
        grid, present = spread(values if trend is None else values - trend, steps)
        self._bare.push(grid, present)
        if trend is not None:
            self._raw.push(*spread(values, steps))

    def _close(self):
        self._grid.begin()
        self._bare.end_stretch()
        if self._raw is not self._bare:
            self._raw.end_stretch()

    def curve(self):
        """Close the last part and return the curve."""
        self._close()
        usable = self._bare.terms > 0
        bare, raw = self._bare.variance()[usable], self._raw.variance()[usable]
        variance, terms = (values[:, usable] for values in self._bare.by_stretch())
        parts = tuple(Parts(variance[:, :, axis], terms) for axis in range(variance.shape[2]))
        return AllanCurve(self._period, self._bare.factors[usable], bare, raw, tuple(self._bare.lengths), parts)
