"""The joint estimate of a calibration by hand: Gauss-Newton, scatter beyond the noise, fixed parameters, covariance."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from imu_calibration.effects.base import Role
from imu_calibration.estimation.covariance_terms import BIAS_PROCESS, EARTH_RATE, GRAVITY, HELD, NOISE, Terms
from imu_calibration.estimation.model_error import ModelError
from imu_calibration.estimation.scaled_solve import covariance_with_held
from imu_calibration.estimation.variance_components import GroupVariances, estimate_group_variances
from imu_calibration.references.gravity.equations import Poses, State, TurnData, build_system, moved
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.pose_model_error import hand_model_error

ITERATIONS = 15
"""Largest number of Gauss-Newton steps; four to six are usual."""
LOOSE = 1e4
"""Factor on the prior sds for an estimate from the data: large enough to remove the priors, small enough for rounding."""


@dataclass(frozen=True, eq=False)
class HandSolution:
    """Joint estimate."""

    state: State
    """Parameters, directions and drifts."""
    terms: Terms
    """Covariance of the parameters as named terms, each of shape (n, n)."""
    held: np.ndarray
    """True where a parameter is fixed at its prior, shape (n,)."""
    scatter: GroupVariances
    """Scatter of poses, drifts and turns beyond the noise."""
    factor: np.ndarray
    """Triangular factor of the weighted equations after directions and drifts are eliminated, shape (n, n)."""
    steps: int
    """Number of Gauss-Newton steps."""
    model_error: ModelError
    """Increase of the covariance beyond noise and scatter."""


def solve_joint(model: HandModel, poses: Poses, turns: list[TurnData], *, gravity_sd: float, fallback: np.ndarray) -> HandSolution:
    """
    Estimate all parameters from poses and turns.

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

    Returns
    -------
    HandSolution

    """
    memory, priors = {}, model.priors
    state = first_state(model, poses)
    state, scatter, steps = _iterate(model, state, poses, turns, ~model.fixed, priors, fallback, fallback, memory)
    held = choose_held(_factor(model, state, poses, turns, scatter, memory), priors, ~model.fixed)
    free = ~(held | model.fixed)
    state = State(np.where(held, model.nominal, state.values), state.up, state.drift)
    start = np.maximum(scatter.variance, 0.01 * fallback)
    state, scatter, more = _iterate(model, state, poses, turns, free, LOOSE * priors, start, fallback, memory)
    factor = _factor(model, state, poses, turns, scatter, memory)
    error = hand_model_error(model, state, poses, turns=turns, scatter=scatter, free=free)
    own, of_held = covariance_with_held(factor, free, held, prior_sd=priors)
    scattered = _of_scatter(model, state, poses, turns=turns, scatter=scatter, free=free, memory=memory)
    terms = {NOISE: own - scattered, BIAS_PROCESS: scattered, HELD: of_held, **error.terms(own + of_held),
             GRAVITY: _of_gravity(model, state.values, gravity_sd / model.gravity), EARTH_RATE: _of_earth(model, state, poses, free)}
    return HandSolution(state, terms, held, scatter, factor, steps + more, error)


def choose_held(factor: np.ndarray, priors: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """
    Return which of the parameters `asked` (mask) have next to no information from the data, shape (n,).

    One after the other, the parameter whose sd (given those fixed so far) is largest in units of the prior's, while that
    exceeds one half.

    """
    held = np.zeros(len(priors), bool)
    while np.any(free := asked & ~held):
        ratio = np.zeros(len(priors))
        ratio[free] = _data_sd(factor[:, free] * priors[free])
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 0.5:
            break
        held[worst] = True
    return held


def _data_sd(scaled):
    """Return the sd of parameters in units of their priors, nearly unlimited without information from the data."""
    factor = np.linalg.qr(np.vstack([scaled, np.eye(scaled.shape[1]) / LOOSE]), mode='r')
    return np.linalg.norm(scipy.linalg.solve_triangular(factor, np.eye(len(factor))), axis=1)


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


def _iterate(model, state, poses, turns, free, priors, variance, fallback, memory):
    """Repeat steps and scatter estimates until both converge."""
    count = len(poses.start)
    scatter = GroupVariances(np.array(variance, float), np.full(len(fallback), np.inf), np.array(variance, float))
    for number in range(1, ITERATIONS + 1):
        system = build_system(model, state, poses, turns=turns, memory=memory)
        design = np.vstack([np.hstack([system.nuisance, system.main[:, free]]),
                            np.hstack([np.zeros((free.sum(), 5 * count)), np.eye(model.size)[free][:, free]])])
        residual = np.concatenate([system.residual, (model.nominal - state.values)[free]])
        noise = np.concatenate([system.noise, priors[free]**2])
        group = np.concatenate([system.component, np.full(free.sum(), -1)])
        before = scatter.variance
        if number > 2:  # after the first steps there are errors of linearisation that are not scatter
            scatter = estimate_group_variances(design, residual, noise, group=group, start=scatter.variance, fallback=fallback)
        root = np.sqrt(scatter.total(noise, group))
        orthogonal, factor = np.linalg.qr(design / root[:, None])
        reduced = scipy.linalg.solve_triangular(factor, orthogonal.T @ (residual / root))
        step = np.zeros(5 * count + model.size)
        step[np.concatenate([np.ones(5 * count, bool), free])] = reduced
        state = moved(state, step, count)
        settled = np.allclose(scatter.variance, before, rtol=0.01, atol=1e-4 * np.min(fallback))
        if number > 3 and settled and np.linalg.norm(factor @ reduced) < 1e-3:  # in units of the joint sd
            break
    return state, scatter, number


def _factor(model, state, poses, turns, scatter, memory):
    """Return the triangular factor of the parameters with directions and drifts eliminated, at inflated variances."""
    system = build_system(model, state, poses, turns=turns, memory=memory)
    root = np.sqrt(scatter.total(system.noise, system.component, inflated=True))
    full = np.linalg.qr(np.hstack([system.nuisance, system.main]) / root[:, None], mode='r')
    return full[system.nuisance.shape[1]:, system.nuisance.shape[1]:]


def _of_scatter(model, state, poses, *, turns, scatter, free, memory):
    """Return the part of the covariance that is due to the scatter of poses, drifts and turns beyond the noise, shape (n, n)."""
    system = build_system(model, state, poses, turns=turns, memory=memory)
    variance = scatter.total(system.noise, system.component, inflated=True)
    orthogonal, factor = np.linalg.qr(np.hstack([system.nuisance, system.main[:, free]]) / np.sqrt(variance)[:, None])
    gain = scipy.linalg.solve_triangular(factor, orthogonal.T)[system.nuisance.shape[1]:] * np.sqrt(1 - system.noise / variance)
    found = np.zeros((model.size,) * 2)
    found[np.ix_(free, free)] = gain @ gain.T
    return found


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
