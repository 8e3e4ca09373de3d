"""Result of a solve: parameters, covariance, noise, quality of the fit."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.covariance_terms import Terms, of_fit, total
from imu_calibration.estimation.model_error import ModelError
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.prior import make_prior


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


SURE = 1e-9
"""Directions of a covariance, scaled to a unit diagonal, below this share of the largest are conventions."""


def shrunk(solution: Solution, parts: list[slice]) -> Solution:
    """
    Return a Solution in which the values of some effects are shrunk towards their prior.

    The factor is ``1 - k / chi2``, at least 0 (James and Stein), chi2 the squared distance from the prior in standard deviations, k its
    number of directions. The other parameters are updated as if the effect were known at the shrunk value. An absent effect then hardly
    raises the error of the other parameters, a significant effect is kept, and the standard deviations hold in both cases.

    Parameters
    ----------
    solution : Solution
    parts : list of slice
        Parameters of each effect.

    """
    if solution.model_error is None:
        return solution
    values, prior = solution.values.copy(), make_prior(solution.model).mean
    covariance = of_fit(solution.terms)
    for part in parts:
        at = np.arange(part.start, part.stop)[~solution.held[part]]
        if not len(at):
            continue
        sd = np.sqrt(np.diag(covariance)[at])
        sizes, directions = np.linalg.eigh(covariance[np.ix_(at, at)] / np.outer(sd, sd))
        known = sizes > SURE * sizes[-1]
        far = directions[:, known].T @ ((values[at] - prior[at]) / sd)
        chi2 = float((far**2 / sizes[known]).sum())
        step = directions[:, known] @ (far / sizes[known]) / sd   # inverse covariance times the distance
        values -= min(1.0, known.sum() / max(chi2, 1e-300)) * np.where(solution.held, 0.0, covariance[:, at] @ step)
    return solution.at(values)
