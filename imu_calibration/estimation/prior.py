"""The prior of the parameters of a model, as rows of a least-squares problem."""

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

    @property
    def root_without_gauge(self) -> np.ndarray:
        """The rows of `root` that carry information, shape (k, n_params)."""
        # The gauge follows the rows of the parameters; sums are behind it (`make_prior`).
        n_params = len(self.mean)
        return np.delete(self.root, slice(n_params, n_params + len(self.gauge)), axis=0)


GAUGE_SD = 1e-12
"""How exactly a gauge holds, in the unit of its parameters."""


def make_prior(model: SensorModel) -> Prior:
    """
    Return the prior of a model.

    When an arm for each axis and a common one are estimated, the former sum to zero: the origin is
    the mean of the sensitive points. Sums of parameters that gravity does not determine
    (`Effect.zero_sums`) are zero to their tolerance: this row has information, so that data with
    another specific force than that of rest determine the sum.
    """
    mean, sd = model.prior()
    mean = np.where(np.isfinite(mean), mean, 0.0)
    rows = [np.diag(1 / sd)]
    gauge = np.zeros((0, len(mean)))
    if {effect.role for effect in model.arms} == {Role.ARMS, Role.ARM}:
        arms = np.arange(len(mean))[model.part('accelerometer', Role.ARMS)].reshape(3, 3)
        gauge = np.zeros((3, len(mean)))
        for component in range(3):
            gauge[component, arms[:, component]] = 1 / GAUGE_SD
        rows.append(gauge)
        # Each of three independent arms less their mean: 2/3 of the variance.
        sd = sd.copy()
        sd[arms.ravel()] *= np.sqrt(2 / 3)
    rows.append(zero_sum_rows(model))
    return Prior(mean, np.concatenate(rows), sd, gauge)


def zero_sum_rows(model: SensorModel) -> np.ndarray:
    """
    Return the rows ``sum / tolerance`` of `Effect.zero_sums`.

    Shape (k, n_params); the sums are zero with a standard deviation of one row unit.
    """
    rows = []
    for effect in model.effects:
        for group in effect.zero_sums:
            row = np.zeros(len(model.param_names))
            row[model.slices[effect.key].start + np.array(group)] = 1 / effect.tolerance
            rows.append(row)
    return np.array(rows).reshape(-1, len(model.param_names))


def fixed_parameters(model: SensorModel) -> np.ndarray:
    """
    Return a mask of parameters that least squares does not estimate.

    They have no column: saturation censors the output.
    """
    return model.mask(lambda effect: effect.coefficients is None and effect.warp is None)
