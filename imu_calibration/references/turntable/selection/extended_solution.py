"""The solution of a recording with the effects that a search has chosen."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.estimation.solution import SAMPLE_NOISE, Solution
from imu_calibration.references.turntable.estimation.session_noise import WEIGHTLESS
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.selection.linearised_problem import LinearisedProblem
from imu_calibration.references.turntable.selection.saturation import Saturation
from imu_calibration.selection.questions import Question


def extended_solution(
    problem: LinearisedProblem,
    chosen: Sequence[Question],
    *,
    saturations: Sequence[Saturation] = (),
) -> Solution:
    """
    Return the Solution of the baseline of a problem, extended by the chosen effects.

    Parameters
    ----------
    problem : LinearisedProblem
        Linearised at the chosen effects.
    chosen : sequence of Question
    saturations : sequence of Saturation
        Limits to write into the model.

    """
    # Linearised where the rows of the recording are, so that their statistics are used again: the
    # point of the baseline, and of effects that only the rows have; arms folded into the columns.
    model_of_rows = problem.recording.model
    model = replace(
        problem.baseline,
        point={**problem.baseline.point, **model_of_rows.point},
        temperature_ref_c=model_of_rows.temperature_ref_c,
        folded_arms=model_of_rows.folded_arms,
    )
    for question in chosen:
        model = model.with_effect(question.sensor, question.name)
    # Of some axes only the slow part is compared (`ParameterSpace.slow_only`).
    trusted = {
        sensor: _in_trusted_band(noise, problem.space.slow_only[sensor])
        for sensor, noise in problem.noise.items()
    }
    solution = solve(problem.recording.accumulated(model), model, noise=trusted)
    # Folded arms are a property of the columns of a search, not of its result.
    solution = replace(solution, model=replace(model, folded_arms=None))
    for limit in saturations:
        solution = _with_limit(solution, limit)
    return solution


def _in_trusted_band(noise: NoiseModel, slow_only: np.ndarray) -> NoiseModel:
    """
    Return the noise with almost no weight for the fast part of some axes.

    `slow_only`: whether only the slow part of an axis is compared, shape (3,).
    """
    moving = {}
    for kind, factors in noise.moving.items():
        centred = np.where(slow_only, WEIGHTLESS * factors.centred, factors.centred)
        moving[kind] = replace(factors, centred=centred)
    return replace(noise, moving=moving)


def _with_limit(solution: Solution, limit: Saturation) -> Solution:
    """Return the solution with the level of a saturation as a further, independent parameter."""
    model = solution.model.with_role(limit.sensor, Role.LIMIT)
    place = model.part(limit.sensor, Role.LIMIT).start

    def grown(matrix: np.ndarray, element: float) -> np.ndarray:
        """Return a matrix with a row and a column for the level, zero but for the diagonal."""
        matrix = np.insert(matrix, place, 0.0, axis=0)
        matrix = np.insert(matrix, place, 0.0, axis=1)
        matrix[place, place] = element
        return matrix

    # The only uncertainty of the level is the noise of the clipped samples.
    terms = {}
    for name, term in solution.terms.items():
        terms[name] = grown(term, limit.level_sd**2 if name == SAMPLE_NOISE else 0.0)
    return replace(
        solution,
        model=model,
        values=np.insert(solution.values, place, limit.level),
        held=np.insert(solution.held, place, False),
        terms=terms,
        information=grown(solution.information, limit.level_sd**-2),
    )
