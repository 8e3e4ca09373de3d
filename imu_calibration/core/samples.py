"""Arrays of samples from a bag or a topic, independent of messages and files."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.errors import InputError, shortened

FIRST_NS = 1_000_000_000
"""
Stamp of the first sample where times do not count from an epoch: a stamp of zero means unset in
ROS.
"""
EPOCH = 1e8
"""s; larger times count from 1970."""


LEAST_NS_STEP = 1000
"""Integer times with this median step or more are nanoseconds: no IMU is read every 1000 s."""
LEAST_STEP, LARGEST_STEP = 5e-5, 1.0
"""Limits of the median step of the times of an IMU, s; beyond them the unit is another one."""


def _times_of(time: ArrayLike) -> np.ndarray:
    """Return times as numbers: datetime64 as integer ns, objects with the type of their values."""
    times = np.asarray(time)
    if times.dtype == object:
        times = np.asarray(times.tolist())
    if times.dtype.kind == 'M':
        missing = np.isnat(times)
        times = times.astype('datetime64[ns]').astype(np.int64)
        times = np.where(missing, np.nan, times) if missing.any() else times
    return times


def _stamps_of_any(time: np.ndarray) -> np.ndarray:
    """Return stamps of times in s, or of integers with the steps of nanoseconds; ns, int64."""
    # The typical step shows the unit of integers.
    is_integer = np.issubdtype(time.dtype, np.integer)
    steps = np.diff(time.astype(np.int64) if is_integer else time)
    step = float(np.median(np.abs(steps))) if len(steps) else LEAST_STEP
    in_ns = is_integer and step >= LEAST_NS_STEP
    seconds = step * 1e-9 if in_ns else step
    if not LEAST_STEP <= seconds <= LARGEST_STEP:
        raise InputError(
            'times must be in s, or integers in ns, with a median step of'
            f' {LEAST_STEP:g} to {LARGEST_STEP:g} s, got {seconds:g} s; convert them',
            code='time_unit',
        )
    if not in_ns:
        return stamps_of(time)
    # In integers, because floats do not hold nanoseconds since 1970.
    time_ns = time.astype(np.int64)
    start_ns = int(time_ns[0]) if time_ns[0] > EPOCH * 10**9 else FIRST_NS
    return start_ns + (time_ns - time_ns[0])


def stamps_of(time: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """
    Return stamps of times in multiples of `unit` seconds, ns, int64, shape (n,).

    Times that do not count from 1970 are shifted, so that the first stamp is `FIRST_NS`.
    """
    start = round(time[0] * unit * 1e9) if time[0] * unit > EPOCH else FIRST_NS
    return start + np.round((time - time[0]) * (unit * 1e9)).astype(np.int64)


def _numbers(name: str, values: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return values as an array of floats of a shape; `name` for errors."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f'{name} must be numbers, got {shortened(str(error))}; convert the array',
            code='array_type',
        ) from error
    if array.shape != shape or not shape[0]:
        raise InputError(
            f'{name} must have shape {shape} with at least one row, got'
            f' {array.shape}; correct the array',
            code='array_shape',
        )
    return array


class AlignedArrays:
    """
    Slicing and joining for dataclasses whose array fields share their first axis.

    A field may hold another such object, or None.
    """

    unaligned: ClassVar[frozenset[str]] = frozenset()
    """Fields whose arrays belong to all rows together."""

    def __len__(self) -> int:
        return next(len(value) for value in vars(self).values() if isinstance(value, np.ndarray))

    def select(self, index: Any) -> Any:
        """Return the rows at `index` (slice, mask or integer array)."""
        fields = {}
        for name, value in vars(self).items():
            fields[name] = value if name in self.unaligned else _selected(value, index)
        return type(self)(**fields)

    def after(self, earlier: Any) -> Any:
        """Return these rows after earlier ones; None: there are none."""
        return self if earlier is None else type(self).concatenate([earlier, self])

    @classmethod
    def concatenate(cls, parts: Iterable[Any]) -> Any:
        """
        Join `parts` in order.

        A field that one of them lacks is None, and fields that are not arrays are those of the
        first part.
        """
        parts = list(parts)
        fields = {}
        for name in vars(parts[0]):
            fields[name] = _joined([getattr(part, name) for part in parts])
        return cls(**fields)


def _selected(value, index):
    """Return the rows of an array or of `AlignedArrays`; other values unchanged."""
    if isinstance(value, np.ndarray):
        return value[index]
    return value.select(index) if isinstance(value, AlignedArrays) else value


def _joined(values):
    """Return the values of one field of all parts as that of the joined object."""
    if any(value is None for value in values):
        return None
    if isinstance(values[0], np.ndarray):
        return np.concatenate(values)
    return values[0].concatenate(values) if isinstance(values[0], AlignedArrays) else values[0]


class JoinedParts:
    """Joins samples part by part; `concatenate` needs the memory of all parts twice."""

    SPARE = 8
    """The arrays grow by this fraction of their length."""

    def __init__(self) -> None:
        # The first part without its rows, for the fields that are no arrays.
        self._first: Any = None
        # Name of a field -> its array with spare rows at the end, of which `_count` are in use.
        self._columns: dict[str, np.ndarray] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, part: AlignedArrays) -> None:
        """Append samples of one kind."""
        if self._first is None:
            self._first = part.select(slice(0))
            self._columns = {
                name: values.copy()
                for name, values in vars(self._first).items()
                if isinstance(values, np.ndarray)
            }
        stop = self._count + len(part)
        for name, column in self._columns.items():
            if len(column) < stop:
                self._resize(name, max(stop, len(column) + len(column) // self.SPARE))
            column[self._count : stop] = getattr(part, name)
        self._count = stop

    def samples(self) -> Any:
        """Return the joined samples; nothing can be added after this."""
        for name in self._columns:
            self._resize(name, self._count)
        return replace(self._first, **self._columns)

    def _resize(self, name, count):
        """Change the number of rows of an array in place; no view of it exists."""
        self._columns[name].resize((count, *self._columns[name].shape[1:]), refcheck=False)


@dataclass(frozen=True, eq=False)
class ImuSamples(AlignedArrays):
    """Readings of one IMU in the order of arrival."""

    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    force_s: np.ndarray
    """Specific force in the sensor frame, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Angular rate in the sensor frame, rad/s, shape (n, 3)."""
    frame_id: str = ''
    """Frame of the first message."""
    corrected: np.ndarray | None = None
    """
    Corrected specific force and rate that belong to the readings, shape (n, 6), where a calibration
    is checked.
    """
    absent: tuple[str, ...] = ()
    """
    Sensors without readings, 'accelerometer' or 'gyroscope'; their columns are constant and have no
    meaning.
    """

    @classmethod
    def concatenate(cls, parts: Iterable[Any]) -> Any:
        """Join `parts` in order; a sensor that one of them lacks is absent."""
        parts = list(parts)
        absent = sorted({sensor for part in parts for sensor in part.absent})
        return replace(super().concatenate(parts), absent=tuple(absent))


@dataclass(frozen=True, eq=False)
class JointSamples(AlignedArrays):
    """Joint states brought to one order of names."""

    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    velocity: np.ndarray
    """Joint rates, rad/s, shape (n, n_joints); NaN where the message had none."""
    names: tuple = ()
    """Joint names in column order."""

    @classmethod
    def of_angles(cls, stamp_ns: np.ndarray, angles: dict[str, np.ndarray]) -> 'JointSamples':
        """
        Return the samples of joint angles by name, rad, each of shape (n,); without velocities.
        """
        position = np.column_stack(list(angles.values()))
        return cls(stamp_ns, position, np.full(position.shape, np.nan), tuple(angles))


@dataclass(frozen=True, eq=False)
class TemperatureSamples(AlignedArrays):
    """Temperature near the sensor."""

    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    temperature_c: np.ndarray
    """Temperature, degrees Celsius, shape (n,)."""
    branch: np.ndarray | None = None
    """
    Thermal branch (`kinematics.signal_history`), in [-1, 1], shape (n,); None if not computed.
    """
    rate: np.ndarray | None = None
    """Slope (`kinematics.signal_history`), K/s, shape (n,); None if not computed."""


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """A stretch of a recording, or the messages received since the last call."""

    imu: ImuSamples | None = None
    """IMU samples, or None when the block has none."""
    joints: JointSamples | None = None
    """Joint samples, or None."""
    temperature: TemperatureSamples | None = None
    """Temperature samples, or None."""
    dropped: dict | None = None
    """Messages that could not be turned into samples: reason -> count."""
    notes: dict | None = None
    """Messages that were changed before use, such as messages without a stamp: reason -> count."""

    @classmethod
    def from_arrays(
        cls,
        time: ArrayLike,
        force: ArrayLike,
        rate: ArrayLike,
        *,
        joints: dict[str, ArrayLike] | None = None,
        temperature_c: ArrayLike | None = None,
    ) -> 'SampleBlock':
        """
        Return a recording from arrays.

        Parameters
        ----------
        time : array_like
            Seconds, from an epoch or relative, shape (n,); integers with a median step of at least
            `LEAST_NS_STEP` are nanoseconds. Or datetime64.
        force : array_like
            Specific force in the sensor frame, m/s^2; at rest, z up, +g about z; shape (n, 3).
        rate : array_like
            Angular rate in the sensor frame, rad/s, shape (n, 3).
        joints : dict, optional
            Joint name -> angles at the same times, rad, shape (n,).
        temperature_c : array_like, optional
            Degrees Celsius, shape (n,).

        Raises
        ------
        InputError
            When shapes differ, or times are not finite or in another unit.

        """
        times = _times_of(time)
        # Checked as floats; the stamps are made of `times`, whose integers are exact nanoseconds.
        seconds = _numbers('time', times, (np.size(times),))
        n = len(seconds)
        force_s = _numbers('force', force, (n, 3))
        rate_s = _numbers('rate', rate, (n, 3))
        angles = {}
        for name, values in (joints or {}).items():
            angles[name] = _numbers(f"joint '{name}'", values, (n,))
        celsius = None
        if temperature_c is not None:
            celsius = _numbers('temperature_c', temperature_c, (n,))
        n_missing = np.count_nonzero(~np.isfinite(seconds))
        if n_missing:
            raise InputError(
                f'every time must be finite, got {n_missing} that are not; remove these rows',
                code='time_not_finite',
            )
        stamp_ns = _stamps_of_any(times)
        return cls(
            imu=ImuSamples(stamp_ns, force_s, rate_s, 'imu_link'),
            joints=JointSamples.of_angles(stamp_ns, angles) if angles else None,
            temperature=None if celsius is None else TemperatureSamples(stamp_ns, celsius),
        )


def joined_stream(blocks: Iterable[SampleBlock], stream: str) -> Any:
    """Return the samples of 'imu', 'joints' or 'temperature' of all blocks; None without any."""
    parts = [getattr(block, stream) for block in blocks]
    parts = [part for part in parts if part is not None and len(part)]
    return parts[0].concatenate(parts) if parts else None


def runs_of(flags: ArrayLike, broken: ArrayLike = False) -> np.ndarray:
    """
    Return (start, stop) of each run of true flags, half open, shape (n_runs, 2).

    Cut where `broken`, (n - 1,), separates neighbours.
    """
    flags = np.asarray(flags, bool)
    joined = flags[1:] & flags[:-1] & np.logical_not(broken)
    starts = flags & ~np.append(False, joined)
    stops = flags & ~np.append(joined, False)
    return np.column_stack([np.flatnonzero(starts), np.flatnonzero(stops) + 1])


def any_within(flags: np.ndarray, before: int, after: int) -> np.ndarray:
    """
    Return for each place whether a flag is true from `before` places before it to `after` after it.

    Places beyond the ends count as false; shape (n,).
    """
    # n_true[i] is the number of true flags before place i.
    n_true = np.concatenate([[0], np.cumsum(flags)])
    place = np.arange(len(flags))
    start = np.maximum(place - before, 0)
    stop = np.minimum(place + after + 1, len(flags))
    return n_true[stop] > n_true[start]


def smallest_step(readings: np.ndarray, least: float = 1e-9) -> np.ndarray:
    """
    Return the smallest step from one reading to the next in each column.

    The columns are (n, k). The step is above the share `least` of the largest, and the result has
    shape (k,).
    """
    steps = []
    for column in readings.T:  # one at a time: the temporary arrays of a long recording are large
        step = np.abs(np.diff(column))
        steps.append(
            np.min(step, where=step > least * np.abs(column).max(initial=1e-12), initial=np.inf)
        )
    return np.array(steps)


def rounding_variance(readings: np.ndarray) -> np.ndarray:
    """
    Return the variance of rounding, ``step^2 / 12`` of the smallest step, of each column.

    Shape (k,); 0 where none changes.
    """
    step = smallest_step(readings, 1e-12)
    return np.where(np.isfinite(step), step, 0.0) ** 2 / 12


BlockSource = Iterable[SampleBlock]
"""Blocks of a recording; each iteration begins at its start, so that it can be read repeatedly."""
