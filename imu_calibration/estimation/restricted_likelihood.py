"""Restricted likelihood of the means of windows as a function of the noise, beside all parameters or some of them."""

from typing import Sequence

import numpy as np
from scipy.linalg import lapack

from imu_calibration.estimation.noise_model import BiasProcess
from imu_calibration.estimation.scaled_solve import JITTER
from imu_calibration.estimation.whitening import Whitening


class RestrictedLikelihood:
    """
    Minus twice the restricted log likelihood of mean rows ``[design | residual]``.

    Parameters
    ----------
    rows : ndarray, shape (n, n_axes, q + 1)
        Mean rows of the linearised model, one layer per axis.
    times : ndarray, shape (n,)
        Middle of each window, s.
    sessions : list of ndarray
        Indices of each recording's windows in order of time.
    information : ndarray, shape (q + 1, q + 1), optional
        Normal matrix of everything else that is known of the parameters; without it of nothing.

    """

    def __init__(self, rows: np.ndarray, times: np.ndarray, sessions: list[np.ndarray], information: np.ndarray | None = None):
        self._rows, self._times, self._sessions = rows, times, sessions
        self._information = np.zeros((rows.shape[2],) * 2) if information is None else information

    def __call__(self, variance: np.ndarray, processes: Sequence[BiasProcess] = (), session_variance: float = 0.0) -> float:
        """Return the value for independent variances of the rows, shape (n, n_axes), bias processes and an offset per session."""
        logs, normal = self.whitened(variance, processes, session_variance)
        return logs + profile(normal)

    def whitened(self, variance: np.ndarray, processes: Sequence[BiasProcess] = (), session_variance: float = 0.0) -> tuple[float, np.ndarray]:
        """Return log|V| and the normal matrix of ``[design | residual]`` weighted with V^-1, `information` included."""
        whitening = Whitening(variance, self._times, self._sessions, processes, session_variance)
        white = whitening(self._rows).reshape(-1, self._rows.shape[2])
        return whitening.log_determinant, self._information + white.T @ white


def profile(normal: np.ndarray, restricted: bool = True) -> float:
    """Return ``y'y - b' A^-1 b``, for the restricted likelihood with ``log|A|``, of the normal matrix ``[[A, b], [b', y'y]]``."""
    scale = np.sqrt(np.maximum(np.diag(normal)[:-1], 1e-300))
    scaled = normal[:-1, :-1] / np.outer(scale, scale)
    scaled.flat[::len(scaled) + 1] += JITTER
    factor = np.linalg.cholesky(scaled)
    solved = lapack.dtrtrs(factor, normal[:-1, -1] / scale, lower=1)[0]
    logs = 2 * np.log(np.diag(factor)).sum() + 2 * np.log(scale).sum() if restricted else 0.0
    return logs + normal[-1, -1] - solved @ solved
