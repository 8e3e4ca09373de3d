"""Solution of the system: one weighted non-linear least-squares problem over all windows, with its covariance."""

from dataclasses import replace

import numpy as np

from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import Accumulator
from imu_calibration.estimation.attitudes import not_separable
from imu_calibration.estimation.contradicted import contradicted
from imu_calibration.estimation.covariance_terms import BIAS_PROCESS, HELD, NOISE
from imu_calibration.estimation.model_error import model_error
from imu_calibration.estimation.noise_model import BiasProcess, NoiseModel
from imu_calibration.estimation.prior import Prior, fixed_parameters, make_prior
from imu_calibration.estimation.scaled_solve import covariance_with_held, inverse_gram, scaled_lstsq
from imu_calibration.estimation.session_noise import first_noise, updated_noise
from imu_calibration.estimation.solution import Solution
from imu_calibration.estimation.unbelievable import unbelievable
from imu_calibration.estimation.weighted_system import WeightedSystem
from imu_calibration.estimation.whitening import predict_session_offsets

HELD_SHARE = 0.5
"""A parameter whose standard deviation exceeds this share of its prior's is fixed at the prior."""
NOISE_ROUNDS = 6
"""Largest number of alternating estimates of noise and parameters."""
LEAVING_ROUNDS = 5
"""Largest number of rounds of outlier exclusion; one outlier may hide another."""


def solve(accumulator: Accumulator, model: SensorModel, *, allow_holding: bool = True, prior: Prior | None = None,
          noise: dict[str, NoiseModel] | None = None, bias_processes: dict[str, tuple[BiasProcess, ...]] | None = None) -> Solution:
    """
    Estimate all parameters jointly from accumulated windows.

    Minimises the sum of squares of whitened rows ``[columns | output] @ [coefficients(values); -1]`` over all windows and
    axes plus the prior. Window offsets and bias processes are part of the noise (restricted maximum likelihood).

    Parameters
    ----------
    accumulator : Accumulator
        Windows reduced with the columns of `model`.
    model : SensorModel
    allow_holding : bool
        Whether parameters that the data do not determine may be fixed at their prior.
    prior : Prior, optional
        Prior of the parameters; by default the one of the catalogue.
    noise : dict, optional
        Sensor -> NoiseModel, if known.
    bias_processes : dict, optional
        Sensor -> bias processes from a separate measurement; the other noise parameters are estimated.

    Returns
    -------
    Solution

    Raises
    ------
    NotObservableError
        When no parameter is determined, or one is undetermined and `allow_holding` is False.

    """
    if not accumulator.rows:
        raise NotObservableError('at least one static window, spin or dynamic stretch must be found, none was; '
                                 'rest the table between moves, or check the joint states', code='no_windows')
    prior = prior or make_prior(model)
    system = WeightedSystem(accumulator, model, prior)
    values, free = start(system), ~fixed_parameters(model)
    noises = noise or first_noise(system, values, bias_processes or {})
    if noise is None:
        values, noises = _with_noise(system, values, noises, free)
        for _ in range(LEAVING_ROUNDS):
            more = contradicted(system, values, noises)
            if not any(more.values()):
                break
            smaller = {s: replace(noises[s], left_out=noises[s].left_out | more[s]) for s in SENSORS}
            values, noises = _with_noise(system, values, smaller, free)
    factors = _factors(system, noises)
    values = _minimised(system, values, factors, free)
    held = _undetermined(system, values, factors, free) | not_separable(accumulator, model)
    _refuse(held | ~free, held, model, allow_holding)
    not_believed: dict[str, float] = {}
    while True:
        if held.any():
            values = _minimised(system, np.where(held, prior.mean, values), factors, free & ~held)
        data = system.jacobian(values, factors)
        own, of_held = covariance_with_held(np.concatenate([data, prior.root]), free & ~held, held, prior_sd=prior.sd)
        strange = unbelievable(system, values, sd=np.sqrt(np.diag(own + of_held)), noises=noises, free=free & ~held)
        if not allow_holding or not strange.any() or (held | strange | ~free).all():
            break
        not_believed |= {name: float(value) for name, value, flag in zip(model.param_names, values, strange) if flag}
        held |= strange
    error = model_error(system, values, noises, free=free & ~held)
    moving = system.bias_information(values, noises)
    terms = {NOISE: own - own @ moving @ own, BIAS_PROCESS: own @ moving @ own, HELD: of_held} | error.terms(own + of_held)
    chi2, rms = _fit_quality(system, values, noises)
    return Solution(model, values, terms, held, noises, chi2, data.T @ data, rms, _session_biases(system, values, noises), error,
                    not_believed)


def _with_noise(system, values, noises, free):
    """
    Return (values, noise), estimated alternately.

    One round usually suffices: the likelihood of the offsets is restricted, so it does not depend on the values of the parameters.
    With separate weights of slow and fast parts, weights and parameters depend on each other.
    """
    for _ in range(NOISE_ROUNDS):
        values = _minimised(system, values, _factors(system, noises), free, enough=0.01)
        before, noises = noises, updated_noise(system, values, noises)
        if all(noises[s].weighs_alike(before[s]) for s in SENSORS):
            break
    return values, noises


def _refuse(without, held, model, allow_holding):
    names = [name for name, flag in zip(model.param_names, held) if flag]
    if without.all():
        raise NotObservableError('the recording must determine at least one parameter, it determines none; '
                                 'record static positions in at least four different attitudes')
    if held.any() and not allow_holding:
        raise NotObservableError(f"every parameter must be determined, {len(names)} are not: {', '.join(names)}; "
                                 'record more motion or allow holding', code='undetermined')


def start(system: WeightedSystem) -> np.ndarray:
    """Return the solution for bias and matrix of each sensor, all other parameters at their prior, shape (n_params,)."""
    model = system.model
    values = model.start()
    values = np.where(np.isfinite(values), values, 0.0)
    for sensor in SENSORS:
        every = np.arange(model.layout(sensor).width)
        chosen = np.concatenate([every[model.columns_of(sensor, role)] for role in (Role.OFFSET, Role.LINEAR)])
        means = system.means[sensor]
        weight = np.sqrt(system.counts / system.counts.max())[:, None]
        penalty = 1e-6 * np.eye(4)
        target = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        design = np.concatenate([weight * means[:, chosen], penalty])
        solution = np.linalg.lstsq(design, np.concatenate([weight * means[:, -3:], penalty @ target]), rcond=None)[0]
        values[model.part(sensor, Role.OFFSET)], values[model.part(sensor, Role.LINEAR)] = solution[0], solution[1:].T.ravel()
    return values


def _factors(system, noises):
    return {sensor: system.factors(sensor, noises[sensor]) for sensor in SENSORS}


def _minimised(system, values, factors, free, enough=1e-7):
    """Gauss-Newton with step halving on the triangular factors, until steps are below `enough` standard deviations."""
    for _ in range(40):
        residual, data = system.residuals(values, factors), system.jacobian(values, factors)[:, free]
        step = scaled_lstsq(np.concatenate([data, system.prior.root[:, free]]), -residual)
        values, cost = _halved(system, values, step, free, factors, residual @ residual)
        sd_steps = np.abs(step) * np.sqrt((data**2).sum(axis=0) + 1 / system.prior.sd[free]**2)
        if np.max(sd_steps, initial=0.0) < enough * max(1.0, 1e-7 * np.sqrt(cost)):
            break
    return values


def _halved(system, values, step, free, factors, cost):
    """Return the values after the longest of the halved steps that does not raise the cost, and that cost."""
    for shrink in range(12):
        moved = values.copy()
        moved[free] += step * 0.5**shrink
        residual = system.residuals(moved, factors)
        if residual @ residual <= cost * (1 + 1e-12) + 1e-12:
            return moved, residual @ residual
    return values, cost


def _undetermined(system, values, factors, free):
    """
    Return a mask of the parameters whose standard deviation exceeds a share of the prior's.

    First the parameters that are weak even if all other parameters were known; then one at a time, given the ones fixed before:
    of parameters of which only the sum is observable, one stays free.
    """
    data, prior = system.jacobian(values, factors), system.prior
    jacobian = np.concatenate([data, prior.root])
    held = free & (HELD_SHARE * prior.sd * np.linalg.norm(data, axis=0) < 1)
    while True:
        left, share = free & ~held, np.zeros(len(values))
        share[left] = np.sqrt(np.diag(inverse_gram(jacobian[:, left]))) / prior.sd[left]
        if not np.any(share > HELD_SHARE):
            return held
        # The first of equal values, independent of rounding.
        held[np.argmax(share > 0.99 * share.max())] = True


def _fit_quality(system, values, noises):
    """Return chi-square per degree of freedom by part, and rms residuals (moving samples, window means)."""
    chi2, rms = {}, {}
    for sensor in SENSORS:
        noise, quality, moving, count = noises[sensor], {}, 0.0, 0
        misfit = system.misfit(sensor, system.means[sensor], values)
        white = system.whitened(misfit[:, :, None], noise)
        quality['means'] = float((white**2).sum() / max(white.size - _used(system, sensor), 1))
        for kind, factor in system.within[sensor].items():
            squares = (system.misfit(sensor, factor, values)**2).sum(axis=0)
            quality[kind] = float(np.mean(squares / (system.dof_within[kind] * noise.white_variance)))
            moving, count = moving + squares.sum(), count + 3 * system.dof_within[kind]
        chi2[sensor] = quality
        rms[sensor] = np.array([np.sqrt(moving / count) if count else np.nan, np.sqrt((misfit**2).mean())])
    return chi2, rms


def _session_biases(system, values, noises):
    """Return the bias of each recording for sensors with a bias of its own per recording: the best linear prediction."""
    found = {}
    for sensor in SENSORS:
        noise = noises[sensor]
        if noise.session_variance > 0:
            misfit = system.misfit(sensor, system.means[sensor], values)
            found[sensor] = values[system.model.part(sensor, Role.OFFSET)] + predict_session_offsets(
                misfit, system.mean_variance(noise) + noise.offset_sd**2, system.times, sessions=system.sessions, noise=noise)
    return found


def _used(system, sensor):
    """Return how many parameters the means determine: the ones of the sensor, at most half the data."""
    own = sum(e.size for e in system.model.concerning(sensor))
    return min(own, system.means[sensor].shape[0] * 3 // 2)
