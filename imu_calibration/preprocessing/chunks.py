"""A stream of IMU samples as short chunks: mean, scatter and range of each, in bounded memory."""

from dataclasses import dataclass, replace

import numpy as np

CHUNK_TIME = 0.25
"""s; short against turns by hand, long against the period of the samples."""
LEAST, MOST = 8, 2048
"""Samples per chunk."""
FIRST = 200
"""Samples from which the period is estimated."""
CAPACITY = 40_000
"""Chunks kept, nearly three hours; later samples are counted but not checked."""


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
    first_ns: int = 0
    """Stamp of the first sample, where `time` is zero."""

    def __len__(self) -> int:
        return len(self.time)

    def select(self, keep: np.ndarray) -> 'Chunks':
        """Return the chunks at a mask."""
        return replace(self, **{name: getattr(self, name)[keep] for name in ('time', 'duration', 'mean', 'sd', 'range')})


class ChunkSeries:
    """
    Cuts clean samples into chunks of equal number; how the stream was cut into blocks does not matter.

    Parameters
    ----------
    chunk_time : float
        Wanted length of a chunk, s.
    capacity : int
        Chunks kept.

    """

    def __init__(self, chunk_time: float = CHUNK_TIME, capacity: int = CAPACITY):
        self.size, self._chunk_time, self._capacity = None, chunk_time, capacity
        self.n_samples = 0
        self.n_changed = np.zeros(6, np.int64)
        self.n_repeated = 0
        self._rest: tuple[np.ndarray, np.ndarray] | None = None
        self._first_ns, self._last = None, None
        self._parts, self._n_chunks = [], 0

    def push(self, stamp_ns: np.ndarray, columns: np.ndarray) -> None:
        """Process clean samples of one epoch of the clock: stamps, shape (n,), and force and rate, shape (6, n)."""
        self._count_changes(columns)
        if self._rest is not None:
            stamp_ns, columns = np.concatenate([self._rest[0], stamp_ns]), np.concatenate([self._rest[1], columns], axis=1)
        self._rest = (stamp_ns, columns)
        if self.size is None and len(stamp_ns) >= FIRST:
            self.size = _size(stamp_ns, self._chunk_time)
        if self.size is not None:
            self._cut()

    def chunks(self) -> Chunks:
        """Return the Chunks until now."""
        if self.size is None and self._rest is not None and len(self._rest[0]) > LEAST:
            self.size = _size(self._rest[0], self._chunk_time)
            self._cut()
        parts = self._parts or [(np.zeros(0), np.zeros(0), *(np.zeros((0, 6)) for _ in range(3)))]
        time, duration, mean, sd, extent = (np.concatenate(column) for column in zip(*parts, strict=True))
        return Chunks(time, duration, mean, sd, extent, self.size or LEAST, int(self._first_ns or 0))

    def _count_changes(self, columns):
        if self._last is not None:
            changed = columns[:, :1] != self._last
            self.n_changed += changed[:, 0]
            self.n_repeated += not changed.any()
        changed = columns[:, 1:] != columns[:, :-1]
        self.n_changed += np.count_nonzero(changed, axis=1)
        self.n_repeated += changed.shape[1] - int(np.count_nonzero(changed.any(axis=0)))
        self.n_samples += columns.shape[1]
        self._last = columns[:, -1:].copy()

    def _cut(self):
        stamp_ns, columns = self._rest
        n = len(stamp_ns) // self.size
        used = n * self.size
        self._rest = stamp_ns[used:].copy(), columns[:, used:].copy()
        if not n or self._n_chunks >= self._capacity:
            return
        if self._first_ns is None:
            self._first_ns = stamp_ns[0]
        self._parts.append(_describe(((stamp_ns[:used] - self._first_ns) * 1e-9).reshape(n, self.size),
                                     columns[:, :used].reshape(6, n, self.size)))
        self._n_chunks += n


def _size(stamps, chunk_time):
    period = float(np.median(np.diff(stamps[:FIRST]))) * 1e-9
    return int(np.clip(round(chunk_time / max(period, 1e-6)), LEAST, MOST))


def _describe(time, values):
    start = values[:, :, :1].copy()
    values = values - start   # avoids cancellation with large offsets
    mean = values.mean(axis=2)
    sd = np.sqrt(np.maximum(np.einsum('ijk,ijk->ij', values, values) / values.shape[2] - mean**2, 0.0))
    size = time.shape[1]
    spread = values.max(axis=2) - values.min(axis=2)
    return time.mean(axis=1), (time[:, -1] - time[:, 0]) * size / (size - 1), (mean + start[:, :, 0]).T, sd.T, spread.T
