"""The largest outputs of a stream and how often each was read: a range that is too small shows as a pile at its end."""

import numpy as np

KEPT = 24
"""Different outputs below the largest that are counted."""
NEAR = 0.9
"""Outputs above this share of the largest are looked at."""
CANDIDATES = 400
LEAST_CLIPPED = 4
PILE = 5.0
"""A pile has this many times the samples of the outputs just below it."""


class Extremes:
    """The largest distinct values of one signal with their counts, in bounded memory."""

    def __init__(self):
        self.level, self.count = -np.inf, 0
        self._below = {}

    def push(self, values):
        """Take values, shape (n,)."""
        largest = values.max()
        if largest <= 0 or largest < NEAR * self.level:
            return
        if largest > self.level:
            if np.isfinite(self.level):
                self._below[self.level] = self.count
            self.level, self.count = float(largest), 0
        self.count += int(np.count_nonzero(values == self.level))
        near = values[(values < self.level) & (values > NEAR * self.level)]
        if len(near) > CANDIDATES:
            near = np.partition(near, len(near) - CANDIDATES)[-CANDIDATES:]
        for value, count in zip(*np.unique(near, return_counts=True)):
            self._below[float(value)] = self._below.get(float(value), 0) + int(count)
        self._below = dict(sorted(self._below.items(), reverse=True)[:KEPT])

    @property
    def n_clipped(self):
        """Samples at the largest value when they are a pile, else 0."""
        counts = [count for value, count in self._below.items() if value > NEAR * self.level][:10]
        usual = sum(counts) / len(counts) if counts else 1.0
        return self.count if self.count >= max(LEAST_CLIPPED, PILE * usual) else 0
