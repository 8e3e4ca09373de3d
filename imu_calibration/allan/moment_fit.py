"""
The fit of noise processes to an Allan curve: all scales at once, weighted with their covariance.

Generalised least squares on the variances, which are linear in the squares of the figures: the weights come from the fitted model itself,
until both agree (a generalised method of moments; Guerrier et al., JASA 108:1021, 2013, for wavelet variances). A correlation time enters
through its own scan.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from imu_calibration.allan.processes import NoiseProcess, gauss_markov
from imu_calibration.allan.scale_covariance import ScaleCovariance
from imu_calibration.allan.trends import KeptShare, Parts

STEPS = 25
"""Rounds of weights and coefficients at most."""
FLOOR = 1e-6
"""Least share of the upper limit of each process in the weights, so that they are finite."""
RIDGE = 0.02
"""Added to the correlations, which are good to a hundredth: neighbouring scales are nearly the same."""
SHORTEST_TIME = 4.0
"""Shortest correlation time of a bias, s."""
TIME_RATIO, TIME_RATIO_OF_WEIGHTS = 1.1, 1.3
"""Correlation times are tried on a grid of the first ratio, weights are made on one of the second."""


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
        """Correlation times that are tried, s, always from the same grid; shorter ones belong to filters, not to a bias."""
        longest = max(4 * self.scales.tau[self.used][-1], 2 * SHORTEST_TIME)
        first, last = (round(np.log(t) / np.log(TIME_RATIO)) for t in (SHORTEST_TIME, longest))
        return TIME_RATIO ** np.arange(first, last + 1.0)

    @cached_property
    def wander(self) -> np.ndarray:
        """Expectations of Gauss-Markov processes of unit variance with these times, shape (n_used, n_times)."""
        return self.design(tuple(gauss_markov(time) for time in self.times))

    def design(self, processes: tuple[NoiseProcess, ...]) -> np.ndarray:
        """Return the expectations for unit coefficients, shape (n_used, n_processes)."""
        tau = self.scales.tau
        return np.column_stack([self.scales.expectation(process) * self.kept.of(process, tau) for process in processes])[self.used]

    def tensor(self, processes: tuple[NoiseProcess, ...]) -> np.ndarray:
        """Return the products of `ScaleCovariance.tensor` at the scales used; for weights a nearby correlation time will do."""
        rounded = tuple(gauss_markov(_rounded(process.time)) if process.time else process for process in processes)
        return self.scales.tensor(rounded)[:, :, self.used][:, :, :, self.used]

    @property
    def target(self) -> np.ndarray:
        """The variances used, shape (n_used,)."""
        return self.variance[self.used]

    def covariance(self, design: np.ndarray, tensor: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the covariance of the variances used for coefficients `values`: sampling error and variation between parts."""
        chance = np.einsum('p,q,pqij->ij', values, values, tensor)
        if not self.scatter:
            return chance
        level = self.scatter * np.sqrt(self.parts.share())[self.used] * (design @ values)
        return chance + np.outer(level, level)


def fit_processes(moments: Moments, processes: tuple[NoiseProcess, ...], fixed: dict[int, float] | None = None,
                  *, start: np.ndarray | None = None) -> MomentFit:
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

    design, tensor, target = moments.design(processes), moments.tensor(processes), moments.target
    free = np.array([k for k in range(len(processes)) if k not in (fixed or {})], int)
    values = _first_guess(design, target, moments) if start is None else np.array(start, float)
    for k, value in (fixed or {}).items():
        values[k] = value
    floor = FLOOR * np.min(target[:, None] / design, axis=0)
    for _ in range(STEPS):
        covariance = moments.covariance(design, tensor, np.maximum(values, floor))
        whitener = Whitener(covariance)
        new = values.copy()
        if len(free):
            columns = whitener(design[:, free])
            rest = whitener(target - sum((design[:, k] * value for k, value in (fixed or {}).items()), np.zeros(len(target))))
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
        self._inverse = np.linalg.inv(self._factor)   # well conditioned with the ridge; a triangular solve of this size waits for threads

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
    """Return the factor of a correlation matrix with approximation errors in its smallest eigenvalues."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.linalg.cholesky(matrix + (RIDGE - np.linalg.eigvalsh(matrix)[0]) * np.eye(len(matrix)))


def _rounded(time):
    return TIME_RATIO_OF_WEIGHTS ** round(np.log(time) / np.log(TIME_RATIO_OF_WEIGHTS))


def _first_guess(design, target, moments):
    """Return coefficients that follow the curve on a logarithmic scale, more closely at short averaging times."""
    from scipy.optimize import nnls

    weight = 1.0 / (target * np.sqrt(moments.scales.tau[moments.used]))
    values = nnls(design * weight[:, None], target * weight)[0]
    return np.maximum(values, 1e-6 * np.min(target[:, None] / design, axis=0))


def fit_with_time(moments: Moments, processes: tuple[NoiseProcess, ...], fixed: dict[int, float] | None = None) -> MomentFit:
    """
    Fit given processes and, as the last one, a Gauss-Markov process whose correlation time is estimated too.

    With fixed weights the best time minimises the weighted sum of squares; the weights are updated until the time converges.
    """
    whitener = Whitener(np.diag((moments.target**2 * moments.scales.tau[moments.used])))
    fit, seen = None, set()
    while True:
        best = _best_time(moments, processes, whitener, fixed or {})
        if fit is not None and best in seen:
            return fit
        seen.add(best)
        model = (*processes, gauss_markov(moments.times[best]))
        fit = fit_processes(moments, model, fixed, start=None if fit is None else fit.coefficients)
        whitener = Whitener(fit.covariance)


def _best_time(moments, processes, whitener, fixed):
    """Return the index of the time with the smallest sum of squares at given weights, no coefficient being negative."""
    last = len(processes)
    known = whitener(moments.design(processes))
    wander, times = whitener(moments.wander), moments.times
    target = whitener(moments.target) - sum((known[:, k] * value for k, value in fixed.items() if k < last), np.zeros(len(known)))
    rest = target[:, None] - wander * fixed[last] if last in fixed else np.repeat(target[:, None], len(times), axis=1)
    free = [k for k in range(last) if k not in fixed]
    best = np.full(len(times), np.inf)
    for count in range(len(free) + 1):
        for chosen in combinations(free, count):
            best = np.minimum(best, _costs(known[:, list(chosen)], wander, rest, last in fixed))
    return int(np.argmin(best))


def _costs(known, wander, rest, held):
    """Return the sums of squares with these columns and one of `wander` each; infinite where a coefficient would be negative."""
    basis, triangle = np.linalg.qr(known)
    own, beside = (values - basis @ (basis.T @ values) for values in (wander, rest))
    amount = np.zeros(wander.shape[1]) if held else np.maximum(np.einsum('it,it->t', own, beside) / np.einsum('it,it->t', own, own), 0.0)
    cost = np.einsum('it,it->t', beside - amount * own, beside - amount * own)
    values = np.linalg.solve(triangle, basis.T @ (rest - amount * wander)) if known.shape[1] else np.zeros((1, 1))
    return np.where((values >= 0).all(axis=0), cost, np.inf)
