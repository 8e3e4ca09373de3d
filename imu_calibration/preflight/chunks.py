"""A stream of IMU samples as short chunks: mean, scatter and range of each, in bounded memory."""

from dataclasses import dataclass

import numpy as np

CHUNK_TIME = 0.25
"""s; short against turns by hand, long against the period of the samples."""
LEAST, MOST = 8, 2048
"""Samples per chunk."""
FIRST = 200
"""Samples that tell the period."""
CAPACITY = 40_000
"""Chunks kept, nearly three hours; what comes later is counted but not looked at."""


@dataclass(frozen=True, eq=False)
class Chunks:
    """Chunks in order of time; columns are force x, y, z, then rate x, y, z."""

    time: np.ndarray
    """Mean stamp, s since the first sample, shape (n,)."""
    duration: np.ndarray
    """Mean step times the number of samples, s, shape (n,)."""
    mean: np.ndarray
    """Shape (n, 6)."""
    sd: np.ndarray
    """Shape (n, 6)."""
    range: np.ndarray
    """Largest minus smallest, shape (n, 6)."""
    size: int
    """Samples per chunk."""

    def __len__(self):
        return len(self.time)


class ChunkSeries:
    """Cuts clean samples into chunks of equal number; how the stream was cut into blocks does not matter."""

    def __init__(self):
        self.size = None
        self.n_samples = 0
        self.n_changed = np.zeros(6, np.int64)
        self.n_repeated = 0
        self._rest, self._first_ns, self._last = None, None, None
        self._parts, self._n_chunks = [], 0

    def push(self, imu):
        """Take clean ImuSamples of one epoch of the clock."""
        values = np.concatenate([imu.force_s, imu.rate_s], axis=1)
        self._count_changes(values)
        stamps = imu.stamp_ns
        if self._rest is not None:
            stamps, values = np.concatenate([self._rest[0], stamps]), np.concatenate([self._rest[1], values])
        self._rest = (stamps, values)
        if self.size is None and len(stamps) >= FIRST:
            self.size = _size(stamps)
        if self.size is not None:
            self._cut()

    def chunks(self):
        """Return the Chunks until now."""
        if self.size is None and self._rest is not None and len(self._rest[0]) > LEAST:
            self.size = _size(self._rest[0])
            self._cut()
        parts = self._parts or [(np.zeros(0), np.zeros(0), *(np.zeros((0, 6)) for _ in range(3)))]
        return Chunks(*(np.concatenate(column) for column in zip(*parts, strict=True)), self.size or LEAST)

    def _count_changes(self, values):
        before = values if self._last is None else np.concatenate([self._last, values])
        changed = before[1:] != before[:-1]
        self.n_changed += np.count_nonzero(changed, axis=0)
        self.n_repeated += len(changed) - int(np.count_nonzero(changed.any(axis=1)))
        self.n_samples += len(values)
        self._last = values[-1:]

    def _cut(self):
        stamps, values = self._rest
        n = len(stamps) // self.size
        used = n * self.size
        self._rest = stamps[used:].copy(), values[used:].copy()
        if not n or self._n_chunks >= CAPACITY:
            return
        if self._first_ns is None:
            self._first_ns = stamps[0]
        self._parts.append(_describe(((stamps[:used] - self._first_ns) * 1e-9).reshape(n, self.size), values[:used].reshape(n, self.size, 6)))
        self._n_chunks += n


def _size(stamps):
    period = float(np.median(np.diff(stamps[:FIRST]))) * 1e-9
    return int(np.clip(round(CHUNK_TIME / max(period, 1e-6)), LEAST, MOST))


def _describe(time, values):
    values = np.ascontiguousarray(np.moveaxis(values, 2, 1))   # sums run fastest along the last axis
    start = values[:, :, :1].copy()
    values -= start   # counts far from zero would cancel
    mean = values.mean(axis=2)
    sd = np.sqrt(np.maximum(np.einsum('ijk,ijk->ij', values, values) / values.shape[2] - mean**2, 0.0))
    size = time.shape[1]
    return time.mean(axis=1), (time[:, -1] - time[:, 0]) * size / (size - 1), mean + start[:, :, 0], sd, values.max(axis=2) - values.min(axis=2)
