"""
Test of a sine in a recording at rest: a hump of an Allan curve is an oscillation only if the periodogram has a line there.

Noise that a resonance filters has the same hump as a sine, but no line. The ordinates of a periodogram averaged over K segments are
chi-square with 2 K degrees of freedom; a line is significant if an F test against the neighbouring ordinates rejects noise (Percival and
Walden, Spectral Analysis for Physical Applications, chapter 10).
"""

import numpy as np

from imu_calibration.chances import f_sf

CYCLES = 64
"""Cycles of the hump's frequency in a segment: a resonance of quality below 16 is wider than the neighbouring ordinates of the test."""
FEWEST_CYCLES = 16
"""Cycles in the longest rest, at least: with fewer, slow noise and a line are not separable."""
PER_CYCLE = 16
"""Block means per cycle: twice the hump's frequency, the highest under test, has eight."""
LOBE, NEIGHBOURS = 2, 9
"""Half width of a line under a Hann window, and distance of the farthest neighbouring ordinates, in bins."""
INDEPENDENT = 2 / 3
"""Share of independent ordinates under a Hann window, whose noise bandwidth is 1.5 bins."""
SIGNIFICANT = 1e-4
"""Significance level over all frequencies under test: six axes of 100 recordings without a line give 0.06 false ones."""


class ToneSearch:
    """
    Search for a line between half and twice the frequency of a hump in one axis, block by block, at constant memory.

    Parameters
    ----------
    frequency : float
        Frequency of the hump, Hz.
    period : float
        Time between samples, s.
    column : int
        Axis: force x, y, z, then rate x, y, z.
    longest : float
        Duration of the longest rest, s.

    """

    def __init__(self, frequency: float, period: float, column: int, *, longest: float):
        self._frequency, self._column = frequency, column
        self._block = max(int(1 / (PER_CYCLE * frequency * period)), 1)
        self._step = self._block * period
        self._size = int(min(CYCLES / frequency, longest) / self._step) if longest * frequency >= FEWEST_CYCLES else 0
        self._power, self._count, self._samples = np.zeros(self._size // 2 + 1), 0, np.zeros(0)

    def push(self, values: np.ndarray, present: np.ndarray) -> None:
        """Add the next samples of a rest, shape (n, 6); missing ones are replaced by the mean."""
        from scipy.signal import periodogram  # here, because its import is slow

        if not self._size or not present.any():
            return
        self._samples = np.concatenate([self._samples, np.where(present, values[:, self._column], values[present, self._column].mean())])
        length = self._block * self._size
        while len(self._samples) >= length:
            segment, self._samples = self._samples[:length].reshape(self._size, self._block).mean(axis=1), self._samples[length:]
            self._power += periodogram(segment, window='hann', detrend='linear', scaling='spectrum')[1]
            self._count += 1

    def end_stretch(self) -> None:
        """Discard the incomplete segment: the next sample belongs to another rest."""
        self._samples = np.zeros(0)

    def line(self) -> tuple[float, float] | None:
        """Return (frequency in Hz, amplitude) of the most significant line, None without a significant one."""
        bins = np.arange(NEIGHBOURS, len(self._power) - NEIGHBOURS)
        hertz = 1 / (max(self._size, 1) * self._step)
        bins = bins[(bins * hertz >= 0.5 * self._frequency) & (bins * hertz <= 2 * self._frequency)]
        if not self._count or not len(bins):
            return None
        offsets = np.r_[-NEIGHBOURS:-LOBE, LOBE + 1:NEIGHBOURS + 1]
        around = self._power[bins[:, None] + offsets].mean(axis=1)
        ratio = self._power[bins] / around
        best = int(np.argmax(ratio))
        if not f_sf(ratio[best], 2 * self._count, 2 * self._count * len(offsets) * INDEPENDENT) * len(bins) < SIGNIFICANT:
            return None
        lobe = np.arange(bins[best] - LOBE, bins[best] + LOBE + 1)
        power = self._power[lobe]
        place = float(power @ lobe / power.sum()) * hertz
        square = max(power.sum() - len(lobe) * around[best], 0.0) / self._count * 2 * INDEPENDENT
        return place, float(np.sqrt(square) / np.sinc(place * self._step))
