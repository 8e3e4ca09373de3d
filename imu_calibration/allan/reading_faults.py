"""Faults of the readings at rest that raise their white noise: heavy tails, repeated readings."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.allan.independent_errors import excess_of_errors
from imu_calibration.allan.torn_reads import HIGH_BYTE, Excess, excess_of_torn_reads
from imu_calibration.effects.base import SENSORS
from imu_calibration.preprocessing.scan import SENSOR_COLUMNS

LEAST_STEPS_IN_SCATTER = 4.0
"""Steps of the converter within the scatter, at least: below, its quantiles are those of steps."""
NAMED_EXCESS = 0.015
"""Least excess of the noise that is named, as a share."""
NAMED_EXCESS_SDS = 3.0
"""Least excess that is named, in its standard deviations."""
SMALLEST_TORN = 2.5
"""Least error by a torn read in the tails, in sds of the noise: smaller ones are in the core."""
LARGEST_TORN = 10.0
"""Largest such error: larger ones are outliers, which are excluded before."""
MEAN_DEVIATION = 0.8
"""Mean of the absolute value of a standard normal variable."""
ROUNDING = 1e-12
"""Share of a reading that is rounding, where an outlier was replaced."""
READINGS_PER_MEAN = 32
"""
Neighbouring readings whose mean is subtracted: motion and drift are slower, and an outlier moves
the mean by 3 % of its size.
"""
NAMED_REPEATED_SHARE = 0.05
"""Share of repeated readings above which they are named."""
TOGETHER = 0.9
"""Where an axis repeats its reading, the other axes do in at least this share: no chance."""
NONE_REPLACED = np.zeros(6)
"""Share of replaced readings of each axis where no outlier was found."""
MOST_LEFT_OUT = 0.5
"""Largest share of missing readings that is taken into account."""
LEAST_EXAMINED = 1024
"""Readings whose distribution is examined, at least."""
MOST_KEPT_READINGS = 200_000
"""Readings that are kept."""


@dataclass(frozen=True, eq=False)
class ReadingFaults:
    """Faults by which the white noise of the readings exceeds that of the sensor."""

    tails: np.ndarray
    """Noise of means with tails and torn reads over that without, at least 1, shape (6,)."""
    named: np.ndarray
    """Whether this excess is significant, shape (6,)."""
    repeated: np.ndarray
    """Share of readings that repeat the reading before, accelerometer and gyroscope, shape (2,)."""
    repetition: np.ndarray
    """
    Root of the mean square over the mean of the numbers of repetitions, shape (2,): readings that
    count unequally raise the noise of means by it.
    """
    missing: np.ndarray
    """
    Share of the readings that are missing or replaced, shape (6,): the noise of means is that of
    the others.
    """

    def factor(self, column: int) -> float:
        """Return by how much the white noise of a column may be too high, at least 1."""
        number_factor = 1.0 / np.sqrt(1.0 - self.missing[column])
        return float(self.tails[column] * self.repetition[column // 3] * number_factor)


NO_FAULTS = ReadingFaults(np.ones(6), np.zeros(6, bool), np.zeros(2), np.ones(2), NONE_REPLACED)


class FaultSearch:
    """Accumulates differences and repetitions of the readings at rest (a `Sink`, raw values)."""

    def __init__(self) -> None:
        # The last sample of the present rest, shape (1, 6); None before the first.
        self._last: np.ndarray | None = None
        # Readings of complete blocks, and the readings of the next block.
        self._readings: dict[str, list[np.ndarray]] = {sensor: [] for sensor in SENSORS}
        self._n_kept = dict.fromkeys(SENSORS, 0)
        self._next_block = dict.fromkeys(SENSORS, np.zeros((0, 3)))
        # Least difference of neighbours that is not zero: the step of the converter.
        self._smallest_step = np.full(6, np.inf)
        # Pairs of neighbouring samples; periods at rest, and those without a sample.
        self._n_pairs = 0
        self._n_periods = 0
        self._n_missing = 0
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
        self._n_periods += len(present)
        self._n_missing += int(np.count_nonzero(~present))

        # Pairs of neighbours, the last sample of the call before included.
        rows = values[present]
        if self._last is not None:
            rows = np.vstack([self._last, rows])
        if not len(rows):
            return
        self._last = rows[-1:].copy()
        if len(rows) < 2:
            return
        difference = np.diff(rows, axis=0)
        # Which axes repeat their reading, up to rounding, shape (n_pairs, 6).
        same = np.abs(difference) <= ROUNDING * np.abs(rows).max(axis=0)
        self._n_pairs += len(same)
        self._n_same_axis += same.sum(axis=0)
        steps = np.where(same, np.inf, np.abs(difference))
        self._smallest_step = np.minimum(self._smallest_step, steps.min(axis=0))
        # A sensor repeats where all its axes do.
        for k, sensor in enumerate(SENSORS):
            repeats = same[:, SENSOR_COLUMNS[sensor]].all(axis=1)
            self._n_same_sensor[k] += repeats.sum()
            self._add_runs(k, np.flatnonzero(~repeats), len(repeats))
            # A repeated reading is no reading of the noise.
            self._add_blocks(sensor, rows[1:][~repeats, SENSOR_COLUMNS[sensor]])

    def _add_blocks(self, sensor: str, readings: np.ndarray) -> None:
        """Add the complete blocks of a sensor; the last one is continued."""
        if self._n_kept[sensor] >= MOST_KEPT_READINGS:
            return
        readings = np.vstack([self._next_block[sensor], readings])
        n_complete = len(readings) // READINGS_PER_MEAN * READINGS_PER_MEAN
        self._next_block[sensor] = readings[n_complete:].copy()
        self._readings[sensor].append(readings[:n_complete].copy())
        self._n_kept[sensor] += n_complete

    def _add_runs(self, k: int, changes: np.ndarray, n_pairs: int) -> None:
        """
        Add the lengths of the runs of one reading of sensor `k`; the last run is continued.

        A run ends at each of the pairs `changes`, of `n_pairs` new pairs of neighbours.
        """
        if not len(changes):
            self._run_length[k] += n_pairs
            return
        lengths = np.diff(changes, prepend=-1).astype(float)
        # The first run began before this call; its last reading begins the first pair too.
        lengths[0] += self._run_length[k] - 1.0
        self._n_runs[k] += len(lengths)
        self._run_sum[k] += lengths.sum()
        self._run_squares[k] += (lengths**2).sum()
        self._run_length[k] = n_pairs - changes[-1]

    def end_stretch(self) -> None:
        """Begin another rest: its first reading has no reading before."""
        self._last = None
        self._next_block = dict.fromkeys(SENSORS, np.zeros((0, 3)))
        self._run_length = np.ones(2)

    def result(self, replaced: np.ndarray = NONE_REPLACED) -> ReadingFaults:
        """
        Return the faults of all rests.

        Parameters
        ----------
        replaced : ndarray, shape (6,)
            Share of the readings of each axis that replace an outlier.

        """
        if not self._n_pairs:
            return NO_FAULTS
        # A sensor repeats readings if its axes do so together; a coarse axis repeats by chance.
        share = self._n_same_sensor / self._n_pairs
        largest_axis_share = self._n_same_axis.reshape(2, 3).max(axis=1) / self._n_pairs
        repeats = (share > NAMED_REPEATED_SHARE) & (share > TOGETHER * largest_axis_share)
        # Root of the mean square over the mean of the lengths; 1 before the first complete run.
        n_runs = np.maximum(self._n_runs, 1.0)
        mean_square = np.maximum(self._run_squares, 1.0) / n_runs
        mean = np.maximum(self._run_sum, 1.0) / n_runs
        repetition = np.sqrt(mean_square) / mean

        # The largest excess of each axis; it is named if it is significant and not small.
        ratios = np.ones(6)
        named = np.zeros(6, bool)
        for column, excesses in enumerate(self._excesses()):
            for excess in excesses:
                ratios[column] = max(ratios[column], excess.ratio)
                if excess.sds > NAMED_EXCESS_SDS and excess.ratio > 1.0 + NAMED_EXCESS:
                    named[column] = True
        return ReadingFaults(
            tails=ratios,
            named=named,
            repeated=np.where(repeats, share, 0.0),
            repetition=np.where(repeats, np.maximum(repetition, 1.0), 1.0),
            missing=np.minimum(replaced + self._n_missing / self._n_periods, MOST_LEFT_OUT),
        )

    def _excesses(self) -> list[list[Excess]]:
        """Return the list of `Excess` of each axis, by tails and by torn reads."""
        excesses: list[list[Excess]] = []
        for sensor, columns in SENSOR_COLUMNS.items():
            if self._n_kept[sensor] < LEAST_EXAMINED:
                excesses += [[], [], []]
                continue
            readings_of_axes = np.concatenate(self._readings[sensor]).T
            for readings, step in zip(readings_of_axes, self._smallest_step[columns], strict=True):
                if not np.isfinite(step):  # constant readings
                    excesses.append([])
                    continue
                tails = _excess_of_tails(readings, step)
                excesses.append([excess_of_torn_reads(readings, step)])
                if tails is not None:
                    excesses[-1].append(tails)
        return excesses


def _excess_of_tails(readings: np.ndarray, smallest_step: float) -> Excess | None:
    """
    Return the largest factor by which heavy tails raise the white noise of one axis.

    The tails are those of the readings less the means of blocks. With the sd s of the noise alone
    and that of the readings::

        ratio = sd(readings) / s         upper bound, `excess_of_errors`

    Parameters
    ----------
    readings : ndarray, shape (n_blocks READINGS_PER_MEAN,)
    smallest_step : float
        Step of the converter, in the unit of the readings.

    Returns
    -------
    Excess or None
        None if s is so few steps that the distribution is that of the steps.

    """
    blocks = readings.reshape(-1, READINGS_PER_MEAN)
    deviation = (blocks - blocks.mean(axis=1, keepdims=True)).ravel()
    excess = excess_of_errors(deviation, READINGS_PER_MEAN)

    readings_sd = float(np.sqrt(np.mean(deviation**2)))
    noise_steps = readings_sd / excess.ratio / smallest_step
    if noise_steps < LEAST_STEPS_IN_SCATTER:
        return None

    # Torn reads correlate with the readings: the noise of means exceeds by more than the readings.
    # Without significant errors there are none.
    if excess.sds > NAMED_EXCESS_SDS:
        return Excess(excess_of_means(excess.ratio, noise_steps), excess.sds)
    return excess


def excess_of_means(ratio: float, noise_steps: float) -> float:
    """
    Return by how much tails of readings raise the noise of their means.

    An error that is independent of the noise raises both by the same ratio. A torn register read
    (high byte of the reading before) has an error e of ``k = 256 / noise_steps`` sd against the
    deviation x of its reading from the change of the high byte, in a share p of the readings::

        reading:  ratio^2 = 1 + E[e^2] + 2 E[e x] = 1 + p k^2 - 2 p k E|x|,  E|x| = 0.8
        means:    excess^2 = 1 + p k^2 = 1 + (ratio^2 - 1) k / (k - 1.6)

    Parameters
    ----------
    ratio : float
        Standard deviation over that of the core.
    noise_steps : float
        Noise in steps of the converter.

    """
    torn_error = HIGH_BYTE / noise_steps
    if not SMALLEST_TORN < torn_error < LARGEST_TORN:
        return ratio
    return float(np.sqrt(1.0 + (ratio**2 - 1.0) * torn_error / (torn_error - 2 * MEAN_DEVIATION)))
