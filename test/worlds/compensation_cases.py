"""
Random calibrations for the tests of compensation.

Every effect that can be inverted, at sizes that still converge.
"""

from dataclasses import replace

import numpy as np

from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel

SIZE = {
    'bias': 0.3,
    'accel_quadratic': 2e-4,
    'accel_cubic': 1e-5,
    'accel_scale_asymmetry': 2e-3,
    'accel_cross_product': 2e-4,
    'accel_size_effect': 0.02,
    'accel_thermal_bias': 0.01,
    'accel_thermal_scale': 3e-4,
    'gyro_quadratic': 1e-3,
    'gyro_scale_asymmetry': 2e-3,
    'gyro_rate_product': 3e-3,
    'gyro_g_sensitivity': 1e-3,
    'gyro_thermal_bias': 1e-3,
    'gyro_thermal_scale': 3e-4,
    'gyro_force_squared': 1e-6,
    'accel_cross_axis_lag': 1e-4,
    'gyro_cross_axis_lag': 1e-4,
    'accel_thermal_bias_2': 3e-4,
    'gyro_thermal_bias_2': 3e-5,
    'accel_thermal_hysteresis': 0.02,
    'gyro_thermal_hysteresis': 1e-3,
    'accel_vibration_rectification': 0.1,
    'gyro_vibration_rectification': 4e-3,
}
"""Typical size of each further effect, SI."""
FURTHER = {
    sensor: tuple(
        name
        for (owner, name), effect in CATALOGUE.effects().items()
        if owner == sensor and effect.compensation == 'exact' and name not in ('bias', 'matrix')
    )
    for sensor in ('accelerometer', 'gyroscope')
}
"""Names of the further effects that compensation inverts."""
NOISE = {'accelerometer': 0.02, 'gyroscope': 0.002}


def random_calibration(
    seed=0,
    accelerometer=('accel_size_effect',),
    gyroscope=(),
    sd=1e-4,
    matrix_spread=0.02,
    **fields,
):
    """
    Return a calibration with these further effects and random values.

    It has a full covariance and known noise.
    """
    rng = np.random.default_rng([seed, 17])
    model = SensorModel(('bias', 'matrix', *accelerometer), ('bias', 'matrix', *gyroscope))
    values = np.concatenate([_values(effect, matrix_spread, rng) for effect in model.effects])
    spread = rng.normal(0.0, sd / np.sqrt(len(values)), (len(values), len(values)))
    statistics = {
        sensor: {'noise_sd': [level, 1.1 * level, 0.9 * level]} for sensor, level in NOISE.items()
    }
    conditions = {'largest_rate': 3.0, 'largest_force': 12.0, 'temperature_range_c': None}
    fields = {
        'frame_id': 'imu_link',
        'statistics': statistics,
        'conditions': conditions,
        'decision': {'accelerometer': 'helps', 'gyroscope': 'helps'},
        'readings': RawReadings(axes='flu'),
        **fields,
    }
    return Calibration(model, values, spread @ spread.T, ('determined',) * len(values), **fields)


def _values(effect, matrix_spread, rng):
    if effect.name == 'matrix':
        return (np.eye(3) + rng.normal(0.0, matrix_spread, (3, 3))).ravel()
    size = SIZE.get(effect.name, 1.0) * (
        0.05 if (effect.sensor, effect.name) == ('gyroscope', 'bias') else 1.0
    )
    return rng.uniform(-1.0, 1.0, effect.size) * size


def random_motion(n=50, seed=0):
    """Return (force, rate, alpha, temperature) of a lively motion, shapes (n, 3) and (n,)."""
    rng = np.random.default_rng([seed, 19])
    return (
        rng.uniform(-15, 15, (n, 3)),
        rng.uniform(-5, 5, (n, 3)),
        rng.uniform(-20, 20, (n, 3)),
        rng.uniform(5, 45, n),
    )


def with_values(calibration, model, values):
    """Return the calibration with other values that are known, and no statements about its own."""
    count = len(values)
    return replace(
        calibration,
        model=model,
        values=values,
        covariance=1e-12 * np.eye(count),
        status=('determined',) * count,
        covariance_terms={},
        held_reason={},
        judgement=None,
        proof={},
        statistics={},
    )
