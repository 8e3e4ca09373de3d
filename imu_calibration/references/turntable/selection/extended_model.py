"""The model of a search: that of the baseline with all effects under test."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import Effect, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.questions import special


def extended_model(model: SensorModel, effects: Sequence[Effect]) -> SensorModel:
    """
    Return the model with all these effects that have columns.

    Warm-ups (bank of time constants) and saturation have none.
    """
    kept = [e for e in effects if e.warp is not None or not special(e)]
    for effect in kept:
        model = model.with_effect(effect.sensor, effect.name)
    return model


def point_with(
    model: SensorModel, effects: Sequence[Effect], values: dict[str, float]
) -> tuple[SensorModel, np.ndarray]:
    """
    Return (the model with all these effects, linearised; the parameters of the linearisation).

    They have the given `values`, parameter -> value, else the start of the model.
    """
    extended = extended_model(model, effects)
    starts = zip(extended.param_names, extended.start())
    parameters = [values.get(name, start) for name, start in starts]
    point = np.where(np.isfinite(parameters), parameters, 0.0)
    return extended.at(point), point


def without_saturation(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that are tested by columns; a step has columns only at a known time."""
    return [effect for effect in effects if effect.role is not Role.LIMIT and not effect.located]
