"""From a diagnosis on a topic to the planner of the motion that separates its collinear causes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.status import HELD
from imu_calibration.driving.campaign import Suspect
from imu_calibration.errors import InputError
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.planning.planner import Planner
from imu_calibration.planning.separation import make_separator
from imu_calibration.reference.motion_limits import MotionLimits
from imu_calibration.reference.table import Table

LONGEST = 180.0
"""Causes that no plan of this length separates count as one cause for this table, s."""


def separator_of(table: Table, calibration: Calibration, suspect: Suspect, *, noise: dict[str, NoiseModel], rate: float = 100.0,
                 options: CalibrationOptions = CalibrationOptions(), limits: MotionLimits | None = None) -> Planner:
    """
    Return the planner of the motion that separates a suspect from its mates.

    Parameters
    ----------
    table : Table
    calibration : Calibration
        The calibration, of a model that may lack the suspect.
    suspect : Suspect
    noise : mapping
        Sensor -> NoiseModel of single samples at `rate`.
    rate : float
        Samples of the IMU per second.
    options : CalibrationOptions
        Tolerances and catalogue.
    limits : MotionLimits, optional
        Default: the limits of the table.

    Raises
    ------
    InputError
        When an effect is unknown, or no motion can show it.

    """
    sensors = {name: sensor for sensor, name in options.catalogue.effects(table.joint_names)}
    for name in (suspect.effect, *suspect.mates):
        if name not in sensors:
            raise InputError(f"a cause must be an effect of the catalogue, got '{name}'; name one that it has", code='cause_unknown')
    causes = [(sensors[name], name) for name in (suspect.effect, *suspect.mates)]
    planner = make_separator(table, with_suspect(calibration, causes[0], suspect.sizes), causes, noise=noise, rate=rate, options=options,
                             sizes=suspect.sizes, limits=limits)
    planner.within(LONGEST)
    return planner


def with_suspect(calibration: Calibration, cause: tuple[str, str], sizes: dict[str, float]) -> Calibration:
    """Return the calibration with an effect at its estimated size; the other parameters do not change."""
    if cause in calibration.model.slices:
        return calibration
    model = calibration.model.with_effect(*cause)
    effect = next(each for each in model.effects if (each.sensor, each.name) == cause)
    values = model.start_from(calibration.model, calibration.values)
    values[model.slices[cause]] = [sizes.get(name, 0.0) for name in effect.param_names()]
    places = [model.param_names.index(name) for name in calibration.param_names]
    covariance, status = np.diag(model.prior()[1]**2), [HELD] * len(values)
    covariance[np.ix_(places, places)] = calibration.covariance
    for place, known in zip(places, calibration.status, strict=True):
        status[place] = known
    return replace(calibration, model=model.at(values), values=values, covariance=covariance, status=tuple(status))
