"""The extended model, solved on all windows by the same solver that calibrates."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.band_misfit import WEIGHTLESS
from imu_calibration.estimation.covariance_terms import NOISE
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.estimation.solver import solve
from imu_calibration.selection.parameter_space import ParameterSpace
from imu_calibration.selection.questions import Question
from imu_calibration.selection.saturation import Saturation


def extended_solution(space: ParameterSpace, noise: dict[str, NoiseModel], baseline: SensorModel, *, chosen: Sequence[Question],
                      saturations: Sequence[Saturation] = ()) -> Solution:
    """
    Return the Solution of the baseline extended by the chosen effects.

    Parameters
    ----------
    space : ParameterSpace
        Of a recording linearised at the chosen effects.
    noise : dict
        Sensor -> NoiseModel.
    baseline : SensorModel
    chosen : sequence of Question
    saturations : sequence of Saturation
        Limits to write into the model.

    """
    wide = space.recording.model
    model = replace(baseline, point={**baseline.point, **wide.point}, temperature_ref_c=wide.temperature_ref_c,
                    folded_arms=wide.folded_arms)
    for question in chosen:
        model = model.with_effect(question.sensor, question.name)
    weighed = {sensor: _in_trusted_band(noise[sensor], space.slow_only[sensor]) for sensor in SENSORS}
    solution = solve(space.recording.accumulated(model), model, noise=weighed)
    solution = replace(solution, model=replace(model, folded_arms=None))
    for limit in saturations:
        solution = _with_limit(solution, limit)
    return solution


def _in_trusted_band(noise, slow_only):
    """Return the noise with weight zero for fast parts on axes where only the slow part is compared."""
    return replace(noise, moving={kind: replace(factors, every=np.where(slow_only, WEIGHTLESS * factors.every, factors.every))
                                  for kind, factors in noise.moving.items()})


def _with_limit(solution, limit):
    model = solution.model.with_role(limit.sensor, Role.LIMIT)
    place = model.part(limit.sensor, Role.LIMIT).start

    def grown(matrix, corner):
        matrix = np.insert(np.insert(matrix, place, 0.0, axis=0), place, 0.0, axis=1)
        matrix[place, place] = corner
        return matrix
    terms = {name: grown(term, limit.level_sd**2 if name == NOISE else 0.0) for name, term in solution.terms.items()}
    return replace(solution, model=model, values=np.insert(solution.values, place, limit.level),
                   held=np.insert(solution.held, place, False), terms=terms,
                   information=grown(solution.information, limit.level_sd**-2))
