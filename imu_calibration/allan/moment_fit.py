"""
Fit of noise processes to an Allan curve by moments, with intervals of inverted score tests.

The expected Allan variances are ``design @ coefficients``: a column of the design is the curve of a
process with the coefficient 1, and a coefficient is the square of a figure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

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
"""Largest number of alternating computations of weights and coefficients."""
FLOOR = 1e-6
"""Least share of the upper limit of each process in the weights, so that they are finite."""
RIDGE = 0.02
"""
Added to the correlations, which are good to a hundredth: neighbouring scales are nearly the same.
"""
SHORTEST_TIME = 4.0
"""Shortest correlation time of a bias, s."""
TIME_RATIO = 1.1
"""Ratio of neighbouring correlation times that are tried."""
TIME_RATIO_OF_WEIGHTS = 1.3
"""Ratio of neighbouring correlation times for which weights are computed."""


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
        Correlation times that are tried, s: powers of `TIME_RATIO`, shape (n_times,).

        Shorter times than `SHORTEST_TIME` belong to filters, not to a bias.
        """
        longest = max(4 * self.scales.tau[self.used][-1], 2 * SHORTEST_TIME)
        first = round(np.log(SHORTEST_TIME) / np.log(TIME_RATIO))
        last = round(np.log(longest) / np.log(TIME_RATIO))
        return TIME_RATIO ** np.arange(first, last + 1.0)

    @cached_property
    def wander(self) -> np.ndarray:
        """
        Allan variances of Gauss-Markov processes of unit variance and `times`, (n_used, n_times).
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

        The correlation time is rounded, because the weights depend little on it.
        """
        rounded = []
        for process in processes:
            if process.time:
                power = round(np.log(process.time) / np.log(TIME_RATIO_OF_WEIGHTS))
                process = gauss_markov(TIME_RATIO_OF_WEIGHTS**power)
            rounded.append(process)
        return self.scales.tensor(tuple(rounded))[:, :, self.used][:, :, :, self.used]

    @property
    def target(self) -> np.ndarray:
        """The variances used, shape (n_used,)."""
        return self.variance[self.used]

    def covariance(self, design: np.ndarray, tensor: np.ndarray, values: np.ndarray) -> np.ndarray:
        """
        Return the covariance of the Allan variances used, shape (n_used, n_used).

        It is the sum of the sampling error of processes with the coefficients `values`, and of the
        variation of the level of the curve between parts, which is common to all scales.
        """
        sampling = np.einsum('p,q,pqij->ij', values, values, tensor)
        if not self.scatter:
            return sampling
        level_sd = self.scatter * np.sqrt(self.parts.share())[self.used] * (design @ values)
        return sampling + np.outer(level_sd, level_sd)


def fit_processes(
    moments: Moments,
    processes: tuple[NoiseProcess, ...],
    fixed: dict[int, float] | None = None,
    *,
    start: np.ndarray | None = None,
) -> MomentFit:
    """
    Fit the coefficients of given processes: weighted least squares without negative values.

    The weights depend on the coefficients; both are computed alternately until they converge.

    Parameters
    ----------
    moments : Moments
    processes : tuple of NoiseProcess
    fixed : dict, optional
        Index of a process -> coefficient that is not fitted.
    start : ndarray, shape (n_processes,), optional
        Coefficients for the first weights.

    """
    from scipy.optimize import nnls  # here, because its import is slow

    design = moments.design(processes)
    tensor = moments.tensor(processes)
    target = moments.target
    fixed = fixed or {}
    free = np.array([k for k in range(len(processes)) if k not in fixed], int)
    values = _first_guess(design, target, moments) if start is None else np.array(start, float)
    fixed_variance = np.zeros(len(target))  # of the processes with fixed coefficients
    for k, value in fixed.items():
        values[k] = value
        fixed_variance = fixed_variance + design[:, k] * value
    # The weights are those of coefficients above zero: no variance is exact.
    floor = FLOOR * np.min(target[:, None] / design, axis=0)
    for _ in range(MAX_WEIGHT_ROUNDS):
        covariance = moments.covariance(design, tensor, np.maximum(values, floor))
        whitener = Whitener(covariance)
        new = values.copy()
        if len(free):
            columns = whitener(design[:, free])
            norms = np.linalg.norm(columns, axis=0)
            new[free] = nnls(columns / norms, whitener(target - fixed_variance))[0] / norms
        # The coefficients of the last weights are the same to seven digits.
        done = np.all(np.abs(new - values) <= 1e-7 * np.maximum(new, values))
        values = new
        if done:
            break
    covariance = moments.covariance(design, tensor, np.maximum(values, floor))
    residual = Whitener(covariance)(target - design @ values)
    return MomentFit(tuple(processes), values, covariance, float(residual @ residual))


class Whitener:
    """
    Whitening of vectors with a covariance, by the Cholesky factor L of their correlations.

    The whitened vector is ``L^-1 (vector / sd)``; `RIDGE` is added to the correlations.
    """

    def __init__(self, covariance: np.ndarray):
        self._sd = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(self._sd, self._sd)
        self._cholesky_factor = _cholesky(correlation + RIDGE * np.eye(len(correlation)))
        # The inverse is accurate because of the ridge; a solve of this size waits for threads.
        self._inverse_factor = dtrtri(self._cholesky_factor, lower=1)[0]

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return float(2 * np.log(np.diag(self._cholesky_factor)).sum() + 2 * np.log(self._sd).sum())

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return a whitened vector, or whitened columns of a matrix."""
        scaled = rows / (self._sd if rows.ndim == 1 else self._sd[:, None])
        return self._inverse_factor @ scaled

    def weights(self, whitened: np.ndarray) -> np.ndarray:
        """Return w with ``w @ vector = whitened @ self(vector)`` for every vector."""
        return self._inverse_factor.T @ whitened / self._sd


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor of correlations, of which approximations may be indefinite."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        missing = RIDGE - np.linalg.eigvalsh(matrix)[0]
        return np.linalg.cholesky(matrix + missing * np.eye(len(matrix)))


def _first_guess(design: np.ndarray, target: np.ndarray, moments: Moments) -> np.ndarray:
    """
    Return coefficients by least squares of relative errors, with the weights 1 / tau.
    """
    from scipy.optimize import nnls

    weight = 1.0 / (target * np.sqrt(moments.scales.tau[moments.used]))
    values = nnls(design * weight[:, None], target * weight)[0]
    return np.maximum(values, FLOOR * np.min(target[:, None] / design, axis=0))


def fit_with_time(
    moments: Moments, processes: tuple[NoiseProcess, ...], fixed: dict[int, float] | None = None
) -> MomentFit:
    """
    Fit given processes, and as the last one a Gauss-Markov process of unknown correlation time.

    With fixed weights the best time minimises the weighted sum of squares; the weights are updated
    until a time occurs again. `fixed` is that of `fit_processes`.
    """
    # First weights: the relative errors of the variances increase with the averaging time.
    whitener = Whitener(np.diag((moments.target**2 * moments.scales.tau[moments.used])))
    fit = None
    tried_times = set()
    while True:
        best = _best_time(moments, processes, whitener, fixed or {})
        if fit is not None and best in tried_times:
            return fit
        tried_times.add(best)
        model = (*processes, gauss_markov(moments.times[best]))
        fit = fit_processes(moments, model, fixed, start=None if fit is None else fit.coefficients)
        whitener = Whitener(fit.covariance)


def _best_time(
    moments: Moments,
    processes: tuple[NoiseProcess, ...],
    whitener: Whitener,
    fixed: dict[int, float],
) -> int:
    """
    Return the index of the correlation time with the least sum of squares at given weights.

    The processes and a Gauss-Markov process of each of the `Moments.times` are fitted without
    negative coefficients: the best fit is the least one over all subsets of the free processes of
    which no coefficient is negative.
    """
    last = len(processes)  # index of the Gauss-Markov process
    columns = whitener(moments.design(processes))
    wander = whitener(moments.wander)
    fixed_variance = np.zeros(len(columns))  # of the processes with fixed coefficients, whitened
    for k, value in fixed.items():
        if k < last:
            fixed_variance = fixed_variance + columns[:, k] * value
    target = whitener(moments.target) - fixed_variance

    # A target for each time, less a Gauss-Markov process with a fixed coefficient.
    wander_is_fixed = last in fixed
    targets = np.repeat(target[:, None], len(moments.times), axis=1)
    if wander_is_fixed:
        targets = target[:, None] - wander * fixed[last]
    free = [k for k in range(last) if k not in fixed]
    squares = np.full(len(moments.times), np.inf)
    for n_chosen in range(len(free) + 1):
        for chosen in combinations(free, n_chosen):
            squares_of_subset = _squares_of_times(
                columns[:, list(chosen)], wander, targets, wander_is_fixed
            )
            squares = np.minimum(squares, squares_of_subset)
    return int(np.argmin(squares))


def _squares_of_times(
    columns: np.ndarray, wander: np.ndarray, targets: np.ndarray, wander_is_fixed: bool
) -> np.ndarray:
    """
    Return the residual sum of squares for each correlation time, shape (n_times,).

    All `columns` and one column of `wander` are fitted to the column of `targets` of the same time;
    with `wander_is_fixed` the columns only. Infinite where a coefficient of a column is negative.
    """
    # Parts orthogonal to the columns give the coefficient of the wander.
    basis, triangle = np.linalg.qr(columns)
    free_wander = wander - basis @ (basis.T @ wander)
    free_targets = targets - basis @ (basis.T @ targets)
    amount = np.zeros(wander.shape[1])
    if not wander_is_fixed:
        product = np.einsum('it,it->t', free_wander, free_targets)
        amount = np.maximum(product / np.einsum('it,it->t', free_wander, free_wander), 0.0)
    residual = free_targets - amount * free_wander
    squares = np.einsum('it,it->t', residual, residual)
    if not columns.shape[1]:
        return squares
    values = np.linalg.solve(triangle, basis.T @ (targets - amount * wander))
    return np.where((values >= 0).all(axis=0), squares, np.inf)


TAIL = 0.025
"""Probability beyond each end of an interval."""
MAX_LOG_RATIO = 20.0
"""Largest logarithm of an end of an interval over the estimate."""
LOG_TIME_STEP = 0.02
"""Step of the derivative by the logarithm of a correlation time."""
INTERVAL_ACCURACY_SDS = 0.02
"""Accuracy of the ends of an interval, in standard deviations."""


def coefficient_interval(
    moments: Moments,
    fits: Sequence[MomentFit],
    weights: Sequence[float],
    *,
    name: str,
    excess: float = 1.0,
) -> tuple[float, float]:
    """
    Return the interval of the coefficient of a process, from 0 if the curve does not require it.

    Parameters
    ----------
    moments : Moments
    fits : sequence of MomentFit
        Fits of the models that have the process, the best first.
    weights : sequence of float
        Likelihood of each of them, with which the tails are averaged.
    name : str
        Name of the process.
    excess : float
        Factor on all covariances, for a curve whose misfit exceeds the sampling error.

    """
    best = fits[0]
    index = best.names.index(name)
    scores = [_ScoreOfCoefficient(moments, fit, excess, fit.names.index(name)) for fit in fits]
    averaged = _AveragedScore(scores, np.asarray(weights, float) / np.sum(weights))

    # From the estimate in steps of its relative sd, which is infinite for 0 and is limited; or from
    # a thousandth of the largest value that the curve allows.
    limit = float(np.min(moments.target / moments.design((best.processes[index],))[:, 0]))
    middle = max(best.coefficients[index], 1e-3 * limit)
    step = min(scores[0].relative_sd(), 1.5)
    lower = 0.0
    # The lower end is 0 unless the test rejects 0. An only process cannot be 0: no variance would
    # be expected.
    is_only_process = not np.any(np.delete(best.coefficients, index))
    if best.coefficients[index] > 0 and (is_only_process or averaged.tails(0.0)[0] < TAIL):
        lower = _crossing(lambda value: averaged.tails(value)[0] - TAIL, middle, -step)
    return lower, _crossing(lambda value: averaged.tails(value)[1] - TAIL, middle, step)


def score_at_zero(moments: Moments, fit: MomentFit) -> float:
    """Return the p-value of the first process: the null hypothesis is a coefficient of zero."""
    return _ScoreOfCoefficient(moments, fit, 1.0, 0).tails(0.0)[0]


def time_interval(
    moments: Moments, fits: Sequence[MomentFit], weights: Sequence[float], *, excess: float = 1.0
) -> tuple[float, float]:
    """
    Return the interval of the correlation time of models with a Gauss-Markov process last, s.

    Its upper end is infinite where a random walk fits as well. The arguments are those of
    `coefficient_interval`.
    """
    times = moments.times
    best = int(np.argmin(np.abs(np.log(times / fits[0].processes[-1].time))))
    scores = [_ScoreOfTime(moments, fit, excess) for fit in fits]
    averaged = _AveragedScore(scores, np.asarray(weights, float) / np.sum(weights))
    # The first rejected times above and below that of the best fit.
    upper = _first_rejected(times[best + 1 :], lambda time: averaged.tails(time)[1] < TAIL)
    lower = _first_rejected(times[:best][::-1], lambda time: averaged.tails(time)[0] < TAIL)
    return 0.0 if lower is None else lower, np.inf if upper is None else upper


def _first_rejected(values: np.ndarray, rejected: Callable[[float], bool]) -> float | None:
    """
    Return the first of the values that is rejected, None if none is.

    All values after a rejected one are rejected too: a growing step brackets the first, then
    bisection.
    """
    if not len(values):
        return None
    accepted = -1  # index of the last value that is known to be accepted
    trial = 0
    last = len(values) - 1
    while not rejected(values[trial]):
        if trial == last:
            return None
        accepted = trial
        trial = min(2 * trial + 1, last)
    while trial - accepted > 1:
        middle = (accepted + trial) // 2
        if rejected(values[middle]):
            trial = middle
        else:
            accepted = middle
    return float(values[trial])


@dataclass(frozen=True, eq=False)
class _Fixed:
    """A fit with one parameter fixed at a trial value."""

    fit: MomentFit
    direction: np.ndarray
    """Derivative of the expected variances by the fixed parameter, shape (n_used,)."""
    free_directions: list[np.ndarray]
    """Derivatives by the parameters that are fitted, each of shape (n_used,)."""


class _Score:
    """
    Score test of one parameter: its misfit at a trial value, with all other parameters fitted.

    Parameters
    ----------
    moments : Moments
    fit : MomentFit
        With the parameter fitted.
    excess : float
        Factor on all covariances.

    """

    def __init__(self, moments: Moments, fit: MomentFit, excess: float):
        self.moments = moments
        self.fit = fit
        self._excess = excess
        # Trial value -> its tails, which several steps of a search need.
        self._tails: dict[float, tuple[float, float]] = {}

    def at(self, value: float) -> _Fixed:
        """Return the fit with the parameter fixed at a value."""
        raise NotImplementedError

    def tails(self, value: float) -> tuple[float, float]:
        """Return the probabilities of a larger and of a smaller score if `value` is true."""
        if value not in self._tails:
            self._tails[value] = _tails(self.moments, self.at(value), self._excess)
        return self._tails[value]


@dataclass(frozen=True, eq=False)
class _AveragedScore:
    """Score tests of the same parameter in several models."""

    scores: Sequence[_Score]
    weights: np.ndarray
    """Weight of each model, of sum 1."""

    def tails(self, value: float) -> np.ndarray:
        """Return the average of the `_Score.tails` of the models, shape (2,)."""
        return self.weights @ [score.tails(value) for score in self.scores]


class _ScoreOfCoefficient(_Score):
    """Score test of the coefficient of the process with the number `index`."""

    def __init__(self, moments: Moments, fit: MomentFit, excess: float, index: int):
        super().__init__(moments, fit, excess)
        self.index = index

    def relative_sd(self) -> float:
        """Return sd / value of the coefficient, all others fitted too; infinite for the value 0."""
        if not self.fit.coefficients[self.index] > 0:
            return np.inf
        whiten = Whitener(self._excess * self.fit.covariance)
        at_fit = self._with_directions(self.fit)
        free = [whiten(direction) for direction in at_fit.free_directions]
        information_root = np.linalg.norm(_orthogonal_part(whiten(at_fit.direction), free))
        return 1.0 / (information_root * self.fit.coefficients[self.index])

    def at(self, value: float) -> _Fixed:
        """Return the fit with the coefficient fixed at a value."""
        processes = self.fit.processes
        # The correlation time is fitted too, unless its process is absent: then it has no effect.
        if processes[-1].time and (value > 0 or self.index != len(processes) - 1):
            fit = fit_with_time(self.moments, processes[:-1], {self.index: value})
        else:
            fit = fit_processes(
                self.moments, processes, {self.index: value}, start=self.fit.coefficients
            )
        return self._with_directions(fit)

    def _with_directions(self, fit: MomentFit) -> _Fixed:
        """Return a fit with the derivatives by its parameters that are not at the bound 0."""
        design = self.moments.design(fit.processes)
        free_directions = []
        for k in range(len(fit.processes)):
            if k != self.index and fit.coefficients[k] > 0:
                free_directions.append(design[:, k])
        if fit.processes[-1].time and fit.coefficients[-1] > 0:
            free_directions.append(_by_log_time(self.moments, fit.processes[-1].time))
        return _Fixed(fit, design[:, self.index], free_directions)


class _ScoreOfTime(_Score):
    """Score test of the logarithm of the correlation time of the last process."""

    def at(self, value: float) -> _Fixed:
        """Return the fit with the correlation time fixed at a value, s."""
        processes = (*self.fit.processes[:-1], gauss_markov(value))
        fit = fit_processes(self.moments, processes, None, start=self.fit.coefficients)
        design = self.moments.design(processes)
        free_directions = [design[:, k] for k in range(len(processes)) if fit.coefficients[k] > 0]
        return _Fixed(fit, _by_log_time(self.moments, value), free_directions)


def _by_log_time(moments: Moments, time: float) -> np.ndarray:
    """
    Return the derivative of the Gauss-Markov curve by the logarithm of its time, shape (n_used,).
    """
    late = moments.design((gauss_markov(time * (1 + LOG_TIME_STEP)),))[:, 0]
    early = moments.design((gauss_markov(time * (1 - LOG_TIME_STEP)),))[:, 0]
    return (late - early) / (2 * LOG_TIME_STEP)


def _tails(moments: Moments, fixed: _Fixed, excess: float) -> tuple[float, float]:
    """
    Return (probability above, probability below) of the efficient score of a fixed parameter.

    With the whitened direction d of the parameter, less its projection on the free directions, and
    the whitened residual r, the score ``d r / |d|`` has the variance 1. Its skewness is that of a
    weighted sum of variances, and its distribution is Pearson III.
    """
    fit = fixed.fit
    covariance = excess * fit.covariance
    whiten = Whitener(covariance)
    free = [whiten(direction) for direction in fixed.free_directions]
    direction = _orthogonal_part(whiten(fixed.direction), free)
    expected = moments.design(fit.processes) @ fit.coefficients
    size = np.linalg.norm(direction)
    score = float(direction @ whiten(moments.target - expected) / size)
    weights = whiten.weights(direction / size)
    skewness = _third_moment(weights, covariance, np.maximum(expected, 1e-9 * moments.target))
    return pearson_tails(score, skewness)


def _orthogonal_part(vector: np.ndarray, directions: Sequence[np.ndarray]) -> np.ndarray:
    """Return the part of a vector orthogonal to some directions."""
    if not directions:
        return vector
    basis = np.linalg.qr(np.column_stack(directions))[0]
    return vector - basis @ (basis.T @ vector)


def _third_moment(weights: np.ndarray, covariance: np.ndarray, expected: np.ndarray) -> float:
    """
    Return the third central moment of a weighted sum of Allan variances.

    A variance of mean f and variance v from a sum of squares has the third moment 2 v^2 / f
    (chi-square); mixed ones are computed as ``2 (v_ij v_jk v_ki)^(2/3) / (f_i f_j f_k)^(1/3)``.
    """
    pair = np.cbrt(np.abs(covariance)) ** 2
    weighted = (weights / np.cbrt(expected))[:, None] * pair
    return float(2.0 * np.sum((weighted @ weighted) * weighted.T))


def pearson_tails(score: float, skewness: float) -> tuple[float, float]:
    """
    Return (probability above, probability below) of a standardised Pearson III distribution.

    With ``k = 4 / skewness^2``, ``k + sign(skewness) score sqrt(k)`` has the gamma distribution of
    shape k.
    """
    # Nearly normal: the shape would be very large.
    if abs(skewness) < 1e-3:
        return float(ndtr(-score)), float(ndtr(score))
    shape = 4.0 / skewness**2
    at = shape + score * np.sqrt(shape) * np.sign(skewness)
    above = float(gammaincc(shape, at)) if at > 0 else 1.0
    below = float(gammainc(shape, at)) if at > 0 else 0.0
    return (above, below) if skewness > 0 else (below, above)


def _crossing(function: Callable[[float], float], start: float, step: float) -> float:
    """
    Return the argument at which a function that is positive at `start` becomes negative.

    The logarithm of the argument changes by 2 `step`, then by steps of 1.6 times the one before,
    until the function is negative; Brent's method finds the zero in the last step. The result is
    `start` if the function is not positive there; without a crossing it is 0 or infinite, by the
    sign of `step`.
    """
    from scipy.optimize import brentq  # here, because its import is slow

    if not function(start) > 0:
        return start
    near = np.log(start)
    far = np.log(start) + 2.0 * step
    while function(np.exp(far)) > 0:
        length = far - near
        near = far
        far = far + 1.6 * length
        if abs(far - np.log(start)) > MAX_LOG_RATIO:
            return np.inf if step > 0 else 0.0
    accuracy = INTERVAL_ACCURACY_SDS * abs(step)
    return float(np.exp(brentq(lambda x: function(np.exp(x)), near, far, xtol=accuracy)))
