"""
Single outlying readings: a glitch on the bus, a corrupt message; dropped before any averaging.
"""

from typing import Any

import numpy as np

from imu_calibration.core.samples import ImuSamples, runs_of

NOISE_SAMPLES = 32
"""Samples per estimate of the noise."""
BREAK_NS = 10**9
"""Samples further apart than this are not neighbours."""
SPIKE_REACH = 8
"""Samples on either side that the test uses; the same number is buffered."""
SPIKE_NEIGHBOURS = 4
"""Samples on either side for the comparison of a reading."""
LARGE_SDS = 8.0
"""Deviations below this many noise sds are not tested."""
PREDICTION_SHARE = 0.2
"""
Largest difference of the predictions from either side, as a share of the deviation: a knock, a stop
and fast twisting exceed it.
"""
SPIKE_SPREADS = 10.0
"""Factor on the spread of the eight neighbours without the two lowest and the two highest."""
PREDICTION_MARGIN = 0.25
"""The same in units of `LARGE_SDS` noise sds, for the noise of these predictions."""
SHARED = 1.5
"""
The same for the differences of the four neighbours, of which the noise is 0.4 of this unit: more in
two of six readings is a knock.
"""
BETWEEN = (0.03, 0.4)
"""
A neighbour that deviates by more than the first share of a spike, and less than the second,
indicates a knock.
"""
NOISE_ROUNDING = 1e-7
"""Share of the readings below which differences are due to rounding."""
_CANDIDATE = 6.0
"""Second differences above this many noise sds are tested further."""
_NORMAL = 1.4826 / np.sqrt(1.5)
"""Sd of white noise over the median of ``|x_k - (x_k-1 + x_k+1) / 2|``."""


class SpikeFilter:
    """
    Removes spikes from a stream.

    The result does not depend on the division of the stream into pieces.

    A reading is a spike when its deviation from the cubic through the four nearest readings exceeds
    `LARGE_SDS` sds of the noise, and by far the differences of its neighbours. The cubic follows
    fast motion; it must agree with the predictions from each side. Where one of the four is an
    outlier as well, the median of the nine readings around replaces the cubic (Hampel's test). The
    noise is estimated from medians of second differences, over the chunk of samples before or the
    samples around; white noise exceeds 8 sds once in 1e15 samples. Source: Pearson et al., EURASIP
    J. Adv. Signal Process. 2016:87.
    """

    def __init__(self) -> None:
        self.dropped = 0
        """Samples with a spike so far."""
        self._reset()

    def _reset(self) -> None:
        """Discard all samples and the noise: the next sample begins a stream."""
        # Samples without a decision.
        self._buffered: Any = None
        # Readings, (n, 6), of these and of decided samples before them, which are needed as
        # neighbours; and the number of the first of these rows in the stream.
        self._readings = np.zeros((0, 6))
        self._first_row = 0
        # Noise sd of the newest chunks of `NOISE_SAMPLES`, (n, 6), the number of chunks until now,
        # and the smallest step of each column until now.
        self._noise_sds = np.zeros((1, 6))
        self._n_chunks = 0
        self._smallest_step = np.full(6, np.inf)

    def push(self, samples: ImuSamples) -> list[ImuSamples]:
        """Return a list of the ImuSamples with a decision; the last `SPIKE_REACH` are buffered."""
        passed = []
        for start, stop in runs_of(np.ones(len(samples)), np.diff(samples.stamp_ns) > BREAK_NS):
            part = samples.select(slice(start, stop))
            if (
                self._buffered is not None
                and part.stamp_ns[0] - self._buffered.stamp_ns[-1] > BREAK_NS
            ):
                passed += self.finish()
            self._buffered = part.after(self._buffered)
            self._readings = np.vstack([self._readings, np.hstack([part.force_s, part.rate_s])])
            # Not before the noise of the first chunk can be estimated.
            if self._first_row + len(self._readings) > NOISE_SAMPLES:
                passed += self._decide(max(len(self._buffered) - SPIKE_REACH, 0))
        return passed

    def finish(self) -> list[ImuSamples]:
        """Return the buffered samples, and reset."""
        passed = [] if self._buffered is None else self._decide(len(self._buffered))
        self._reset()
        return passed

    def _decide(self, count: int) -> list[ImuSamples]:
        """Return the first `count` of the buffered samples, without spikes, in a list."""
        if not count:
            return []
        samples = self._buffered.select(slice(0, count))
        # The buffered samples are the last rows of the readings.
        rows = len(self._readings) - len(self._buffered) + np.arange(count)
        is_spike = self._spikes(rows)
        self.dropped += int(np.count_nonzero(is_spike))
        self._buffered = self._buffered.select(slice(count, None))
        # Drop the rows that no later test needs, in whole chunks. The noise sds that are kept are
        # those of as many chunks as the rows and the next `SPIKE_REACH` ones span, and of two more.
        n_old_chunks = max((rows[-1] + 1 - SPIKE_REACH) // NOISE_SAMPLES - 1, 0)
        self._readings = self._readings[n_old_chunks * NOISE_SAMPLES :]
        self._first_row += n_old_chunks * NOISE_SAMPLES
        self._noise_sds = self._noise_sds[
            -2 - (len(self._readings) + SPIKE_REACH) // NOISE_SAMPLES :
        ]
        return [samples.select(~is_spike) if is_spike.any() else samples]

    def _spikes(self, rows: np.ndarray) -> np.ndarray:
        """
        Return which samples have a spike in one of their six readings, bool, shape (n,).

        `rows` are their indices in the stored readings, shape (n,).
        """
        values = self._readings
        if len(values) < 2 * SPIKE_REACH + 1:
            return np.zeros(len(rows), bool)
        # 1. Second differences of all stored rows; the two ends have those of their neighbours.
        second = np.abs(values[1:-1] - 0.5 * (values[2:] + values[:-2]))
        second = np.vstack([second[:1], second, second[-1:]])
        self._add_noise(second)

        # 2. Candidates exceed the noise of the chunk before. Each is one reading: an index into
        #    `rows`, and a column.
        limits = self._limits_at(rows)
        candidate, column = np.nonzero(second[rows] > _CANDIDATE / LARGE_SDS * limits)
        is_spike = np.zeros(len(rows), bool)
        if not len(candidate):
            return is_spike
        row = rows[candidate]

        # 3. A knock affects two neighbours on either side, and several columns. Rows without two
        #    neighbours on each side are not tested for one.
        inner = np.clip(row, 2, len(values) - 3)
        is_knock = _is_knock(values[inner[:, None] + [-2, -1, 1, 2]], limits[candidate])
        is_knock &= inner == row

        # 4. During vibration, as at the first touch of a hand, the previous noise does not apply:
        #    it is the median of 15 second differences around, of which a spike affects three, two
        #    spikes six. `window` has the 17 rows around each of the m candidates, shape (m, 17).
        first = np.clip(row - SPIKE_REACH, 0, len(values) - 2 * SPIKE_REACH - 1)
        window = first[:, None] + np.arange(2 * SPIKE_REACH + 1)
        median_around = np.median(second[window[:, 1:-1], column[:, None]], axis=1)
        limit = np.maximum(limits[candidate, column], LARGE_SDS * _NORMAL * median_around)

        # 5. The nine readings around each candidate, (m, 9), and its place among them.
        first = np.clip(row - SPIKE_NEIGHBOURS, 0, len(values) - 2 * SPIKE_NEIGHBOURS - 1)
        around = values[first[:, None] + np.arange(2 * SPIKE_NEIGHBOURS + 1), column[:, None]]
        place = row - first
        is_outlier = _contradicted(around, place, limit) | _off_the_median(around, place, limit)
        is_spike[candidate[~is_knock & is_outlier]] = True
        return is_spike

    def _limits_at(self, rows: np.ndarray) -> np.ndarray:
        """Return `LARGE_SDS` noise sds of the chunk before each of some rows, shape (n, 6)."""
        # The last of the noise sds is that of the newest chunk; there may be fewer than chunks.
        chunk = np.maximum((self._first_row + rows) // NOISE_SAMPLES - 1, 0)
        n_noise = len(self._noise_sds)
        noise_row = np.clip(chunk - self._n_chunks + n_noise, 0, n_noise - 1)
        return LARGE_SDS * self._noise_sds[noise_row]

    def _add_noise(self, second: np.ndarray) -> None:
        """
        Estimate the noise sd of each complete chunk, at least the step of the converter.

        `second`: second differences of the rows, shape (n, 6).
        """
        # 1. The complete chunks without an estimate, each shape (NOISE_SAMPLES, 6). The last row
        #    has no second difference yet.
        start = self._n_chunks * NOISE_SAMPLES - self._first_row
        count = (len(second) - 1 - start) // NOISE_SAMPLES if len(second) > NOISE_SAMPLES else 0
        if self._n_chunks == 0 and count == 0:  # a stream that ended before
            chunks = second[None]
            values = self._readings[None]
        else:
            rows = slice(start, start + count * NOISE_SAMPLES)
            chunks = second[rows].reshape(count, NOISE_SAMPLES, 6)
            values = self._readings[rows].reshape(count, NOISE_SAMPLES, 6)
        if not len(chunks):
            return
        # 2. Smallest step until each chunk, (n_chunks, 6), infinite before the first change.
        change = np.abs(np.diff(values, axis=1))
        steps = np.where(change > 0, change, np.inf).min(axis=1)
        steps = np.minimum.accumulate(np.vstack([self._smallest_step, steps]))[1:]
        # 3. Noise of each chunk. A constant output (clipped, frozen, coarse) has none: the last one
        #    above zero is kept. Row 0 is the newest earlier estimate.
        estimates = np.vstack([self._noise_sds[-1:], _NORMAL * _median(chunks)])
        number = np.arange(len(estimates))[:, None]
        last_known = np.maximum.accumulate(np.where(estimates > 0, number, 0))
        estimates = np.take_along_axis(estimates, last_known, axis=0)[1:]
        # 4. At least the step of the converter, and the rounding of the readings.
        noise = np.maximum(
            np.maximum(estimates, np.where(np.isfinite(steps), steps, 0.0)),
            NOISE_ROUNDING * np.abs(_median(values)),
        )
        self._noise_sds = np.vstack([self._noise_sds, noise])
        self._n_chunks += len(noise)
        self._smallest_step = steps[-1]


def _median(values: np.ndarray) -> np.ndarray:
    """
    Return the median along axis 1.

    A sort of short columns is several times faster than the partition of `np.median`.
    """
    ordered = np.sort(values, axis=1)
    count = values.shape[1]
    return 0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2])


def _is_knock(neighbours: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """
    Return where two or more of the six columns deviate in the neighbours as well, shape (m,).

    Such a deviation indicates motion, which affects several axes. It is ``2 (b - c) - (a - d)`` of
    the two neighbours before, a and b, and after, c and d.

    Parameters
    ----------
    neighbours : array, shape (m, 4, 6)
        Readings a, b, c, d.
    limit : array, shape (m, 6)
        `LARGE_SDS` noise sds.

    """
    deviation = np.abs(np.einsum('mkc,k->mc', neighbours, [-1.0, 2.0, -2.0, 1.0]))
    return np.count_nonzero(deviation > SHARED * limit, axis=1) >= 2


def _contradicted(around: np.ndarray, place: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """
    Return where readings deviate from the cubic through two neighbours on either side, (m,).

    A motion with such a deviation at one reading also affects its neighbours: the impulse response
    of 0.9 of the Nyquist bandwidth has a tenth there. The straight lines through the two neighbours
    of each side must therefore agree with the cubic.

    Parameters
    ----------
    around : array, shape (m, 9)
        Nine successive readings.
    place : array of int, shape (m,)
        Index of the reading among them: the middle except at the ends of the stream.
    limit : array, shape (m,)
        `LARGE_SDS` noise sds.

    """
    a, b, x, c, d = around[:, SPIKE_NEIGHBOURS - 2 : SPIKE_NEIGHBOURS + 3].T
    predicted = (4 * (b + c) - (a + d)) / 6
    deviation = np.abs(x - predicted)
    apart = np.maximum(np.abs(2 * b - a - predicted), np.abs(2 * c - d - predicted))
    # The prediction is as noisy as the reading.
    is_deviating = (place == SPIKE_NEIGHBOURS) & (deviation > 1.4 * limit)
    return is_deviating & (apart < PREDICTION_SHARE * deviation + PREDICTION_MARGIN * limit)


def _off_the_median(around: np.ndarray, place: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """
    Return where readings deviate from the median of nine, which two further outliers do not move.

    The deviation exceeds `limit` and `SPIKE_SPREADS` times the range of the nine without the two
    lowest and the two highest, and no neighbour has a visible smaller one, which would indicate a
    knock. Arguments as for `_contradicted`.
    """
    ordered = np.sort(around, axis=1)
    deviations = np.abs(around - ordered[:, [SPIKE_NEIGHBOURS]])
    rows = np.arange(len(around))
    deviation = deviations[rows, place]
    neighbours = np.clip(place[:, None] + [-2, -1, 1, 2], 0, 2 * SPIKE_NEIGHBOURS)
    neighbour_deviations = deviations[rows[:, None], neighbours]
    is_visible = neighbour_deviations > np.maximum(BETWEEN[0] * deviation, 0.5 * limit)[:, None]
    is_smaller = neighbour_deviations < BETWEEN[1] * deviation[:, None]
    is_knock = (is_visible & is_smaller).any(axis=1)
    inner_range = ordered[:, -3] - ordered[:, 2]
    return (deviation > np.maximum(limit, SPIKE_SPREADS * inner_range)) & ~is_knock
