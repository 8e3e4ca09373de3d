"""Recordings of which all specific forces have one direction, and the parameters to hold then."""

from collections.abc import Iterable

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.references.turntable.accumulator import Accumulator

ONE_ATTITUDE = 0.02
"""
Specific forces have a single attitude if their rms across the main direction is below this share of
the rms along it, rad.
"""


def one_attitude(accumulators: Iterable[Accumulator], model: SensorModel) -> bool:
    """
    Return whether the reference specific force has the same direction in all groups.

    Criterion: the second largest eigenvalue of ``sum f f^T`` over all samples is below
    `ONE_ATTITUDE` squared of the largest.

    Parameters
    ----------
    accumulators : iterable of Accumulator
        Rows reduced with the columns of `model`.
    model : SensorModel

    """
    of_force = model.columns_of('accelerometer', Role.LINEAR)
    moment = np.zeros((3, 3))  # sum of f f'
    for accumulator in accumulators:
        for row in accumulator.rows:
            if 'accelerometer' in row.sensors:
                force = row.sensors['accelerometer'].mean[of_force]
                moment += row.count * np.outer(force, force)
        for (sensor, _), factor in accumulator.within.items():
            if sensor == 'accelerometer':
                moment += factor[:, of_force].T @ factor[:, of_force]
    eigenvalues = np.linalg.eigvalsh(moment)
    return bool(eigenvalues[-1] > 0 and eigenvalues[-2] < ONE_ATTITUDE**2 * eigenvalues[-1])


def not_separable(accumulator: Accumulator, model: SensorModel) -> np.ndarray:
    """
    Return a mask of the parameters that windows of a single attitude do not separate, (n_params,).

    With more attitudes it is empty. They are not separable from bias and common arm: the product of
    the matrix and constant gravity is a bias, and its product with the accelerations at a lever arm
    is an arm of each axis.
    """
    mask = np.zeros(len(model.param_names), bool)
    if one_attitude([accumulator], model):
        for role in (Role.LINEAR, Role.ARMS):
            mask[model.part('accelerometer', role)] = True
    return mask
