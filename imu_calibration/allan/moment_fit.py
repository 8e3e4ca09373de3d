"""Fit of noise processes to an Allan curve by moments, with intervals of inverted score tests."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations
from typing import Any

import numpy as np
from scipy.linalg.lapack import dtrtri
from scipy.special import gammainc, gammaincc, ndtr

from imu_calibration.allan.processes import (
    QUANTISATION,
    WHITE,
    NoiseProcess,
    ScaleCovariance,
    gauss_markov,
)
from imu_calibration.allan.trends import KeptShare, Parts

MAX_WEIGHT_ROUNDS = 25
"""Rounds of weights and coefficients at most."""
FLOOR = 1e-6
"""Least share of the upper limit of each process in the weights, so that they are finite."""
RIDGE = 0.02
"""
Added to the correlations, which are good to a hundredth: neighbouring scales are nearly the same.
"""
SHORTEST_TIME = 4.0
"""Shortest correlation time of a bias, s."""
TIME_RATIO, TIME_RATIO_OF_WEIGHTS = 1.1, 1.3
"""
Correlation times are tried on a grid of the first ratio, weights are made on one of the second.
"""


@dataclass(frozen=True, eq=False)
class MomentFit:
    """Coefficients of processes fitted to one axis."""

    processes: tuple[NoiseProcess, ...]
    """The model."""
    coefficients: np.ndarray
    """Squares of the figures, shape (n_processes,), none negative."""
    covariance: np.ndarray
    """Covariance of the variances at the fitted model, shape (n_scales, n_scales)."""
    misfit: float
    """Weighted sum of squares."""

    cost: float = np.inf
    """Cost among the forms (`terms.fit_form`); infinite where forms were not compared."""

    @property
    def form(self) -> tuple[str, ...]:
        """Names of the slow processes."""
        return tuple(name for name in self.names if name not in (QUANTISATION.name, WHITE.name))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the processes."""
        return tuple(process.name for process in self.processes)

    def coefficient(self, name: str) -> float:
        """Return the coefficient of a process, 0 without it."""
        return float(self.coefficients[self.names.index(name)]) if name in self.names else 0.0


@dataclass(frozen=True, eq=False)
class Moments:
    """The Allan variances of one axis at the scales that are fitted."""

    scales: ScaleCovariance
    """Expected values."""
    variance: np.ndarray
    """Shape (n_scales,)."""
    used: np.ndarray
    """Mask of the scales in the fit, bool, shape (n_scales,)."""
    kept: KeptShare = KeptShare()
    """Share of each process that remains after subtraction of the trends."""
    parts: Parts = Parts()
    """The variances of each part at rest."""
    scatter: float = 0.0
    """Standard deviation of the level of the noise from part to part, over the level."""

    @cached_property
    def times(self) -> np.ndarray:
        """
        Correlation times that are tried, s, always from the same grid.

        Shorter ones belong to filters, not to a bias.
        """
        longest = max(4 * self.scales.tau[self.used][-1], 2 * SHORTEST_TIME)
        first, last = (round(np.log(t) / np.log(TIME_RATIO)) for t in (SHORTEST_TIME, longest))
        return TIME_RATIO ** np.arange(first, last + 1.0)

    @cached_property
    def wander(self) -> np.ndarray:
        """
        Expectations of Gauss-Markov processes of unit variance with these times.

        Shape (n_used, n_times).
        """
        return self.design(tuple(gauss_markov(time) for time in self.times))

    def design(self, processes: tuple[NoiseProcess, ...]) -> np.ndarray:
        """Return the expectations for unit coefficients, shape (n_used, n_processes)."""
        tau = self.scales.tau
        return np.column_stack(
            [self.scales.expectation(process) * self.kept.of(process, tau) for process in processes]
        )[self.used]

    def tensor(self, processes: tuple[NoiseProcess, ...]) -> np.ndarray:
        """
        Return the products of `ScaleCovariance.tensor` at the scales used.

        For weights a nearby correlation time will do.
        """
        rounded = tuple(
            gauss_markov(_rounded(process.time)) if process.time else process
            for process in processes
        )
        return self.scales.tensor(rounded)[:, :, self.used][:, :, :, self.used]

    @property
    def target(self) -> np.ndarray:
        """The variances used, shape (n_used,)."""
        return self.variance[self.used]

    def covariance(self, design: np.ndarray, tensor: np.ndarray, values: np.ndarray) -> np.ndarray:
        """
        Return the covariance of the variances used for coefficients `values`.

        Sampling error and variation between parts.
        """
        chance = np.einsum('p,q,pqij->ij', values, values, tensor)
        if not self.scatter:
            return chance
        level = self.scatter * np.sqrt(self.parts.share())[self.used] * (design @ values)
        return chance + np.outer(level, level)


def fit_processes(
    moments: Moments,
    processes: tuple[NoiseProcess, ...],
    fixed: dict[int, float] | None = None,
    *,
    start: np.ndarray | None = None,
) -> MomentFit:
    """
    Fit the coefficients of given processes.

    Parameters
    ----------
    moments : Moments
    processes : tuple of NoiseProcess
    fixed : dict, optional
        Index of a process -> coefficient that is not fitted.
    start : ndarray, shape (n_processes,), optional
        Coefficients that the first weights are made with.

    """
    from scipy.optimize import nnls  # here, because its import is slow

    design = moments.design(processes)
    tensor = moments.tensor(processes)
    target = moments.target
    free = np.array([k for k in range(len(processes)) if k not in (fixed or {})], int)
    values = _first_guess(design, target, moments) if start is None else np.array(start, float)
    for k, value in (fixed or {}).items():
        values[k] = value
    floor = FLOOR * np.min(target[:, None] / design, axis=0)
    for _ in range(MAX_WEIGHT_ROUNDS):
        covariance = moments.covariance(design, tensor, np.maximum(values, floor))
        whitener = Whitener(covariance)
        new = values.copy()
        if len(free):
            columns = whitener(design[:, free])
            rest = whitener(
                target
                - sum(
                    (design[:, k] * value for k, value in (fixed or {}).items()),
                    np.zeros(len(target)),
                )
            )
            size = np.linalg.norm(columns, axis=0)
            new[free] = nnls(columns / size, rest)[0] / size
        done = np.all(np.abs(new - values) <= 1e-7 * np.maximum(new, values))
        values = new
        if done:
            break
    covariance = moments.covariance(design, tensor, np.maximum(values, floor))
    residual = Whitener(covariance)(target - design @ values)
    return MomentFit(tuple(processes), values, covariance, float(residual @ residual))


class Whitener:
    """Turns vectors into ones of unit covariance."""

    def __init__(self, covariance: np.ndarray):
        self._sd = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(self._sd, self._sd)
        self._factor = _cholesky(correlation + RIDGE * np.eye(len(correlation)))
        # Well conditioned with the ridge; a solve of this size waits for threads.
        self._inverse = dtrtri(self._factor, lower=1)[0]

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return float(2 * np.log(np.diag(self._factor)).sum() + 2 * np.log(self._sd).sum())

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return vectors (or the columns of a matrix) of unit covariance."""
        scaled = rows / (self._sd if rows.ndim == 1 else self._sd[:, None])
        return self._inverse @ scaled

    def weights(self, whitened: np.ndarray) -> np.ndarray:
        """Return the weights of the original vector that give the product with a whitened one."""
        return self._inverse.T @ whitened / self._sd


def _cholesky(matrix):
    """
    Return the factor of a correlation matrix with approximation errors in its smallest eigenvalues.
    """
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.linalg.cholesky(
            matrix + (RIDGE - np.linalg.eigvalsh(matrix)[0]) * np.eye(len(matrix))
        )


def _rounded(time):
    return TIME_RATIO_OF_WEIGHTS ** round(np.log(time) / np.log(TIME_RATIO_OF_WEIGHTS))


def _first_guess(design, target, moments):
    """
    Return coefficients that follow the curve on a logarithmic scale.

    They follow it more closely at short averaging times.
    """
    from scipy.optimize import nnls

    weight = 1.0 / (target * np.sqrt(moments.scales.tau[moments.used]))
    values = nnls(design * weight[:, None], target * weight)[0]
    return np.maximum(values, 1e-6 * np.min(target[:, None] / design, axis=0))


def fit_with_time(
    moments: Moments, processes: tuple[NoiseProcess, ...], fixed: dict[int, float] | None = None
) -> MomentFit:
    """
    Fit given processes, and as the last one a Gauss-Markov process of unknown correlation time.

    With fixed weights the best time minimises the weighted sum of squares; the weights are updated
    until the time converges.
    """
    whitener = Whitener(np.diag((moments.target**2 * moments.scales.tau[moments.used])))
    fit = None
    seen = set()
    while True:
        best = _best_time(moments, processes, whitener, fixed or {})
        if fit is not None and best in seen:
            return fit
        seen.add(best)
        model = (*processes, gauss_markov(moments.times[best]))
        fit = fit_processes(moments, model, fixed, start=None if fit is None else fit.coefficients)
        whitener = Whitener(fit.covariance)


def _best_time(moments, processes, whitener, fixed):
    """
    Return the index of the time with the smallest sum of squares at given weights.

    No coefficient is negative.
    """
    last = len(processes)
    known = whitener(moments.design(processes))
    wander = whitener(moments.wander)
    times = moments.times
    target = whitener(moments.target) - sum(
        (known[:, k] * value for k, value in fixed.items() if k < last), np.zeros(len(known))
    )
    rest = (
        target[:, None] - wander * fixed[last]
        if last in fixed
        else np.repeat(target[:, None], len(times), axis=1)
    )
    free = [k for k in range(last) if k not in fixed]
    best = np.full(len(times), np.inf)
    for count in range(len(free) + 1):
        for chosen in combinations(free, count):
            best = np.minimum(best, _costs(known[:, list(chosen)], wander, rest, last in fixed))
    return int(np.argmin(best))


def _costs(known, wander, rest, held):
    """
    Return the sums of squares with these columns and one of `wander` each.

    Infinite where a coefficient would be negative.
    """
    basis, triangle = np.linalg.qr(known)
    own, beside = (values - basis @ (basis.T @ values) for values in (wander, rest))
    amount = (
        np.zeros(wander.shape[1])
        if held
        else np.maximum(np.einsum('it,it->t', own, beside) / np.einsum('it,it->t', own, own), 0.0)
    )
    cost = np.einsum('it,it->t', beside - amount * own, beside - amount * own)
    values = (
        np.linalg.solve(triangle, basis.T @ (rest - amount * wander))
        if known.shape[1]
        else np.zeros((1, 1))
    )
    return np.where((values >= 0).all(axis=0), cost, np.inf)


TAIL = 0.025
"""Probability beyond each end."""
MAX_LOG_RATIO = 20.0
"""Largest logarithm of an end over the estimate."""
LOG_TIME_STEP = 0.02
"""Step of the derivative by the logarithm of a correlation time."""
INTERVAL_ACCURACY_SDS = 0.02
"""Accuracy of the ends, in standard deviations."""


def coefficient_interval(
    moments: Moments,
    fits: Sequence[MomentFit],
    weights: Sequence[float],
    *,
    name: str,
    excess: float = 1.0,
) -> tuple[float, float]:
    """
    Return the interval of the coefficient of a process: from 0 where the curve does without it.

    Parameters
    ----------
    moments : Moments
    fits : sequence of MomentFit
        Fits of the models that have the process, the best first.
    weights : sequence of float
        How likely each of them is; the tails are averaged.
    name : str
        Name of the process.
    excess : float
        Factor on all covariances, for a curve whose misfit exceeds the sampling error.

    """
    first = fits[0]
    index = fits[0].names.index(name)
    members = [_ScoreOfCoefficient(moments, fit, excess, fit.names.index(name)) for fit in fits]
    tails = partial(_averaged, members, np.asarray(weights, float) / np.sum(weights))
    limit = float(np.min(moments.target / moments.design((first.processes[index],))[:, 0]))
    middle = max(first.coefficients[index], 1e-3 * limit)
    step = min(members[0].relative_sd(), 1.5)
    lower = 0.0
    alone = not np.any(np.delete(first.coefficients, index))
    if first.coefficients[index] > 0 and (alone or tails(0.0)[0] < TAIL):
        lower = _crossing(lambda value: tails(value)[0] - TAIL, middle, -step)
    return lower, _crossing(lambda value: tails(value)[1] - TAIL, middle, step)


def score_at_zero(moments: Moments, fit: MomentFit) -> float:
    """Return the p-value of the first process: the null hypothesis is a coefficient of zero."""
    return _ScoreOfCoefficient(moments, fit, 1.0, 0).tails(0.0)[0]


def time_interval(
    moments: Moments, fits: Sequence[MomentFit], weights: Sequence[float], *, excess: float = 1.0
) -> tuple[float, float]:
    """
    Return the interval of the time of models whose last process is Gauss-Markov, s.

    Infinite where a random walk fits as well.
    """
    times = moments.times
    best = int(np.argmin(np.abs(np.log(times / fits[0].processes[-1].time))))
    members = [_ScoreOfTime(moments, fit, excess) for fit in fits]
    tails = partial(_averaged, members, np.asarray(weights, float) / np.sum(weights))
    upper = _first(times[best + 1 :], lambda time: tails(time)[1] < TAIL)
    lower = _first(times[:best][::-1], lambda time: tails(time)[0] < TAIL)
    return 0.0 if lower is None else lower, np.inf if upper is None else upper


def _first(values, refused):
    """Return the first of the values that is refused, None without; from one that is, all are."""
    if not len(values):
        return None
    near = -1
    far = 0
    last = len(values) - 1
    while not refused(values[far]):
        if far == last:
            return None
        near = far
        far = min(2 * far + 1, last)
    while far - near > 1:
        middle = (near + far) // 2
        near, far = (near, middle) if refused(values[middle]) else (middle, far)
    return float(values[far])


def _averaged(members, weights, value):
    """
    Return the `tails` of several models at `value`, averaged with weights of sum 1, shape (2,).
    """
    return weights @ [member.tails(value) for member in members]


class _Score:
    """
    Where the misfit in the direction of one parameter lies in its distribution.

    The parameter is at a value that is tried.
    """

    def __init__(self, moments, fit, excess):
        self.moments = moments
        self.fit = fit
        self._excess = excess
        self._tails = {}

    def at(self, value: float) -> tuple[Any, np.ndarray, list[np.ndarray]]:
        """Return the fit with the parameter fixed, its direction, and those of the free ones."""
        raise NotImplementedError

    def tails(self, value):
        """
        Return the probabilities of a larger and of a smaller misfit than observed.

        If `value` is true.
        """
        if value not in self._tails:
            fit, direction, others = self.at(value)
            self._tails[value] = _tails(self.moments, fit, direction, others, self._excess)
        return self._tails[value]


class _ScoreOfCoefficient(_Score):
    def __init__(self, moments, fit, excess, index):
        super().__init__(moments, fit, excess)
        self.index = index

    def relative_sd(self):
        """
        Return the standard deviation of the coefficient by its information, as a share of it.

        Large where there is none.
        """
        if not self.fit.coefficients[self.index] > 0:
            return np.inf
        whiten = Whitener(self._excess * self.fit.covariance)
        own, others = self._directions(self.fit)
        return 1.0 / (
            np.linalg.norm(_beside(whiten(own), [whiten(other) for other in others]))
            * self.fit.coefficients[self.index]
        )

    def at(self, value):
        """
        Return the fit with the coefficient fixed, and the directions of the parameters.

        The values are the fit, the coefficient's own direction, and the directions of the other
        parameters.
        """
        processes = self.fit.processes
        if processes[-1].time and (value > 0 or self.index != len(processes) - 1):
            fit = fit_with_time(self.moments, processes[:-1], {self.index: value})
        else:
            fit = fit_processes(
                self.moments, processes, {self.index: value}, start=self.fit.coefficients
            )
        return fit, *self._directions(fit)

    def _directions(self, fit):
        design = self.moments.design(fit.processes)
        others = []
        for k in range(len(fit.processes)):
            if k != self.index and fit.coefficients[k] > 0:
                others.append(design[:, k])
        if fit.processes[-1].time and fit.coefficients[-1] > 0:
            others.append(_by_time(self.moments, fit.processes[-1].time))
        return design[:, self.index], others


class _ScoreOfTime(_Score):
    def at(self, value):
        """
        Return the fit with the time fixed, and the directions of the parameters.

        The values are the fit, the direction of a longer time, and the directions of the
        coefficients.
        """
        processes = (*self.fit.processes[:-1], gauss_markov(value))
        fit = fit_processes(self.moments, processes, None, start=self.fit.coefficients)
        design = self.moments.design(processes)
        return (
            fit,
            _by_time(self.moments, value),
            [design[:, k] for k in range(len(processes)) if fit.coefficients[k] > 0],
        )


def _by_time(moments, time):
    """
    Return the derivative of the Gauss-Markov curve by the logarithm of its time.

    By a central difference.
    """
    late, early = (
        moments.design((gauss_markov(time * factor),))[:, 0]
        for factor in (1 + LOG_TIME_STEP, 1 - LOG_TIME_STEP)
    )
    return (late - early) / (2 * LOG_TIME_STEP)


def _tails(moments, fit, direction, others, excess):
    """
    Return (probability above, probability below) of an efficient score.

    It is the efficient score of `direction` given `others`.
    """
    covariance = excess * fit.covariance
    whiten = Whitener(covariance)
    own = _beside(whiten(direction), [whiten(other) for other in others])
    expected = moments.design(fit.processes) @ fit.coefficients
    size = np.linalg.norm(own)
    score = float(own @ whiten(moments.target - expected) / size)
    weights = whiten.weights(own / size)
    third_moment = _third_moment(weights, covariance, np.maximum(expected, 1e-9 * moments.target))
    return pearson_tails(score, float(third_moment))


def _beside(own, others):
    """Return the part of a vector orthogonal to the other directions."""
    if not others:
        return own
    basis = np.linalg.qr(np.column_stack(others))[0]
    return own - basis @ (basis.T @ own)


def _third_moment(weights, covariance, expected):
    """
    Return the third central moment of a weighted sum of Allan variances.

    A variance of mean f and variance v from a sum of squares has the third moment 2 v^2 / f
    (chi-square); mixed ones are computed as ``2 (v_ij v_jk v_ki)^(2/3) / (f_i f_j f_k)^(1/3)``.
    """
    pair = np.cbrt(np.abs(covariance)) ** 2
    scaled = weights / np.cbrt(expected)
    return float(
        2.0 * np.einsum('i,j,k,ij,jk,ki->', scaled, scaled, scaled, pair, pair, pair, optimize=True)
    )


def pearson_tails(score: float, skewness: float) -> tuple[float, float]:
    """Return (probability above, probability below) of a standardised Pearson III distribution."""
    if abs(skewness) < 1e-3:
        return float(ndtr(-score)), float(ndtr(score))
    shape = 4.0 / skewness**2
    at = shape + score * np.sqrt(shape) * np.sign(skewness)
    above, below = (
        (float(gammaincc(shape, at)), float(gammainc(shape, at))) if at > 0 else (1.0, 0.0)
    )
    return (above, below) if skewness > 0 else (below, above)


def _crossing(function, start, step):
    """
    Return where a positive function becomes negative.

    From `start` on by growing steps of the logarithm.
    """
    from scipy.optimize import brentq  # here, because its import is slow

    if not function(start) > 0:
        return start
    near = np.log(start)
    far = np.log(start) + 2.0 * step
    while function(np.exp(far)) > 0:
        near, far = far, far + 1.6 * (far - near)
        if abs(far - np.log(start)) > MAX_LOG_RATIO:
            return np.inf if step > 0 else 0.0
    return float(
        np.exp(
            brentq(lambda x: function(np.exp(x)), near, far, xtol=INTERVAL_ACCURACY_SDS * abs(step))
        )
    )
