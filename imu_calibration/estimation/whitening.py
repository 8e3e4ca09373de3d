"""Whitening of correlated noise."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import lapack

from imu_calibration.estimation.sensor_noise import BiasProcess


class Whitening:
    """
    Multiplication with an inverse root W of the covariance of window means, ``W V W' = I``.

    Within a session ``V = diag(variance) + sum_j sd_j^2 exp(-|dt| / time_j) + s^2 1 1'``, the sum
    over any number of bias processes. Their part is whitened by the innovations of a Kalman filter,
    in which each process is a state; the offset of the session with variance s^2 then by
    ``(I + s^2 u u')^(-1/2)``, with the vector u of ones after the filter.

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
        self._variance = variance
        self._sessions = sessions
        self._session_variance = session_variance
        self._filter: _Filter | None = None
        """Filter over the rows of all axes in one chain; None without bias processes."""
        self._ones: np.ndarray | None = None
        """Ones after the filter, shape (n, n_axes); None without an offset of sessions."""
        processes = [process for process in processes if process.sd > 0]
        if processes:
            self._order = np.concatenate(sessions)
            """Indices of the rows in the chain of one axis: sessions, each in order of time."""
            # An infinite step before the first row of each session begins a new series.
            steps = np.full(len(self._order), np.inf)
            start = 0
            for index in sessions:
                times_of_session = times[index]
                steps[start + 1 : start + len(index)] = np.diff(times_of_session)
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
        Return ``W' white``, shape (n, n_axes, q); it overwrites `white`.

        Of whitened values, ``white = W values``, that is ``V^-1 values``.
        """
        return self._filtered(self._with_session_offsets(white), adjoint=True)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance, all axes together."""
        of_rows = self._variance if self._filter is None else self._filter.total
        log_determinant = np.log(of_rows).sum()
        if self._ones is not None:
            # log det(I + s^2 u u') of each session
            of_offsets = 0.0
            for index in self._sessions:
                squares = (self._ones[index] ** 2).sum(axis=0)
                of_offsets += np.log1p(self._session_variance * squares).sum()
            log_determinant += of_offsets
        return float(log_determinant)

    def _chained(self, values: np.ndarray) -> np.ndarray:
        """
        Return values (n, n_axes, q) as one chain of rows, shape (n_axes n, q).

        The axes are one after the other; of each axis the sessions, each in order of time.
        """
        return values[self._order].transpose(1, 0, 2).reshape(-1, values.shape[2])

    def _filtered(self, values: np.ndarray, *, adjoint: bool = False) -> np.ndarray:
        """
        Return values whitened by the noise of the rows and the bias processes, (n, n_axes, q).

        With `adjoint` they are multiplied by the transposed operator.
        """
        if self._filter is None:
            return values / np.sqrt(self._variance)[:, :, None]
        chain = self._chained(values)
        chain = self._filter.adjoint(chain) if adjoint else self._filter.forward(chain)
        # Back from the chain to the order of the rows.
        white = np.empty_like(values)
        white[self._order] = chain.reshape(values.shape[1], -1, values.shape[2]).transpose(1, 0, 2)
        return white

    def _with_session_offsets(self, white: np.ndarray) -> np.ndarray:
        """
        Multiply with ``(I + s^2 u u')^(-1/2)`` in each session, in place.

        It is ``I - (1 - 1 / sqrt(1 + s^2 u'u)) / (u'u) u u'``.
        """
        if self._ones is None:
            return white
        for index in self._sessions:
            ones = self._ones[index]
            square = (ones**2).sum(axis=0)
            shrink = (1 - 1 / np.sqrt(1 + self._session_variance * square)) / square
            projected = np.einsum('ka,kaq->aq', ones, white[index])  # u' times the rows
            white[index] -= (shrink * ones)[:, :, None] * projected
        return white


LARGEST_SAFE_RATIO = 1e11
"""
Largest ratio of variances whose differences are not lost in rounding; windows without weight and
rests that all read zero are farther apart.
"""


class _Filter:
    """
    Innovations over their standard deviations of one chain of rows, in place.

    With the decay d_j = exp(-dt / time_j) of process j from row to row, the Kalman gain g_j and the
    variance S of the innovation e of a row y, the predicted states s follow::

        e_k = y_k - sum_j s_jk,   s_k = F_k s_(k-1) + d_k g_(k-1) y_(k-1)
        F_k = diag(d_k) (I - g_(k-1) 1')

    An infinite step (d = 0) begins a new series.

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
        is_safe = variance.max() < LARGEST_SAFE_RATIO * (variance + fresh[:, 0]).min()
        if len(power) == 1 and is_safe:
            total, gain = _gains_of_one(variance, decay[:, 0], fresh[:, 0])
        else:
            total, gain = _gains(variance, decay, fresh)
        self.total = total
        """Variances S of the innovations, shape (n,)."""
        self._width = width = len(power)
        """Number m of processes."""
        self._driven_by = decay[1:] * gain[:-1]
        """Factors ``d_k g_(k-1)`` of the row before in the states, shape (n - 1, m)."""

        # All states from one banded system, s_k - F_k s_(k-1) = d_k g_(k-1) y_(k-1), with the m
        # states of each row of the chain next to each other. Element (i, j) of -F_k multiplies
        # state j of the row before in the equation of state i: it is `width + i - j` below the
        # diagonal, in each column j + m k but that of the last row.
        self._bands = np.zeros((2 * width, width * (len(variance) - 1)))
        """Its unit lower triangle in the band storage of LAPACK, shape (2 m, m (n - 1))."""
        self._bands[0] = 1.0
        for i in range(width):
            for j in range(width):
                factor = (i == j) - gain[1:-1, i]
                self._bands[width + i - j, j:-width:width] = -decay[2:, i] * factor

    def forward(self, values: np.ndarray) -> np.ndarray:
        """Return the innovations of rows, shape (n, q), which it overwrites."""
        if len(values) > 1:
            # States of all rows but the first, shape (m (n - 1), q); their sum is the prediction.
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
    """
    Return (variances S of the innovations, shape (n,), gains g, shape (n, m)) of m processes.

    The Kalman filter with the covariance P of the states, ``P <- d P d' + diag(fresh)``,
    ``S = 1'P1 + variance``, ``g = P1 / S``, ``P <- P - g 1'P``.

    Parameters
    ----------
    variance : array, shape (n,)
        Independent part of the variance of each row.
    decay, fresh : array, shape (n, m)
        Factor on each state since the row before, and the variance that it gained.

    """
    covariance = np.zeros((decay.shape[1],) * 2)
    total = np.empty(len(variance))
    gain = np.empty(decay.shape)
    for k, of_row in enumerate(variance):
        covariance = decay[k][:, None] * covariance * decay[k] + np.diag(fresh[k])
        with_row = covariance.sum(axis=1)
        total[k] = with_row.sum() + of_row
        gain[k] = with_row / total[k]
        covariance = covariance - np.outer(gain[k], with_row)
    return total, gain


def _gains_of_one(
    variance: np.ndarray, decay: np.ndarray, fresh: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the result of `_gains` for one process, all arguments of shape (n,).

    It is the common case, called hundreds of times. Differences ``y_k - decay_k y_(k-1)`` have a
    tridiagonal covariance, whose pivots are the variances of the innovations.
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
