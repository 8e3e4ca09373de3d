"""The largest outputs of a stream and how often each was read: a range that is too small shows as a pile at its end."""

import numpy as np

KEPT = 24
"""Different outputs below the largest that are counted."""
NEAR = 0.9
"""Outputs above this share of the largest are evaluated."""
CANDIDATES = 400
LEAST_CLIPPED = 4
JUMP = 0.01
"""A step to the largest value by more than this share of it is not noise."""
PILE = 5.0
"""A pile has this many times the samples of the outputs just below it."""


class Extremes:
    """The largest distinct values of one signal with their counts, in bounded memory."""

    def __init__(self) -> None:
        self.level, self.count, self.n_jumps = -np.inf, 0, 0
        self._below, self._last = {}, np.inf

    def push(self, values: np.ndarray) -> None:
        """Process values, shape (n,)."""
        before, self._last = self._last, values[-1]
        largest = values.max()
        if largest <= 0 or largest < NEAR * self.level:
            return
        if largest > self.level:
            if np.isfinite(self.level):
                self._below[self.level] = self.count
            self.level, self.count, self.n_jumps = float(largest), 0, 0
        near = values[values > NEAR * self.level]
        below = near < self.level
        self.count += len(near) - int(np.count_nonzero(below))
        near = near[below]
        if largest == self.level:
            at = np.flatnonzero(values == largest)
            self.n_jumps += int(np.count_nonzero(np.where(at > 0, values[at - 1], before) < (1 - JUMP) * largest))
        if len(near) > CANDIDATES:
            near = np.partition(near, len(near) - CANDIDATES)[-CANDIDATES:]
        for value, count in zip(*np.unique(near, return_counts=True)):
            self._below[float(value)] = self._below.get(float(value), 0) + int(count)
        self._below = dict(sorted(self._below.items(), reverse=True)[:KEPT])

    @property
    def jumped(self) -> bool:
        """Whether the largest value was often reached by a large step, which does not occur with rounded readings of a constant."""
        return self.n_jumps >= LEAST_CLIPPED

    @property
    def n_clipped(self) -> int:
        """Samples at the largest value if their number is far above that of neighbouring values, else 0."""
        counts = [count for value, count in self._below.items() if value > NEAR * self.level][:10]
        usual = sum(counts) / len(counts) if counts else 1.0
        return self.count if self.count >= max(LEAST_CLIPPED, PILE * usual) else 0
