"""Whether a solution lies too far from where its columns were taken, and where they should be taken instead."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import Effect
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution

PASSES = 6
"""Passes over a recording at most, when effects have to be linearised anew."""


STARTS = 6
"""Time constants from which the iteration starts, a factor of 2.3 apart: it converges from a start within this factor."""
LINEAR_STEPS = 25
"""Steps of a numerical derivative (5 ms of a delay) over which a linearisation is believed in directions that are hardly seen."""


def linearise_again(model: SensorModel, solution: Solution) -> SensorModel | None:
    """Return the model linearised at a solution that lies too far from where its columns were taken, else None."""
    return model.at(model.start_from(solution.model, _cautious(solution))) if _needs_another_pass(model, solution) else None


def at_time_constants(model: SensorModel, effect: Effect, duration: float) -> list[SensorModel]:
    """Return the model with the columns of a warm-up at each of several time constants that a recording of `duration` s can show."""
    return [replace(model, point={**model.point, effect.name: effect.at_time_constant(constant)})
            for constant in np.geomspace(max(duration / 30, 5.0), 2 * duration, STARTS)]


def _cautious(solution):
    """
    Return values to linearise at: those of the solution, but for directions that the recording hardly shows.

    At zero a lag and a delay are the same to first order. What tells them apart, and how far, is only seen from a point where both act;
    a full step along their difference would lead anywhere. So the step is the solution's with a pull of LINEAR_STEPS towards the point.
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
    """Return whether an effect moved so far from where its columns were taken that the first derivative no longer holds."""
    for effect in model.relinearised:
        if effect.key not in solution.model.slices:
            continue
        part = solution.model.slices[effect.key]
        moved = np.abs(solution.values[part] - model.point_of(effect))
        if np.any(moved > np.maximum(3 * solution.sd[part], 5 * effect.step)):
            return True
    return False

