"""Implausible values: beyond the range of known sensors, and no larger than an error caused by model misfit."""

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.weighted_system import WeightedSystem

FAR = 3.0
"""Prior standard deviations beyond which an entry of a matrix needs a reason that is not misfit."""

NOISE = 1.1
"""Residuals up to this times the variance at rest are noise: the rest used for its estimate may have been quieter."""


def unbelievable(system: WeightedSystem, values: np.ndarray, *, sd: np.ndarray, noises: dict[str, NoiseModel],
                 free: np.ndarray) -> np.ndarray:
    """
    Return a mask of the parameters whose information may be an artefact of misfit.

    The value exceeds the range of known instruments, and it is no larger than the shift that all excess misfit of moving windows causes
    along the parameter. Example: an accelerometer's scale along an axis without gravity, determined only through arms and wrong angles.
    A gyroscope at the wrong full-scale setting has a value larger than its misfit explains, and is kept. All parameters of an effect are
    fixed, of a matrix single entries.

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
    found, feigned = np.zeros(len(values), bool), {sensor: _feigned(system, sensor, values, noises[sensor]) for sensor in SENSORS}
    for effect in system.model.effects:
        part = system.model.slices[effect.key]
        if effect.role is Role.OFFSET or not np.isfinite(_limit(effect)):
            continue
        size = np.abs(values[part] - system.prior.mean[part])
        sensors = (effect.sensor,) if effect.sensor in SENSORS else effect.acts_on
        strange = free[part] & (size > _limit(effect)) & (size < sd[part] * max(feigned[sensor] for sensor in sensors))
        found[part] = strange if effect.role is Role.LINEAR else free[part] & strange.any()
    return found


def _limit(effect: Effect) -> float:
    return FAR * float(np.max(effect.prior_sds())) if effect.role is Role.LINEAR else effect.largest


def _feigned(system, sensor, values, noise):
    """Return the largest shift, in sds of noise, of a parameter of the worst axis by all excess misfit of moving windows."""
    rested = any(row.kind == 'static' for row in system.accumulator.rows)
    rest = NOISE * np.maximum(noise.low_variance, noise.white_variance) if rested else 0.0
    total = np.zeros(3)
    for kind, factor in system.within[sensor].items():
        squares = (system.misfit(sensor, factor, values)**2).sum(axis=0)
        weight = noise.low_variance * (noise.moving[kind].slow if kind in noise.moving else 1.0)
        total += np.maximum(squares - system.dof_within[kind] * rest, 0.0) / weight
    return float(np.sqrt(total.max()))
