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
LARGE = 8.0
"""Deviations below this many noise sds are not tested."""
PREDICTION_SHARE = 0.2
"""
Largest difference of the predictions from either side, as a share of the deviation: a knock, a stop
and fast twisting exceed it.
"""
SPIKE_SPREADS = 10.0
"""Factor on the spread of the eight neighbours without the two lowest and the two highest."""
PREDICTION_MARGIN = 0.25
"""The same in units of `LARGE` noise sds, for the noise of these predictions."""
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
_NORMAL = 1.4826 / np.sqrt(1.5)  # sd of white noise over the median of |x_k - (x_k-1 + x_k+1) / 2|


class SpikeFilter:
    """
    Removes spikes from a stream.

    The result does not depend on the division of the stream into pieces.

    A reading is a spike when its deviation from the cubic through the four nearest readings exceeds
    `LARGE` sds of the noise and by far the differences of its neighbours. The cubic follows fast
    motion; it must agree with the predictions from each side. Where one of the four is an outlier
    as well, the median of the nine readings around replaces the cubic (Hampel's test). The noise is
    estimated from medians of second differences, over the chunk of samples before or the samples
    around; white noise exceeds 8 sds once in 1e15 samples. Source: Pearson et al., EURASIP J. Adv.
    Signal Process. 2016:87.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._begin()

    def _begin(self):
        self._held: Any = None
        self._values, self._first = np.zeros((0, 6)), 0
        self._noise, self._n_noise, self._step = np.zeros((1, 6)), 0, np.full(6, np.inf)

    def push(self, samples: ImuSamples) -> list[ImuSamples]:
        """Return a list of the ImuSamples with a decision; the last `SPIKE_REACH` are buffered."""
        passed = []
        for start, stop in runs_of(np.ones(len(samples)), np.diff(samples.stamp_ns) > BREAK_NS):
            part = samples.select(slice(start, stop))
            if self._held is not None and part.stamp_ns[0] - self._held.stamp_ns[-1] > BREAK_NS:
                passed += self.finish()
            self._held = part if self._held is None else type(part).concatenate([self._held, part])
            self._values = np.vstack([self._values, np.hstack([part.force_s, part.rate_s])])
            passed += self._decide(
                max(len(self._held) - SPIKE_REACH, 0)
                if self._first + len(self._values) > NOISE_SAMPLES
                else 0
            )
        return passed

    def finish(self) -> list[ImuSamples]:
        """Return the buffered samples, and reset."""
        rest = [] if self._held is None else self._decide(len(self._held))
        self._begin()
        return rest

    def _decide(self, count):
        """Return the first `count` of the buffered samples, without spikes, in a list."""
        if not count:
            return []
        samples = self._held.select(slice(0, count))
        held = self._held.select(slice(count, None))
        at = len(self._values) - len(self._held) + np.arange(count)
        spiky = self._spikes(at)
        self.dropped, self._held = self.dropped + int(np.count_nonzero(spiky)), held
        # The first kept row has no second difference.
        kept = max((at[-1] + 1 - SPIKE_REACH) // NOISE_SAMPLES - 1, 0) * NOISE_SAMPLES
        self._values, self._first = self._values[kept:], self._first + kept
        self._noise = self._noise[-2 - (len(self._values) + SPIKE_REACH) // NOISE_SAMPLES :]
        return [samples.select(~spiky) if spiky.any() else samples]

    def _spikes(self, at):
        """Return which of the rows `at` of the values are spikes."""
        values = self._values
        if len(values) < 2 * SPIKE_REACH + 1:
            return np.zeros(len(at), bool)
        second = np.abs(values[1:-1] - 0.5 * (values[2:] + values[:-2]))
        second = np.vstack([second[:1], second, second[-1:]])
        self._add_noise(second)
        chunk = np.maximum((self._first + at) // NOISE_SAMPLES - 1, 0)
        limit = (
            LARGE
            * self._noise[
                np.clip(chunk - self._n_noise + len(self._noise), 0, len(self._noise) - 1)
            ]
        )
        spiky = np.zeros(len(at), bool)
        row, column = np.nonzero(second[at] > _CANDIDATE / LARGE * limit)
        if len(row):
            first = np.clip(at[row] - SPIKE_REACH, 0, len(values) - 2 * SPIKE_REACH - 1)
            window = first[:, None] + np.arange(2 * SPIKE_REACH + 1)
            column = column[:, None]
            inner = np.clip(at[row], 2, len(values) - 3)
            knock = _knocked(values[inner[:, None] + [-2, -1, 1, 2]], limit[row]) & (
                inner == at[row]
            )
            # during vibration, as at the first touch of a hand, the previous noise does not apply;
            # a spike affects three second differences, two in six
            shaking = LARGE * _NORMAL * np.median(second[window[:, 1:-1], column], axis=1)
            limit = np.maximum(limit[row, column[:, 0]], shaking)
            first = np.clip(at[row] - SPIKE_NEIGHBOURS, 0, len(values) - 2 * SPIKE_NEIGHBOURS - 1)
            around = values[first[:, None] + np.arange(2 * SPIKE_NEIGHBOURS + 1), column]
            place = at[row] - first
            spiky[
                row[
                    ~knock
                    & (_contradicted(around, place, limit) | _off_the_median(around, place, limit))
                ]
            ] = True
        return spiky

    def _add_noise(self, second):
        """
        Estimate the noise sd of each complete chunk, at least the converter's step.

        Shape (n_chunks, 6).
        """
        start = self._n_noise * NOISE_SAMPLES - self._first
        count = (len(second) - 1 - start) // NOISE_SAMPLES if len(second) > NOISE_SAMPLES else 0
        if self._n_noise == 0 and count == 0:  # a stream that ended before
            parts = second[None]
            values = self._values[None]
        else:
            parts, values = (
                rows[start : start + count * NOISE_SAMPLES].reshape(count, NOISE_SAMPLES, 6)
                for rows in (second, self._values)
            )
        if not len(parts):
            return
        change = np.abs(np.diff(values, axis=1))
        steps = np.where(change > 0, change, np.inf).min(axis=1)
        steps = np.minimum.accumulate(np.vstack([self._step, steps]))[1:]
        usual = _NORMAL * _median(parts)
        # a constant output (clipped, frozen, coarse) has no noise estimate: the previous one is
        # kept
        known = np.vstack([self._noise[-1:], usual])
        last = np.maximum.accumulate(np.where(known > 0, np.arange(len(known))[:, None], 0))
        usual = np.take_along_axis(known, last, axis=0)[1:]
        noise = np.maximum(
            np.maximum(usual, np.where(np.isfinite(steps), steps, 0.0)),
            NOISE_ROUNDING * np.abs(_median(values)),
        )
        self._noise, self._n_noise, self._step = (
            np.vstack([self._noise, noise]),
            self._n_noise + len(noise),
            steps[-1],
        )


def _median(values):
    """
    Return the median along axis 1.

    A sort of short columns is several times faster than the partition of `np.median`.
    """
    ordered = np.sort(values, axis=1)
    count = values.shape[1]
    return 0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2])


def _knocked(beside, limit):
    """
    Return where two or more of the six readings deviate in the neighbours as well.

    The neighbours are `beside` (m, 4, 6). Such a deviation indicates motion, which affects several
    axes.
    """
    return (
        np.count_nonzero(
            np.abs(np.einsum('mkc,k->mc', beside, [-1.0, 2.0, -2.0, 1.0])) > SHARED * limit, axis=1
        )
        >= 2
    )


def _contradicted(around, place, limit):
    """
    Compare with the cubic and the straight lines through the neighbours.

    The cubic is through two neighbours on either side, and the lines are through the two on each
    side.

    A motion with such a deviation at one reading also affects its neighbours: the impulse response
    of 0.9 of the Nyquist bandwidth has a tenth there. Both lines must therefore agree with the
    cubic; `place` of the reading in `around` is the middle except at the ends.
    """
    a, b, x, c, d = around[:, SPIKE_NEIGHBOURS - 2 : SPIKE_NEIGHBOURS + 3].T
    predicted = (4 * (b + c) - (a + d)) / 6
    off = np.abs(x - predicted)
    apart = np.maximum(np.abs(2 * b - a - predicted), np.abs(2 * c - d - predicted))
    # The prediction is as noisy as the reading.
    return (
        (place == SPIKE_NEIGHBOURS)
        & (off > 1.4 * limit)
        & (apart < PREDICTION_SHARE * off + PREDICTION_MARGIN * limit)
    )


def _off_the_median(around, place, limit):
    """Compare with the median, which is robust to two further outliers."""
    ordered = np.sort(around, axis=1)
    rows = np.arange(len(around))
    off = np.abs(around - ordered[:, [SPIKE_NEIGHBOURS]])
    own = off[rows, place]
    beside = off[rows[:, None], np.clip(place[:, None] + [-2, -1, 1, 2], 0, 2 * SPIKE_NEIGHBOURS)]
    knock = (
        (beside > np.maximum(BETWEEN[0] * own, 0.5 * limit)[:, None])
        & (beside < BETWEEN[1] * own[:, None])
    ).any(axis=1)
    return (own > np.maximum(limit, SPIKE_SPREADS * (ordered[:, -3] - ordered[:, 2]))) & ~knock
