"""Restricted likelihood of the means of windows as a function of the sizes of their offsets and of the bias process."""

import numpy as np
from scipy.linalg import lapack


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
