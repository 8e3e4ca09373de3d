"""Model error in standard deviations: the scatter of parameters between blocks of windows."""

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.effects.forward_equations import coefficient_jacobian, coefficients
from imu_calibration.estimation.model_error import (
    MIN_SCATTER_BLOCKS,
    ModelError,
    errors_of_waves,
    waves_of_blocks,
)
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.noise_model import NoiseModel

COMMON_MEAN_FACTOR = 1.5
"""
Factor on the scatter of means in the variance of an accelerometer's bias, which absorbs an error
with a mean as large as its scatter.
"""
SHORTEST_BIAS_TIME = 30.0
"""Correlation time below which a bias process is no wander of a bias but model error, s."""


def model_error(
    system: WeightedSystem, values: np.ndarray, noises: dict[str, NoiseModel], *, free: np.ndarray
) -> ModelError:
    """
    Return the model error from the scatter of parameters between blocks of windows, beyond noise.

    Parameters
    ----------
    system : WeightedSystem
    values : ndarray, shape (n_params,)
        The estimate.
    noises : dict
        Sensor -> NoiseModel of the estimate.
    free : ndarray of bool, shape (n_params,)
        Parameters that were estimated.

    """
    # Too few blocks have no scatter: no growth of the standard deviations.
    if len(system.accumulator.blocks) < MIN_SCATTER_BLOCKS or not free.any():
        return ModelError(np.ones(len(values)), *np.zeros((2, len(values))))
    information, gradient = _block_scores(system, values, noises)
    waves = waves_of_blocks(information, gradient, system.prior.root, free=free)
    error, misfits = errors_of_waves(waves, system.model)
    if 'accelerometer' in misfits:
        # An error that depends on the attitude scatters the means as offsets or a fast bias process
        # do. It has a mean as large as its scatter, absorbed by the bias.
        noise = noises['accelerometer']
        processes = [p for p in noise.bias_processes if p.time < SHORTEST_BIAS_TIME]
        scatter = noise.offset_sd**2 + sum(process.sd**2 for process in processes)
        bias = system.model.part('accelerometer', Role.OFFSET)
        error.scatter_variance[bias] += COMMON_MEAN_FACTOR * scatter
    return error


def _block_scores(
    system: WeightedSystem, values: np.ndarray, noises: dict[str, NoiseModel]
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (information A'A, gradient A'r) of each of k blocks of windows at the values.

    A is the whitened design of a block, r its residual. The shapes are (k, n_params, n_params) and
    (k, n_params).
    """
    blocks = system.accumulator.blocks
    information = np.zeros((len(blocks), len(values), len(values)))
    gradient = np.zeros((len(blocks), len(values)))
    block_of_window = system.accumulator.block_of(system.session, system.time)
    for sensor in system.sensors:
        # Coefficients K of the columns C, shape (n_columns, 3): output = C K + error.
        coefficient = coefficients(system.model, sensor, values)
        slope = coefficient_jacobian(system.model, sensor, values)
        noise = noises[sensor]
        white_means = system.whitened_means(sensor, noise)
        for number, block in enumerate(blocks):
            weighed = list(system.weighed_rows(sensor, noise, block))
            for axis in range(3):
                # Rows [columns | output]: the means of the block's windows, and their centred rows.
                places = system.columns_and_output(sensor, axis)
                means = white_means[block_of_window == number, axis]
                centred = [factor[:, places] * weight[axis] for factor, weight in weighed]
                rows = np.concatenate([means, *centred])
                design = rows[:, :-1] @ slope[:, axis]
                residual = rows[:, -1] - rows[:, :-1] @ coefficient[:, axis]
                information[number] += design.T @ design
                gradient[number] += design.T @ residual
    return information, gradient
