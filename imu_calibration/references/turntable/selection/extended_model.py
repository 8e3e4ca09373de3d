"""The model of a search: that of the baseline with all effects under test."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import Effect, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.questions import special


def extended_model(model: SensorModel, effects: Sequence[Effect]) -> SensorModel:
    """
    Return the model with all these effects, except the ones tested differently.

    The exceptions are warm-ups and saturation.
    """
    kept = [e for e in effects if e.warp is not None or not special(e)]
    for effect in kept:
        model = model.with_effect(effect.sensor, effect.name)
    return model


def point_with(
    model: SensorModel, effects: Sequence[Effect], values: dict[str, float]
) -> tuple[SensorModel, np.ndarray]:
    """
    Return (the model with all these effects linearised there, its parameters).

    The linearisation is at the given values, else at the prior.
    """
    wide = extended_model(model, effects)
    start = np.array(
        [values.get(name, known) for name, known in zip(wide.param_names, wide.start())]
    )
    start = np.where(np.isfinite(start), start, 0.0)
    return wide.at(start), start


def without_saturation(effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that are tested by columns; a step has columns only at a known time."""
    return [effect for effect in effects if effect.role is not Role.LIMIT and not effect.located]
