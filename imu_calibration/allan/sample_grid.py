"""
Samples on the grid of their period: the number of periods between neighbours, robust against jitter of the stamps.

An Allan variance counts samples. A lost one must leave a hole, a late stamp must not: where stamps are nearly regular, a long step is
a loss; where they are not (packets of a bus, stamps of arrival), only a delay that persists for `WINDOW` samples counts as one.
"""

import numpy as np

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
