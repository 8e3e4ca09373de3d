"""Statistics of a calibration document: noise, residuals, windows and samples."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.core.documents import stated


@dataclass(frozen=True, kw_only=True, eq=False)
class AttitudeScatter:
    """Scatter of the means at rest that depends on the attitude."""

    variance_ratio: float
    """Variance with a dependence on the attitude over that without."""
    p_value: float
    """Probability of this ratio without a dependence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorEntry:
    """
    Noise and residuals of one sensor, in m/s^2 or rad/s.

    None: the reference does not estimate the quantity; NaN: the recording does not determine it.
    """

    noise_sd: np.ndarray | list[float]
    """Standard deviation of single samples at rest, shape (3,)."""
    low_frequency_factor: np.ndarray | None = None
    """Variance of means over that of white noise of `noise_sd`, shape (3,)."""
    between_window_sd: float | None = None
    """Scatter of the means of windows or poses beyond noise."""
    between_window_dof: float | None = None
    """Degrees of freedom of that scatter."""
    wander_sd: float | None = None
    """Standard deviation of a bias that wanders."""
    wander_time_s: float | None = None
    """Its correlation time, s."""
    residual_rms_moving: float | None = None
    """Residual of single samples in motion."""
    residual_rms_window_means: float | None = None
    """Residual of the means of windows."""
    chi2_per_dof: Mapping[str, float] | None = None
    """Kind of window -> weighted sum of squared residuals per degree of freedom."""
    slow_over_fast: Mapping[str, Any] | None = None
    """Kind of window -> slow over fast part of the residual: above 1 it has structure in time."""
    attitude: AttitudeScatter | None = None
    """Dependence of the means at rest on the attitude."""
    between_recordings_sd: float | None = None
    """Standard deviation of the bias from recording to recording."""
    bias_of_recordings: np.ndarray | None = None
    """Bias of each recording, shape (n_recordings, 3)."""
    left_out_s: list[float] | None = None
    """Middles of the windows without weight, s."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingStatistics:
    """Statistics of recordings and of a solution, as a document states them."""

    sensors: Mapping[str, SensorEntry]
    """Sensor -> its statistics."""
    not_believed: Mapping[str, float] | None = None
    """Fixed parameter -> its estimate, which no known sensor has."""
    windows: Mapping[str, int]
    """Kind -> number of windows, poses or turns."""
    samples_used: Mapping[str, int] | None = None
    """Kind of window -> number of samples."""
    by_hand: Mapping[str, Any] | None = None
    """Further statistics of poses and turns."""
    dropped: Mapping[str, int]
    """Reason -> number of unusable samples."""
    stream: Mapping[str, int] | None = None
    """Event in the streams without a fault -> number of samples."""
    common_turn_deg: list[float] | None = None
    """Rotation vector of both sensors against the mount, deg."""
    unusable_sensors: Mapping[str, str] | None = None
    """Sensor -> why its readings cannot be used."""
    gyroscope_delay: Mapping[str, float] | None = None
    """Delay of the gyroscope's stamps and its standard deviation, s."""

    def to_mapping(self) -> dict[str, Any]:
        """Return the section of the document; the entry of each sensor is at its top level."""
        entries = stated(self)
        return {**entries.pop('sensors'), **entries}
