"""From parameters to outputs: coefficients of the columns, their derivative, and the prediction of both sensors."""

from typing import Any

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.columns import columns_at_point, warped_reference
from imu_calibration.effects.sensor_model import WARP, WARP_LEVER, SensorModel
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.reference_motion import Reference
from imu_calibration.kinematics.table import Table


def coefficients(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """Return the coefficients of the columns for a parameter vector (real or complex), shape (n_columns, 3)."""
    of_sensor, layout = model.values_of(sensor, values), model.layout(sensor)
    total = np.zeros((layout.width, 3), values.dtype)
    for effect in layout.effects:
        _add_coefficients(total, model, effect, of_sensor, layout)
    return total


def _add_coefficients(total, model, effect, of_sensor, layout):
    """Add one effect's coefficients in place."""
    if effect.warp is not None:
        change = of_sensor[effect.name] - model.point_of(effect)
        matrix = of_sensor['matrix'].reshape(3, 3)
        total[layout.rows[WARP + effect.name]] += (change[:, None, None] * matrix.T[None]).reshape(-1, 3)
        if WARP_LEVER + effect.name in layout.rows:
            arms = sum((of_sensor[e.name].reshape(-1, 3) for e in model.arms), np.zeros((3, 3)))
            products = (matrix[:, :, None] * arms[:, None, :]).reshape(3, 9).T
            total[layout.rows[WARP_LEVER + effect.name]] += (change[:, None, None] * products[None]).reshape(-1, 3)
    elif effect.coefficients is not None:
        for group, block in effect.coefficients(of_sensor, layout.point).items():
            if group in layout.rows:   # an effect on both sensors has groups of each
                total[layout.rows[group]] += block


def all_arms(model: SensorModel, values: np.ndarray) -> np.ndarray:
    """Return the arms from the reference point to the three sensitive points, shape (3, 3), zero where the model has none."""
    return sum((values[model.slices[e.key]].reshape(-1, 3) for e in model.arms), np.zeros((3, 3)))


def coefficient_jacobian(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """
    Return d(coefficients)/d(values) by complex steps, shape (n_columns, 3, n_params).

    Besides its own values an effect's coefficients depend on the sensor's matrix and, for warps, on its arms.
    """
    layout, step = model.layout(sensor), 1e-30
    jacobian = np.zeros((layout.width, 3, len(values)))
    for effect in layout.effects:
        concerned = layout.effects if effect.shared else (effect,)
        part = model.slices[effect.key]
        for index in range(part.start, part.stop):
            moved = values.astype(complex)
            moved[index] += 1j * step
            of_sensor, total = model.values_of(sensor, moved), np.zeros((layout.width, 3), complex)
            for other in concerned:
                _add_coefficients(total, model, other, of_sensor, layout)
            jacobian[:, :, index] = total.imag / step
    return jacobian


def effect_slopes(effect: Effect, of_sensor: dict[str, np.ndarray],
                  point: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return {group: coefficients (w, 3)} of one effect and {group: derivative by its own values (w, 3, size)}, by complex steps."""
    coefficients = effect.coefficients
    if coefficients is None:
        raise ValueError(f'{effect.name} has no coefficients')
    found = coefficients(of_sensor, point)
    slopes = {group: np.zeros(block.shape + (effect.size,)) for group, block in found.items()}
    for k in range(effect.size):
        moved = of_sensor[effect.name].astype(complex)
        moved[k] += 1e-30j
        for group, block in coefficients({**of_sensor, effect.name: moved}, point).items():
            slopes[group][..., k] = np.imag(block) / 1e-30
    return found, slopes


def predict(model: SensorModel, values: np.ndarray, table: Table, *, motion: JointMotion,
            temperature_c: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the readings of this model, (force, rate), each shape (n, 3): the forward equations.

    Warps are exact at `values`; saturation clips the result.
    """
    exact = model.at(values)
    outputs = []
    for sensor in SENSORS:
        ref = warped_reference(exact, sensor, table, motion=motion, temperature_c=temperature_c)
        output = columns_at_point(exact, sensor, ref) @ coefficients_at_point(exact, sensor, values)
        outputs.append(clip(exact, sensor, values, output=output))
    return outputs[0], outputs[1]


def coefficients_at_point(model: SensorModel, sensor: str, values: np.ndarray) -> np.ndarray:
    """Return the coefficients that belong to `columns_at_point`."""
    layout, found = model.layout(sensor), coefficients(model, sensor, values)
    return np.concatenate([found[layout.rows[name]] for name in layout.groups])


def clip(model: SensorModel, sensor: str, values: np.ndarray, *, output: np.ndarray) -> np.ndarray:
    """Clip the output at the saturation level, when the model has one."""
    level = model.value(sensor, Role.LIMIT, values)
    return output if level is None else np.clip(output, -level, level)


def sensor_output(model: SensorModel, sensor: str, values: np.ndarray, *, ref: Reference) -> np.ndarray:
    """
    Return the output for a given true motion, without warps, shape (n, 3); compensation inverts it.

    Parameters
    ----------
    ref : Reference
        True specific force, rate and angular acceleration in the sensor frame.

    """
    return columns_at_point(model, sensor, ref) @ coefficients_at_point(model, sensor, values)
