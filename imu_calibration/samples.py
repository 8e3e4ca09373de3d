"""Arrays of samples as they come from a bag or a topic; nothing here knows messages or files."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike


class _Columns:
    """Slicing and joining for dataclasses whose array fields share their first axis."""

    def __len__(self):
        return len(self.stamp_ns)

    def select(self, index):
        """Return the samples at `index` (slice, mask or integer array)."""
        return type(self)(**{f.name: _pick(getattr(self, f.name), index) for f in fields(self)})

    @classmethod
    def concatenate(cls, parts):
        """Join `parts` in order; fields that are not arrays come from the first part."""
        parts = list(parts)
        return cls(**{f.name: _join([getattr(part, f.name) for part in parts]) for f in fields(cls)})


def _pick(value, index):
    return value[index] if isinstance(value, np.ndarray) else value


def _join(values):
    return np.concatenate(values) if isinstance(values[0], np.ndarray) else values[0]


@dataclass(frozen=True, eq=False)
class ImuSamples(_Columns):
    """Readings of one IMU in the order of arrival."""

    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    force_s: np.ndarray
    """Specific force in the sensor frame, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """Angular rate in the sensor frame, rad/s, shape (n, 3)."""
    frame_id: str = ''
    """Frame of the first message."""


@dataclass(frozen=True, eq=False)
class JointSamples(_Columns):
    """Joint states brought to one order of names."""

    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    velocity: np.ndarray
    """Joint rates, rad/s, shape (n, n_joints); NaN where the message had none."""
    names: tuple = ()
    """Joint names in column order."""


@dataclass(frozen=True, eq=False)
class TemperatureSamples(_Columns):
    """Temperature near the sensor."""

    stamp_ns: np.ndarray
    """Header stamps, int64, shape (n,)."""
    temperature_c: np.ndarray
    """Temperature, degrees Celsius, shape (n,)."""
    branch: np.ndarray | None = None
    """Which way it came (`reference.thermal_branch`), in [-1, 1], shape (n,); None where nobody asked."""


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """A stretch of a recording, or what arrived on the topics since the last call."""

    imu: ImuSamples | None = None
    """IMU samples, or None when the block has none."""
    joints: JointSamples | None = None
    """Joint samples, or None."""
    temperature: TemperatureSamples | None = None
    """Temperature samples, or None."""
    dropped: dict | None = None
    """Messages that could not be turned into samples: reason -> count."""
    notes: dict | None = None
    """Messages that were used in another way than they came, such as those without a stamp: reason -> count."""


@dataclass(frozen=True)
class NominalScaling:
    """Nominal conversion of volts or counts to SI: ``SI = (reading - offset) / scale``."""

    accelerometer_offset: float = 0.0
    """Reading at zero specific force."""
    accelerometer_scale: float = 1.0
    """Reading per m/s^2."""
    gyroscope_offset: float = 0.0
    """Reading at zero rate."""
    gyroscope_scale: float = 1.0
    """Reading per rad/s."""

    def apply(self, imu: ImuSamples) -> ImuSamples:
        """Return the samples in SI."""
        return replace(imu, force_s=(imu.force_s - self.accelerometer_offset) / self.accelerometer_scale,
                       rate_s=(imu.rate_s - self.gyroscope_offset) / self.gyroscope_scale)


def runs_of(flags: ArrayLike) -> np.ndarray:
    """Return (start, stop) of each run of true flags, half open, shape (n_runs, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], np.asarray(flags, bool), [False]]))).reshape(-1, 2)
