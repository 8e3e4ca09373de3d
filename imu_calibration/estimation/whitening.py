"""Whitening of correlated noise."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import lapack

from imu_calibration.estimation.sensor_noise import BiasProcess


class Whitening:
    """
    Multiplication with the inverse Cholesky factor of the covariance of window means.

    By the innovations of a Kalman filter.

    The covariance is ``diag(variance) + sum_j sd_j^2 exp(-|dt| / time_j)`` within a session, the
    sum over any number of bias processes, each a state of the filter. An offset of each session is
    then removed with ``(I + s^2 u u')^(-1/2)``, u the whitened ones.

    Parameters
    ----------
    variance : ndarray, shape (n, n_axes)
        Independent part of the variance of each row.
    times : ndarray, shape (n,)
        Middle of each window, s.
    sessions : list of ndarray
        Indices of each session's rows in order of time.
    processes : sequence of BiasProcess
    session_variance : float
        Variance of an offset that all rows of a session share.

    """

    def __init__(
        self,
        variance: np.ndarray,
        times: np.ndarray,
        sessions: list[np.ndarray],
        *,
        processes: Sequence[BiasProcess] = (),
        session_variance: float = 0.0,
    ):
        self._variance, self._sessions = variance, sessions
        self._session_variance = session_variance
        self._filter: _Filter | None = None
        self._ones: np.ndarray | None = None
        processes = [process for process in processes if process.sd > 0]
        if processes:
            self._order = np.concatenate(sessions)
            # Each session begins a new series.
            steps = np.full(len(self._order), np.inf)
            start = 0
            for index in sessions:
                own_times = times[index]
                steps[start + 1 : start + len(index)] = own_times[1:] - own_times[:-1]
                start += len(index)
            self._filter = _Filter(
                self._chained(variance[:, :, None])[:, 0],
                np.concatenate([steps] * variance.shape[1]),
                processes,
            )
        if session_variance > 0:
            self._ones = self._filtered(np.ones(variance.shape + (1,)))[:, :, 0]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the whitened rows of `values`, both shape (n, n_axes, q)."""
        return self._with_session_offsets(self._filtered(values))

    def adjoint(self, white: np.ndarray) -> np.ndarray:
        """
        Return ``W' white``, shape (n, n_axes, q), of rows whitened by W, which it overwrites.

        ``V^-1 values`` with V the covariance.
        """
        return self._filtered(self._with_session_offsets(white), adjoint=True)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance, all axes together."""
        logs = np.log(self._variance if self._filter is None else self._filter.total).sum()
        if self._ones is not None:
            logs += sum(
                np.log1p(self._session_variance * (self._ones[index] ** 2).sum(axis=0)).sum()
                for index in self._sessions
            )
        return float(logs)

    def _chained(self, values: np.ndarray) -> np.ndarray:
        """
        Return the rows of all axes and sessions one after the other, each session in order of time.

        Shape (n_axes n, q).
        """
        return values[self._order].transpose(1, 0, 2).reshape(-1, values.shape[2])

    def _filtered(self, values: np.ndarray, *, adjoint: bool = False) -> np.ndarray:
        """Return rows divided by their noise, bias processes included, without session offsets."""
        if self._filter is None:
            return values / np.sqrt(self._variance)[:, :, None]
        chained = self._chained(values)
        found = self._filter.adjoint(chained) if adjoint else self._filter.forward(chained)
        white = np.empty_like(values)
        white[self._order] = found.reshape(values.shape[1], -1, values.shape[2]).transpose(1, 0, 2)
        return white

    def _with_session_offsets(self, white: np.ndarray) -> np.ndarray:
        """Multiply with ``(I + s^2 u u')^(-1/2)`` in each session, in place."""
        if self._ones is None:
            return white
        for index in self._sessions:
            ones = self._ones[index]
            square = (ones**2).sum(axis=0)
            shrink = (1 - 1 / np.sqrt(1 + self._session_variance * square)) / square
            white[index] -= (shrink * ones)[:, :, None] * np.einsum(
                'ka,kaq->aq', ones, white[index]
            )
        return white


LARGEST_SAFE_RATIO = 1e11
"""
Largest ratio of variances whose differences are not lost in rounding; windows without weight and
rests that all read zero are farther apart.
"""


class _Filter:
    """
    Innovations over their standard deviations of one chain of rows, in place.

    An infinite step begins a new series.

    Parameters
    ----------
    variance : array, shape (n,)
        Independent part of the variance of each row.
    steps : array, shape (n,)
        Time since the row before, s.
    processes : sequence of BiasProcess

    """

    def __init__(self, variance: np.ndarray, steps: np.ndarray, processes: Sequence[BiasProcess]):
        # A process keeps exp(-dt / time) of its value, and gains the variance that it lost.
        power = np.array([process.sd**2 for process in processes])
        times = np.array([process.time for process in processes])
        decay = np.exp(-steps[:, None] / times)
        fresh = -np.expm1(-2 * steps[:, None] / times) * power
        alike = variance.max() < LARGEST_SAFE_RATIO * (variance + fresh[:, 0]).min()
        if len(power) == 1 and alike:
            self.total, gain = _gains_of_one(variance, decay[:, 0], fresh[:, 0])
        else:
            self.total, gain = _gains(variance, decay, fresh)

        # The states follow s_k = F_k s_(k-1) + u_k with F_k = diag(decay) (I - gain 1'): a banded
        # system for all of them at once.
        self._width = width = len(power)
        self._driven_by = decay[1:] * gain[:-1]
        self._bands = np.zeros((2 * width, width * (len(variance) - 1)))
        self._bands[0] = 1.0
        for i in range(width):
            for j in range(width):
                self._bands[width + i - j, j:-width:width] = -decay[2:, i] * (
                    (i == j) - gain[1:-1, i]
                )

    def forward(self, values: np.ndarray) -> np.ndarray:
        """Return the innovations of rows, shape (n, q), which it overwrites."""
        if len(values) > 1:
            driven = (self._driven_by[:, :, None] * values[:-1, None, :]).reshape(
                -1, values.shape[1]
            )
            states = lapack.dtbtrs(
                self._bands, np.asfortranarray(driven), uplo='L', diag='U', overwrite_b=1
            )[0]
            if self._width > 1:
                states = states.reshape(len(values) - 1, self._width, -1).sum(axis=1)
            values[1:] -= states
        values /= np.sqrt(self.total)[:, None]
        return values

    def adjoint(self, values: np.ndarray) -> np.ndarray:
        """Return the transposed of `forward` times rows, shape (n, q), which it overwrites."""
        values /= np.sqrt(self.total)[:, None]
        if len(values) > 1:
            states = np.asfortranarray(np.repeat(values[1:], self._width, axis=0))
            driven = lapack.dtbtrs(
                self._bands, states, uplo='L', trans='T', diag='U', overwrite_b=1
            )[0]
            driven = driven.reshape(len(values) - 1, self._width, -1)
            values[:-1] -= np.einsum('kj,kjq->kq', self._driven_by, driven)
        return values


def _gains(
    variance: np.ndarray, decay: np.ndarray, fresh: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (variances of the innovations, shape (n,), gains, shape (n, m)) of m processes."""
    spread = np.zeros((decay.shape[1],) * 2)
    total = np.empty(len(variance))
    gain = np.empty(decay.shape)
    for k, own in enumerate(variance):
        spread = decay[k][:, None] * spread * decay[k] + np.diag(fresh[k])
        reach = spread.sum(axis=1)
        total[k] = reach.sum() + own
        gain[k] = reach / total[k]
        spread = spread - np.outer(gain[k], reach)
    return total, gain


def _gains_of_one(
    variance: np.ndarray, decay: np.ndarray, fresh: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the same for one process, the common case (called hundreds of times).

    Differences ``y_k - decay_k y_(k-1)`` have a tridiagonal covariance, whose pivots are the
    variances of the innovations.
    """
    carried = decay[1:] * variance[:-1]
    diagonal = fresh + variance
    diagonal[1:] += decay[1:] * carried
    total, _, info = lapack.dpttrf(diagonal, -carried)
    if info:
        raise FloatingPointError(
            'the covariance of the window means must be positive definite; variances are not finite'
        )
    return total, (1 - variance / total)[:, None]
