"""Windows, their construction from samples, and the settings of the segmentation."""

import pickle
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from io import SEEK_END
from tempfile import SpooledTemporaryFile
from typing import Any

import numpy as np

from imu_calibration.core.samples import AlignedArrays
from imu_calibration.core.settings import setting
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.joint_motion import JointMotion


class WindowKind(StrEnum):
    """Motion of the IMU in a window."""

    UNUSED = 'unused'
    """Excluded on purpose."""
    STATIC = 'static'
    """It rests."""
    SPIN = 'spin'
    """All joint rates are constant, and one joint turns."""
    DYNAMIC = 'dynamic'
    """Any other motion."""


class UnusedReason(StrEnum):
    """Reason for which complete samples are in no window of a kind."""

    NONE = ''
    SETTLING = 'settling'
    NOT_QUIET = 'not quiet'
    TURN_ON = 'turn-on'
    TOO_SHORT = 'too short'
    REST_TOO_SHORT = 'rest too short'


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of samples of one kind, without gaps."""

    kind: WindowKind
    """Kind of motion."""
    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    time: np.ndarray
    """Seconds since the session's first IMU sample, shape (n,); continues across clock resets."""
    force_s: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Measured angular rate, rad/s, shape (n, 3)."""
    motion: JointMotion
    """
    The joints at the IMU's stamps; one row at rest: mean position, and rates of zero unless the
    joints creep significantly.
    """
    temperature_c: np.ndarray | None = None
    """Temperature at the samples, degrees Celsius, shape (n,), or None."""
    reason: UnusedReason = UnusedReason.NONE
    """Why the window is unused."""
    joint_step: np.ndarray | None = None
    """
    Steps of the encoders visible in the readings, rad, zero where none are, shape (n_joints,).
    """
    corrected: np.ndarray | None = None
    """See `ImuSamples`."""
    absent: tuple[str, ...] = ()
    """See `ImuSamples`."""

    def __len__(self) -> int:
        return len(self.time)

    def select(self, index: Any) -> 'Window':
        """Return the samples at `index` (slice, mask or integer array)."""
        fields: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray) and name != 'joint_step':
                fields[name] = value[index]
        # At rest the motion is one row.
        if len(self.motion) == len(self):
            fields['motion'] = self.motion.select(index)
        return replace(self, **fields)

    @property
    def period(self) -> float:
        """Median sampling period, s; 0 for one sample."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @property
    def noise_sd(self) -> np.ndarray:
        """
        Sd of white noise of specific force and angular rate, SI, shape (2, 3); NaN if too short.

        From second differences, in which smooth motion cancels: their variance is 6 times that of
        white noise.
        """
        second = np.diff(np.stack([self.force_s, self.rate_s]), 2, axis=1)
        return second.std(axis=1) / np.sqrt(6) if second.shape[1] > 1 else np.full((2, 3), np.nan)


@dataclass(frozen=True, eq=False)
class PhasedSamples(AlignedArrays):
    """IMU samples with the motion of the joints."""

    stamp_ns: np.ndarray
    """Header stamps, shape (n,)."""
    force_s: np.ndarray
    """Shape (n, 3)."""
    rate_s: np.ndarray
    """Shape (n, 3)."""
    motion: JointMotion
    """
    At session time; derivatives are zero where the joints rest, the thermal branch is NaN where the
    temperature is unknown.
    """
    temperature_c: np.ndarray
    """NaN where unknown, shape (n,)."""
    phase: np.ndarray
    """STILL, STEADY or MOVING, shape (n,)."""
    quiet: np.ndarray
    """Whether the IMU is as quiet as at rest, shape (n,)."""
    after_gap: np.ndarray
    """Whether a window cannot continue from the sample before, shape (n,)."""
    after_loss: np.ndarray
    """Whether the joints were unknown just before, shape (n,)."""
    joint_step: np.ndarray
    """Steps of the encoders, rad, zero where none are visible, shape (n, n_joints)."""
    corrected: np.ndarray | None = None
    """See `ImuSamples`."""
    absent: tuple[str, ...] = ()
    """See `ImuSamples`."""

    @property
    def time(self) -> np.ndarray:
        """Session time, s, shape (n,)."""
        return self.motion.time


def make_window(
    samples: PhasedSamples, kind: WindowKind, reason: UnusedReason = UnusedReason.NONE
) -> Window:
    """Return the `Window` of a kind that holds all of `samples`."""
    motion = samples.motion
    temperature = samples.temperature_c
    if np.isnan(temperature).any():
        temperature = None
        motion = replace(motion, thermal_branch=None, temperature_rate=None)
    if kind == WindowKind.STATIC:
        motion = _mean_motion(motion)
    return Window(
        kind=kind,
        stamp_ns=samples.stamp_ns,
        time=samples.time,
        force_s=samples.force_s,
        rate_s=samples.rate_s,
        motion=motion,
        temperature_c=temperature,
        reason=reason,
        joint_step=samples.joint_step.max(axis=0),
        corrected=samples.corrected,
        absent=samples.absent,
    )


@dataclass(frozen=True, eq=False)
class MotionReadings(AlignedArrays):
    """Readings and the motion of the joints at the same times."""

    time: np.ndarray
    """Session time, s, shape (n,)."""
    force_s: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Measured angular rate, rad/s, shape (n, 3)."""
    motion: JointMotion
    """Motion of the joints as read."""


def motion_readings(windows: Sequence[Window], most: int) -> MotionReadings:
    """Return every k-th reading of moving windows: about `most`, or all if they are fewer."""
    readings = MotionReadings.concatenate(
        MotionReadings(window.time, window.force_s, window.rate_s, window.motion)
        for window in windows
    )
    return readings.select(slice(None, None, max(1, len(readings) // most)))


STORED_IN_MEMORY = 64 << 20
"""Bytes of `StoredWindows` in memory; more are moved to a temporary file."""


class StoredWindows:
    """
    A list of windows in a temporary file, so that memory does not grow with the recording.

    An access reads a window from the file.
    """

    def __init__(self) -> None:
        self._file: Any = SpooledTemporaryFile(max_size=STORED_IN_MEMORY)
        # Position of each window in the file, bytes.
        self._starts: list[int] = []

    def __del__(self) -> None:
        self._file.close()

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, number: int) -> Window:
        self._file.seek(self._starts[number])
        return pickle.load(self._file)

    @property
    def is_complete(self) -> bool:
        """Whether all windows are stored: always."""
        return True

    def used(self) -> Iterator[Window]:
        """Yield the windows that are not unused."""
        for number in range(len(self)):
            window = self[number]
            if window.kind != 'unused':
                yield window

    def clear(self) -> None:
        """Remove all windows."""
        self._file.truncate(0)
        self._starts = []

    def extend(self, windows: Iterable[Window]) -> None:
        """Append windows."""
        for window in windows:
            self._starts.append(self._file.seek(0, SEEK_END))
            pickle.dump(window, self._file, pickle.HIGHEST_PROTOCOL)


def sensors_of(windows: Sequence[Window]) -> tuple[str, ...]:
    """Return the sensors with readings in the windows of one recording."""
    return tuple(sensor for sensor in SENSORS if sensor not in windows[0].absent)


WINDOW_GROUP_SAMPLES = 4096
"""Samples whose columns or predictions are in memory at once."""


def chunks(windows: Iterable[Window]) -> Iterator[list[Window]]:
    """
    Yield the windows in groups of limited size, in order.

    A group has at most `WINDOW_GROUP_SAMPLES` samples, or is a single longer window.
    """
    group: list[Window] = []
    size = 0
    for window in windows:
        if group and size + len(window.motion) > WINDOW_GROUP_SAMPLES:
            yield group
            group = []
            size = 0
        group.append(window)
        size += len(window.motion)
    if group:
        yield group


def joined_motion(windows: Sequence[Window]) -> tuple[JointMotion, np.ndarray | None]:
    """
    Return the rows of motion of all windows, and the temperature of each row, degrees Celsius.

    A static window has one row, with its mean temperature. None if one window has no temperature.
    """
    temperatures: list[Any] = []
    for window in windows:
        if window.temperature_c is not None:
            is_static = window.kind == WindowKind.STATIC
            temperatures.append(
                [window.temperature_c.mean()] if is_static else window.temperature_c
            )
    temperature = np.concatenate(temperatures) if len(temperatures) == len(windows) else None
    if len(windows) == 1:
        return windows[0].motion, temperature
    return JointMotion.concatenate(window.motion for window in windows), temperature


def all_samples(windows: Sequence[Window]) -> tuple[JointMotion, np.ndarray | None, np.ndarray]:
    """
    Return the result of `joined_motion`, and the index of its row for each sample of the windows.
    """
    rows = []
    first_row = 0
    for window in windows:
        n_rows = len(window.motion)
        if n_rows == len(window):
            rows.append(np.arange(first_row, first_row + n_rows))
        else:
            rows.append(np.full(len(window), first_row))
        first_row += n_rows
    return *joined_motion(windows), np.concatenate(rows)


def _mean_motion(motion: JointMotion) -> JointMotion:
    """
    Return the motion of a rest in one row: mean position, and slope where it is significant.

    The slope is that of a straight line through the positions.
    """
    mean = motion.position.mean(axis=0)
    # The levels are averages over 0.2 s, so a part of them contains the same information.
    thinned = slice(None, None, max(1, len(motion) // 500))
    time = motion.time[thinned] - motion.time[thinned].mean()
    position = motion.position[thinned] - mean
    slope = time @ position / max(time @ time, 1e-12)
    scatter = (position - time[:, None] * slope).std(axis=0)
    distance = np.abs(slope) * (time[-1] - time[0])
    # Creep is a distance of more than 8 sds: one encoder step in mid-window, which is no creep, has
    # a distance of 1.5 steps and a scatter of a quarter of a step. Below 1e-6 it is rounding.
    slope = np.where((distance > 8 * scatter) & (distance > 1e-6), slope, 0.0)
    zero = np.zeros((1, len(mean)))

    def mean_row(values: np.ndarray | None) -> np.ndarray | None:
        """Return the mean of rows as one row; None for unknown ones."""
        return None if values is None else values.mean(axis=0, keepdims=True)

    return JointMotion(
        motion.time.mean(keepdims=True),
        mean[None],
        slope[None],
        zero,
        zero,
        mean_row(motion.thermal_branch),
        mean_row(motion.vibration),
        mean_row(motion.temperature_rate),
    )


@dataclass(frozen=True)
class WindowSettings:
    """Settings for static windows, constant-rate spins and dynamic stretches."""

    static_rate: float = setting(
        0.002,
        'rad/s',
        'joints slower than this, and the IMU quiet, count as at rest',
        (0.0, 1.0),
        'too small: no static windows; too large: slow creep enters the means',
        live=True,
    )
    quiet_ratio: float = setting(
        3.0,
        '1',
        'at rest the IMU may scatter by this factor more than where it is quietest',
        (1.2, 100.0),
        'too small: no static windows; too large: knocks and vibration enter the means',
        live=True,
    )
    settling: float = setting(
        0.5,
        's',
        'kept out after a joint stops and after a ramp ends',
        (0.0, 60.0),
        'too small: ringing of the table shows as between-window variance',
        live=True,
    )
    turn_on: float = setting(
        0.0,
        's',
        'kept out at the start of a recording',
        (0.0, 3600.0),
        'too small: the turn-on transient shows as bias drift',
        fixed='the session has begun',
    )
    static_minimum: float = setting(
        1.0,
        's',
        'shortest static window',
        (0.05, 600.0),
        'too large: short poses are lost',
        live=True,
    )
    window_maximum: float = setting(
        20.0,
        's',
        'longer windows are cut, which bounds memory',
        (1.0, 600.0),
        'too large: bias wander inside a window; too small: windows no longer independent',
        live=True,
    )
    spin_rate_variation: float = setting(
        0.01,
        '1',
        'largest relative change of each joint rate in a constant-rate spin',
        (0.0, 0.5),
        'too small: spins are treated as dynamic stretches',
        live=True,
    )
    spin_minimum: float = setting(1.0, 's', 'shortest constant-rate spin', (0.05, 600.0), live=True)
    dynamic_minimum: float = setting(0.3, 's', 'shortest dynamic stretch', (0.05, 600.0), live=True)
    gap: float = setting(
        0.1,
        's',
        'a longer hole in either stream ends a window; also never below five IMU periods',
        (0.001, 60.0),
        'too small: every lost message cuts a window',
        live=True,
    )
    chunk: float = setting(
        20.0,
        's',
        'the joints are smoothed in pieces of this length',
        (2.0, 600.0),
        fixed='the pieces count from the first sample on',
    )
    overlap: float = setting(
        2.0,
        's',
        'margin on both sides of a piece, so that its ends do not show',
        (0.2, 60.0),
        fixed='the pieces count from the first sample on',
    )
