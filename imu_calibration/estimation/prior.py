"""Priors of the parameters, gauge, and parameters that least squares does not estimate."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior as rows: ``root @ (values - mean)`` has unit variance."""

    mean: np.ndarray
    """Prior values, shape (n_params,)."""
    root: np.ndarray
    """Square root of the information, shape (k, n_params)."""
    sd: np.ndarray
    """Marginal standard deviations, shape (n_params,)."""
    gauge: np.ndarray
    """Rows of `root` that fix an origin and carry no information, shape (k, n_params)."""


GAUGE_SD = 1e-12
"""How exactly a gauge holds, in the unit of its parameters."""


def make_prior(model: SensorModel) -> Prior:
    """
    Return the prior of a model.

    When an arm for each axis and a common one are estimated, the former sum to zero: the origin is the
    mean of the sensitive points.
    """
    mean, sd = model.prior()
    mean = np.where(np.isfinite(mean), mean, 0.0)
    rows, gauge = [np.diag(1 / sd)], np.zeros((0, len(mean)))
    if {effect.role for effect in model.arms} == {Role.ARMS, Role.ARM}:
        arms = np.arange(len(mean))[model.part('accelerometer', Role.ARMS)].reshape(3, 3)
        gauge = np.zeros((3, len(mean)))
        for component in range(3):
            gauge[component, arms[:, component]] = 1 / GAUGE_SD
        rows.append(gauge)
        sd = sd.copy()
        sd[arms.ravel()] *= np.sqrt(2 / 3)
    return Prior(mean, np.concatenate(rows), sd, gauge)


def fixed_parameters(model: SensorModel) -> np.ndarray:
    """Return a mask of parameters that least squares does not estimate (saturation is censoring, not a column)."""
    return np.concatenate([np.full(e.size, e.coefficients is None and e.warp is None) for e in model.effects])
