"""Outliers at rest: single readings that are not noise of the sensor."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from imu_calibration.core.samples import ImuSamples
from imu_calibration.preprocessing.stream_cleaning import CleanedBlock, EpochFilters

PIECE = 1024
"""Samples that are decided together, with one estimate of their scatter."""
MEDIAN_SAMPLES = 7
"""Samples of the running median: three outliers among them do not shift it to one of them."""
LEVEL_SAMPLES = 129
"""Samples around an outlier whose median is the level of the reading in its place."""
CONTEXT_SAMPLES = 8
"""Samples on either side of a piece that its running median and its counts use."""
FAR = 5.5
"""Standard deviations beyond which a reading is an outlier: white noise exceeds it in 4e-8."""
MOST_AROUND = 6
"""
Largest number of outliers of an axis among the 2 CONTEXT_SAMPLES + 1 readings around one; with more
the IMU moved.
"""
TAIL_QUANTILE, TAIL_SD = 0.9, 1.645
"""Quantile of absolute values, and its value for a standard normal distribution."""
NORMAL_QUARTILE = 0.6745
"""Upper quartile of a standard normal distribution."""


class RestOutliers:
    """
    Replaces the single readings that deviate from their neighbours at rest.

    The filter of a moving stream (`SpikeFilter`) must tolerate fast motion, and passes outliers
    that are close to each other. At rest the running median of seven readings predicts each of
    them, and the scatter about it is known. A torn register read (high byte of one reading, low
    byte of the next) deviates by 256 steps, and dozens of them can be in a minute. Where many
    readings deviate together, the IMU moved: they are kept, and the search for rest decides.

    The other five readings of the sample are kept, because holes would bias the means. In place of
    an outlier is the reading before, reflected about the level of a second or so by chance::

        x[k] = level +- (x[j] - level),  E[(x[k] - level) (x[j] - level)] = 0

    so that means have the variance of independent readings: a copy would count twice, and the
    median of few neighbours would give them more weight.
    """

    def __init__(self) -> None:
        self.replaced = 0
        """Samples with a replaced reading."""
        # Samples with a decision, and replaced readings of each axis.
        self._n_samples = 0
        self._n_readings = np.zeros(6)
        # Random signs of the reflection.
        self._signs = np.random.default_rng(0)
        # `_n_before` samples with a decision, as context, then undecided ones.
        self._buffered: ImuSamples | None = None
        self._n_before = 0

    @property
    def share(self) -> np.ndarray:
        """Share of the readings of each axis that are replaced, shape (6,)."""
        return self._n_readings / max(self._n_samples, 1)

    def push(self, samples: ImuSamples) -> list[ImuSamples]:
        """Return the samples with a decision; at most `PIECE` + `CONTEXT_SAMPLES` are buffered."""
        self._buffered = samples.after(self._buffered)
        passed = []
        while len(self._buffered) >= self._n_before + PIECE + CONTEXT_SAMPLES:
            passed.append(self._decide(self._n_before + PIECE))
        return passed

    def finish(self) -> list[ImuSamples]:
        """Return the buffered samples, and begin a new stream."""
        passed = []
        if self._buffered is not None and len(self._buffered) > self._n_before:
            passed.append(self._decide(len(self._buffered)))
        self._buffered = None
        self._n_before = 0
        return passed

    def _decide(self, stop: int) -> ImuSamples:
        """Return the samples up to row `stop` without outliers; their last rows become context."""
        assert self._buffered is not None
        # The search uses the context on both sides; only the rows from `_n_before` on are decided.
        context = self._buffered.select(slice(0, min(stop + CONTEXT_SAMPLES, len(self._buffered))))
        values = np.hstack([context.force_s, context.rate_s])
        decided = slice(self._n_before, stop)
        outlying = outliers(values)
        samples = self._buffered.select(decided)

        # Count and replace.
        self._n_samples += len(samples)
        self._n_readings += np.count_nonzero(outlying[decided], axis=0)
        n_samples = int(np.count_nonzero(outlying[decided].any(axis=1)))
        if n_samples:
            self.replaced += n_samples
            values = self._without(values, outlying)[decided]
            samples = replace(samples, force_s=values[:, :3], rate_s=values[:, 3:])

        # The last decided rows remain, as context of the next piece.
        first = max(stop - CONTEXT_SAMPLES, 0)
        self._n_before = stop - first
        self._buffered = self._buffered.select(slice(first, None))
        return samples

    def _without(self, values: np.ndarray, outlying: np.ndarray) -> np.ndarray:
        """
        Return the values with another reading in place of each outlier, shape (n, 6).

        `outlying` is the mask of the outliers.
        """
        row, column = np.nonzero(outlying)

        # Row of the last reading before each outlier that is none.
        rows = np.arange(len(values))[:, None]
        last_good = np.maximum.accumulate(np.where(outlying, 0, rows), axis=0)
        donor = last_good[row, column]

        # Median of the readings around each outlier.
        n_around = min(LEVEL_SAMPLES, len(values))
        first = np.clip(row - n_around // 2, 0, len(values) - n_around)
        around = values[first[:, None] + np.arange(n_around), column[:, None]]
        level = np.median(around, axis=1)

        sign = self._signs.choice([-1.0, 1.0], len(row))
        replaced = values.copy()
        replaced[row, column] = level + sign * (values[donor, column] - level)
        return replaced


def without_outliers(
    blocks: Iterable[CleanedBlock], search: RestOutliers
) -> Iterator[CleanedBlock]:
    """Yield cleaned blocks with replaced outliers; each epoch of the clock is a stream."""
    filters = EpochFilters(search)
    for cleaned in blocks:
        imu = []
        for epoch, samples in cleaned.imu:
            imu += filters.push(epoch, samples)
        yield replace(cleaned, imu=_not_empty(imu))
    yield CleanedBlock(imu=_not_empty(filters.finish()))


def _not_empty(parts: list[tuple[int, ImuSamples]]) -> list[tuple[int, ImuSamples]]:
    """Return the (epoch, samples) that have samples."""
    return [(epoch, samples) for epoch, samples in parts if len(samples)]


def outliers(values: np.ndarray) -> np.ndarray:
    """
    Return which readings are single outliers, shape (n, n_columns).

    ``|x - median7| > FAR sd``; sd from the median and the 90 % quantile of the same deviations.

    Parameters
    ----------
    values : ndarray, shape (n, n_columns)

    """
    from scipy.ndimage import median_filter, uniform_filter1d  # here, because its import is slow

    if len(values) < 4 * CONTEXT_SAMPLES:
        return np.zeros(values.shape, bool)
    deviation = np.abs(values - median_filter(values, (MEDIAN_SAMPLES, 1), mode='nearest'))
    # The quantile is for readings that repeat, of which many deviate by zero.
    middle = np.median(deviation, axis=0) / NORMAL_QUARTILE
    tail = np.quantile(deviation, TAIL_QUANTILE, axis=0) / TAIL_SD
    scatter = np.maximum(middle, tail)
    # Most readings are equal: the scatter of the remaining ones, such as by one step.
    for column in np.flatnonzero(middle == 0):
        changes = np.abs(np.diff(values[:, column]))
        changes = changes[changes > 0]
        typical_change = np.median(changes) if len(changes) else np.inf
        scatter[column] = max(scatter[column], typical_change)
    far = deviation > FAR * scatter

    # Number of far readings around each, which is a whole number up to rounding.
    width = 2 * CONTEXT_SAMPLES + 1
    n_around = width * uniform_filter1d(far.astype(float), width, axis=0, mode='constant')
    return far & (n_around < MOST_AROUND + 0.5)
