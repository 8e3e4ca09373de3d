"""Stretches in which a sensor with noise repeats one reading, or in which all joint positions are constant while the IMU turns."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import runs_of
from imu_calibration.preprocessing.chunks import Chunks
from imu_calibration.preprocessing.rest import find_rest

SENSOR_COLUMNS = {'accelerometer': slice(0, 3), 'gyroscope': slice(3, 6)}
LONG = 4
"""Chunks, one second."""
STEPS = 2.0
"""A sensor with a noise at rest of at least this many converter steps in a chunk is not constant on three axes for a second."""
TURNS = 0.1
"""Mean rate of a chunk from which on the IMU turns, rad/s."""


@dataclass(frozen=True, eq=False)
class FrozenPart:
    """One stretch without new readings."""

    who: str
    """'accelerometer', 'gyroscope' or 'joints'."""
    start: float
    """s since the first Imu sample."""
    stop: float
    """The same, of its end."""
    samples: int
    """Imu samples in it."""


def long_runs(flags: np.ndarray) -> np.ndarray:
    """Return (start, stop) of the runs of at least `LONG` true flags, shape (n, 2)."""
    runs = runs_of(flags)
    return runs[np.ptp(runs, axis=1) >= LONG]


def frozen_chunks(chunks: Chunks, resolution: np.ndarray) -> dict[str, np.ndarray]:
    """
    Return sensor -> which chunks it is frozen in, bool, shape (n,).

    A sensor with visible noise at rest never repeats one reading on three axes for a second. A sensor with steps coarser than its noise,
    or without noise, does so at every rest: the constant stretches then outnumber the rests with noise, and none is reported.

    Parameters
    ----------
    chunks : Chunks
        Of the whole recording.
    resolution : array, shape (6,)
        Smallest step between readings of each column.

    """
    flat = {sensor: (chunks.range[:, part] == 0).all(axis=1) for sensor, part in SENSOR_COLUMNS.items()}
    runs = {sensor: long_runs(flags) for sensor, flags in flat.items()}
    found = {sensor: np.zeros(len(chunks), bool) for sensor in SENSOR_COLUMNS}
    if not any(map(len, runs.values())):
        return found
    rest = find_rest(chunks.select(~np.logical_or(*flat.values())))
    if rest is None:
        return found
    for sensor, part in SENSOR_COLUMNS.items():
        noisy = (rest.range[part] >= STEPS * resolution[part]).all() and (rest.range[part] > 0).all()
        if noisy and len(runs[sensor]) <= len(rest.force):
            for start, stop in runs[sensor]:
                found[sensor][start:stop] = True
    return found


def frozen_parts(chunks: Chunks, frozen: dict[str, np.ndarray]) -> list[FrozenPart]:
    """Return the stretches of `frozen_chunks` in order of time."""
    parts = [_part(chunks, sensor, start, stop) for sensor, flags in frozen.items() for start, stop in long_runs(flags)]
    return sorted(parts, key=lambda part: part.start)


def frozen_joints(chunks: Chunks, still_ns: np.ndarray, rate_at_rest: np.ndarray) -> list[FrozenPart]:
    """
    Return the stretches in which all joint positions are constant for a second while the IMU turns.

    Parameters
    ----------
    chunks : Chunks
        Without chunks in which the gyroscope is frozen.
    still_ns : array, shape (n, 2)
        First and last stamp of each stretch in which no joint position changes.
    rate_at_rest : array, shape (3,)
        Reading of the gyroscope at rest, rad/s; its most frequent reading with constant joints if that explains more (spins about
        the vertical are as steady as rests).

    """
    inside = np.zeros(len(chunks), bool)
    for start, stop in (still_ns - chunks.first_ns) * 1e-9:
        inside |= (chunks.time - chunks.duration / 2 >= start) & (chunks.time + chunks.duration / 2 <= stop)
    if not inside.any():
        return []
    rates = chunks.mean[:, 3:]
    turning = min((np.linalg.norm(rates - rate, axis=1) > TURNS for rate in (rate_at_rest, np.median(rates[inside], axis=0))),
                  key=lambda flags: np.count_nonzero(flags & inside))
    return [_part(chunks, 'joints', start, stop) for start, stop in long_runs(turning & inside)]


def _part(chunks, who, start, stop):
    return FrozenPart(who, float(chunks.time[start] - chunks.duration[start] / 2),
                      float(chunks.time[stop - 1] + chunks.duration[stop - 1] / 2),
                      int((stop - start) * chunks.size))


class StandingJoints:
    """Notes, in bounded memory, in which stretches of more than half a second no joint position changes."""

    LEAST_NS = 500_000_000
    CAPACITY = 10_000

    def __init__(self) -> None:
        self._found: list[tuple[int, int]] = []
        self._last: np.ndarray | None = None
        self._since, self._until = 0, 0

    def push(self, stamp_ns: np.ndarray, position: np.ndarray) -> None:
        """Process joint samples in order: stamps, shape (n,), and positions, shape (n, n_joints)."""
        if self._last is not None and len(self._last) != position.shape[1]:
            self._close()
            self._last = None
        before = position[:1] if self._last is None else self._last[None]
        changed = np.any(position != np.concatenate([before, position[:-1]]), axis=1)
        if self._last is None:
            changed[0] = True
        starts = np.flatnonzero(changed)
        for k, start in enumerate(starts):
            if k == 0 and start > 0:
                self._until = int(stamp_ns[start - 1])
            self._close()
            stop = starts[k + 1] if k + 1 < len(starts) else len(stamp_ns)
            self._since, self._until = int(stamp_ns[start]), int(stamp_ns[stop - 1])
        if not len(starts):
            self._until = int(stamp_ns[-1])
        self._last = position[-1].copy()

    def stretches(self) -> np.ndarray:
        """Return first and last stamp of each stretch until now, shape (n, 2)."""
        open_one = [] if self._until - self._since < self.LEAST_NS else [(self._since, self._until)]
        return np.array(self._found + open_one, np.int64).reshape(-1, 2)

    def _close(self):
        if self._until - self._since >= self.LEAST_NS and len(self._found) < self.CAPACITY:
            self._found.append((self._since, self._until))
