"""Restricted likelihood of the means of windows as a function of the noise, over all parameters or some of them."""

from collections.abc import Sequence

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
        Normal matrix of the centred rows and the prior; zero by default.

    """

    def __init__(self, rows: np.ndarray, times: np.ndarray, sessions: list[np.ndarray], *, information: np.ndarray | None = None):
        self._rows, self._times, self._sessions = rows, times, sessions
        self._information = np.zeros((rows.shape[2],) * 2) if information is None else information

    def of_axes(self, axes: np.ndarray) -> 'RestrictedLikelihood':
        """Return the same of the rows of some axes only."""
        return RestrictedLikelihood(self._rows[:, axes], self._times, self._sessions, information=self._information)

    def __call__(self, variance: np.ndarray, processes: Sequence[BiasProcess] = (), session_variance: float = 0.0) -> float:
        """Return the value for independent variances of the rows, shape (n, n_axes), bias processes and an offset per session."""
        logs, normal = self.whitened(variance, processes, session_variance)
        return logs + profile(normal)

    def whitened(self, variance: np.ndarray, processes: Sequence[BiasProcess] = (), session_variance: float = 0.0) -> tuple[float,
                                                                                                                            np.ndarray]:
        """Return log|V| and the normal matrix of ``[design | residual]`` weighted with V^-1, `information` included."""
        whitening = Whitening(variance, self._times, self._sessions, processes=processes, session_variance=session_variance)
        white = whitening(self._rows).reshape(-1, self._rows.shape[2])
        return whitening.log_determinant, self._information + white.T @ white

    def scoring(self, variance: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return score and information (Fisher scoring) of the variances of groups of independent rows.

        Parameters
        ----------
        variance : ndarray, shape (n, n_axes)
            Independent variances of the rows.
        members : ndarray, shape (n_groups, n n_axes)
            Which rows belong to each group, as ones and zeros.

        Returns
        -------
        tuple
            First derivative of the log likelihood by the variances, shape (n_groups,), and minus the expected second one, (n_groups,
            n_groups).

        """
        white = Whitening(variance, self._times, self._sessions)(self._rows).reshape(-1, self._rows.shape[2])
        left = np.linalg.qr(white[:, :-1])[0]
        rest = white[:, -1] - left @ (left.T @ white[:, -1])
        redundancy = 1 - np.einsum('ij,ij->i', left, left)
        weighted = members / variance.ravel()
        return 0.5 * weighted @ (rest**2 - redundancy), 0.5 * weighted @ (np.eye(len(left)) - left @ left.T)**2 @ weighted.T


def profile(normal: np.ndarray) -> float:
    """Return ``y'y - b' A^-1 b + log|A|`` of the normal matrix ``[[A, b], [b', y'y]]``."""
    scale = np.sqrt(np.maximum(np.diag(normal)[:-1], 1e-300))
    scaled = normal[:-1, :-1] / np.outer(scale, scale)
    scaled.flat[::len(scaled) + 1] += JITTER
    factor = np.linalg.cholesky(scaled)
    solved = lapack.dtrtrs(factor, normal[:-1, -1] / scale, lower=1)[0]
    logs = 2 * np.log(np.diag(factor)).sum() + 2 * np.log(scale).sum()
    return logs + normal[-1, -1] - solved @ solved
