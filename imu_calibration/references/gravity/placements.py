"""
Placements: consecutive rests of one attitude, and the errors that these rests have in common.

A board that is put on a face lies there as it did before in each of the next rests: an error of
the face, of the table or of the sensor is the same in all of them.
"""

import numpy as np
import scipy.linalg

from imu_calibration.estimation.rows import NO_COMPONENT, Rows, flat
from imu_calibration.references.gravity.equations import COMPONENTS, SCATTER_SD
from imu_calibration.references.rows.group_variances import GroupVariances, estimate_group_variances
from imu_calibration.references.rows.row_estimate import RowEstimate, gain_of_rows

PLACED_AGAIN = 0.0125
"""Consecutive rests within this angle are one placement, rad: they have the same error."""
VARIANCE_STEPS = 5
"""Largest number of estimates of the variance; two to four are usual."""


def placements(up: np.ndarray) -> np.ndarray:
    """
    Return the index of the first rest of each placement.

    `up` has the direction of gravity in each rest, unit vectors of shape (k, 3).
    """
    step = np.linalg.norm(np.diff(up, axis=0), axis=1)
    return np.flatnonzero(np.append(True, step > PLACED_AGAIN))


def excess(covariance: np.ndarray, known: np.ndarray, index: np.ndarray) -> np.ndarray:
    """
    Return the covariance that exceeds a known one of some parameters, shape (n_params, n_params).

    With the root L of the covariance C, and ``L^-1 A L^-T = U diag(w) U^T`` for the known one A::

        L U diag(max(1 - w, 0)) U^T L^T        C - A where C is larger, otherwise 0

    Parameters
    ----------
    covariance : array, shape (m, m)
    known : array, shape (n_params, n_params)
    index : array of int, shape (m,)
        Parameters of `covariance`.

    """
    block = np.ix_(index, index)
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    shares, axes = np.linalg.eigh(inverse @ known[block] @ inverse.T)
    scaled_axes = root @ axes
    excess_covariance = np.zeros_like(known)
    excess_covariance[block] = (scaled_axes * np.maximum(1.0 - shares, 0.0)) @ scaled_axes.T
    return excess_covariance


def covariance_of_placements(rows: Rows, estimate: RowEstimate) -> np.ndarray:
    """
    Return the covariance that common errors of rests add to the one of independent errors.

    The estimate is ``x = sum g_i y_i`` over the rows y. An error of the variance v that all rests
    of a placement have in common, in addition to independent ones of the variance s^2, adds::

        sum over placements of  g g' max(v - sum a_i^2 s^2, 0)        g = sum g_i

    with the weights a_i of the rests in their mean.

    Parameters
    ----------
    rows : Rows
        `GravityRows` at the estimate.
    estimate : RowEstimate

    Returns
    -------
    ndarray, shape (n_params, n_params)
        Zero where each placement has one rest.

    """
    n_params = len(estimate.free)
    n_rests = len(estimate.state.up)
    covariance = np.zeros((n_params, n_params))
    first = placements(estimate.state.up)
    if len(first) == n_rests:
        return covariance
    placement = np.searchsorted(first, np.arange(n_rests), side='right') - 1  # of each rest

    # Weights of the rests in the mean of each placement and axis, shape (n_means, m). A rest has
    # three rows, one for each axis; axis a of placement p has the mean number 3 p + a.
    pose = COMPONENTS.index('pose')
    of_poses = np.flatnonzero(rows.component == pose)
    mean = 3 * placement[rows.group[of_poses]] + np.arange(len(of_poses)) % 3
    weights = np.zeros((3 * len(first), len(rows.residual)))
    variances = rows.with_scatter(estimate.scatter.variance).variance.ravel()
    weights[mean, of_poses] = 1 / variances[of_poses]
    weights /= weights.sum(axis=1, keepdims=True)

    # Excess of the variance of the means over that of independent rests.
    variance = _variance_of_means(rows, estimate, weights).upper[0]
    of_independent = (weights**2).sum(axis=1) * estimate.scatter.upper[pose]
    excess_variance = np.maximum(variance - of_independent, 0.0)

    # Change of the estimate by an error that is common to the rests of a mean: sum of the g_i.
    common_gain = gain_of_rows(rows, estimate.scatter, estimate.free) @ (weights > 0).T
    free_block = np.ix_(estimate.free, estimate.free)
    covariance[free_block] = (common_gain * excess_variance) @ common_gain.T
    return covariance


def _variance_of_means(rows: Rows, estimate: RowEstimate, weights: np.ndarray) -> GroupVariances:
    """
    Return the variance of the means of placements beyond the noise of their samples, (m/s^2)^2.

    It is estimated by restricted likelihood from the means and the differences within placements:
    the rows of each placement are transformed to their mean and to the directions across it.
    `weights` of the rows in the means have the shape (n_means, m).
    """
    free = rows.of_parameters(estimate.free)
    columns = flat(free.equations)
    white = flat(free.with_scatter(estimate.scatter.variance).white())

    # Other rows, the means, and the differences within each mean: for whitened rests the mean has
    # the direction of the roots of the weights.
    transformed = [white[rows.component != COMPONENTS.index('pose')], weights @ columns]
    for weights_of_mean in weights:
        in_mean = np.flatnonzero(weights_of_mean)
        across = scipy.linalg.null_space(np.sqrt(weights_of_mean[in_mean])[None])
        transformed.append(across.T @ white[in_mean])
    # The means have the variance to be estimated, all other rows are whitened.
    stacked = np.concatenate(transformed)
    first_mean = len(transformed[0])
    means = slice(first_mean, first_mean + len(weights))
    noise = np.ones(len(stacked))
    noise[means] = weights**2 @ rows.variance.ravel()
    component = np.full(len(stacked), NO_COMPONENT)
    component[means] = 0
    transformed_rows = Rows(
        equations=stacked[:, None], variance=noise[:, None], component=component
    )

    fallback = np.array([SCATTER_SD[0] ** 2])
    start = fallback
    for _ in range(VARIANCE_STEPS):
        variances = estimate_group_variances(transformed_rows, start=start, fallback=fallback)
        if np.allclose(variances.variance, start, rtol=0.01):
            break
        start = variances.variance
    return variances
