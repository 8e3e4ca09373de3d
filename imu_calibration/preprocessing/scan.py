"""One pass over a recording in chunks: rest, and parts with frozen output."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.samples import AlignedArrays, runs_of, smallest_step
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.kinematics.sphere import Sphere, fit_sphere

CHUNK_SECONDS = 0.25
"""
s; short against turns by hand, long against the period of the samples; also the distance at which
temperatures are kept.
"""
MIN_CHUNK_SAMPLES, MAX_CHUNK_SAMPLES = 8, 2048
"""Samples per chunk."""
FIRST = 200
"""Samples from which the period is estimated."""
MAX_SCAN_CHUNKS = 40_000
"""Chunks kept, nearly three hours; later samples are counted but not checked."""


RESOLUTION_SAMPLES = 20_000
"""First samples, from which the smallest step between readings is estimated."""


@dataclass(frozen=True, eq=False)
class Chunks(AlignedArrays):
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
    step: np.ndarray
    """Median step between the stamps, s, shape (n,); a dropped sample does not change it."""
    size: int
    """Samples per chunk."""
    first_ns: int = 0
    """Stamp of the first sample, where `time` is zero."""


class ChunkSeries:
    """
    Cuts clean samples into chunks of equal number.

    The result does not depend on the division of the stream into blocks.

    Parameters
    ----------
    chunk_time : float
        Wanted length of a chunk, s.
    capacity : int
        Chunks kept.

    """

    def __init__(self, chunk_time: float = CHUNK_SECONDS, capacity: int = MAX_SCAN_CHUNKS):
        self.size: int | None = None
        """Samples of a chunk; None until the period is known."""
        self.n_samples = 0
        """Samples that were processed."""
        self.n_changed = np.zeros(6, np.int64)
        """Readings of each column that differ from the one before."""
        self.n_repeated = 0
        """Samples in which no column differs."""
        self._chunk_time = chunk_time
        self._capacity = capacity
        # Stamps and columns that do not fill a chunk yet.
        self._incomplete: tuple[np.ndarray, np.ndarray] | None = None
        self._first_ns: int | None = None
        # Columns of the last sample, shape (6, 1).
        self._last: np.ndarray | None = None
        self._parts: list[Chunks] = []
        self._n_chunks = 0

    def push(self, stamp_ns: np.ndarray, columns: np.ndarray) -> None:
        """
        Process clean samples of one epoch of the clock.

        Stamps, shape (n,), and force and rate, shape (6, n).
        """
        self._count_changes(columns)
        if self._incomplete is not None:
            stamp_ns = np.concatenate([self._incomplete[0], stamp_ns])
            columns = np.concatenate([self._incomplete[1], columns], axis=1)
        self._incomplete = (stamp_ns, columns)
        if self.size is None and len(stamp_ns) >= FIRST:
            self.size = _size(stamp_ns, self._chunk_time)
        if self.size is not None:
            self._cut()

    def chunks(self) -> Chunks:
        """Return the Chunks until now."""
        incomplete = self._incomplete
        if self.size is None and incomplete is not None and len(incomplete[0]) > MIN_CHUNK_SAMPLES:
            self.size = _size(incomplete[0], self._chunk_time)
            self._cut()
        if self._parts:
            return Chunks.concatenate(self._parts)
        none, no_columns = np.zeros(0), np.zeros((0, 6))
        size = self.size or MIN_CHUNK_SAMPLES
        return Chunks(none, none, no_columns, no_columns, no_columns, none, size)

    def _count_changes(self, columns: np.ndarray) -> None:
        """Count the readings that differ from the ones before, and the samples without any."""
        joined = columns if self._last is None else np.concatenate([self._last, columns], axis=1)
        changed = joined[:, 1:] != joined[:, :-1]
        self.n_changed += np.count_nonzero(changed, axis=1)
        self.n_repeated += changed.shape[1] - int(np.count_nonzero(changed.any(axis=0)))
        self.n_samples += columns.shape[1]
        self._last = columns[:, -1:].copy()

    def _cut(self) -> None:
        """Describe the complete chunks and buffer the incomplete one."""
        # Called with samples, after the size of a chunk is chosen.
        assert self._incomplete is not None and self.size is not None
        stamp_ns, columns = self._incomplete
        n = len(stamp_ns) // self.size
        used = n * self.size
        self._incomplete = stamp_ns[used:].copy(), columns[:, used:].copy()
        if not n or self._n_chunks >= self._capacity:
            return
        if self._first_ns is None:
            self._first_ns = int(stamp_ns[0])
        time = ((stamp_ns[:used] - self._first_ns) * 1e-9).reshape(n, self.size)
        values = columns[:, :used].reshape(6, n, self.size)
        self._parts.append(_describe(time, values, self._first_ns))
        self._n_chunks += n


def _size(stamps: np.ndarray, chunk_time: float) -> int:
    """Return the number of samples in `chunk_time` s, from the period of the first stamps, ns."""
    period = float(np.median(np.diff(stamps[:FIRST]))) * 1e-9
    return int(np.clip(round(chunk_time / max(period, 1e-6)), MIN_CHUNK_SAMPLES, MAX_CHUNK_SAMPLES))


def _describe(time: np.ndarray, values: np.ndarray, first_ns: int) -> Chunks:
    """Return chunks of samples at times, s, shape (n, size), with columns, shape (6, n, size)."""
    origin = values[:, :, :1].copy()
    values = values - origin  # avoids cancellation with large offsets
    mean = values.mean(axis=2)
    mean_square = np.einsum('ijk,ijk->ij', values, values) / values.shape[2]
    sd = np.sqrt(np.maximum(mean_square - mean**2, 0.0))
    extent = values.max(axis=2) - values.min(axis=2)
    size = time.shape[1]
    return Chunks(
        time=time.mean(axis=1),
        duration=(time[:, -1] - time[:, 0]) * size / (size - 1),
        mean=(mean + origin[:, :, 0]).T,
        sd=sd.T,
        range=extent.T,
        step=np.median(np.diff(time, axis=1), axis=1),
        size=size,
        first_ns=first_ns,
    )


LEAST_CHUNKS = 4
"""Chunks at rest, at least."""
MAX_CHUNK_TURN = 0.02
"""Largest turn of the measured gravity from one chunk to the next, rad."""


LEAST_POSES = 9
"""Rests from which on the sphere of their readings is used."""
LEAST_FACES = 6
"""Rests from which on a bias is estimated roughly."""
FARTHEST = 0.8
"""Bias in units of gravity from which on readings are no sphere but counts with an offset."""
LEAST_EIGENVALUE = 0.05
"""
Smallest eigenvalue of the scatter of directions (1/3 when they are even) above which poses separate
bias from length.
"""


@dataclass(frozen=True, eq=False)
class Rest:
    """Readings while steady: at rest, or in a rotation with constant direction of gravity."""

    force: np.ndarray
    """Mean specific force in each steady stretch, shape (n_stretches, 3)."""
    rate: np.ndarray
    """Median of the mean rate, shape (3,)."""
    range: np.ndarray
    """
    Median over the chunks at rest of largest minus smallest, force then rate, shape (6,); 0 where
    the noise does not show.
    """
    ranges: np.ndarray
    """First chunk of each stretch and the one after its last, shape (n_stretches, 2)."""

    @property
    def norm(self) -> np.ndarray:
        """Length of the specific force in each stretch, shape (n_stretches,)."""
        return np.linalg.norm(self.force, axis=1)

    @property
    def sphere(self) -> Sphere | None:
        """The sphere on which the readings of many poses lie; its centre is the bias; or None."""
        return self._sphere() if len(self.force) >= LEAST_POSES else None

    @property
    def bias(self) -> np.ndarray | None:
        """
        Bias of the accelerometer, to about a tenth of gravity; None with fewer than six rests.
        """
        sphere = self._sphere() if len(self.force) >= LEAST_FACES else None
        return None if sphere is None else sphere.centre

    def _sphere(self) -> Sphere | None:
        """Return the sphere fitted to the readings, or None where they do not determine it."""
        if not np.median(self.norm) > 0.0:  # an accelerometer that reads zero has no sphere
            return None
        sphere = fit_sphere(self.force)
        is_far = np.linalg.norm(sphere.centre) > FARTHEST * np.median(self.norm)
        return None if is_far or sphere.spread < LEAST_EIGENVALUE else sphere

    @property
    def length(self) -> float:
        """
        Gravity in the units of the accelerometer: the radius of the sphere, else the median length.
        """
        return float(np.median(self.norm)) if self.sphere is None else self.sphere.radius


def find_rest(chunks: Chunks) -> Rest | None:
    """Return the `Rest` of Chunks, or None when the sensor never rests (see `still_chunks`)."""
    still = still_chunks(chunks)
    if still.sum() < LEAST_CHUNKS:
        return None
    runs = _stretches(still)
    force = np.array([chunks.mean[a:b, :3].mean(axis=0) for a, b in runs])
    return Rest(
        force,
        np.median(chunks.mean[still, 3:], axis=0),
        np.median(chunks.range[still], axis=0),
        runs,
    )


def still_chunks(chunks: Chunks) -> np.ndarray:
    """
    Return in which chunks the sensor is at rest, bool, shape (n,).

    At rest both sensors scatter as little as in the quietest tenth, and gravity keeps its
    direction. Both are relative, so that counts and g do as well as m/s^2.
    """
    if len(chunks) < LEAST_CHUNKS:
        return np.zeros(len(chunks), bool)
    quiet = np.ones(len(chunks), bool)
    for part in SENSOR_COLUMNS.values():
        scatter = np.linalg.norm(chunks.sd[:, part], axis=1)
        quiet &= scatter <= 3.0 * np.quantile(scatter, 0.1) + 1e-3 * np.median(scatter)
    turn = np.linalg.norm(np.diff(unit_rows(chunks.mean[:, :3]), axis=0), axis=1)
    keeps_before = np.append(0.0, turn) < MAX_CHUNK_TURN
    keeps_after = np.append(turn, 0.0) < MAX_CHUNK_TURN
    still = quiet & keeps_before & keeps_after
    if still.sum() < LEAST_CHUNKS:
        return still
    # A spin at constant rate about the vertical is as quiet as rest, but has rates.
    rate_at_rest = np.median(chunks.mean[still, 3:], axis=0)
    rate = np.linalg.norm(chunks.mean[:, 3:] - rate_at_rest, axis=1)
    noise = np.median(np.linalg.norm(chunks.sd[still, 3:], axis=1))
    return still & (rate <= np.maximum(0.05 * rate.max(), 3.0 * noise))


def _stretches(still: np.ndarray) -> np.ndarray:
    """
    Return (start, stop) of each run of chunks at rest, shape (n, 2).

    Runs of one chunk are left out unless all have one: a short pause of a motion is no rest.
    """
    runs = runs_of(still)
    long_runs_only = runs[np.ptp(runs, axis=1) >= 2]
    return long_runs_only if len(long_runs_only) else runs


SENSOR_COLUMNS = {'accelerometer': slice(0, 3), 'gyroscope': slice(3, 6)}
"""Sensor -> its columns in (force x, y, z, rate x, y, z)."""
LONG_RUN_CHUNKS = 4
"""Chunks of a long run, at least: one second."""
MIN_NOISE_STEPS = 2.0
"""
A sensor with a noise at rest of at least this many converter steps in a chunk is not constant on
three axes for a second.
"""
MIN_TURN_RATE = 0.1
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
    """Return (start, stop) of the runs of at least `LONG_RUN_CHUNKS` true flags, shape (n, 2)."""
    runs = runs_of(flags)
    return runs[np.ptp(runs, axis=1) >= LONG_RUN_CHUNKS]


def in_long_runs(flags: np.ndarray) -> np.ndarray:
    """Return the flags without runs of fewer than `LONG_RUN_CHUNKS`."""
    is_in_long_run = np.zeros(len(flags), bool)
    for start, stop in long_runs(flags):
        is_in_long_run[start:stop] = True
    return is_in_long_run


def frozen_chunks(chunks: Chunks, resolution: np.ndarray) -> dict[str, np.ndarray]:
    """
    Return sensor -> whether it is frozen in each chunk, bool, shape (n,).

    A sensor with visible noise at rest never repeats one reading on three axes for a second. A
    sensor with steps coarser than its noise, or without noise, does so at every rest: the constant
    stretches then outnumber the rests with noise, and none is reported.

    Parameters
    ----------
    chunks : Chunks
        Of the whole recording.
    resolution : array, shape (6,)
        Smallest step between readings of each column.

    """
    constant = {}
    for sensor, part in SENSOR_COLUMNS.items():
        flags = (chunks.range[:, part] == 0).all(axis=1)
        if flags.all():  # an absent sensor, or one without any reading: no part of it is frozen
            flags = np.zeros(len(chunks), bool)
        constant[sensor] = flags
    frozen = {sensor: in_long_runs(flags) for sensor, flags in constant.items()}
    # The noise at rest, from chunks in which neither sensor is constant; only needed for a sensor
    # that may be frozen.
    rest = None
    if np.logical_or(*frozen.values()).any():
        rest = find_rest(chunks.select(~np.logical_or(*constant.values())))
    # Without a verdict on a sensor:
    for sensor, part in SENSOR_COLUMNS.items():
        if (
            # The noise at rest is not known, or is zero, or is below the steps of the converter.
            rest is None
            or not rest.range[part].all()
            or (rest.range[part] < MIN_NOISE_STEPS * resolution[part]).any()
            # Most rests are constant.
            or len(runs_of(frozen[sensor])) > len(rest.force)
        ):
            frozen[sensor] = np.zeros(len(chunks), bool)
    return frozen


def frozen_parts(chunks: Chunks, frozen: dict[str, np.ndarray]) -> list[FrozenPart]:
    """Return the stretches of `frozen_chunks` in order of time."""
    parts = []
    for sensor, flags in frozen.items():
        for start, stop in long_runs(flags):
            parts.append(_part(chunks, sensor, start, stop))
    return sorted(parts, key=lambda part: part.start)


class ResolutionSearch:
    """The smallest step between readings of each column, from the first samples of a stream."""

    def __init__(self) -> None:
        self._n_samples = 0
        # Smallest step so far, infinite where no reading has changed.
        self._step = np.full(6, np.inf)

    def push(self, readings: np.ndarray) -> None:
        """Process the next readings, shape (n, 6)."""
        if self._n_samples < RESOLUTION_SAMPLES:
            self._step = np.minimum(self._step, smallest_step(readings[:RESOLUTION_SAMPLES]))
        self._n_samples += len(readings)

    def result(self) -> np.ndarray:
        """Return the smallest step of each column, shape (6,); 0 where no reading changes."""
        return np.where(np.isfinite(self._step), self._step, 0.0)


class FrozenSearch:
    """Searches raw readings for parts with frozen output, in bounded memory."""

    def __init__(self) -> None:
        self._series = ChunkSeries()
        self._resolution = ResolutionSearch()

    def push(self, stamp_ns: np.ndarray, force: np.ndarray, rate: np.ndarray) -> None:
        """Process readings in order of arrival: stamps, shape (n,), and two arrays (n, 3)."""
        readings = np.concatenate([force, rate], axis=1)
        finite = np.isfinite(readings).all(axis=1)
        if not finite.any():
            return
        readings = readings[finite]
        self._resolution.push(readings)
        self._series.push(stamp_ns[finite], readings.T)

    def parts(self) -> list[FrozenPart]:
        """Return the parts with frozen output until now, in order of time."""
        chunks = self._series.chunks()
        return frozen_parts(chunks, frozen_chunks(chunks, self._resolution.result()))


def frozen_joints(
    chunks: Chunks, still_ns: np.ndarray, rate_at_rest: np.ndarray
) -> list[FrozenPart]:
    """
    Return the stretches in which all joint positions are constant for a second while the IMU turns.

    Parameters
    ----------
    chunks : Chunks
        Without chunks in which the gyroscope is frozen.
    still_ns : array, shape (n, 2)
        First and last stamp of each stretch in which no joint position changes.
    rate_at_rest : array, shape (3,)
        Reading of the gyroscope at rest, rad/s; its most frequent reading with constant joints if
        that explains more (spins about the vertical are as steady as rests).

    """
    chunk_start = chunks.time - chunks.duration / 2
    chunk_stop = chunks.time + chunks.duration / 2
    joints_rest = np.zeros(len(chunks), bool)
    for start, stop in (still_ns - chunks.first_ns) * 1e-9:  # s, as the times of the chunks
        joints_rest |= (chunk_start >= start) & (chunk_stop <= stop)
    if not joints_rest.any():
        return []
    rates = chunks.mean[:, 3:]
    usual_rate = np.median(rates[joints_rest], axis=0)
    contradicts = joints_rest & (np.linalg.norm(rates - rate_at_rest, axis=1) > MIN_TURN_RATE)
    # Spins about the vertical are as steady as rests, and `rate_at_rest` may be that of a spin.
    contradicts_usual = joints_rest & (np.linalg.norm(rates - usual_rate, axis=1) > MIN_TURN_RATE)
    if np.count_nonzero(contradicts_usual) < np.count_nonzero(contradicts):
        contradicts = contradicts_usual
    return [_part(chunks, 'joints', start, stop) for start, stop in long_runs(contradicts)]


def _part(chunks: Chunks, who: str, start: int, stop: int) -> FrozenPart:
    """Return the stretch from chunk `start` to before chunk `stop`."""
    return FrozenPart(
        who,
        max(float(chunks.time[start] - chunks.duration[start] / 2), 0.0),
        float(chunks.time[stop - 1] + chunks.duration[stop - 1] / 2),
        int((stop - start) * chunks.size),
    )


class StandingJoints:
    """
    Records, in bounded memory, the stretches of at least half a second with constant joints.

    No joint position changes in them.
    """

    LEAST_NS = 500_000_000
    CAPACITY = 10_000

    def __init__(self) -> None:
        # First and last stamp of the complete long stretches, (n, 2), and of the newest stretch.
        self._complete_stretches = np.zeros((0, 2), np.int64)
        self._newest_stretch = np.zeros((1, 2), np.int64)
        # Positions of the last sample.
        self._last = np.zeros(0)

    def push(self, stamp_ns: np.ndarray, position: np.ndarray) -> None:
        """
        Process joint samples in order: stamps, shape (n,), and positions, shape (n, n_joints).
        """
        if len(self._last) != position.shape[1]:
            self._last = np.full(position.shape[1], np.nan)  # differs from any position
        position_before = np.concatenate([self._last[None], position[:-1]])
        starts = np.flatnonzero(np.any(position != position_before, axis=1))
        # A stretch ends with the sample before the next start; `stamp_before[k]` is the stamp of
        # sample k - 1.
        stamp_before = np.append(self._newest_stretch[0, 1], stamp_ns)
        first_ns = np.append(self._newest_stretch[0, 0], stamp_ns[starts])
        last_ns = stamp_before[np.append(starts, len(stamp_ns))]
        stretches = np.column_stack([first_ns, last_ns])
        complete = np.concatenate([self._complete_stretches, self._long(stretches[:-1])])
        self._complete_stretches = complete[: self.CAPACITY]
        self._newest_stretch = stretches[-1:]
        self._last = position[-1].copy()

    def stretches(self) -> np.ndarray:
        """Return first and last stamp of each stretch until now, shape (n, 2)."""
        return np.concatenate([self._complete_stretches, self._long(self._newest_stretch)])

    def _long(self, stretches: np.ndarray) -> np.ndarray:
        """Return the stretches of at least `LEAST_NS`."""
        return stretches[np.ptp(stretches, axis=1) >= self.LEAST_NS]
