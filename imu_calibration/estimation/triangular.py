"""The triangular factor of rows: an exact summary of any number of them for least squares."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import lapack

BLOCK = 2000
"""Rows per orthogonal factorisation: taller blocks do not fit in the processor's cache."""
PANEL = 4
"""Columns that are reflected at a time."""


def triangular(rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor of `rows`, shape (min(m, n), n), by Householder reflections of one block after the other."""
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


@dataclass(frozen=True, eq=False)
class PackedFactor:
    """A triangular factor without the zeros below its diagonal: half the memory of a square one."""

    shape: tuple[int, int]
    """Rows and columns."""
    values: np.ndarray
    """Elements on and above the diagonal, row by row."""

    @classmethod
    def of(cls, factor: np.ndarray) -> 'PackedFactor':
        """Return an upper triangular (or trapezoidal) factor packed."""
        rows, width = factor.shape
        return cls((rows, width), factor.ravel()[_places(width)[:_size(rows, width)]])

    def unpacked(self) -> np.ndarray:
        """Return the factor, shape (k, n)."""
        return unpacked([self])[0]


def unpacked(factors: Sequence[PackedFactor]) -> np.ndarray:
    """Return factors of n columns and at most k rows in one array, shape (m, k, n); missing rows are zero."""
    rows, width = max(factor.shape[0] for factor in factors), factors[0].shape[1]
    found, places = np.zeros((len(factors), rows * width)), _places(width)
    for row, factor in zip(found, factors):
        row[places[:len(factor.values)]] = factor.values
    return found.reshape(len(factors), rows, width)


def _size(rows, width):
    """Return the number of elements on and above the diagonal."""
    return rows * width - rows * (rows - 1) // 2


@lru_cache(maxsize=8)
def _places(width):
    """Return the positions of the upper triangle in a flat square matrix, row by row."""
    return np.flatnonzero(np.triu(np.ones((width, width), bool)))


def _r_factor(stacked):
    if not len(stacked):
        return stacked
    raw, _, _, info = lapack.dgeqrf(stacked, overwrite_a=1)
    _require_finite(info, raw[:, 0])
    return np.triu(raw[:min(raw.shape)])


def _require_finite(info, values):
    if info != 0 or not np.isfinite(values).all():
        raise FloatingPointError('orthogonal factorisation met values that are not finite')
