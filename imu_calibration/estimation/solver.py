"""Solving the system: one weighted non-linear least-squares problem over all windows, with honest standard deviations."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficient_jacobian, coefficients
from imu_calibration.errors import NotObservableError
from imu_calibration.estimation.band_misfit import band_misfit, own_misfit, variance_along, weighed
from imu_calibration.estimation.linear_least_squares import _inverse_gram, _scaled_lstsq, triangular
from imu_calibration.estimation.noise_model import WindowNoise, sessions_of, white_noise
from imu_calibration.estimation.noise_search import estimate_offsets
from imu_calibration.estimation.prior import fixed_parameters, make_prior
from imu_calibration.estimation.solution import Solution
from imu_calibration.estimation.whitening import predict_session_offsets, whiten

HELD_SHARE = 0.5
"""A parameter whose standard deviation exceeds this share of its prior's is held at the prior."""

NOISE_ROUNDS = 6
"""Times that noise and parameters are estimated in turn, at most."""


def solve(accumulator, model, allow_holding=True, prior=None, noise=None):
    """
    Estimate all parameters jointly from accumulated windows.

    Minimises the sum of squares of whitened rows ``[columns | output] @ [coefficients(values); -1]`` over all windows and
    axes plus the prior. Window offsets and a wandering bias are part of the noise (restricted maximum likelihood).

    Parameters
    ----------
    accumulator : Accumulator
        Windows reduced with the columns of `model`.
    allow_holding : bool
        Whether parameters that the data do not determine may be held at their prior.
    noise : dict, optional
        Sensor -> WindowNoise, when it is known.

    Raises
    ------
    NotObservableError
        When nothing is determined, or something is not and holding is not allowed.

    """
    if not accumulator.rows:
        raise NotObservableError('at least one static window, spin or dynamic stretch must be found, none was; '
                                 'let the table rest between moves, or check the joint states')
    prior = prior or make_prior(model)
    problem = _Problem(accumulator, model, prior)
    values = problem.start()
    noises = noise or problem.first_noise(values)
    if noise is None:
        # Mostly once is enough: the likelihood of the offsets is taken over the parameters, so it does not depend on where they stand.
        # Where slow and fast parts are weighed apart, the weights move the parameters and these the weights.
        for _ in range(NOISE_ROUNDS):
            values = problem.minimise(values, noises, _free(model, None), enough=0.01)
            before, noises = noises, problem.update_noise(values, noises)
            if all(noises[s].weighs_alike(before[s]) for s in SENSORS):
                break
    values = problem.minimise(values, noises, _free(model, None))
    held = problem.undetermined(values, noises)
    _refuse(held | fixed_parameters(model), held, model, allow_holding)
    if held.any():
        values = np.where(held, prior.mean, values)
        values = problem.minimise(values, noises, _free(model, held))
    covariance, information = problem.covariance(values, noises, held)
    chi2, rms = problem.fit_quality(values, noises)
    return Solution(model, values, covariance, held, noises, chi2, information, rms, problem.session_biases(values, noises))


def _free(model, held):
    free = ~fixed_parameters(model)
    return free if held is None else free & ~held


def _refuse(without, held, model, allow_holding):
    names = [name for name, flag in zip(model.param_names, held) if flag]
    if without.all():
        raise NotObservableError('the recording must determine at least one parameter, it determines none; record static positions in at least four '
                                 'different attitudes')
    if held.any() and not allow_holding:
        raise NotObservableError(f"every parameter must be determined, {len(names)} are not: {', '.join(names)}; record more motion or allow holding")


class _Problem:
    """The rows of one solve, and the functions of the values that the solve needs."""

    def __init__(self, accumulator, model, prior):
        self.model, self.prior, self.accumulator = model, prior, accumulator
        rows = accumulator.rows
        self.times = np.array([row.time for row in rows])
        self.counts = np.array([row.count for row in rows], float)
        self.sessions = sessions_of(rows)
        self.means = {s: np.array([row.sensors[s].mean for row in rows]) for s in SENSORS}
        self.within = {s: {k: f for (sensor, k), f in sorted(accumulator.within.items()) if sensor == s and len(f)} for s in SENSORS}
        self.dof_within = {k: max(accumulator.samples[k] - accumulator.windows[k], 1) for k in accumulator.samples}
        self.fixed = np.where(np.isfinite(model.prior()[0]), 0.0, np.inf)

    def start(self):
        """Return the static solution: bias and matrix of each sensor alone, everything else at its prior."""
        values = self.model.start()
        values = np.where(np.isfinite(values), values, 0.0)
        for sensor in SENSORS:
            index = np.arange(len(values))
            bias, matrix = (index[self.model.slices[sensor, name]] for name in ('bias', 'matrix'))
            order = np.cumsum([0] + [width for _, width in self.model.groups(sensor)])
            first = {name: start for (name, _), start in zip(self.model.groups(sensor), order)}
            chosen = [first['one']] + [first['force' if sensor == 'accelerometer' else 'rate'] + k for k in range(3)]
            means, p = self.means[sensor], self.means[sensor].shape[1] - 3
            weight = np.sqrt(self.counts / self.counts.max())[:, None]
            penalty = 1e-6 * np.eye(4)
            target = np.concatenate([np.zeros((1, 3)), np.eye(3)])
            design = np.concatenate([weight * means[:, chosen], penalty])
            solution = np.linalg.lstsq(design, np.concatenate([weight * means[:, p:], penalty @ target]), rcond=None)[0]
            values[bias], values[matrix] = solution[0], solution[1:].T.ravel()
        return values

    def first_noise(self, values):
        """Return the noise before any residual is known; fast parts wait where slow ones can be fitted better."""
        return {s: self._with_bands(s, self._noise_of(s, values)) for s in SENSORS}

    def _noise_of(self, sensor, values):
        white = white_noise(self.accumulator.rows, sensor)
        if white is not None:
            return WindowNoise(*white)
        variance = np.full(3, 1e-30)
        for kind in self.within[sensor]:
            variance = np.maximum(variance, self._band_misfit(sensor, kind, values).noise)
        if not self.within[sensor]:
            variance = np.full(3, self.means[sensor][:, -3:].var() + 1e-12)
        return WindowNoise(variance, np.ones(3))

    def _misfit(self, sensor, rows, values):
        """Return output minus prediction of rows ``[columns | output]``, shape (k, 3)."""
        return rows[:, -3:] - rows[:, :-3] @ coefficients(self.model, sensor, values)

    def mean_variance(self, noise):
        """Return the variance of the window means by the noise within, shape (n_windows, 3)."""
        return noise.white_variance * noise.inflation / self.counts[:, None]

    def _whitened(self, rows, noise):
        variance = self.mean_variance(noise) + noise.offset_sd**2
        return whiten(rows, variance, self.times, self.sessions, noise.wander_sd, noise.wander_time, noise.session_variance)

    def systems(self, sensor, noise):
        """Return for each axis the triangular factor of all whitened rows ``[columns | output]``."""
        p = self.means[sensor].shape[1] - 3
        rows = np.stack([self.means[sensor][:, list(range(p)) + [p + axis]] for axis in range(3)], axis=1)
        white = self._whitened(rows, noise)
        factors = []
        for axis in range(3):
            parts = [white[:, axis]]
            parts += [rows[:, list(range(p)) + [p + axis]] * weight[axis] for rows, weight in self._weighed_rows(sensor, noise)]
            factors.append(triangular(np.concatenate(parts)))
        return factors

    def _weighed_rows(self, sensor, noise):
        """Yield (centred rows, weight of each axis (3,)): all of each kind, and once more the slow ones where these count for more."""
        for kind, factor in self.within[sensor].items():
            yield factor, 1 / noise.within_sd(kind)
            extra = noise.slow_weight(kind)
            if extra.any():
                yield self.accumulator.slow[sensor, kind], extra

    def rows_of(self, values, factors):
        """Return residual rows and their Jacobian over both sensors and all axes, without the prior."""
        residuals, jacobians = [], []
        for sensor in SENSORS:
            c, dc = coefficients(self.model, sensor, values), coefficient_jacobian(self.model, sensor, values)
            for axis, factor in enumerate(factors[sensor]):
                residuals.append(factor[:, :-1] @ c[:, axis] - factor[:, -1])
                jacobians.append(factor[:, :-1] @ dc[:, axis])
        return np.concatenate(residuals), np.concatenate(jacobians)

    def minimise(self, values, noises, free, enough=1e-7):
        """Gauss-Newton with step halving on the triangular factors, until steps are below `enough` standard deviations."""
        factors = {s: self.systems(s, noises[s]) for s in SENSORS}
        cost = np.inf
        for _ in range(40):
            residual, jacobian = self._with_prior(values, factors)
            step = _scaled_lstsq(jacobian[:, free], -residual)
            moved, cost, residual_new = self._halve(values, step, free, factors, residual @ residual)
            sd_steps = np.abs(step) * np.sqrt((jacobian[:-len(self.prior.root), free]**2).sum(axis=0) + 1 / self.prior.sd[free]**2)
            values = moved
            if np.max(sd_steps, initial=0.0) < enough * max(1.0, 1e-7 * np.sqrt(cost)):
                break
        return values

    def _halve(self, values, step, free, factors, cost):
        for shrink in range(12):
            moved = values.copy()
            moved[free] += step * 0.5**shrink
            residual = self._residual_with_prior(moved, factors)
            if residual @ residual <= cost * (1 + 1e-12) + 1e-12:
                return moved, residual @ residual, residual
        return values, cost, None

    def _residual_with_prior(self, values, factors):
        parts = []
        for sensor in SENSORS:
            c = coefficients(self.model, sensor, values)
            parts += [factor[:, :-1] @ c[:, axis] - factor[:, -1] for axis, factor in enumerate(factors[sensor])]
        return np.concatenate(parts + [self.prior.root @ (values - self.prior.mean)])

    def _with_prior(self, values, factors):
        residual, jacobian = self.rows_of(values, factors)
        return (np.concatenate([residual, self.prior.root @ (values - self.prior.mean)]), np.concatenate([jacobian, self.prior.root]))

    def undetermined(self, values, noises):
        """Return a mask of the parameters whose standard deviation stays above a share of the prior's."""
        factors = {s: self.systems(s, noises[s]) for s in SENSORS}
        _, jacobian = self._with_prior(values, factors)
        free = _free(self.model, None)
        sd = np.zeros(len(values))
        sd[free] = np.sqrt(np.diag(_inverse_gram(jacobian[:, free])))
        return free & (sd > HELD_SHARE * self.prior.sd)

    def covariance(self, values, noises, held):
        """Return the covariance with held parameters considered at their prior, and the information of the data."""
        factors = {s: self.systems(s, noises[s]) for s in SENSORS}
        _, data = self.rows_of(values, factors)
        free = _free(self.model, held)
        jacobian = np.concatenate([data, self.prior.root])
        gain = _inverse_gram(jacobian[:, free])
        total = np.zeros((len(values), len(values)))
        prior_cov = np.diag(np.where(held, self.prior.sd**2, 0.0))
        sensitivity = -_scaled_lstsq(jacobian[:, free], jacobian[:, held]) if held.any() else np.zeros((free.sum(), 0))
        inner = prior_cov[np.ix_(held, held)]
        total[np.ix_(free, free)] = gain + sensitivity @ inner @ sensitivity.T
        total[np.ix_(free, held)] = sensitivity @ inner
        total[np.ix_(held, free)] = total[np.ix_(free, held)].T
        total[np.ix_(held, held)] = inner
        return total, data.T @ data

    def update_noise(self, values, noises):
        """Return the noise that the residuals at `values` show."""
        return {sensor: self._updated(sensor, values, noises) for sensor in SENSORS}

    def _updated(self, sensor, values, noises):
        noise = noises[sensor]
        if white_noise(self.accumulator.rows, sensor) is None:
            noise = self._noise_of(sensor, values)
        noise = weighed(noise, {kind: self._judged(sensor, kind, values) for kind in self.within[sensor]})
        design, information = self._linearised(sensor, values, noise, noises)
        offsets = estimate_offsets(design, self.mean_variance(noise), self.times, self.sessions, information)
        return replace(noise, **offsets)

    def _with_bands(self, sensor, noise):
        """Return the noise with next to no weight for the fast parts where slow parts, each fitted alone, leave less."""
        misfits = {kind: self._band_misfit(sensor, kind) for kind in self.within[sensor]}
        return weighed(noise, {kind: misfit.without_fast() for kind, misfit in misfits.items() if misfit.apart.any()})

    def _judged(self, sensor, kind, values):
        """Return the BandMisfit of the centred rows of a kind, with what the fast part misses along the parameters."""
        misfit = self._band_misfit(sensor, kind, values)
        if not misfit.apart.any():
            return misfit
        dc = coefficient_jacobian(self.model, sensor, values)[:, :, ~fixed_parameters(self.model)]
        along = np.zeros(3)
        for axis in range(3):
            along[axis] = variance_along(*((rows[:, :-3] @ dc[:, axis], self._misfit(sensor, rows, values)[:, axis])
                                           for rows in (self.within[sensor][kind], self.accumulator.slow[sensor, kind])))
        return replace(misfit, fast=np.where(misfit.apart, np.maximum(misfit.fast, along), misfit.fast))

    def _band_misfit(self, sensor, kind, values=None):
        """Return the BandMisfit of the centred rows of a kind at `values`; without them, of each part at its own best fit."""
        rows, n_slow = self.within[sensor][kind], self.accumulator.slow_rows.get(kind, 0) - self.accumulator.windows[kind]
        slow = self.accumulator.slow[sensor, kind] if n_slow > 0 else rows[:0]
        misfits = [own_misfit(part) if values is None else self._misfit(sensor, part, values) for part in (rows, slow)]
        total, of_slow = ((misfit**2).sum(axis=0) for misfit in misfits)
        return band_misfit(total, self.dof_within[kind], of_slow, n_slow)

    def _linearised(self, sensor, values, noise, noises):
        """Return mean rows ``[design | residual]`` in the parameters, and the Gram matrix of what else is known of them."""
        dc = coefficient_jacobian(self.model, sensor, values)
        own = np.flatnonzero(np.any(dc != 0, axis=(0, 1)))
        dc, root = dc[:, :, own], self.prior.root[:, own]
        means = self.means[sensor]
        misfit = self._misfit(sensor, means, values)
        design = np.einsum('kp,paq->kaq', means[:, :-3], dc)
        rows = np.concatenate([design, misfit[:, :, None]], axis=2)
        used = np.any(root != 0, axis=1)
        offset = self.prior.root[used] @ (self.prior.mean - values)
        parts = [np.concatenate([root[used], offset[:, None]], axis=1)]
        for factor, weight in self._weighed_rows(sensor, noise):
            rest = self._misfit(sensor, factor, values)
            parts += [np.concatenate([factor[:, :-3] @ dc[:, axis], rest[:, axis:axis + 1]], axis=1) * weight[axis] for axis in range(3)]
        stacked = np.concatenate(parts)
        return rows, stacked.T @ stacked

    def fit_quality(self, values, noises):
        """Return chi-square per degree of freedom by part, and rms residuals (moving samples, window means)."""
        chi2, rms = {}, {}
        for sensor in SENSORS:
            noise, quality, moving, count = noises[sensor], {}, 0.0, 0
            misfit = self._misfit(sensor, self.means[sensor], values)
            white = self._whitened(misfit[:, :, None], noise)
            quality['means'] = float((white**2).sum() / max(white.size - self._used(sensor), 1))
            for kind, factor in self.within[sensor].items():
                squares = (self._misfit(sensor, factor, values)**2).sum(axis=0)
                quality[kind] = float(np.mean(squares / (self.dof_within[kind] * noise.white_variance)))
                moving, count = moving + squares.sum(), count + 3 * self.dof_within[kind]
            chi2[sensor] = quality
            rms[sensor] = np.array([np.sqrt(moving / count) if count else np.nan, np.sqrt((misfit**2).mean())])
        return chi2, rms

    def session_biases(self, values, noises):
        """Return the bias of each recording for sensors with a bias of its own per recording: the best linear prediction."""
        found = {}
        for sensor in SENSORS:
            noise = noises[sensor]
            if noise.session_variance > 0:
                misfit = self._misfit(sensor, self.means[sensor], values)
                found[sensor] = values[self.model.slices[sensor, 'bias']] + predict_session_offsets(
                    misfit, self.mean_variance(noise) + noise.offset_sd**2, self.times, self.sessions, noise)
        return found

    def _used(self, sensor):
        """Return how many parameters the means determine: those of bias and matrix, at most half the data."""
        own = sum(e.size for e in self.model.concerning(sensor))
        return min(own, self.means[sensor].shape[0] * 3 // 2)
