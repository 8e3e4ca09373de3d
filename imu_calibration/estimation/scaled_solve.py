"""Triangular factors, and least squares with scaled columns."""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from scipy.linalg import lapack

FACTORED_ROWS = 2000
"""Rows per orthogonal factorisation: taller blocks do not fit in the processor's cache."""
PANEL = 4
"""Columns that are reflected at a time."""


def triangular(rows: np.ndarray) -> np.ndarray:
    """
    Return the triangular factor of `rows`, shape (min(m, n), n).

    By Householder reflections of one block after the other.
    """
    count, width = rows.shape
    if count < 2 * width:
        return _r_factor(np.array(rows, order='F'))
    factor = np.zeros((width, width), order='F')
    for start in range(0, count, FACTORED_ROWS):
        # Each block is folded into the triangle, whose zeros are skipped.
        block = np.array(rows[start : start + FACTORED_ROWS], order='F')
        factor, _, _, info = lapack.dtpqrt(
            0, min(PANEL, width), factor, block, overwrite_a=1, overwrite_b=1
        )
        _require_finite(info, factor)
    return np.triu(factor)


BAND_COLUMNS = 20
"""Columns that are eliminated at a time."""


def triangular_of_band(rows: np.ndarray) -> np.ndarray:
    """
    Return the triangular factor of `rows`, shape (n, n).

    Rows that begin in the same band of `BAND_COLUMNS` columns are reflected together.

    With the elements near a diagonal, and dense columns last, the cost is proportional to the
    number of rows.
    """
    width = rows.shape[1]
    first_band = np.argmax(rows != 0, axis=1) // BAND_COLUMNS
    factor = np.zeros((width, width))
    carried = rows[:0]
    for band in range(-(-width // BAND_COLUMNS)):  # rounded up
        # The rows that begin in this band, and the remainder of the rows before it.
        stacked = np.concatenate([carried, rows[first_band == band]])
        used = np.flatnonzero(stacked.any(axis=0))
        if not len(used):
            # no row has an element in this band
            carried = rows[:0]
            continue
        part = triangular(stacked[:, used])
        reflected = np.zeros((len(part), width))
        reflected[:, used] = part
        # Row k of the part begins in column `used[k]`. Those that begin up to this band are final,
        # because all other rows begin later; the rows below them are carried on.
        n_final = min(int(np.searchsorted(used, (band + 1) * BAND_COLUMNS)), len(part))
        factor[used[:n_final]] = reflected[:n_final]
        carried = reflected[n_final:]
    return factor


def _r_factor(stacked: np.ndarray) -> np.ndarray:
    """Return the triangular factor of one block, which it overwrites."""
    if not len(stacked):
        return stacked
    raw, _, _, info = lapack.dgeqrf(stacked, overwrite_a=1)
    _require_finite(info, raw[:, 0])
    return np.triu(raw[: min(raw.shape)])


def _require_finite(info: int, values: np.ndarray) -> None:
    """Raise FloatingPointError where a factorisation failed."""
    if info != 0 or not np.isfinite(values).all():
        raise FloatingPointError('orthogonal factorisation met values that are not finite')


JITTER = 1e-12
"""
Added to the diagonal of a scaled normal matrix: above its rounding, below the information of the
data.
"""


def scaled_lstsq(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """
    Return the least-squares solution of ``matrix @ x = right``.

    The columns of the matrix are scaled to unit norm first.
    """
    scale = np.linalg.norm(matrix, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    q, r, order = scipy.linalg.qr(matrix / scale, mode='economic', pivoting=True)
    # Columns beyond the rank depend on the ones before, and get the value 0.
    diagonal = np.abs(np.diag(r))
    rank = int((diagonal > 1e-15 * diagonal[0]).sum()) if len(diagonal) else 0
    solved = np.zeros((matrix.shape[1],) + right.shape[1:])
    solved[order[:rank]] = scipy.linalg.solve_triangular(r[:rank, :rank], (q.T @ right)[:rank])
    return (solved.T / scale).T


def inverse_gram(matrix: np.ndarray) -> np.ndarray:
    """Return ``(matrix' matrix)^-1`` through the triangular factor of the scaled columns."""
    scale = np.linalg.norm(matrix, axis=0)
    r = scipy.linalg.qr(matrix / scale, mode='r')[0][: matrix.shape[1]]
    inverse = scipy.linalg.solve_triangular(r, np.eye(len(r)))
    return (inverse @ inverse.T) / np.outer(scale, scale)


def inverse_normal(information: np.ndarray) -> np.ndarray:
    """
    Return the inverse of an information matrix, scaled to a unit diagonal first.

    Several matrices, shape (..., n, n), are inverted one by one.
    """
    scale = 1 / np.sqrt(np.einsum('...ii->...i', information))
    products = scale[..., :, None] * scale[..., None, :]
    scaled = information * products
    np.einsum('...ii->...i', scaled)[...] += JITTER
    return np.linalg.inv(scaled) * products


def solve_scaled(information: np.ndarray, right: np.ndarray) -> np.ndarray:
    """
    Return the solutions (k, n) of k systems ``information @ x = right``, (k, n, n) and (k, n).

    Each information matrix is scaled to a unit diagonal first.
    """
    scale = 1 / np.sqrt(np.einsum('kii->ki', information))
    scaled = information * scale[:, :, None] * scale[:, None, :]
    np.einsum('kii->ki', scaled)[:] += JITTER
    return np.linalg.solve(scaled, (scale * right)[:, :, None])[:, :, 0] * scale


def solve_normal(
    normal: np.ndarray, used: np.ndarray, prior_sd: np.ndarray, *, prior_mean: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (values, covariance) of the parameters `used` of least cost with their prior.

    With the normal matrix ``[[A, b], [b', y'y]]`` and the information W of the prior m::

        covariance = (A + W)^-1,   values = covariance (b + W m)

    Parameters
    ----------
    normal : ndarray, shape (q + 1, q + 1)
        Products of ``[design | output]``, weighted.
    used : array of int
        Parameters under estimation; the other parameters are zero.
    prior_sd, prior_mean : ndarray, shape (q,)

    """
    used = np.asarray(used)
    information = normal[np.ix_(used, used)] + np.diag(1 / prior_sd[used] ** 2)
    covariance = inverse_normal(information)
    return covariance @ (normal[used, -1] + prior_mean[used] / prior_sd[used] ** 2), covariance


def quadratic(normal: np.ndarray, used: Sequence[int] | np.ndarray, values: np.ndarray) -> float:
    """
    Return ``y'y - 2 x'b + x'A x`` of the normal matrix ``[[A, b], [b', y'y]]``.

    That is the residual sum of squares at the `values` x of the parameters `used`.
    """
    used = np.asarray(used)
    return float(
        normal[-1, -1]
        - 2 * values @ normal[used, -1]
        + values @ normal[np.ix_(used, used)] @ values
    )


def covariance_with_held(
    rows: np.ndarray, free: np.ndarray, held: np.ndarray, *, prior_sd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (covariance of the free parameters, covariance due to the fixed ones), each (n, n).

    With the design A and the influence ``G = -(A_free' A_free)^-1 A_free' A_fixed`` of the fixed
    parameters on the free ones (one on themselves) the terms are ``(A_free' A_free)^-1`` and
    ``G diag(prior_sd^2) G'``. Their sum is the total.

    Parameters
    ----------
    rows : ndarray, shape (m, n)
        Weighted design, with the prior's rows where the prior of the free parameters counts.
    free, held : ndarray of bool, shape (n,)
        Estimated, and fixed at the prior; parameters that are neither are certain.
    prior_sd : ndarray, shape (n,)

    """
    influence = np.zeros((len(prior_sd), int(held.sum())))
    influence[held] = np.eye(int(held.sum()))
    if held.any() and free.any():
        influence[free] = -scaled_lstsq(rows[:, free], rows[:, held])
    of_free = np.zeros((len(prior_sd),) * 2)
    of_free[np.ix_(free, free)] = inverse_gram(rows[:, free])
    return of_free, influence @ np.diag(prior_sd[held] ** 2) @ influence.T


def orthonormal_basis(columns: np.ndarray, least: float = 1e-6) -> np.ndarray:
    """
    Return an orthonormal basis of the space of some columns, shape (n_rows, rank).

    The columns may be dependent: with unit length, singular values above `least` of the largest
    count for the rank.
    """
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    if not columns.shape[1]:
        return columns
    directions, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return directions[:, singular > least * singular[0]]
