"""The joint estimate of a calibration by hand: first guess, and the covariance due to gravity, the Earth's rate and the model error."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import Role
from imu_calibration.estimation.covariance_terms import EARTH_RATE, GRAVITY, total
from imu_calibration.estimation.model_error import LEAST_BLOCKS, ModelError, model_error_of_rows
from imu_calibration.estimation.row_estimate import ITERATIONS, RowEstimate, estimate_rows
from imu_calibration.references.gravity.equations import GravityRows, Poses, State, TurnData
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_parameters import HandModel


def solve_joint(model: HandModel, poses: Poses, turns: list[TurnData], *, gravity_sd: float,
                fallback: np.ndarray) -> tuple[RowEstimate, ModelError]:
    """
    Return the estimate of all parameters from poses and turns, and the model error in its covariance.

    Parameters
    ----------
    model : HandModel
        Parameters, priors, gravity.
    poses : Poses
    turns : list of TurnData
    gravity_sd : float
        Sd of gravity, m/s^2.
    fallback : array, shape (3,)
        Variances of `COMPONENTS` where the data are too few to estimate them.

    """
    found = estimate_rows(GravityRows(model, poses, turns), first_state(model, poses), fallback=fallback)
    error, values = _model_error(GravityRows(model, poses, turns), found), found.state.values
    terms = {**found.terms, **error.terms(total(found.terms)), GRAVITY: _of_gravity(model, values, gravity_sd / model.gravity),
             EARTH_RATE: _of_earth(model, found.state, poses, found.free)}
    return replace(found, terms=terms), error


def _model_error(reference, found):
    """
    Return the model error; a block is a pose with the turn that begins in it.

    None where parts are fitted almost exactly: they have no scatter to compare.
    """
    model, free, count, rows = reference.model, found.free, len(reference.poses.start), reference.linearise(found.state)
    spare = np.isin(rows.component, (0, 2)).sum() - 2 * count - free.sum() + free[model.gyro_bias].sum()
    if min(count, spare) < LEAST_BLOCKS or not free.any():
        return ModelError(np.ones(model.size), *np.zeros((2, model.size)))
    return model_error_of_rows(rows, found, model.model, block=np.minimum(rows.group[:, 0], count - 1))


def first_state(model: HandModel, poses: Poses) -> State:
    """Return a `State` from the norms in poses, which determine directions too, and the rates at rest."""
    values, nominal, priors, gravity = model.nominal.copy(), model.nominal, model.priors, model.gravity
    own = model.base_index('accelerometer')
    for _ in range(ITERATIONS):
        residual, columns = model.norm_rows(values, poses.force, time=poses.time, temperature_c=poses.temperature_c)
        rows = np.vstack([columns[:, own] / (1e-3 * gravity), np.diag(1 / priors[own])])
        target = np.concatenate([residual / (1e-3 * gravity), (nominal - values)[own] / priors[own]])
        step = np.linalg.lstsq(rows, target, rcond=None)[0]
        values[own] += step
        if np.max(np.abs(step)) < 1e-10:
            break
    bias, matrix, *_ = model.linear(values)
    true = np.linalg.solve(matrix, (poses.force - bias).T).T
    values[model.gyro_bias] = poses.rate.mean(0)
    return State(values, true / np.linalg.norm(true, axis=1, keepdims=True), np.zeros_like(poses.rate))


def _of_gravity(model, values, relative_sd):
    """Return the contribution of a wrong gravity to the covariance: poses at rest determine only matrix / gravity."""
    common, part = np.zeros(len(values)), model.model.part('accelerometer', Role.LINEAR)
    common[part] = values[part]
    return relative_sd**2 * np.outer(common, common)


def _of_earth(model, state, poses, free):
    """Return the contribution of the Earth's rate about the vertical to the covariance, through biases and responses to gravity."""
    slopes = model.further('gyroscope', state.values, model.gravity * state.up, rate=np.zeros_like(state.up), time=poses.time,
                           temperature_c=poses.temperature_c)[1]
    own = np.concatenate([np.arange(model.size)[model.gyro_bias], model.extra_index('gyroscope')])
    columns = np.concatenate([np.broadcast_to(np.eye(3), (len(slopes), 3, 3)), slopes], axis=2).reshape(-1, len(own))
    taken, kept = np.zeros(model.size), own[free[own]]
    taken[kept] = np.linalg.lstsq(columns[:, free[own]], EARTH_UPWARDS_SD * state.up.ravel(), rcond=None)[0]
    return np.outer(taken, taken)
