"""How much to smooth: noise and resolution of encoders, and the penalty that suits the data."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from imu_calibration.bspline import ORDER, penalty_bands

# Decades of the penalty relative to the samples per knot: from interpolation to a bandwidth of 1/128 of Nyquist's.
_COARSE = np.arange(-6.0, 10.1, 2.0)


@dataclass(frozen=True, eq=False)
class Smooth:
    """A penalised fit of one joint."""

    coefficients: np.ndarray
    """Spline coefficients, shape (n_coefficients,)."""
    penalty: float
    """Penalty of the third differences that was chosen."""
    dof: float
    """Effective number of parameters."""
    noise_sd: float
    """Standard deviation of the residuals, unit of the data, corrected for `dof`."""


class PenalisedSpline:
    """
    Least squares on rows ``design @ coefficients = values`` with the penalty ``lambda |third differences|^2``.

    Eilers and Marx 1996. The degrees of freedom come from the mean bands of the normal matrix, as for a long uniform
    record: ``3 + (n - 3) mean_theta N / (N + lambda (2 - 2 cos theta)^3)``.
    """

    def __init__(self, knots, design, bands):
        self.design, self.bands, self.penalty = design, bands, penalty_bands(knots)
        self.n_rows = design.shape[0]
        self.density = self.n_rows / knots.n_coefficients
        theta = (np.arange(256) + 0.5) * np.pi / 256
        weights = np.where(np.arange(ORDER) == 0, 1.0, 2.0)
        self._symbol = np.maximum(np.cos(theta[:, None] * np.arange(ORDER)) @ (weights * bands.sum(axis=1)) / knots.n_coefficients, 0)
        self._penalty_symbol = (2 - 2 * np.cos(theta)) ** 3

    def solve(self, values, penalty):
        """Return the coefficients for columns of `values`."""
        return solveh_banded(self.bands + penalty * self.penalty, self.design.T @ values, lower=True, overwrite_ab=True,
                             overwrite_b=True, check_finite=False)

    def residual_share(self, penalty):
        """Return the share of the rows that is left to the residuals, ``1 - dof / n``."""
        damped = penalty * self._penalty_symbol
        return (1 - 3 / self.n_rows) * np.mean(damped / (self._symbol + damped))

    def residual_squares(self, values, penalty):
        """Return the mean squared residual of each column."""
        residual = values - self.design @ self.solve(values, penalty)
        return np.einsum('ij,ij->j', residual, residual) / self.n_rows


def smooth(spline, values, noise_floor, dof_weight):
    """
    Return a `Smooth` per column of `values`, with the penalty that predicts best.

    The larger one of two penalties: that of generalised cross-validation (Craven and Wahba 1979), which needs no
    noise, and that of Mallows' Cp for `noise_floor`, which holds where the noise is not white (coarse encoders).

    Parameters
    ----------
    spline : PenalisedSpline
        Rows and penalty.
    values : array, shape (n, n_joints)
        Right-hand sides.
    noise_floor : array, shape (n_joints,)
        Standard deviation that the noise has at least.
    dof_weight : float
        Weight of the degrees of freedom; above one it guards against fits that are too rough.

    """
    squares = {x: spline.residual_squares(values, _penalty(spline, x)) for x in _COARSE}
    results = []
    for column, floor in enumerate(noise_floor):
        known = {x: square[column] for x, square in squares.items()}

        def score(x, column=column, known=known, floor=floor):
            if x not in known:
                known[x] = spline.residual_squares(values[:, column:column + 1], _penalty(spline, x))[0]
            share = spline.residual_share(_penalty(spline, x))
            gcv = known[x] / max(1 - dof_weight * (1 - share), 1e-12) ** 2 if dof_weight * (1 - share) < 1 else np.inf
            return gcv, known[x] + 2 * dof_weight * floor ** 2 * (1 - share)

        x = max(_minimum(lambda x: score(x)[0]), _minimum(lambda x: score(x)[1]))
        penalty = _penalty(spline, x)
        coefficients = spline.solve(values[:, column:column + 1], penalty)
        residual = values[:, column] - spline.design @ coefficients[:, 0]
        share = spline.residual_share(penalty)
        noise = np.sqrt(np.mean(residual ** 2) / share) if share > 0 else 0.0
        results.append(Smooth(coefficients[:, 0], penalty, (1 - share) * spline.n_rows, float(noise)))
    return results


def _penalty(spline, decade):
    return spline.density * 10.0 ** decade


def _minimum(score):
    """Return the decade of the smallest score: coarse steps, then one decade, then half a one."""
    best = min(_COARSE, key=score)
    for step in (1.0, 0.5):
        best = min((best - step, best, best + step), key=score)
    return best


def encoder_step(position):
    """
    Return the resolution of an encoder that shows in its readings, or 0.

    Looks at isolated jumps, those between readings that repeat; they are one step high. Readings that move by many steps
    from sample to sample have none; their quantisation is white and needs no notice.
    """
    change = np.diff(position)
    moved = change != 0
    isolated = np.abs(change[1:-1][moved[1:-1] & ~moved[:-2] & ~moved[2:]])
    if not len(isolated):
        return 0.0
    step = np.median(isolated)
    return float(step) if np.mean(np.abs(isolated / step - 1) < 0.15) > 0.8 else 0.0
