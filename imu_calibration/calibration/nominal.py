"""A calibration of which one sensor is not used: its parameters as of a data sheet, and nothing that is made of its readings."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imu_calibration.calibration.status import HELD
from imu_calibration.effects.base import SECTIONS, Role

if TYPE_CHECKING:
    from imu_calibration.calibration.document import Calibration

READINGS = {'accelerometer': {'force'}, 'gyroscope': {'rate', 'angular acceleration'}}
"""Sensor -> what of `ColumnGroup.uses` is made of its readings when others are corrected."""


def with_nominal(calibration: 'Calibration', sensors: Sequence[str]) -> 'Calibration':
    """
    Return a calibration that leaves sensors as they come.

    Biases and matrices of these sensors are their priors', with the priors' standard deviations, which the covariances of corrected
    readings carry on; their further effects go, but for the limits of their range. So does what the other sensor is corrected by with their
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
