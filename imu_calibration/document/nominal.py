"""A calibration with one unused sensor: nominal parameters, and no corrections computed from its readings."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import SECTIONS, Role
from imu_calibration.estimation.status import HELD

READINGS = {'accelerometer': {'force'}, 'gyroscope': {'rate', 'angular acceleration'}}
"""Sensor -> items of `ColumnGroup.uses` that are computed from its readings to correct the other sensor."""


def with_nominal(calibration: Calibration, sensors: Sequence[str]) -> Calibration:
    """
    Return a calibration without correction of the given sensors.

    Biases and matrices of these sensors are their priors', with the priors' standard deviations, which the covariances of corrected
    readings propagate; their other effects, except range limits, are removed. So are corrections of the other sensor that use their
    readings: a g-sensitivity by the force of a refused accelerometer, lever arms by the rate of a refused gyroscope.
    """
    model = calibration.model
    names = {section: tuple(effect.name for effect in model.effects if effect.sensor == section and _stays(effect, sensors))
             for section in SECTIONS}
    small = replace(model, accelerometer=names['accelerometer'], gyroscope=names['gyroscope'], reference=names['reference'])
    places = np.concatenate([np.arange(part.start, part.stop) for part in map(model.slices.__getitem__, small.slices)])
    values, covariance = calibration.values[places], calibration.covariance[np.ix_(places, places)]
    status = [calibration.status[place] for place in places]
    for effect in small.effects:
        if effect.sensor in sensors and effect.role is not Role.LIMIT:
            part = small.slices[effect.key]
            values[part], status[part] = effect.prior_values(), [HELD] * effect.size
            covariance[part, :] = covariance[:, part] = 0.0
            covariance[part, part] = np.diag(effect.prior_sds()**2)
    return replace(calibration, model=small, values=values, covariance=covariance, status=tuple(status), covariance_terms={},
                   held_reason={})


def _stays(effect, sensors):
    if effect.sensor in sensors:
        return effect.role in (Role.OFFSET, Role.LINEAR, Role.LIMIT)
    return effect.sensor == 'reference' or not any(group.uses & READINGS[sensor] for sensor in sensors for group in effect.groups)
