"""Dependence of the means at rest on the attitude, beyond the parameters of the model."""

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import Role
from imu_calibration.effects.forward_equations import coefficient_jacobian
from imu_calibration.estimation.rows import flat
from imu_calibration.estimation.scaled_solve import orthonormal_basis
from imu_calibration.estimation.solution import AttitudeDependence
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.noise_model import NoiseModel

MIN_SPARE = 6
"""Fewest degrees of freedom that must remain after the fit of the attitude."""
PRODUCT_AXES = np.triu_indices(3)
"""Axes of the six products of two components of gravity."""


def attitude_dependence(
    system: WeightedSystem, sensor: str, values: np.ndarray, *, noise: NoiseModel
) -> AttitudeDependence | None:
    """
    Return the `AttitudeDependence` of a sensor at rest; None with too few rests.

    The whitened residuals ``r`` of the means at rest, less their part along the design of the
    model, are fitted with the components f_i of gravity in the sensor and their products f_i f_j,
    on each axis of the sensor. With S0 the sum of squares of r over n degrees of freedom, and S1
    that of the fit with m more parameters::

        ratio = (S0 / n) / (S1 / (n - m)),    F = ((S0 - S1) / m) / (S1 / (n - m))

    The offsets of windows and the bias processes of `noise` are part of the whitening. They absorb
    the dependence, which a ratio does not notice because it divides S0 and S1 alike. A bias that
    changes with time does not depend on the attitude.

    Parameters
    ----------
    system : WeightedSystem
    sensor : str
    values : ndarray, shape (n_params,)
        The estimate.
    noise : NoiseModel
        Of the sensor.

    """
    still = np.flatnonzero(~system.moving)
    model = system.model
    # The rows of the accelerometer contain the attitude.
    if len(still) == 0 or 'accelerometer' not in system.sensors:
        return None

    # Rows of the means, of each axis: [design | f and its products | residual].
    means = system.means[sensor]
    design = np.einsum('kp,paq->kaq', means[:, :-3], coefficient_jacobian(model, sensor, values))
    misfit = system.misfit(sensor, means, values)
    of_force = model.columns_of('accelerometer', Role.LINEAR)
    force = system.means['accelerometer'][:, of_force]
    first, second = PRODUCT_AXES
    functions = np.concatenate([force, force[:, first] * force[:, second]], axis=1)
    # Separate amplitudes on each axis.
    candidates = np.einsum('ks,ab->kabs', functions, np.eye(3)).reshape(len(means), 3, -1)
    equations = np.concatenate([design, candidates, misfit[:, :, None]], axis=2)

    # Independent rows of unit variance.
    white = flat(system.mean_rows(equations, noise).select(still).white())
    n_design = design.shape[2]

    # S0: without the part along the design. S1: also without the attitude.
    of_design = orthonormal_basis(white[:, :n_design])
    of_both = orthonormal_basis(white[:, :-1])
    residual = white[:, -1]
    squares_0 = float(residual @ residual - np.sum((of_design.T @ residual) ** 2))
    squares_1 = float(residual @ residual - np.sum((of_both.T @ residual) ** 2))
    dof_0 = len(residual) - of_design.shape[1]
    dof_1 = len(residual) - of_both.shape[1]
    n_added = dof_0 - dof_1
    if n_added == 0 or dof_1 < MIN_SPARE or squares_1 <= 0:
        return None
    ratio = (squares_0 / dof_0) / (squares_1 / dof_1)
    f_value = ((squares_0 - squares_1) / n_added) / (squares_1 / dof_1)
    return AttitudeDependence(ratio, float(f_sf(f_value, n_added, dof_1)))
