"""Test of the validity of a linearisation at the solution, and selection of the next point."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import Effect
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.questions import time_constants

PASSES = 6
"""Most passes over a recording with repeated linearisation."""
STARTS = 6
"""Number of start values of the time constant, with a ratio of 2.3: the iteration converges from a start within this factor."""
LINEAR_STEPS = 25
"""Steps of a numerical derivative (5 ms of a delay) up to which a linearisation is valid in weakly determined directions."""


def linearise_again(model: SensorModel, solution: Solution) -> SensorModel | None:
    """Return the model linearised at a solution outside the validity of its linearisation, else None."""
    return model.at(model.start_from(solution.model, _cautious(solution))) if _needs_another_pass(model, solution) else None


def at_time_constants(model: SensorModel, effect: Effect, duration: float) -> list[SensorModel]:
    """Return the model with the columns of a warm-up at each of several time constants that a recording of `duration` s can show."""
    return [replace(model, point={**model.point, effect.name: effect.at_time_constant(constant)})
            for constant in time_constants(duration, STARTS)]


def _cautious(solution):
    """
    Return values to linearise at: those of the solution, except along weakly determined directions.

    At zero, lag and delay have the same first derivative. They are separable only at a point where both are nonzero;
    a full step along their difference would be arbitrary. The step is therefore regularised with LINEAR_STEPS towards the point.
    """
    model, values = solution.model, solution.values
    move, pull = np.zeros(len(values)), np.zeros(len(values))
    for effect in model.relinearised:
        if effect.warp is not None:
            part = model.slices[effect.key]
            move[part], pull[part] = values[part] - model.point_of(effect), (LINEAR_STEPS * effect.step)**-2
    moving = np.flatnonzero(pull)
    if not len(moving):
        return values
    known = np.linalg.inv(solution.covariance[np.ix_(moving, moving)])
    kept = values.copy()
    kept[moving] -= np.linalg.solve(known + np.diag(pull[moving]), pull[moving] * move[moving])
    return kept


def _needs_another_pass(model, solution):
    """Return whether an effect moved beyond the validity of its first derivative."""
    for effect in model.relinearised:
        if effect.key not in solution.model.slices:
            continue
        part = solution.model.slices[effect.key]
        moved = np.abs(solution.values[part] - model.point_of(effect))
        if np.any(moved > np.maximum(3 * solution.sd[part], 5 * effect.step)):
            return True
    return False

