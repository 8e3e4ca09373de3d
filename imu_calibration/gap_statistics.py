"""Steps between stamps, summed up in constant memory."""

import numpy as np

_BINS_PER_E = 100
_N_BINS = 4500
"""One per cent wide, up to the longest step that 64 bits of nanoseconds hold."""
_FINE_STEP_NS = 100


class StepHistogram:
    """Numbers and sums of steps in bins of equal ratio; adding pieces in any order gives the same numbers."""

    def __init__(self):
        self.common_step_ns = 0
        self._number = np.zeros(_N_BINS, np.int64)
        self._sum_ns = np.zeros(_N_BINS, np.int64)
        self._longest_ns = 0

    def add(self, step_ns):
        """Add steps, int64, ns, all positive."""
        if not len(step_ns):
            return
        index = (np.log(step_ns) * _BINS_PER_E).astype(np.int64)
        np.add.at(self._number, index, 1)
        np.add.at(self._sum_ns, index, step_ns)
        self._longest_ns = max(self._longest_ns, int(step_ns.max()))
        if self.common_step_ns == 0 or self.common_step_ns > _FINE_STEP_NS:
            self.common_step_ns = int(np.gcd(self.common_step_ns, np.gcd.reduce(step_ns)))

    def median(self):
        """Return the median step to one per cent (exact when the steps are equal), s; 0 without steps."""
        total = self._number.sum()
        if total == 0:
            return 0.0
        middle = np.searchsorted(np.cumsum(self._number), (total + 1) // 2)
        return float(self._sum_ns[middle] / self._number[middle] / 1e9)

    def longer_than(self, gap):
        """Return number and total (s) of the steps longer than `gap` s, bin by bin, and the longest step (s)."""
        filled = np.maximum(self._number, 1)
        longer = self._sum_ns / filled > gap * 1e9
        return int(self._number[longer].sum()), float(self._sum_ns[longer].sum() / 1e9), self._longest_ns / 1e9
