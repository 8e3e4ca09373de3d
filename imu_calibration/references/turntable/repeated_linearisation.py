"""Repeated linearisation of the columns of a model at its solution."""

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
    Return the model linearised at a solution, or None if its linearisation is valid there.

    It is valid up to three standard deviations or five steps of a numerical derivative.
    """
    for effect in model.relinearised:
        if effect.key in solution.model.slices:
            part = solution.model.slices[effect.key]
            distance = np.abs(solution.values[part] - model.point_of(effect))
            if np.any(distance > np.maximum(3 * solution.sd[part], 5 * effect.step)):
                return model.at(model.start_from(solution.model, _next_point(solution)))
    return None


def _next_point(solution: Solution) -> np.ndarray:
    """
    Return the next point of linearisation, shape (n_params,).

    It is the solution, except for weakly determined directions of delays and lags. At zero, lag and
    delay have the same first derivative. They are separable only at a point where both are nonzero;
    a full step along their difference would be arbitrary. The step d is therefore regularised, with
    the information I of the solution and ``P = (LINEAR_STEPS step)^-2``: ``(I + P)^-1 I d``. A time
    constant is positive: it is at least the share `LEAST_TIME_CONSTANT` of the one before.
    """
    # Time constants.
    model = solution.model
    values = solution.values.copy()
    for effect in model.relinearised:
        if effect.time_constant:
            last = model.slices[effect.key].stop - 1
            values[last] = max(values[last], LEAST_TIME_CONSTANT * model.point_of(effect)[-1])

    # Delays and lags: the step d, and the diagonal of P.
    step = np.zeros(len(values))
    precision = np.zeros(len(values))
    for effect in model.relinearised:
        if effect.warp is not None:
            part = model.slices[effect.key]
            step[part] = values[part] - model.point_of(effect)
            precision[part] = (LINEAR_STEPS * effect.step) ** -2
    warps = np.flatnonzero(precision)
    if not len(warps):
        return values

    # (I + P)^-1 I d = d - (I + P)^-1 P d, so that the last term is subtracted from the solution.
    information = np.linalg.inv(solution.covariance[np.ix_(warps, warps)])
    regularised = information + np.diag(precision[warps])
    values[warps] -= np.linalg.solve(regularised, precision[warps] * step[warps])
    return values
