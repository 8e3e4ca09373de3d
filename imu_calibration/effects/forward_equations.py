"""From parameters to outputs: coefficients of the columns, their derivative, and the prediction of both sensors."""

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import columns_at_point
from imu_calibration.effects.regressors import GROUPS


def coefficients(model, sensor, values):
    """Return the coefficients of the columns for a parameter vector (real or complex), shape (n_columns, 3)."""
    of_sensor, layout = model.values_of(sensor, values), model.layout(sensor)
    total = np.zeros((layout.width, 3), values.dtype)
    for effect in layout.effects:
        _add_coefficients(total, model, effect, of_sensor, layout)
    return total


def _add_coefficients(total, model, effect, of_sensor, layout):
    """Add one effect's coefficients in place."""
    if effect.warp is not None:
        change = of_sensor[effect.name] - model.warp_point(effect)
        matrix = of_sensor['matrix'].reshape(3, 3)
        total[layout.rows['warp:' + effect.name]] += (change[:, None, None] * matrix.T[None]).reshape(-1, 3)
        if 'warp_lever:' + effect.name in layout.rows:
            products = (matrix[:, :, None] * _all_arms(of_sensor)[:, None, :]).reshape(3, 9).T
            total[layout.rows['warp_lever:' + effect.name]] += (change[:, None, None] * products[None]).reshape(-1, 3)
    elif effect.coefficients is not None:
        for group, block in effect.coefficients(of_sensor, layout.point).items():
            total[layout.rows[group]] += block


def _all_arms(of_sensor):
    """Return the arms from the reference point, shape (3, 3)."""
    arms = of_sensor['accel_size_effect'].reshape(3, 3) if 'accel_size_effect' in of_sensor else np.zeros((3, 3))
    return arms + of_sensor['lever_arm'] if 'lever_arm' in of_sensor else arms


SHARED = ('matrix', 'accel_size_effect', 'lever_arm')
"""Effects whose values enter the coefficients of others."""


def coefficient_jacobian(model, sensor, values):
    """
    Return d(coefficients)/d(values) by complex steps, shape (n_columns, 3, n_params).

    Besides its own values an effect's coefficients depend on the sensor's matrix and, for warps, on its arms.
    """
    layout, step = model.layout(sensor), 1e-30
    jacobian = np.zeros((layout.width, 3, len(values)))
    for effect in layout.effects:
        concerned = layout.effects if effect.name in SHARED else (effect,)
        part = model.slices[effect.sensor, effect.name]
        for index in range(part.start, part.stop):
            moved = values.astype(complex)
            moved[index] += 1j * step
            of_sensor, total = model.values_of(sensor, moved), np.zeros((layout.width, 3), complex)
            for other in concerned:
                _add_coefficients(total, model, other, of_sensor, layout)
            jacobian[:, :, index] = total.imag / step
    return jacobian


def predict(model, values, table, motion, temperature_c=None):
    """
    Return what the IMU of this model would read, (force, rate), each shape (n, 3): the forward equations.

    Warps are taken exactly at `values`; saturation clips the result.
    """
    exact = model.at(values)
    outputs = []
    for sensor in SENSORS:
        output = columns_at_point(exact, sensor, table, motion, temperature_c) @ coefficients_at_point(exact, sensor, values)
        outputs.append(clip(exact, sensor, values, output))
    return tuple(outputs)


def coefficients_at_point(model, sensor, values):
    """Return the coefficients that belong to `columns_at_point`."""
    rows = np.concatenate([np.full(width, name in GROUPS) for name, width in model.groups(sensor)])
    return coefficients(model, sensor, values)[rows]


def clip(model, sensor, values, output):
    """Clip the output at the saturation level, when the model has one."""
    name = {'accelerometer': 'accel_saturation', 'gyroscope': 'gyro_saturation'}[sensor]
    if (sensor, name) not in model.slices:
        return output
    level = float(values[model.slices[sensor, name]][0])
    return np.clip(output, -level, level)


def sensor_output(model, sensor, values, ref):
    """
    Return the output for a given true motion, without warps: what compensation inverts, shape (n, 3).

    Parameters
    ----------
    ref : Reference
        True specific force, rate and angular acceleration in the sensor frame.

    """
    return columns_at_point(model, sensor, None, None, ref=ref) @ coefficients_at_point(model, sensor, values)
