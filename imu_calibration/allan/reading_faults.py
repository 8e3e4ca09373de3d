"""Faults of the readings at rest that raise their white noise: heavy tails, repeated readings."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.allan.outliers import NORMAL_QUARTILE
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS

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
LEAST_DIFFERENCES = 1024
"""Differences that change the reading, at least, for the quartiles."""
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
        # Pairs of neighbours with one reading: of each axis, and of all axes of a sensor.
        self._n_same_axis = np.zeros(6)
        self._n_same_sensor = np.zeros(2)
        # Of each sensor, the length of the present run of one reading, and of the complete runs
        # number, sum and sum of squares of the lengths.
        self._run_length = np.ones(2)
        self._n_runs = np.zeros(2)
        self._run_sum = np.zeros(2)
        self._run_squares = np.zeros(2)

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a rest, shape (n, 6)."""
        rows = values[present]
        if self._last is not None:
            rows = np.vstack([self._last, rows])
        if not len(rows):
            return
        self._last = rows[-1:].copy()
        if len(rows) < 2:
            return
        difference = np.diff(rows, axis=0)
        same = difference == 0
        self._n_pairs += len(same)
        self._n_same_axis += same.sum(axis=0)
        if self._n_kept < MOST_DIFFERENCES:
            self._differences.append(difference)
            self._n_kept += len(difference)
        for k, sensor in enumerate(SENSORS):
            held = same[:, SENSOR_COLUMNS[sensor]].all(axis=1)
            self._n_same_sensor[k] += held.sum()
            self._add_runs(k, np.flatnonzero(~held), len(held))

    def _add_runs(self, k, changes, n_pairs):
        """Add the lengths of the runs that end at `changes`; the last one is continued."""
        if not len(changes):
            self._run_length[k] += n_pairs
            return
        lengths = np.diff(changes, prepend=-1).astype(float)
        lengths[0] += self._run_length[k] - 1.0
        self._n_runs[k] += len(lengths)
        self._run_sum[k] += lengths.sum()
        self._run_squares[k] += (lengths**2).sum()
        self._run_length[k] = n_pairs - changes[-1]

    def end_stretch(self) -> None:
        """Begin another rest: its first reading has no reading before."""
        self._last = None
        self._run_length = np.ones(2)

    def result(self) -> ReadingFaults:
        """Return the faults of all rests."""
        if not self._n_pairs:
            return NO_FAULTS
        share = self._n_same_sensor / self._n_pairs
        largest_axis_share = self._n_same_axis.reshape(2, 3).max(axis=1) / self._n_pairs
        repeats = (share > REPEATED) & (share > TOGETHER * largest_axis_share)
        # Root of the mean square over the mean of the lengths; 1 before the first complete run.
        n_runs = np.maximum(self._n_runs, 1.0)
        mean_square = np.maximum(self._run_squares, 1.0) / n_runs
        mean = np.maximum(self._run_sum, 1.0) / n_runs
        repetition = np.sqrt(mean_square) / mean
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
            if len(difference) < LEAST_DIFFERENCES:
                continue
            low, high = np.quantile(difference, (0.25, 0.75))
            usual = (high - low) / (2 * NORMAL_QUARTILE)
            if usual < LEAST_STEPS * np.abs(difference).min():
                continue
            ratio = float(np.sqrt(np.mean(difference**2))) / usual
            if ratio > 1.0 + max(LEAST_EXCESS, EXCESS_SDS * RATIO_SD / len(difference) ** 0.5):
                tails[column] = ratio
        return tails
