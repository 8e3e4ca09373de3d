"""Noise of a session: white noise within windows, an offset per window, a bias that wanders from window to window."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize


@dataclass(frozen=True, eq=False)
class WindowNoise:
    """
    Noise of one sensor.

    The mean of window k has variance ``white_variance * inflation / n_k + offset_sd^2`` and, with its neighbours in the
    same recording, the covariance ``wander_sd^2 exp(-|t_k - t_l| / wander_time)``.
    """

    white_variance: np.ndarray
    """Variance of single samples, shape (3,)."""
    inflation: np.ndarray
    """Factor by which the noise at low frequency exceeds white noise of that variance, shape (3,)."""
    offset_sd: float = 0.0
    """Standard deviation of an independent offset per window."""
    wander_sd: float = 0.0
    """Standard deviation of a first-order Gauss-Markov wander of the bias."""
    wander_time: float = 100.0
    """Correlation time of the wander, s."""
    kind_scale: dict = field(default_factory=dict)
    """Kind -> factor on the variance of the centred rows, shape (3,): what moving windows scatter beyond the noise at rest."""

    def sample_sd(self):
        """Return the standard deviation of single samples, shape (3,)."""
        return np.sqrt(self.white_variance)

    def within_sd(self, kind):
        """Return the standard deviation per centred row of windows of `kind`, shape (3,)."""
        return np.sqrt(self.white_variance * self.inflation * self.kind_scale.get(kind, np.ones(3)))


def white_noise(rows, sensor):
    """
    Return (white_variance, inflation) pooled over static windows, each shape (3,), or None without static windows.

    Windows whose variance lies far from the median (clipped, knocked) are left out.
    """
    static = [row for row in rows if row.kind == 'static' and np.all(np.isfinite(row.sensors[sensor].noise_variance))]
    if not static:
        return None
    variances = np.array([row.sensors[sensor].noise_variance for row in static])
    inflations = np.array([row.sensors[sensor].inflation for row in static])
    counts = np.array([row.count for row in static], float)
    pooled, factors = np.empty(3), np.empty(3)
    for axis in range(3):
        median = np.median(variances[:, axis])
        near = (variances[:, axis] <= 2 * median) & (variances[:, axis] >= 0.5 * median)
        weight = counts * near
        pooled[axis] = np.average(variances[:, axis], weights=weight) if weight.sum() else median
        weight = (counts >= 32) * near
        factors[axis] = np.average(inflations[:, axis], weights=weight) if weight.sum() else 1.0
    floor = 1e-30 + np.finfo(float).eps**2 * np.max(np.abs([row.sensors[sensor].mean[-3:] for row in static]))**2
    return np.maximum(pooled, floor), np.clip(factors, 0.8, None)


def sessions_of(rows):
    """Return the index arrays of the rows of each recording, in order of time."""
    numbers = np.array([row.session for row in rows])
    times = np.array([row.time for row in rows])
    return [np.flatnonzero(numbers == number)[np.argsort(times[numbers == number], kind='stable')] for number in np.unique(numbers)]


def whiten(values, variance, times, sessions, wander_sd, wander_time):
    """
    Turn rows with correlated offsets into independent rows of unit variance.

    Innovations of a scalar Kalman filter, row after row: the same as multiplying with the inverse Cholesky factor of
    ``diag(variance) + wander_sd^2 exp(-|dt| / wander_time)``, in linear time.

    Parameters
    ----------
    values : ndarray, shape (n, n_axes, q)
        Rows for each axis.
    variance : ndarray, shape (n, n_axes)
        Independent part of the variance.

    Returns
    -------
    ndarray, ndarray
        Whitened rows, and the log of the innovation variances, shape (n, n_axes).

    """
    if wander_sd == 0:
        return values / np.sqrt(variance)[:, :, None], np.log(variance)
    white, logs = np.empty_like(values), np.empty_like(variance)
    for index in sessions:
        state, spread = np.zeros(values.shape[1:]), np.full(variance.shape[1], wander_sd**2)
        steps = np.exp(-np.diff(times[index], prepend=times[index[0]]) / wander_time)
        for k, decay in zip(index, steps):
            state = decay * state
            spread = decay**2 * spread + (1 - decay**2) * wander_sd**2
            total = spread + variance[k]
            innovation = values[k] - state
            gain = spread / total
            white[k] = innovation / np.sqrt(total)[:, None]
            logs[k] = np.log(total)
            state = state + gain[:, None] * innovation
            spread = spread * (1 - gain)
    return white, logs


class OffsetLikelihood:
    """
    Minus twice the restricted log likelihood of mean rows ``[design | residual]`` as a function of the offsets' variances.

    With ``V = D + s^2 K``, K exponential in time, ``V^-1 = D^-1 - D^-1 (D^-1 + K^-1 / s^2)^-1 D^-1``, and K^-1 is tridiagonal: linear
    time.
    """

    def __init__(self, rows, white, times, sessions, information):
        order = np.concatenate(sessions)
        self.rows, self.white, self.information = rows[order], white[order], information
        steps = np.diff(times[order])
        steps[np.cumsum([len(index) for index in sessions])[:-1] - 1] = np.inf
        self.steps = steps

    def __call__(self, offset, wander=0.0, time=100.0):
        """Return the value for an offset sd, a wander sd and its correlation time."""
        logs, gram = self.whitened(offset, wander, time)
        return logs + _profile(gram)

    def whitened(self, offset, wander=0.0, time=100.0):
        """Return log|V| and the Gram matrix of ``[design | residual]`` weighted with V^-1, `information` included."""
        variance = self.white + offset**2
        logs, gram = np.log(variance).sum(), self.information.copy()
        scaled = self.rows / np.sqrt(variance)[:, :, None]
        flat = scaled.reshape(-1, self.rows.shape[2])
        gram += flat.T @ flat
        if wander > 0:
            decay = np.exp(-self.steps / time)
            rest = -np.expm1(-2 * self.steps / time)
            logs += 3 * (len(self.rows) * 2 * np.log(wander) + np.log(rest).sum())
            bands = self._inverse_kernel(decay, rest, wander)
            for axis in range(3):
                logs += self._take_wander(gram, bands, self.rows[:, axis], variance[:, axis])
        return logs, gram

    def _inverse_kernel(self, decay, rest, wander):
        """Return K^-1 / s^2 of the wander as lower bands, shape (2, n)."""
        bands = np.zeros((2, len(self.rows)))
        bands[0] = 1.0
        bands[0, :-1] += decay**2 / rest
        bands[0, 1:] += decay**2 / rest
        bands[1, :-1] = -decay / rest
        return bands / wander**2

    def _take_wander(self, gram, bands, rows, variance):
        """Subtract the wander's part from the Gram matrix in place; return the log determinant that goes with it."""
        banded = bands.copy()
        banded[0] += 1 / variance
        factor = cholesky_banded(banded, lower=True, check_finite=False)
        weighted = rows / variance[:, None]
        gram -= weighted.T @ cho_solve_banded((factor, True), weighted, check_finite=False)
        return 2 * np.log(factor[0]).sum()


def _profile(gram):
    """Return log|A| + (y' y - b' A^-1 b) for the Gram matrix [[A, b], [b', y' y]]."""
    scale = np.sqrt(np.maximum(np.diag(gram)[:-1], 1e-300))
    factor = np.linalg.cholesky(gram[:-1, :-1] / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    solved = np.linalg.solve(factor, gram[:-1, -1] / scale)
    return 2 * np.log(np.diag(factor)).sum() + 2 * np.log(scale).sum() + gram[-1, -1] - solved @ solved


TYPICAL_TIME, TIME_SPREAD = 100.0, 0.8
"""Correlation times of MEMS biases: around 100 s, log-normal; a short session cannot tell them (field catalogue, section 6)."""
CLEAR_GAIN = 30.0
"""Fall of minus twice the log likelihood beyond which a wander's size is plain and its best estimate is taken."""
OFFSET_GRID = np.array([0.0, 0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0])
WANDER_GRID = np.array([0.0, 0.15, 0.25, 0.4, 0.63, 1.0, 1.6, 2.5, 4.0, 6.3, 10.0, 25.0, 60.0])
TIME_GRID = np.array([40.0, 100.0, 250.0])
"""Offset and wander in units of the typical noise of a window mean; correlation times in s."""


def estimate_offsets(rows, white, times, sessions, information):
    """
    Return (offset_sd, wander_sd, wander_time) from the restricted likelihood.

    A short session leaves open how large a wander is, and a bias is only as certain as its wander is small. So the
    variances are averaged over the likelihood (posterior means on a grid); only a wander that is plain gets its best value.

    Parameters
    ----------
    rows : ndarray, shape (n, 3, q + 1)
        Mean rows ``[design | residual]`` of the linearised model, one layer per axis.
    white : ndarray, shape (n, 3)
        Variance of the means by the noise within windows.

    """
    typical = float(np.sqrt(np.median(white)))
    likelihood = OffsetLikelihood(rows, white, times, sessions, information)

    def cost(offset, wander=0.0, time=TYPICAL_TIME):
        return likelihood(offset, wander, time) + (np.log(time / TYPICAL_TIME) / TIME_SPREAD)**2

    alone = np.array([cost(ratio * typical) for ratio in OFFSET_GRID])
    offsets = OFFSET_GRID[alone < alone.min() + 20.0]
    offsets = np.unique(np.concatenate([[0.0], offsets])) * typical
    wanders = WANDER_GRID[WANDER_GRID > 0] * typical if len(rows) >= 12 else WANDER_GRID[:0]
    trials = [(offset, 0.0, TYPICAL_TIME) for offset in OFFSET_GRID * typical]
    trials += [(offset, wander, time) for wander in wanders for time in TIME_GRID for offset in offsets]
    costs = np.concatenate([alone, [cost(*trial) for trial in trials[len(alone):]]])
    best = int(np.argmin(costs))
    if alone.min() - costs[best] > CLEAR_GAIN:
        return _best_wander(cost, trials[best], typical)
    return _posterior_mean(np.array(trials), costs - costs[best])


def _posterior_mean(trials, costs):
    """Return the roots of the mean variances, and the mean logarithm of the correlation time, over the likelihood."""
    weight = np.exp(-0.5 * costs) * np.where(trials[:, 1] == 0, 1.0, 1.0 / len(TIME_GRID))
    weight /= weight.sum()
    offset, wander = np.sqrt(weight @ trials[:, :2]**2)
    wandering = weight * trials[:, 1]**2
    if wandering.sum() <= 0:
        return float(offset), 0.0, TYPICAL_TIME
    return float(offset), float(wander), float(np.exp(wandering @ np.log(trials[:, 2]) / wandering.sum()))


def _best_wander(cost, start, typical):
    """Return the best values near a grid point."""
    found = minimize(lambda x: cost(np.exp(x[0]), np.exp(x[1]), np.exp(np.clip(x[2], 1.6, 8.0))), np.log([max(start[0], 0.1 * typical), *start[1:]]),
                     method='Nelder-Mead', options={'maxfev': 80, 'xatol': 0.03, 'fatol': 0.03})
    offset_sd, wander_sd, wander_time = np.exp(np.append(found.x[:2], np.clip(found.x[2], 1.6, 8.0)))
    return float(offset_sd), float(wander_sd), float(wander_time)
