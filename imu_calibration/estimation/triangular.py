"""The triangular factor of rows: an exact summary of any number of them for least squares."""

import numpy as np
from scipy.linalg import lapack

BLOCK = 2000
"""Rows per orthogonal factorisation: taller blocks do not fit in the processor's cache."""
PANEL = 4
"""Columns that are reflected at a time."""


def triangular(rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor of `rows` by Householder reflections, block after block, with as many rows as it has rank bound."""
    count, width = rows.shape
    if count < 2 * width:
        return _r_factor(np.array(rows, order='F'))
    factor = np.zeros((width, width), order='F')
    for start in range(0, count, BLOCK):
        # Each block is folded into the triangle, whose zeros are skipped.
        block = np.array(rows[start:start + BLOCK], order='F')
        factor, _, _, info = lapack.dtpqrt(0, min(PANEL, width), factor, block, overwrite_a=1, overwrite_b=1)
        _require_finite(info, factor)
    return np.triu(factor)


def _r_factor(stacked):
    if not len(stacked):
        return stacked
    raw, _, _, info = lapack.dgeqrf(stacked, overwrite_a=1)
    _require_finite(info, raw[:, 0])
    return np.triu(raw[:min(raw.shape)])


def _require_finite(info, values):
    if info != 0 or not np.isfinite(values).all():
        raise FloatingPointError('orthogonal factorisation met values that are not finite')
