"""Rows whose errors are correlated from window to window, turned into independent rows of unit variance."""

import numpy as np
from scipy.linalg import lapack


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
