"""The parameters that compensation applies: effects that it cannot undo are replaced by a constant, which the bias contains."""

from collections.abc import Mapping

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.forward_equations import coefficient_jacobian, coefficients
from imu_calibration.effects.sensor_model import SensorModel

Centre = Mapping[str, np.ndarray]
"""Column group -> the values of its columns at which an effect that compensation cannot undo counts as zero, shape (width,)."""


def not_applied(model: SensorModel) -> list[Effect]:
    """Return the effects of the sensors that compensation cannot undo: drifts, formulas in joint angles or time."""
    return [effect for effect in model.effects if effect.sensor in SENSORS and effect.compensation == 'none'
            and not effect.in_reference and effect.warp is None and effect.groups]


def in_time(effect: Effect) -> bool:
    """Return whether an effect depends on time only."""
    return all(group.uses <= {'time', 'time constant'} for group in effect.groups)


def centred(model: SensorModel, values: np.ndarray, centre: Centre) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values, their derivative by the given ones) with columns that are measured from `centre`.

    ``bias + column value = (bias + centre value) + (column - centre) value``: only the biases change.

    Parameters
    ----------
    model : SensorModel
    values : array, shape (n_params,)
    centre : mapping

    """
    moved, slope = values.copy(), np.eye(len(values))
    for sensor, group in ((effect.sensor, group) for effect in not_applied(model) for group in effect.groups if group.name in centre):
        bias, rows = model.part(sensor, Role.OFFSET), model.layout(sensor).rows[group.name]
        moved[bias] += centre[group.name] @ coefficients(model, sensor, values)[rows]
        slope[bias] += np.einsum('q,qan->an', centre[group.name], coefficient_jacobian(model, sensor, values)[rows])
    return moved, slope


def applied_values(model: SensorModel, values: np.ndarray, centre: Centre | None = None) -> np.ndarray:
    """Return the values with effects that compensation cannot undo at their value in the centre, which the bias contains."""
    applied = centred(model, values, centre or {})[0]
    for effect in not_applied(model):
        applied[model.slices[effect.key]] = effect.prior_values()
    return np.where(np.isfinite(applied), applied, 0.0)
