"""A clock fitted to loosely related stamps: samples are numbered, including the lost ones."""

import numpy as np

from imu_calibration.segmentation.stamping import LAG, LATE, PAUSE_NS, StampLine

BLOCK = LAG
"""Samples that give one point of the clock."""
REACH = 32
"""Samples on both sides of a long step that decide between lost and late samples; packets are smaller."""
LOST = 0.6
"""Samples were lost at a long step if the clock is ahead by more than this share of a period after it, relative to before."""
FOLLOW = 0.05
"""A period that has changed by more than this share is another one; smaller changes are averaged."""
SLOW = 0.1
"""Weight of a new block in that average."""


class CountedClock:
    """
    Times of samples from their stamps, in order: each block of 64 gives one point; the times are interpolated linearly between points.

    The points are those of the earliest stamps where stamps are times of arrival, which can only be late, otherwise the means. The
    result does not depend on the division of the stamps into blocks.

    Parameters
    ----------
    line : StampLine
        Current estimate of the relation of the stamps to the sampling.

    """

    def __init__(self, line: StampLine):
        self._period, self._arrivals = line.period_ns, line.arrivals
        self._margin = LOST * line.period_ns + (0.0 if line.arrivals else 0.25 * (line.high_ns - line.low_ns))
        self._raw, self._times = np.zeros(0, np.int64), [np.zeros(0, np.int64)]
        self._begin()

    def _begin(self) -> None:
        """Reset everything except the period."""
        self._origin_ns: int | None = None
        self._next = 0.0
        self._before = np.zeros((2, 0))
        self._block: np.ndarray | None = None
        self._points: list[tuple[float, float]] = []

    def push(self, stamp_ns: np.ndarray) -> None:
        """Add stamps in the order of arrival."""
        self._raw = np.concatenate([self._raw, stamp_ns])

    def take(self, final: bool = False) -> np.ndarray:
        """Return the times that are determined now (all with `final`), int64, ns, in the order of the stamps."""
        while len(self._raw) >= BLOCK + REACH or (final and len(self._raw)):
            pause = np.flatnonzero(np.diff(self._raw[:BLOCK + REACH]) > PAUSE_NS)
            end = len(self._raw) if not len(pause) else int(pause[0]) + 1
            self._work(self._raw[:min(BLOCK, end)], self._raw[min(BLOCK, end):min(BLOCK + REACH, end)])
            self._raw = self._raw[min(BLOCK, end):]
            if len(pause) and end <= BLOCK:
                self._finish()
        if final:
            self._finish()
        times, self._times = np.concatenate(self._times), [np.zeros(0, np.int64)]
        return times

    def _work(self, stamp_ns: np.ndarray, ahead_ns: np.ndarray) -> None:
        """Number a block, compute its point, and compute the times of the block before it."""
        if self._origin_ns is None:
            self._origin_ns = int(stamp_ns[0])
        stamp = (np.concatenate([stamp_ns, ahead_ns]) - self._origin_ns).astype(float)
        number = self._numbered(stamp, len(stamp_ns))
        stamp = stamp[:len(stamp_ns)]
        self._before = np.stack([np.concatenate([self._before[0], number]), np.concatenate([self._before[1], stamp])])[:, -REACH:]
        self._next = number[-1] + 1
        if len(number) >= BLOCK // 2 or not self._points:   # the few samples of a shorter one may all be late
            late = stamp - self._period * number
            usual = late.min() if self._arrivals else late.mean()
            self._points.append((float(number.mean()), float(usual + self._period * number.mean())))
        if self._block is not None:
            self._tell(self._block)
            self._follow()
        self._block = number

    def _numbered(self, stamp: np.ndarray, count: int) -> np.ndarray:
        """Return the numbers of the first `count` samples: increments of one, plus the number of samples lost at a long step."""
        middle = np.min if self._arrivals else np.median
        number = self._next + np.arange(len(stamp))
        step = np.diff(stamp, prepend=self._before[1, -1] if self._before.shape[1] else stamp[0])
        for k in np.flatnonzero(step[:count] > LATE * self._period):
            past = np.concatenate([self._before[1] - self._period * self._before[0], stamp[:k] - self._period * number[:k]])[-REACH:]
            if len(past):
                jump = middle(stamp[k:k + REACH] - self._period * number[k:k + REACH]) - middle(past)
                number[k:] += np.round(jump / self._period) if jump > self._margin else 0.0
        return number[:count]

    def _tell(self, number: np.ndarray) -> None:
        """Compute the times of a block, from its point and the points of its neighbours."""
        points = np.array(self._points)
        ends = (points[0] - (BLOCK, BLOCK * self._period), points[-1] + (BLOCK, BLOCK * self._period))
        points = np.vstack([ends[0], points, ends[1]])
        times = np.interp(number, points[:, 0], points[:, 1])
        self._times.append(self._origin_ns + np.rint(times).astype(np.int64))

    def _follow(self) -> None:
        """Update the period; keep the last two points."""
        if len(self._points) < 2:
            return
        (n0, t0), (n1, t1) = self._points[-2:]
        period = (t1 - t0) / (n1 - n0)
        self._period = period if abs(period - self._period) > FOLLOW * self._period else self._period + SLOW * (period - self._period)
        self._points = self._points[-2:]

    def _finish(self) -> None:
        """Compute the remaining times, and reset."""
        if self._block is not None:
            self._tell(self._block)
        self._begin()
