"""Weighted least squares over all windows: noise, outliers, held parameters, covariance."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.distributions import chance_of_fall
from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import Accumulator, not_separable
from imu_calibration.estimation.model_error import model_error
from imu_calibration.estimation.noise_model import BiasProcess, NoiseModel
from imu_calibration.estimation.scaled_solve import (
    covariance_with_held,
    inverse_gram,
    inverse_normal,
    scaled_lstsq,
)
from imu_calibration.estimation.session_noise import (
    first_noise,
    moving_misfit,
    updated_noise,
)
from imu_calibration.estimation.solution import BIAS_PROCESS, HELD_PRIORS, SAMPLE_NOISE, Solution
from imu_calibration.estimation.weighted_system import WeightedSystem, fixed_parameters
from imu_calibration.estimation.whitening import predict_session_offsets

OUTLIER_P_VALUE = 1e-3
"""False positive rate per sensor and kind for a recording without outliers."""
MAX_WINDOW_OUTLIERS = 0.15
"""
Largest share of each kind that is excluded; a more frequent deviation is a property of the
recording.
"""
MIN_WINDOW_FREEDOM = 9.0
"""Residual degrees of freedom of the other windows of the kind that the test requires."""
OUTLIER_CANDIDATES = 8
"""Windows of each kind under test per round, in order of their residual."""
LEAST_SEEN = 0.05
"""A window whose error keeps less than this share in the residuals is not tested."""


def _outlier_windows(system, values, noises):
    """
    Return sensor -> keys of the outlying windows by kind.

    Without the ones that the noise model excludes already.

    Mean-shift F test, one kind of window per round (the one with the least probable outlier),
    because with a bias process one outlier makes its neighbours look inconsistent.

    A separate offset for one window must improve the fit of the other windows significantly (F test
    with Bonferroni correction). The noise may be overestimated because of that window; the factor
    is common to all windows and cancels in the ratio.

    Parameters
    ----------
    system : WeightedSystem
    values : ndarray, shape (n_params,)
        The estimate.
    noises : dict
        Sensor -> NoiseModel of the estimate.

    """
    found, kinds = {}, np.array(system.kinds)
    for sensor in SENSORS:
        fit, out = (
            _Fit.of(system, sensor, values, noises[sensor]),
            np.array([key in noises[sensor].left_out for key in system.keys]),
        )
        worst = min(
            (_of_kind(kinds == kind, out, fit) for kind in sorted(set(system.kinds))),
            key=lambda of_kind: of_kind[0],
        )
        found[sensor] = frozenset(system.keys[at] for at in worst[1])
    return found


def _of_kind(own: np.ndarray, out: np.ndarray, fit: '_Fit') -> tuple[float, list[int]]:
    """
    Return (the smallest p-value, the numbers of the outliers among the windows `own`).

    Without the windows `out`.
    """
    count, kept = int(own.sum()), np.flatnonzero(own & ~out)
    allowed = max(1, int(MAX_WINDOW_OUTLIERS * count)) - (count - len(kept))
    worst = (
        kept[np.argsort(-(fit.rest[kept] ** 2).sum(axis=1), kind='stable')][:OUTLIER_CANDIDATES]
        if allowed > 0
        else []
    )
    found = sorted((fit.p_value(at, kept) * len(kept), at) for at in worst)[:allowed]
    return found[0][0] if found else 1.0, [at for chance, at in found if chance < OUTLIER_P_VALUE]


@dataclass(frozen=True, eq=False)
class _Fit:
    """Whitened means of one sensor with the normal matrix of centred rows and prior."""

    rest: np.ndarray
    """Whitened residuals, shape (n_windows, 3)."""
    design: np.ndarray
    """Whitened columns, shape (n_windows, 3, q)."""
    covariance: np.ndarray
    """Of the parameters, shape (q, q)."""
    whiten: Callable
    """Function that whitens columns, shape (n_windows, 3, k)."""

    @classmethod
    def of(
        cls, system: WeightedSystem, sensor: str, values: np.ndarray, noise: NoiseModel
    ) -> '_Fit':
        rows, normal = system.linearised(sensor, values, noise)
        white = system.whitened(rows, noise)
        design, q = white[:, :, :-1], white.shape[2] - 1
        return cls(
            white[:, :, -1],
            design,
            inverse_normal(normal[:q, :q] + np.einsum('kap,kaq->pq', design, design)),
            lambda columns: system.whitened(columns, noise),
        )

    def p_value(self, at: int, own: np.ndarray) -> float:
        """
        Return the p-value of a separate offset for window `at`.

        It concerns the improvement of the windows `own` by this offset.
        """
        one = np.zeros(self.rest.shape + (1,))
        one[at] = 1.0
        one = self.whiten(one)[:, :, 0]
        along = np.einsum('kap,ka->ap', self.design, one)
        seen = (one**2).sum(axis=0) - np.einsum('ap,pq,aq->a', along, self.covariance, along)
        if np.any(seen < LEAST_SEEN * (one**2).sum(axis=0)):
            return 1.0
        size = (one * self.rest).sum(axis=0) / seen
        better = (
            self.rest
            - (one - np.einsum('kap,pq,aq->ka', self.design, self.covariance, along)) * size
        )
        leverage = np.einsum(
            'kap,pq,kaq->ka', self.design[own], self.covariance, self.design[own]
        ).sum()
        spare = 3 * len(own) - leverage - 3
        if spare < MIN_WINDOW_FREEDOM:
            return 1.0
        total, others = ((part[own] ** 2).sum() for part in (self.rest, better))
        return chance_of_fall(total - others, 3, rest=others, spare=spare)


MAX_PRIOR_SDS = 3.0
"""Prior standard deviations beyond which an entry of a matrix needs a reason that is not misfit."""

REST_NOISE_MARGIN = 1.1
"""
Residuals up to this times the variance at rest are noise: the rest used for its estimate may have
been quieter.
"""


def _implausible_estimates(system, values, *, sd, noises, free):
    """
    Return a mask of the parameters whose information may be an artefact of misfit.

    The value exceeds the range of known instruments, and it is no larger than the shift that all
    excess misfit of moving windows causes along the parameter. Example: an accelerometer's scale
    along an axis without gravity, determined only through arms and wrong angles. A gyroscope at the
    wrong full-scale setting has a value larger than its misfit explains, and is kept. All
    parameters of an effect are fixed, of a matrix single entries.

    Parameters
    ----------
    system : WeightedSystem
    values, sd : ndarray, shape (n_params,)
        The estimate and its standard deviation from noise.
    noises : dict
        Sensor -> NoiseModel.
    free : ndarray of bool, shape (n_params,)
        Parameters that were estimated.

    """
    found, feigned = (
        np.zeros(len(values), bool),
        {sensor: _feigned(system, sensor, values, noises[sensor]) for sensor in SENSORS},
    )
    for effect in system.model.effects:
        part = system.model.slices[effect.key]
        if effect.role is Role.OFFSET or not np.isfinite(_limit(effect)):
            continue
        size = np.abs(values[part] - system.prior.mean[part])
        sensors = (effect.sensor,) if effect.sensor in SENSORS else effect.acts_on
        strange = (
            free[part]
            & (size > _limit(effect))
            & (size < sd[part] * max(feigned[sensor] for sensor in sensors))
        )
        found[part] = strange if effect.role is Role.LINEAR else free[part] & strange.any()
    return found


def _limit(effect: Effect) -> float:
    return (
        MAX_PRIOR_SDS * float(np.max(effect.prior_sds()))
        if effect.role is Role.LINEAR
        else effect.largest
    )


def _feigned(system, sensor, values, noise):
    """
    Return the largest shift of a parameter by excess misfit, in sds of noise.

    It is the shift of a parameter of the worst axis by all excess misfit of moving windows.
    """
    rested = any(row.kind == 'static' for row in system.accumulator.rows)
    rest = (
        REST_NOISE_MARGIN * np.maximum(noise.low_variance, noise.white_variance) if rested else 0.0
    )
    total = np.zeros(3)
    for kind, factor in system.within[sensor].items():
        squares = (system.misfit(sensor, factor, values) ** 2).sum(axis=0)
        weight = noise.low_variance * (noise.moving[kind].slow if kind in noise.moving else 1.0)
        total += np.maximum(squares - system.dof_within[kind] * rest, 0.0) / weight
    return float(np.sqrt(total.max()))


HELD_SHARE = 0.5
"""A parameter whose standard deviation exceeds this share of its prior's is fixed at the prior."""
NOISE_ROUNDS = 6
"""Largest number of alternating estimates of noise and parameters."""
LEAVING_ROUNDS = 5
"""Largest number of rounds of outlier exclusion; one outlier may hide another."""


def solve(
    accumulator: Accumulator,
    model: SensorModel,
    *,
    allow_holding: bool = True,
    noise: dict[str, NoiseModel] | None = None,
    bias_processes: dict[str, tuple[BiasProcess, ...]] | None = None,
) -> Solution:
    """
    Estimate all parameters jointly from accumulated windows.

    Minimises the sum of squares of whitened rows ``[columns | output] @ [coefficients(values);
    -1]`` over all windows and axes plus the prior. Window offsets and bias processes are part of
    the noise (restricted maximum likelihood).

    Parameters
    ----------
    accumulator : Accumulator
        Windows reduced with the columns of `model`.
    model : SensorModel
    allow_holding : bool
        Whether parameters that the data do not determine may be fixed at their prior.
    noise : dict, optional
        Sensor -> NoiseModel, if known.
    bias_processes : dict, optional
        Sensor -> bias processes from a separate measurement; the other noise parameters are
        estimated.

    Returns
    -------
    Solution

    Raises
    ------
    NotObservableError
        When no parameter is determined, or one is undetermined and `allow_holding` is False.

    """
    if not accumulator.rows:
        raise NotObservableError(
            'at least one static window, spin or dynamic stretch must be found, none was; '
            'rest the table between moves, or check the joint states',
            code='no_windows',
        )
    system = WeightedSystem(accumulator, model)
    prior, values, free = system.prior, start(system), ~fixed_parameters(model)
    noises = noise or first_noise(system, values, bias_processes or {})
    if noise is None:
        values, noises = _with_noise(system, values, noises, free)
        for _ in range(LEAVING_ROUNDS):
            more = _outlier_windows(system, values, noises)
            if not any(more.values()):
                break
            smaller = {
                s: replace(noises[s], left_out=noises[s].left_out | more[s]) for s in SENSORS
            }
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
        own, of_held = covariance_with_held(
            np.concatenate([data, prior.root]), free & ~held, held, prior_sd=prior.sd
        )
        strange = _implausible_estimates(
            system, values, sd=np.sqrt(np.diag(own + of_held)), noises=noises, free=free & ~held
        )
        if not allow_holding or not strange.any() or (held | strange | ~free).all():
            break
        not_believed |= {
            name: float(value)
            for name, value, flag in zip(model.param_names, values, strange)
            if flag
        }
        held |= strange
    of_bias = own @ system.bias_information(values, noises) @ own
    terms = {
        SAMPLE_NOISE: own - of_bias,
        BIAS_PROCESS: of_bias,
        HELD_PRIORS: of_held,
        **model_error(system, values, noises, free=free & ~held).terms(own + of_held),
    }
    chi2, rms, slow_over_fast = _fit_quality(system, values, noises)
    return Solution(
        model,
        values,
        terms,
        held,
        noises,
        chi2,
        data.T @ data,
        rms,
        _session_biases(system, values, noises),
        not_believed,
        slow_over_fast=slow_over_fast,
    )


def _with_noise(system, values, noises, free):
    """
    Return (values, noise), estimated alternately.

    One round usually suffices: the likelihood of the offsets is restricted, so it does not depend
    on the values of the parameters. With separate weights of slow and fast parts, weights and
    parameters depend on each other.
    """
    for _ in range(NOISE_ROUNDS):
        values = _minimised(system, values, _factors(system, noises), free, enough=0.01)
        before, noises = (
            noises,
            {s: updated_noise(system, s, values, noise=noises[s]) for s in SENSORS},
        )
        if all(noises[s].weighs_alike(before[s]) for s in SENSORS):
            break
    return values, noises


def _refuse(without, held, model, allow_holding):
    names = [name for name, flag in zip(model.param_names, held) if flag]
    if without.all():
        raise NotObservableError(
            'the recording must determine at least one parameter, it determines none; '
            'record static positions in at least four different attitudes'
        )
    if held.any() and not allow_holding:
        raise NotObservableError(
            f'every parameter must be determined, {len(names)} are not: {", ".join(names)}; '
            'record more motion or allow holding',
            code='undetermined',
        )


def start(system: WeightedSystem) -> np.ndarray:
    """
    Return the solution for bias and matrix of each sensor, all other parameters at their prior.

    Shape (n_params,).
    """
    model = system.model
    values = model.start()
    values = np.where(np.isfinite(values), values, 0.0)
    for sensor in SENSORS:
        every = np.arange(model.layout(sensor).width)
        chosen = np.concatenate(
            [every[model.columns_of(sensor, role)] for role in (Role.OFFSET, Role.LINEAR)]
        )
        means = system.means[sensor]
        weight = np.sqrt(system.counts / system.counts.max())[:, None]
        penalty = 1e-6 * np.eye(4)
        target = np.concatenate([np.zeros((1, 3)), np.eye(3)])
        design = np.concatenate([weight * means[:, chosen], penalty])
        solution = np.linalg.lstsq(
            design, np.concatenate([weight * means[:, -3:], penalty @ target]), rcond=None
        )[0]
        values[model.part(sensor, Role.OFFSET)], values[model.part(sensor, Role.LINEAR)] = (
            solution[0],
            solution[1:].T.ravel(),
        )
    return values


def _factors(system, noises):
    return {sensor: system.factors(sensor, noises[sensor]) for sensor in SENSORS}


def _minimised(system, values, factors, free, enough=1e-7):
    """
    Gauss-Newton with step halving on the triangular factors.

    It continues until steps are below `enough` standard deviations.
    """
    for _ in range(40):
        residual, data = (
            system.residuals(values, factors),
            system.jacobian(values, factors)[:, free],
        )
        step = scaled_lstsq(np.concatenate([data, system.prior.root[:, free]]), -residual)
        values, cost = _halved(system, values, step, free, factors, residual @ residual)
        sd_steps = np.abs(step) * np.sqrt((data**2).sum(axis=0) + 1 / system.prior.sd[free] ** 2)
        if np.max(sd_steps, initial=0.0) < enough * max(1.0, 1e-7 * np.sqrt(cost)):
            break
    return values


def _halved(system, values, step, free, factors, cost):
    """
    Return the values after the longest acceptable step, and their cost.

    The step is the longest of the halved steps that does not raise the cost.
    """
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

    First the parameters that are weak even if all other parameters were known; then one at a time,
    given the ones fixed before: of parameters of which only the sum is observable, one stays free.
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
    """
    Return chi-square per degree of freedom by part, rms residuals, and slow over fast residuals.

    The residuals are for moving samples and for window means.
    """
    chi2, rms, slow_over_fast = {}, {}, {}
    for sensor in SENSORS:
        noise, quality, moving, count = noises[sensor], {}, 0.0, 0
        misfit = system.misfit(sensor, system.means[sensor], values)
        white = system.whitened(misfit[:, :, None], noise)
        quality['means'] = float((white**2).sum() / max(white.size - _used(system, sensor), 1))
        for kind, factor in system.within[sensor].items():
            squares = (system.misfit(sensor, factor, values) ** 2).sum(axis=0)
            quality[kind] = float(
                np.mean(squares / (system.dof_within[kind] * noise.white_variance))
            )
            moving, count = moving + squares.sum(), count + 3 * system.dof_within[kind]
        chi2[sensor] = quality
        slow_over_fast[sensor] = {
            kind: moving_misfit(system, sensor, kind, values=values).slow_over_fast(noise.inflation)
            for kind in system.within[sensor]
        }
        rms[sensor] = np.array(
            [np.sqrt(moving / count) if count else np.nan, np.sqrt((misfit**2).mean())]
        )
    return chi2, rms, slow_over_fast


def _session_biases(system, values, noises):
    """
    Return the bias of each recording for sensors with a bias of its own per recording.

    The best linear prediction.
    """
    found = {}
    for sensor in SENSORS:
        noise = noises[sensor]
        if noise.session_variance > 0:
            misfit = system.misfit(sensor, system.means[sensor], values)
            found[sensor] = values[
                system.model.part(sensor, Role.OFFSET)
            ] + predict_session_offsets(
                misfit,
                system.mean_variance(noise) + noise.offset_sd**2,
                system.times,
                sessions=system.sessions,
                noise=noise,
            )
    return found


def _used(system, sensor):
    """
    Return how many parameters the means determine: the ones of the sensor, at most half the data.
    """
    own = sum(e.size for e in system.model.concerning(sensor))
    return min(own, system.means[sensor].shape[0] * 3 // 2)
