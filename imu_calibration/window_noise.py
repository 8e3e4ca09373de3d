"""Noise of a session: white noise within windows, an offset per window, a bias that wanders from window to window."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import lapack

from imu_calibration.bands import extra_weight


@dataclass(frozen=True, eq=False)
class WindowNoise:
    """
    Noise of one sensor.

    The mean of window k has variance ``white_variance * inflation / n_k + offset_sd^2`` and, with its neighbours in the
    same recording, the covariance ``wander_sd^2 exp(-|t_k - t_l| / wander_time) + session_variance``.
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
    slow_scale: dict = field(default_factory=dict)
    """Kind -> the same of their slow part, where that fits better than the fast part, shape (3,)."""
    session_sd: float = 0.0
    """Standard deviation of the bias from recording to recording; zero when the recordings agree or there is one."""
    session_variance: float = 0.0
    """Its square, larger when few recordings leave it uncertain: what weights and standard deviations are made with."""

    def sample_sd(self):
        """Return the standard deviation of single samples, shape (3,)."""
        return np.sqrt(self.white_variance)

    def within_sd(self, kind):
        """Return the standard deviation per centred row of windows of `kind`, shape (3,)."""
        return np.sqrt(self.white_variance * self.inflation * self.kind_scale.get(kind, np.ones(3)))

    def slow_weight(self, kind):
        """Return the weight of the slow part of centred rows of `kind` beside all of them at `within_sd`, shape (3,)."""
        if kind not in self.slow_scale:
            return np.zeros(3)
        unit = self.white_variance * self.inflation
        return extra_weight(unit * self.kind_scale[kind], unit * self.slow_scale[kind])

    def weighs_alike(self, other, change=0.05):
        """Return whether slow parts count no more than fast ones, or both as with `other`, to a relative change of their variances."""
        unit, other_unit = (noise.white_variance * noise.inflation for noise in (self, other))
        for kind, slow in self.slow_scale.items():
            every = self.kind_scale[kind]
            if np.all(slow == every):
                continue
            if kind not in other.slow_scale:
                return False
            pairs = ((every, other.kind_scale[kind]), (slow, other.slow_scale[kind]))
            if any(np.any(np.abs(unit * mine / (other_unit * its) - 1) > change) for mine, its in pairs):
                return False
        return True


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


def whiten(values, variance, times, sessions, wander_sd, wander_time, session_variance=0.0):
    """
    Turn rows with correlated offsets into independent rows of unit variance.

    Innovations of a scalar Kalman filter: the same as multiplying with the inverse Cholesky factor of
    ``diag(variance) + wander_sd^2 exp(-|dt| / wander_time)``, in linear time. An offset of each session is taken out afterwards, with
    ``(I + s^2 u u')^(-1/2)`` and u the whitened ones of the session.

    Parameters
    ----------
    values : ndarray, shape (n, n_axes, q)
        Rows for each axis.
    variance : ndarray, shape (n, n_axes)
        Independent part of the variance.
    sessions : list of ndarray
        Indices of each session's rows in order of time.
    session_variance : float
        Variance of an offset that all rows of a session share.

    Returns
    -------
    ndarray, shape (n, n_axes, q)

    """
    white = np.empty_like(values)
    for index in sessions:
        white[index] = _whiten_session(values[index], variance[index], times[index], wander_sd, wander_time)
        if session_variance > 0:
            ones = _whiten_session(np.ones((len(index), values.shape[1], 1)), variance[index], times[index], wander_sd, wander_time)[:, :, 0]
            square = (ones**2).sum(axis=0)
            shrink = (1 - 1 / np.sqrt(1 + session_variance * square)) / square
            white[index] -= (shrink * ones)[:, :, None] * np.einsum('ka,kaq->aq', ones, white[index])
    return white


def _whiten_session(values, variance, times, wander_sd, wander_time):
    """Return the innovations of one session: gains step by step, states by a bidiagonal system ``s_k - c_k s_(k-1) = d_k g_k v_k``."""
    if wander_sd == 0:
        return values / np.sqrt(variance)[:, :, None]
    n_axes, decay = variance.shape[1], np.exp(-np.diff(times) / wander_time)
    total, gain = np.empty_like(variance), np.empty_like(variance)
    spread = np.full(n_axes, wander_sd**2)
    fresh = np.append((1 - decay**2) * wander_sd**2, 0.0)
    for k, square in enumerate(np.append(decay**2, 0.0)):
        total[k] = spread + variance[k]
        gain[k] = spread / total[k]
        spread = square * spread * (1 - gain[k]) + fresh[k]
    innovation = values.copy()
    for axis in range(n_axes if len(values) > 1 else 0):
        bands = np.stack([np.ones(len(decay)), np.append(-decay[1:] * (1 - gain[1:-1, axis]), 0.0)])
        driven = np.asfortranarray((decay * gain[:-1, axis])[:, None] * values[:-1, axis])
        innovation[1:, axis] -= lapack.dtbtrs(bands, driven, uplo='L', diag='U')[0]
    return innovation / np.sqrt(total)[:, :, None]


def predict_session_offsets(misfit, variance, times, sessions, noise):
    """
    Return the offset of each session, shape (n_sessions, 3): the mean of its residuals, weighted, drawn towards zero by the noise of that mean.

    Parameters
    ----------
    misfit, variance : ndarray, shape (n, 3)
        Residuals of the window means and the independent part of their variance.

    """
    offsets = []
    for index in sessions:
        rows = np.stack([np.ones((len(index), 3)), misfit[index]], axis=2)
        ones, rest = np.moveaxis(_whiten_session(rows, variance[index], times[index], noise.wander_sd, noise.wander_time), 2, 0)
        offsets.append((ones * rest).sum(axis=0) / ((ones**2).sum(axis=0) + 1 / noise.session_variance))
    return np.array(offsets)


class OffsetLikelihood:
    """
    Minus twice the restricted log likelihood of mean rows ``[design | residual]`` as a function of the offsets' variances.

    With ``V = D + s^2 K``, K exponential in time, ``V^-1 = D^-1 - D^-1 (D^-1 + K^-1 / s^2)^-1 D^-1``, and K^-1 is tridiagonal: linear
    time. An offset per session adds a matrix of rank one to each session's block.
    """

    def __init__(self, rows, white, times, sessions, information):
        order = np.concatenate(sessions)
        self._columns = np.ascontiguousarray(rows[order].transpose(1, 2, 0))
        self.white, self.information = np.ascontiguousarray(white[order].T), information
        ends = np.cumsum([len(index) for index in sessions])
        self._starts = ends - [len(index) for index in sessions]
        self.steps = np.diff(times[order])
        self.steps[ends[:-1] - 1] = np.inf

    def __call__(self, offset, wander=0.0, time=100.0, session=0.0):
        """Return the value for an offset sd, a wander sd and its correlation time, and an sd from session to session."""
        logs, gram = self.whitened(offset, wander, time, session)
        return logs + _profile(gram)

    def whitened(self, offset, wander=0.0, time=100.0, session=0.0):
        """Return log|V| and the Gram matrix of ``[design | residual]`` weighted with V^-1, `information` included."""
        variance = self.white + offset**2
        logs, gram = np.log(variance).sum(), self.information.copy()
        if wander > 0:
            decay, rest = np.exp(-self.steps / time), -np.expm1(-2 * self.steps / time)
            logs += 3 * (self.white.shape[1] * 2 * np.log(wander) + np.log(rest).sum())
            kernel = _inverse_kernel(decay, rest, wander)
        for columns, spread in zip(self._columns, variance):
            weighted = columns / spread
            gram += weighted @ columns.T
            ones = 1 / spread
            if wander > 0:
                diagonal, beside, info = lapack.dpttrf(kernel[0] + 1 / spread, kernel[1])
                if info:
                    raise FloatingPointError('the covariance of the window means must be positive definite; variances are not finite')
                logs += np.log(diagonal).sum()
                gram -= weighted @ lapack.dpttrs(diagonal, beside, weighted.T)[0]
                if session > 0:
                    ones = (1 - lapack.dpttrs(diagonal, beside, ones[:, None])[0][:, 0]) / spread
            if session > 0:
                logs += self._take_session(gram, columns, ones, session)
        return logs, gram

    def _take_session(self, gram, columns, ones, session):
        """Subtract what session offsets explain from the Gram matrix in place; return the log determinant that goes with it."""
        square = 1 + session**2 * np.add.reduceat(ones, self._starts)
        sums = np.add.reduceat(columns * ones, self._starts, axis=1)
        gram -= session**2 * (sums / square) @ sums.T
        return np.log(square).sum()


def _inverse_kernel(decay, rest, wander):
    """Return K^-1 / s^2 of the wander: its diagonal and the one beside it."""
    diagonal = np.ones(len(decay) + 1)
    diagonal[:-1] += decay**2 / rest
    diagonal[1:] += decay**2 / rest
    return diagonal / wander**2, -decay / rest / wander**2


def _profile(gram):
    """Return log|A| + (y' y - b' A^-1 b) for the Gram matrix [[A, b], [b', y' y]]."""
    scale = np.sqrt(np.maximum(np.diag(gram)[:-1], 1e-300))
    factor = np.linalg.cholesky(gram[:-1, :-1] / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    solved = lapack.dtrtrs(factor, gram[:-1, -1] / scale, lower=1)[0]
    return 2 * np.log(np.diag(factor)).sum() + 2 * np.log(scale).sum() + gram[-1, -1] - solved @ solved
