"""Values that nobody should believe: beyond what is known of any sensor, and no larger than what misfit of the model could feign."""

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.weighted_system import WeightedSystem

FAR = 3.0
"""Prior standard deviations beyond which an entry of a matrix needs a reason that is not misfit."""

NOISE = 1.1
"""Residuals up to this times the variance at rest are noise: what it was estimated from may have been a little quieter."""


def unbelievable(system: WeightedSystem, values: np.ndarray, *, sd: np.ndarray, noises: dict[str, NoiseModel],
                 free: np.ndarray) -> np.ndarray:
    """
    Return a mask of the parameters whose information may come through misfit alone.

    The value lies beyond what is known of any instrument, and if all misfit of moving windows that noise does not explain lay along the
    parameter, it would move it as far. An accelerometer's scale along an axis that never saw gravity lives on what little the arms and
    wrong angles bring there; a gyroscope at the wrong full-scale setting does not fit by misfit, and keeps its value. An effect is held as
    a whole, of a matrix single entries.

    Parameters
    ----------
    system : WeightedSystem
    values, sd : ndarray, shape (n_params,)
        The estimate and what noise alone leaves open.
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
    """Return by how many standard deviations of noise all unexplained misfit of moving windows could move a parameter of the worst axis."""
    rested = any(row.kind == 'static' for row in system.accumulator.rows)
    rest = NOISE * np.maximum(noise.low_variance, noise.white_variance) if rested else 0.0
    total = np.zeros(3)
    for kind, factor in system.within[sensor].items():
        squares = (system.misfit(sensor, factor, values)**2).sum(axis=0)
        weight = noise.low_variance * (noise.moving[kind].slow if kind in noise.moving else 1.0)
        total += np.maximum(squares - system.dof_within[kind] * rest, 0.0) / weight
    return float(np.sqrt(total.max()))
