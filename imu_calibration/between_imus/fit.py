"""The equation of the relative arm over many windows: robust fit with Student-t errors and noisy columns, with its covariance."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from imu_calibration.core.errors import NotObservableError
from imu_calibration.kinematics.reference_motion import skew

TAIL_DOF = 3
"""Degrees of freedom of Student's t of the residuals: knocks cause long tails."""


@dataclass(frozen=True, eq=False)
class ArmRows:
    """Integrated equations of the windows with information about the arm."""

    centres: np.ndarray
    """Middles of the windows, s, shape (n,)."""
    difference: np.ndarray
    """Mean force of B, in A's axes, less that of A, m/s^2, shape (n, 3)."""
    alpha: np.ndarray
    """Mean angular acceleration, rad/s^2, shape (n, 3)."""
    products: np.ndarray
    """Mean of rate rate', rad^2/s^2, shape (n, 3, 3)."""
    jerk: np.ndarray
    """Mean slope of the angular acceleration, rad/s^3, shape (n, 3)."""
    products_slope: np.ndarray
    """Mean slope of rate rate', shape (n, 3, 3)."""
    force_slope: np.ndarray
    """Mean slope of A's force, m/s^3, shape (n, 3)."""
    force: np.ndarray
    """Mean force of B in A's axes, m/s^2, shape (n, 3)."""
    alpha_noise: float
    """Variance of `alpha` per axis, rad^2/s^4."""
    clipped_share: float
    """Share of the moving windows that were left out."""
    length: float
    """Length of the windows, s."""


def lever_rows(alpha: np.ndarray, products: np.ndarray) -> np.ndarray:
    """``[alpha x] + omega omega^T - |omega|^2``, shape (n, 3, 3)."""
    return skew(alpha) + products - np.trace(products, axis1=1, axis2=2)[:, None, None] * np.eye(3)


@dataclass(frozen=True, eq=False)
class Fit:
    """Robust solution of the rows."""

    values: np.ndarray
    """Arm, difference of biases, delay of B's force, remaining delay of the rates, shape (8,)."""
    design: np.ndarray
    """Columns, shape (n, 3, 8)."""
    residual: np.ndarray
    """Left-hand side minus prediction, m/s^2, shape (n, 3)."""
    weights: np.ndarray
    """Weight of each window, shape (n,)."""
    weight_fall: np.ndarray
    """Derivative of each weight by the square of its residual, negated, shape (n,)."""
    hessian: np.ndarray
    """Derivative of the estimating equations by the values, shape (8, 8)."""
    seen: tuple
    """Signal shares of the arm's information without the noise of the columns, with their directions."""

    def weighted(self, index: np.ndarray | slice) -> np.ndarray:
        """Return design' times the derivative of the weighted residual by the residual, for some windows, shape (n, p, 3)."""
        turned, residual = np.swapaxes(self.design[index], 1, 2), self.residual[index]
        along = np.einsum('npi,ni->np', turned, residual) * self.weight_fall[index, None]
        return turned * self.weights[index, None, None] - along[:, :, None] * residual[:, None, :]

    def curvature(self, index: np.ndarray | slice) -> np.ndarray:
        """Return the contribution of some windows to the Hessian, shape (p, p)."""
        rows = np.swapaxes(self.weighted(index), 1, 2).reshape(-1, self.design.shape[2])
        return rows.T @ self.design[index].reshape(rows.shape)


def fit_arm(rows: ArmRows) -> Fit:
    """
    Solve ``difference = W(alpha, rate) @ arm + bias + delay terms`` with Student-t errors.

    Parameters
    ----------
    rows : ArmRows

    Returns
    -------
    Fit

    Raises
    ------
    NotObservableError
        When the motion is the same in all windows, or about one axis only and free of noise.

    """
    lever, lever_slope = lever_rows(rows.alpha, rows.products), lever_rows(rows.jerk, rows.products_slope)
    count, arm = len(lever), np.zeros(3)
    for number in range(3):  # the delay column needs the arm
        clocks = [-rows.force_slope[:, :, None], (lever_slope @ arm)[:, :, None]]
        design = np.concatenate([lever, np.tile(np.eye(3), (count, 1, 1)), *clocks], axis=2)
        used = design if number else design[:, :, :-1]
        values, weights, weight_fall, excess = _robust_fit(used, rows.difference, rows.alpha_noise)
        arm = values[:3]
    normal, raw = _normal(design, weights, excess), _normal(design, weights, 0.0)
    try:
        seen = scipy.linalg.eigh(_reduced(normal), _reduced(raw))
    except np.linalg.LinAlgError as error:
        raise NotObservableError('the motion must show the whole arm, one direction has no signal; '
                                 'twist fast about all axes') from error
    partial = Fit(values, design, rows.difference - design @ values, weights, weight_fall, normal, seen)
    hessian = partial.curvature(slice(None)) + (normal - raw)
    return replace(partial, hessian=hessian)


def _reduced(normal):
    """Return the normal matrix of the arm after elimination of the other parameters."""
    return normal[:3, :3] - normal[:3, 3:] @ np.linalg.solve(normal[3:, 3:], normal[3:, :3])


def _normal(design, weights, excess):
    """Weighted normal matrix, less the contribution of the noise of the angular acceleration (errors in variables)."""
    flat = (design * np.sqrt(weights)[:, None, None]).reshape(-1, design.shape[2])
    normal = flat.T @ flat
    ridge = 1e-12 * np.maximum(np.diag(normal), 1e-12)
    normal[:3, :3] -= excess * np.eye(3)
    return normal + np.diag(ridge)


def _robust_fit(design, target, alpha_noise):
    """
    Student-t regression by reweighting; returns (values, weights, negated derivative of the weights, excess of the normal matrix).

    The weight decreases with the residual, so the derivative of a weighted residual is smaller than its weight:
    ``weight - weight_fall residual^2``. The noise in the columns biases the values in this proportion.
    """
    weights, weight_fall, size = np.ones(len(design)), np.zeros(len(design)), np.zeros(len(design))
    flat, values = design.reshape(-1, design.shape[2]), np.full(design.shape[2], np.inf)
    for _ in range(30):
        excess = 2 * alpha_noise * np.sum(weights - weight_fall * size / 3)
        right = flat.T @ (target * weights[:, None]).ravel()
        before, values = values, np.linalg.solve(_normal(design, weights, excess), right)
        size = np.sum((target.ravel() - flat @ values).reshape(-1, 3)**2, axis=1)
        scale = np.median(size) / 2.366 + 1e-300  # the median of chi-square with three degrees of freedom
        weights = (TAIL_DOF + 3) / (TAIL_DOF + size / scale)
        weight_fall = 2 * weights**2 / ((TAIL_DOF + 3) * scale)
        if np.all(np.abs(values - before) <= 1e-9 * np.abs(values)):
            break
    return values, weights, weight_fall, excess


def jackknife_covariance(fit: Fit, centres: np.ndarray, cluster: float) -> np.ndarray:
    """Delete-one-cluster jackknife over stretches of time: errors within a stretch may have any correlation."""
    label = np.unique(np.floor((centres - centres[0]) / cluster).astype(int), return_inverse=True)[1]
    shifts = []
    for group in range(label.max() + 1):
        inside = label == group
        score = np.einsum('nip,ni,n->p', fit.design[inside], fit.residual[inside], fit.weights[inside])
        shifts.append(np.linalg.solve(fit.hessian - fit.curvature(inside), score))
    shifts = np.array(shifts) - np.mean(shifts, axis=0)
    return (len(shifts) - 1) / len(shifts) * shifts.T @ shifts


def response(fit: Fit, columns: np.ndarray) -> np.ndarray:
    """Return the derivative of the values by small changes of the left-hand side, columns (n, 3, k)."""
    return np.linalg.solve(fit.hessian, np.einsum('npi,nik->pk', fit.weighted(slice(None)), columns, optimize=True))
