"""Result of a solve: parameters, covariance, noise, quality of the fit."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.covariance_terms import Terms, total
from imu_calibration.estimation.model_error import ModelError
from imu_calibration.estimation.noise_model import NoiseModel


@dataclass(frozen=True, eq=False)
class Solution:
    """Estimated parameters with covariance, noise and quality of the fit."""

    model: SensorModel
    """The effects, linearised at the values of the columns."""
    values: np.ndarray
    """Parameters in ``model.param_names`` order, SI, shape (n_params,)."""
    terms: Terms
    """Their covariance as named terms (`covariance_terms`), each of shape (n_params, n_params)."""
    held: np.ndarray
    """True where a parameter is fixed at its prior, shape (n_params,)."""
    noise: dict[str, NoiseModel]
    """Sensor -> its noise."""
    chi2_per_dof: dict
    """Sensor -> {'mean', 'spin', 'dynamic'} -> weighted residual sum of squares per degree of freedom."""
    information: np.ndarray
    """Information matrix of the data without the prior, shape (n_params, n_params)."""
    residual_rms: dict
    """Sensor -> rms residual of single samples in moving windows and of window means, shape (2,)."""
    session_biases: dict = field(default_factory=dict)
    """
    Sensor -> bias of each recording, shape (n_sessions, 3), for sensors whose bias differs between recordings; `values` has their mean.
    """

    model_error: ModelError | None = None
    """Allowances for misfit and drift in the covariance."""

    not_believed: dict[str, float] = field(default_factory=dict)
    """Fixed parameter -> its estimate, which exceeds the range of known sensors and is no larger than misfit can cause."""

    replaced: tuple[str, ...] = ()
    """Held parameters that the recording determines weakly, replaced by their prior (`covariance_terms.replace_weak`)."""

    def at(self, values: np.ndarray) -> 'Solution':
        """Return the same with other values, shape (n_params,)."""
        return replace(self, values=values)

    @property
    def param_names(self) -> list[str]:
        """Names in the order of `values`."""
        return self.model.param_names

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the values, the sum of its terms, shape (n_params, n_params)."""
        return total(self.terms)

    @property
    def sd(self) -> np.ndarray:
        """Standard deviations, shape (n_params,)."""
        return np.sqrt(np.diag(self.covariance))

    def value(self, sensor: str, effect: str) -> np.ndarray:
        """Return the values of one effect."""
        return self.values[self.model.slices[sensor, effect]]
