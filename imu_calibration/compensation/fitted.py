"""Interface of a calibration for compensation; `calibration.document.Calibration` implements it."""

from typing import Any, Protocol

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel


class FittedErrors(Protocol):
    """A model of the errors of an IMU with the values of its parameters and how well they are known."""

    @property
    def model(self) -> SensorModel:
        """The effects."""

    @property
    def values(self) -> np.ndarray:
        """Parameters in the order of the model, SI, shape (n_params,)."""

    @property
    def covariance(self) -> np.ndarray:
        """Their covariance, shape (n_params, n_params)."""

    @property
    def status(self) -> tuple[str, ...]:
        """How well each parameter is known: 'determined', 'weak' or 'held'."""

    @property
    def uncertainty_known(self) -> bool:
        """Whether the values have a covariance."""

    @property
    def knows_density(self) -> bool:
        """Whether the noise is known at any sampling rate."""

    @property
    def frame_id(self) -> str:
        """Frame of the messages that it was made from."""

    @property
    def conditions(self) -> dict[str, Any]:
        """Conditions of the recording: the range of temperature, the largest rate."""

    def of(self, sensor: str, role: Role) -> Any:
        """Return the value of the effect that plays a role for a sensor, or None."""

    def noise(self, sensor: str, period: float | None = None) -> tuple[Any, Any]:
        """Return (standard deviation of a sample, sd of window offsets and bias process), each shape (3,)."""
