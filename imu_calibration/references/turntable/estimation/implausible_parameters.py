"""Parameters that only misfit seems to determine."""

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.noise_model import NoiseModel

MAX_PRIOR_SDS = 3.0
"""Prior standard deviations beyond which an entry of a matrix needs a reason that is not misfit."""
REST_NOISE_MARGIN = 1.1
"""
Residuals up to this times the variance at rest are noise: the rest used for its estimate may have
been quieter.
"""


def implausible_parameters(
    system: WeightedSystem,
    values: np.ndarray,
    *,
    sd: np.ndarray,
    noises: dict[str, NoiseModel],
    free: np.ndarray,
) -> np.ndarray:
    """
    Return a mask of the parameters of which the estimate may be an artefact of misfit.

    Its distance from the prior exceeds the range of known instruments, and is no larger than the
    shift that all excess misfit of moving windows causes along the parameter. Example: an
    accelerometer's scale along an axis without gravity, determined only through arms and wrong
    angles. A gyroscope at the wrong full-scale setting has a value larger than its misfit explains,
    and is kept. All parameters of an effect are fixed, of a matrix single entries.

    Parameters
    ----------
    system : WeightedSystem
    values, sd : ndarray, shape (n_params,)
        The estimate and its standard deviation from noise.
    noises : dict
        Sensor -> NoiseModel.
    free : ndarray of bool, shape (n_params,)
        Parameters that were estimated.

    """
    shift_of_misfit = {
        sensor: _shift_of_misfit(system, sensor, values, noises[sensor])
        for sensor in system.sensors
    }
    mask = np.zeros(len(values), bool)
    for effect in system.model.effects:
        part = system.model.slices[effect.key]
        # The largest deviation from the prior that known instruments have.
        limit = effect.largest
        if effect.role is Role.LINEAR:
            limit = MAX_PRIOR_SDS * float(np.max(effect.prior_sds()))
        if effect.role is Role.OFFSET or not np.isfinite(limit):
            continue
        size = np.abs(values[part] - system.prior.mean[part])
        sensors = [sensor for sensor in effect.sensors if sensor in shift_of_misfit]
        if not sensors:
            continue
        largest_shift = max(shift_of_misfit[sensor] for sensor in sensors)
        implausible = free[part] & (size > limit) & (size < sd[part] * largest_shift)
        if effect.role is Role.LINEAR:
            mask[part] = implausible
        else:
            mask[part] = free[part] & implausible.any()
    return mask


def _shift_of_misfit(
    system: WeightedSystem, sensor: str, values: np.ndarray, noise: NoiseModel
) -> float:
    """
    Return the largest shift of a parameter by the excess misfit of moving windows, in its sds.

    With the squares S of the centred rows of a kind on n degrees of freedom, the noise v at rest
    and the variance w with which the rows were weighted, of the axis with the largest sum::

        shift^2 = sum over kinds of max(S - n v, 0) / w

    """
    noise_at_rest = np.zeros(3)
    if any(row.kind == 'static' for row in system.accumulator.rows):
        noise_at_rest = REST_NOISE_MARGIN * np.maximum(noise.low_variance, noise.white_variance)
    total = np.zeros(3)
    for kind, rows in system.within[sensor].items():
        squares = (system.misfit(sensor, rows, values) ** 2).sum(axis=0)
        excess = np.maximum(squares - system.dof_within[kind] * noise_at_rest, 0.0)
        weight = noise.low_variance
        if kind in noise.moving:
            weight = weight * noise.moving[kind].slow
        total += excess / weight
    return float(np.sqrt(total.max()))
