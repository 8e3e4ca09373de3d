"""Dead band of a gyroscope: rates below a threshold are given as exactly zero."""

import numpy as np

BINS_PER_OCTAVE = 16
"""Bins of the histogram of magnitudes per factor of two."""
SMALLEST, LARGEST = 2.0**-30, 2.0**10
"""Rates whose magnitudes are counted, rad/s."""
N_OCTAVE_BINS = int(BINS_PER_OCTAVE * np.log2(LARGEST / SMALLEST))
LEAST_ZERO_SHARE = 0.05
"""Share of zeros of an axis with a dead band: it rests in some part of a recording."""
MOST_STRAYS = 4
"""Readings within the band: transients of filters and faults of the bus."""
LEAST_ABOVE = 15
"""
Readings in the octave above the band. As many are expected in the band if readings are spread
evenly down to zero, so that `MOST_STRAYS` are improbable.
"""
LEAST_BAND_STEPS = 8.0
"""The band is wider than this many steps of the converter; a coarse output also reads zero."""


class DeadBandSearch:
    """Counts zeros and magnitudes of the rates, in bounded memory."""

    def __init__(self) -> None:
        # Samples, readings of exactly zero of each axis, and readings by their magnitude.
        self._n_samples = 0
        self._n_zero = np.zeros(3, np.int64)
        self._counts = np.zeros((3, N_OCTAVE_BINS), np.int64)

    def push(self, rate: np.ndarray) -> None:
        """Process rates, shape (3, n), rad/s."""
        self._n_samples += rate.shape[1]
        self._n_zero += np.count_nonzero(rate == 0.0, axis=1)
        if not self._n_zero.any():
            return  # no band so far; the magnitudes before its first zero are not needed
        for axis, values in enumerate(rate):
            magnitude = np.abs(values[values != 0.0])
            octaves = np.log2(np.clip(magnitude, SMALLEST, 0.99 * LARGEST) / SMALLEST)
            bins = (BINS_PER_OCTAVE * octaves).astype(np.int64)
            self._counts[axis] += np.bincount(bins, minlength=N_OCTAVE_BINS)

    def bands(self, resolution: np.ndarray) -> np.ndarray:
        """
        Return the threshold of each axis, rad/s, shape (3,); 0 without a dead band.

        `resolution` is the smallest step between readings of each axis, shape (3,).
        """
        thresholds = np.zeros(3)
        for axis, counts in enumerate(self._counts):
            # n_below[k] is the number of readings below bin k. The band ends at the last bin below
            # which there are no more readings than transients cause.
            n_below = np.append(0, np.cumsum(counts))
            first = int(np.searchsorted(n_below, MOST_STRAYS, side='right')) - 1
            threshold = SMALLEST * 2.0 ** (first / BINS_PER_OCTAVE)
            n_above = counts[first : first + BINS_PER_OCTAVE].sum()
            often_zero = self._n_zero[axis] >= LEAST_ZERO_SHARE * max(self._n_samples, 1)
            is_wide = threshold >= LEAST_BAND_STEPS * resolution[axis]
            if often_zero and is_wide and n_above >= LEAST_ABOVE:
                thresholds[axis] = threshold
        return thresholds


def dead_bands(rate: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Return `DeadBandSearch.bands` of rates, shape (n, 3)."""
    search = DeadBandSearch()
    search.push(rate.T)
    return search.bands(resolution)
