"""Weighted integrals over short windows: derivatives without differentiation, also for uneven stamps."""

from dataclasses import dataclass

import numpy as np

POWER = 6
"""The weight is sin^6: with eight samples per window its sums equal its integrals, and its ends are smooth to fifth order."""
SAMPLES_LEAST = 8
"""Samples per window; with fewer the sums depend on the positions of the samples."""

BLOCK = 4_000_000
"""Numbers per gather operation."""


@dataclass(frozen=True, eq=False)
class Windows:
    """
    Windows of one length over one stream.

    For a signal x and the weight phi of a window (zero at its ends, integral 1): ``mean = int phi x dt`` and, by parts,
    ``slope = int phi dx/dt dt = -int (dphi/dt) x dt``. Both apply the same low-pass, so an equation between x, its
    derivative and other signals also holds for its weighted integrals, for any motion between the samples.
    """

    index: np.ndarray
    """Samples of each window, padded with the last one, shape (n_windows, width)."""
    weight: np.ndarray
    """Quadrature weights of `mean`, zero for padding, shape (n_windows, width)."""
    weight_slope: np.ndarray
    """Quadrature weights of `slope`, 1/s, shape (n_windows, width)."""

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted means of values (n, k), shape (n_windows, k)."""
        return _weighted(self.index, self.weight, values)

    def slope(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted means of the time derivative of values (n, k), shape (n_windows, k)."""
        return _weighted(self.index, self.weight_slope, values)

    def touches(self, flags: np.ndarray) -> np.ndarray:
        """Return which windows contain a flagged sample, shape (n_windows,)."""
        return np.any(flags[self.index] & (self.weight > 0), axis=1)

    def select(self, keep: np.ndarray) -> 'Windows':
        """Return the windows at `keep`."""
        return Windows(self.index[keep], self.weight[keep], self.weight_slope[keep])


def make_windows(time: np.ndarray, centres: np.ndarray, length: float) -> Windows:
    """
    Lay windows of `length` seconds around `centres` over the samples at `time`.

    Parameters
    ----------
    time : array, shape (n,)
        Rising, s.
    centres : array, shape (n_windows,)
        s; windows should lie inside the stream.
    length : float
        Full length, s.

    """
    first = np.searchsorted(time, centres - length / 2, side='right')
    last = np.searchsorted(time, centres + length / 2, side='left')
    width = max(int(np.max(last - first, initial=1)), 1)
    offset = np.arange(width)
    index = np.minimum(first[:, None] + offset, len(time) - 1)
    inside = offset < (last - first)[:, None]
    phase = np.pi * ((time[index] - centres[:, None]) / length + 0.5)
    sine, share = np.sin(phase), np.gradient(time)[index] / length
    norm = 1 / 0.3125  # the mean of sin^6 over its half period is 5/16
    weight = np.where(inside, norm * sine**POWER * share, 0.0)
    slope = np.where(inside, -norm * POWER * np.pi / length * sine**(POWER - 1) * np.cos(phase) * share, 0.0)
    return Windows(index, weight, slope)


def _weighted(index, weight, values):
    block = max(1, BLOCK // (index.shape[1] * values.shape[1]))  # bounds memory
    parts = [np.einsum('mw,mwk->mk', weight[k:k + block], values[index[k:k + block]]) for k in range(0, len(index), block)]
    return np.concatenate(parts) if parts else np.zeros((0, values.shape[1]))


def holes(time: np.ndarray, longest: float) -> np.ndarray:
    """Return flags of samples next to a step longer than `longest` seconds, shape (n,)."""
    wide = np.diff(time) > longest
    return np.concatenate([wide, [False]]) | np.concatenate([[False], wide])
