"""Readings that are not noise of the sensor: outliers at rest, heavy tails, repeated readings."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from imu_calibration.core.samples import ImuSamples
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS
from imu_calibration.preprocessing.stream_cleaning import CleanedBlock, EpochFilters

PIECE = 1024
"""Samples that are decided together, with one estimate of their scatter."""
MEDIAN_SAMPLES = 7
"""Samples of the running median: three outliers among them do not shift it to one of them."""
CONTEXT = 8
"""Samples on either side of a piece that its running median and its counts use."""
FAR = 5.5
"""Standard deviations beyond which a reading is an outlier: white noise exceeds it in 4e-8."""
MOST_AROUND = 6
"""Outliers of an axis among the 2 CONTEXT + 1 readings around one, at most; more are motion."""
TAIL_QUANTILE, TAIL_SD = 0.9, 1.645
"""Quantile of absolute values, and its value for a standard normal distribution."""
NORMAL_QUARTILE = 0.6745
"""Upper quartile of a standard normal distribution."""


class RestOutliers:
    """
    Removes the single readings that deviate from their neighbours at rest.

    The filter of a moving stream (`SpikeFilter`) must tolerate fast motion, and passes outliers
    that are close to each other. At rest the running median of seven readings predicts each of
    them, and the scatter about it is known. A torn register read (high byte of one reading, low
    byte of the next) deviates by 256 steps, and dozens of them can be in a minute. Where many
    readings deviate together, the IMU moved: they are kept, and the search for rest decides.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._held: ImuSamples | None = None
        self._n_before = 0

    def push(self, samples: ImuSamples) -> list[ImuSamples]:
        """Return the samples with a decision; at most `PIECE` + `CONTEXT` are buffered."""
        held = samples if self._held is None else type(samples).concatenate([self._held, samples])
        self._held = held
        passed = []
        while len(self._held) >= self._n_before + PIECE + CONTEXT:
            passed.append(self._decide(self._n_before + PIECE))
        return passed

    def finish(self) -> list[ImuSamples]:
        """Return the buffered samples, and begin a new stream."""
        passed = []
        if self._held is not None and len(self._held) > self._n_before:
            passed.append(self._decide(len(self._held)))
        self._held, self._n_before = None, 0
        return passed

    def _decide(self, stop):
        """Return the samples up to row `stop` without outliers; their last rows become context."""
        assert self._held is not None
        context = self._held.select(slice(0, min(stop + CONTEXT, len(self._held))))
        values = np.hstack([context.force_s, context.rate_s])
        decided = slice(self._n_before, stop)
        outlying = outliers(values)[decided]
        kept = self._held.select(decided)
        self.dropped += int(np.count_nonzero(outlying))
        if outlying.any():
            kept = kept.select(~outlying)
        first = max(stop - CONTEXT, 0)
        self._n_before = stop - first
        self._held = self._held.select(slice(first, None))
        return kept


def without_outliers(
    blocks: Iterable[CleanedBlock], search: RestOutliers
) -> Iterator[CleanedBlock]:
    """Yield cleaned blocks without the outliers of the IMU; each epoch of the clock is a stream."""
    filters = EpochFilters(search)
    for cleaned in blocks:
        imu = []
        for epoch, samples in cleaned.imu:
            imu += filters.push(epoch, samples)
        yield replace(cleaned, imu=_not_empty(imu))
    yield CleanedBlock(imu=_not_empty(filters.finish()))


def _not_empty(parts):
    return [(epoch, samples) for epoch, samples in parts if len(samples)]


def outliers(values: np.ndarray) -> np.ndarray:
    """
    Return which rows hold a single outlier, shape (n,).

    ``|x - median7| > FAR sd``; sd from the median and the 90 % quantile of the same deviations.

    Parameters
    ----------
    values : ndarray, shape (n, n_columns)

    """
    if len(values) < 4 * CONTEXT:
        return np.zeros(len(values), bool)
    deviation = np.abs(values - median_filter(values, (MEDIAN_SAMPLES, 1), mode='nearest'))
    # The quantile is for readings that repeat, of which many deviate by zero.
    middle = np.median(deviation, axis=0) / NORMAL_QUARTILE
    tail = np.quantile(deviation, TAIL_QUANTILE, axis=0) / TAIL_SD
    # A column whose readings hardly ever change has no known scatter.
    scatter = np.where(middle > 0, np.maximum(middle, tail), np.inf)
    far = deviation > FAR * scatter
    around = uniform_filter1d(far.astype(float), 2 * CONTEXT + 1, axis=0, mode='constant')
    single = far & (around * (2 * CONTEXT + 1) < MOST_AROUND + 0.5)
    return single.any(axis=1)


LEAST_STEPS = 4.0
"""Steps of the converter within the scatter, at least: below, its quantiles are those of steps."""
LEAST_EXCESS, EXCESS_SDS = 0.03, 5.0
"""Least excess of the standard deviation over that of the quartiles, as a share and in its sds."""
RATIO_SD = 1.2
"""sd of the ratio of both for Gaussian noise, times the root of the number of differences."""
REPEATED = 0.05
"""Share of repeated readings above which they are named."""
TOGETHER = 0.9
"""Where an axis repeats its reading, the other axes do in at least this share: no chance."""
MOST_DIFFERENCES = 200_000
"""Differences that are kept for the quartiles."""


@dataclass(frozen=True, eq=False)
class ReadingFaults:
    """What makes the white noise of readings appear larger than that of the sensor."""

    tails: np.ndarray
    """Standard deviation over that of the quartiles, at least 1, shape (6,); 1: Gaussian."""
    repeated: np.ndarray
    """Share of readings that repeat the reading before, accelerometer and gyroscope, shape (2,)."""
    repetition: np.ndarray
    """
    Root of the mean square over the mean of the numbers of repetitions, shape (2,): readings that
    count unequally raise the noise of means by it.
    """

    def factor(self, column: int) -> float:
        """Return by how much the white noise of a column may be too high, at least 1."""
        return float(self.tails[column] * self.repetition[column // 3])


NO_FAULTS = ReadingFaults(np.ones(6), np.zeros(2), np.ones(2))


class FaultSearch:
    """Accumulates differences and repetitions of the readings at rest (a `Sink`, raw values)."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._differences: list[np.ndarray] = []
        self._n_kept = 0
        self._n_pairs = 0
        self._same = np.zeros(6)
        self._same_all = np.zeros(2)
        self._run = np.ones(2)
        self._runs = np.zeros((3, 2))  # number, sum and sum of squares of the run lengths

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a rest, shape (n, 6)."""
        rows = values[present]
        if self._last is not None:
            rows = np.vstack([self._last, rows])
        if len(rows) < 2:
            self._last = rows[-1:] if len(rows) else self._last
            return
        self._last = rows[-1:].copy()
        difference = np.diff(rows, axis=0)
        same = difference == 0
        self._n_pairs += len(same)
        self._same += same.sum(axis=0)
        if self._n_kept < MOST_DIFFERENCES:
            self._differences.append(difference)
            self._n_kept += len(difference)
        for k, sensor in enumerate(SENSORS):
            held = same[:, SENSOR_COLUMNS[sensor]].all(axis=1)
            self._same_all[k] += held.sum()
            self._add_runs(k, np.flatnonzero(~held), len(held))

    def _add_runs(self, k, changes, n_pairs):
        """Add the lengths of the runs that end at `changes`; the last one is continued."""
        if not len(changes):
            self._run[k] += n_pairs
            return
        lengths = np.diff(changes, prepend=-1).astype(float)
        lengths[0] += self._run[k] - 1.0
        self._runs[:, k] += len(lengths), lengths.sum(), (lengths**2).sum()
        self._run[k] = n_pairs - changes[-1]

    def end_stretch(self) -> None:
        """Begin another rest: its first reading has no reading before."""
        self._last, self._run = None, np.ones(2)

    def result(self) -> ReadingFaults:
        """Return the faults of all rests."""
        if not self._n_pairs:
            return NO_FAULTS
        share = self._same_all / self._n_pairs
        of_axes = self._same.reshape(2, 3).max(axis=1) / self._n_pairs
        repeats = (share > REPEATED) & (share > TOGETHER * of_axes)
        number, total, squares = np.maximum(self._runs, 1.0)
        repetition = np.sqrt(squares / number) / (total / number)
        return ReadingFaults(
            self._tails(),
            np.where(repeats, share, 0.0),
            np.where(repeats, np.maximum(repetition, 1.0), 1.0),
        )

    def _tails(self):
        """Return the ratio of the standard deviation to that of the quartiles, shape (6,)."""
        tails = np.ones(6)
        for column, difference in enumerate(np.concatenate(self._differences).T):
            # Repeated readings are not differences of the noise.
            difference = difference[difference != 0]
            if len(difference) < PIECE:
                continue
            low, high = np.quantile(difference, (0.25, 0.75))
            usual = (high - low) / (2 * NORMAL_QUARTILE)
            if usual < LEAST_STEPS * np.abs(difference).min():
                continue
            ratio = float(np.sqrt(np.mean(difference**2))) / usual
            if ratio > 1.0 + max(LEAST_EXCESS, EXCESS_SDS * RATIO_SD / len(difference) ** 0.5):
                tails[column] = ratio
        return tails
