"""
Intervals by inverting a test: a value belongs to the interval when the curve does not reject it.

For each trial value the other parameters are refitted, and the weighted misfit in its own direction (efficient score) is compared
with its scatter *under that value*. The score is a sum of squares of Gaussian numbers and therefore skew, the more so the fewer of the
longest averages there are; a Pearson III distribution with its first three moments approximates it. So the interval is one-sided where it
should be: zero and infinity can belong to it.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import gammainc, gammaincc, ndtr

from imu_calibration.allan.moment_fit import MomentFit, Moments, Whitener, fit_processes, fit_with_time
from imu_calibration.allan.processes import gauss_markov

TAIL = 0.025
"""Probability beyond each end."""
LARGEST = 20.0
"""Largest logarithm of an end over the estimate."""
EXACT = 0.02
"""Accuracy of the ends, in standard deviations."""


def coefficient_interval(moments: Moments, fits: Sequence[MomentFit], weights: Sequence[float], *, name: str,
                         excess: float = 1.0) -> tuple[float, float]:
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
    first, index = fits[0], fits[0].names.index(name)
    scored, tail = _Average([_ScoreOfCoefficient(moments, fit, excess, fit.names.index(name)) for fit in fits], weights), TAIL
    limit = float(np.min(moments.target / moments.design((first.processes[index],))[:, 0]))
    middle = max(first.coefficients[index], 1e-3 * limit)
    step = min(scored.members[0].relative_sd(), 1.5)
    lower = 0.0
    alone = not np.any(np.delete(first.coefficients, index))
    if first.coefficients[index] > 0 and (alone or scored.tail_above(0.0) < tail):
        lower = _crossing(lambda value: scored.tail_above(value) - tail, middle, -step)
    return lower, _crossing(lambda value: scored.tail_below(value) - tail, middle, step)


def score_at_zero(moments: Moments, fit: MomentFit, index: int) -> float:
    """Return the p-value of process `index`: the null hypothesis is a coefficient of zero."""
    return _ScoreOfCoefficient(moments, fit, 1.0, index).tail_above(0.0)


def time_interval(moments: Moments, fits: Sequence[MomentFit], weights: Sequence[float], *, excess: float = 1.0) -> tuple[float, float]:
    """Return the interval of the time of models whose last process is Gauss-Markov, s; infinite where a random walk fits as well."""
    times = moments.times
    best = int(np.argmin(np.abs(np.log(times / fits[0].processes[-1].time))))
    scored, tail = _Average([_ScoreOfTime(moments, fit, excess) for fit in fits], weights), TAIL
    upper = _first(times[best + 1:], lambda time: scored.tail_below(time) < tail)
    lower = _first(times[:best][::-1], lambda time: scored.tail_above(time) < tail)
    return 0.0 if lower is None else lower, np.inf if upper is None else upper


def _first(values, refused):
    """Return the first of the values that is refused, None without; from one that is, all are."""
    if not len(values):
        return None
    near, far, last = -1, 0, len(values) - 1
    while not refused(values[far]):
        if far == last:
            return None
        near, far = far, min(2 * far + 1, last)
    while far - near > 1:
        middle = (near + far) // 2
        near, far = (near, middle) if refused(values[middle]) else (middle, far)
    return float(values[far])


class _Average:
    """Tails averaged over models."""

    def __init__(self, members, weights):
        self.members, self._weights = members, np.asarray(weights, float) / np.sum(weights)

    def tail_above(self, value):
        """Return the probability of a larger misfit."""
        return sum(weight * member.tail_above(value) for weight, member in zip(self._weights, self.members))

    def tail_below(self, value):
        """Return the probability of a smaller one."""
        return sum(weight * member.tail_below(value) for weight, member in zip(self._weights, self.members))


class _Score:
    """Where the misfit in the direction of one parameter lies in its distribution, at a value that is tried."""

    def __init__(self, moments, fit, excess):
        self.moments, self.fit, self._excess, self._tails = moments, fit, excess, {}

    def tail_above(self, value):
        """Return the probability of a larger misfit than observed, if `value` is true."""
        return self._evaluate(value)[0]

    def tail_below(self, value):
        """Return the probability of a smaller one."""
        return self._evaluate(value)[1]

    def _evaluate(self, value):
        if value not in self._tails:
            fit, direction, others = self.at(value)
            self._tails[value] = _tails(self.moments, fit, direction, others, self._excess)
        return self._tails[value]


class _ScoreOfCoefficient(_Score):
    def __init__(self, moments, fit, excess, index):
        super().__init__(moments, fit, excess)
        self.index = index

    def relative_sd(self):
        """Return the standard deviation of the coefficient by its information, as a share of it; large where there is none."""
        if not self.fit.coefficients[self.index] > 0:
            return np.inf
        whiten = Whitener(self._excess * self.fit.covariance)
        own, others = self._directions(self.fit)
        return 1.0 / (np.linalg.norm(_beside(whiten(own), [whiten(other) for other in others])) * self.fit.coefficients[self.index])

    def at(self, value):
        """Return the fit with the coefficient fixed, its own direction, and the directions of the other parameters."""
        processes = self.fit.processes
        if processes[-1].time and (value > 0 or self.index != len(processes) - 1):
            fit = fit_with_time(self.moments, processes[:-1], {self.index: value})
        else:
            fit = fit_processes(self.moments, processes, {self.index: value}, start=self.fit.coefficients)
        return fit, *self._directions(fit)

    def _directions(self, fit):
        design = self.moments.design(fit.processes)
        others = [design[:, k] for k in range(len(fit.processes)) if k != self.index and fit.coefficients[k] > 0]
        if fit.processes[-1].time and fit.coefficients[-1] > 0:
            others.append(_by_time(self.moments, fit.processes[-1].time))
        return design[:, self.index], others


class _ScoreOfTime(_Score):
    def at(self, value):
        """Return the fit with the time fixed, the direction of a longer time, and the directions of the coefficients."""
        processes = (*self.fit.processes[:-1], gauss_markov(value))
        fit = fit_processes(self.moments, processes, None, start=self.fit.coefficients)
        design = self.moments.design(processes)
        return fit, _by_time(self.moments, value), [design[:, k] for k in range(len(processes)) if fit.coefficients[k] > 0]


def _by_time(moments, time, step=0.02):
    """Return the change of the Gauss-Markov curve with the logarithm of its time."""
    late, early = (moments.design((gauss_markov(time * factor),))[:, 0] for factor in (1 + step, 1 - step))
    return (late - early) / (2 * step)


def _tails(moments, fit, direction, others, excess):
    """Return (probability above, probability below) of the efficient score of `direction` given `others`."""
    covariance = excess * fit.covariance
    whiten = Whitener(covariance)
    own = _beside(whiten(direction), [whiten(other) for other in others])
    expected = moments.design(fit.processes) @ fit.coefficients
    size = np.linalg.norm(own)
    score = float(own @ whiten(moments.target - expected)) / size
    weights = whiten.weights(own / size)
    return pearson_tails(score, third_moment(weights, covariance, np.maximum(expected, 1e-9 * moments.target)))


def _beside(own, others):
    """Return the part of a vector orthogonal to the other directions."""
    if not others:
        return own
    basis = np.linalg.qr(np.column_stack(others))[0]
    return own - basis @ (basis.T @ own)


def third_moment(weights: np.ndarray, covariance: np.ndarray, expected: np.ndarray) -> float:
    """
    Return the third central moment of a weighted sum of Allan variances.

    A variance of mean f and variance v from a sum of squares has the third moment 2 v^2 / f (chi-square); mixed ones are computed as
    ``2 (v_ij v_jk v_ki)^(2/3) / (f_i f_j f_k)^(1/3)``.
    """
    pair = np.cbrt(np.abs(covariance))**2
    scaled = weights / np.cbrt(expected)
    return float(2.0 * np.einsum('i,j,k,ij,jk,ki->', scaled, scaled, scaled, pair, pair, pair, optimize=True))


def pearson_tails(score: float, skewness: float) -> tuple[float, float]:
    """Return (probability above, probability below) of a standardised Pearson III distribution."""
    if abs(skewness) < 1e-3:
        return float(ndtr(-score)), float(ndtr(score))
    shape = 4.0 / skewness**2
    at = shape + score * np.sqrt(shape) * np.sign(skewness)
    above, below = (float(gammaincc(shape, at)), float(gammainc(shape, at))) if at > 0 else (1.0, 0.0)
    return (above, below) if skewness > 0 else (below, above)


def _crossing(function, start, step):
    """Return where a positive function becomes negative, from `start` on by growing steps of the logarithm."""
    from scipy.optimize import brentq  # here, because its import is slow

    if not function(start) > 0:
        return start
    near, far = np.log(start), np.log(start) + 2.0 * step
    while function(np.exp(far)) > 0:
        near, far = far, far + 1.6 * (far - near)
        if abs(far - np.log(start)) > LARGEST:
            return np.inf if step > 0 else 0.0
    return float(np.exp(brentq(lambda x: function(np.exp(x)), near, far, xtol=EXACT * abs(step))))
