"""Columns of a model linearised again where its solution is far from their point."""

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution

MAX_TABLE_PASSES = 6
"""Most passes over a recording with repeated linearisation."""
LINEAR_STEPS = 25
"""
Steps of a numerical derivative (5 ms of a delay) up to which a linearisation is valid in weakly
determined directions.
"""
LEAST_TIME_CONSTANT = 0.3
"""Least time constant after a step, as a share of that before it."""


def linearise_again(model: SensorModel, solution: Solution) -> SensorModel | None:
    """
    Return the model linearised at a solution outside the validity of its linearisation, else None.
    """
    for effect in model.relinearised:
        if effect.key in solution.model.slices:
            part = solution.model.slices[effect.key]
            moved = np.abs(solution.values[part] - model.point_of(effect))
            if np.any(moved > np.maximum(3 * solution.sd[part], 5 * effect.step)):
                return model.at(model.start_from(solution.model, _cautious(solution)))
    return None


def _cautious(solution: Solution) -> np.ndarray:
    """
    Return values to linearise at: those of the solution, except along weakly determined directions.

    At zero, lag and delay have the same first derivative. They are separable only at a point where
    both are nonzero; a full step along their difference would be arbitrary. The step is therefore
    regularised with LINEAR_STEPS towards the point. A time constant is positive: its step ends at
    the share `LEAST_TIME_CONSTANT` of the point at the latest.
    """
    model = solution.model
    values = solution.values.copy()
    for effect in model.relinearised:
        if effect.time_constant:
            last = model.slices[effect.key].stop - 1
            values[last] = max(values[last], LEAST_TIME_CONSTANT * model.point_of(effect)[-1])
    move = np.zeros(len(values))
    pull = np.zeros(len(values))
    for effect in model.relinearised:
        if effect.warp is not None:
            part = model.slices[effect.key]
            move[part], pull[part] = (
                values[part] - model.point_of(effect),
                (LINEAR_STEPS * effect.step) ** -2,
            )
    moving = np.flatnonzero(pull)
    if not len(moving):
        return values
    known = np.linalg.inv(solution.covariance[np.ix_(moving, moving)])
    kept = values.copy()
    kept[moving] -= np.linalg.solve(known + np.diag(pull[moving]), pull[moving] * move[moving])
    return kept
