"""Triangular factors kept without their zeros."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np


def packed(factor: np.ndarray) -> np.ndarray:
    """Return an upper triangular or trapezoidal factor without its zeros, row by row."""
    return factor[np.triu_indices(len(factor), m=factor.shape[1])]


def unpacked(factors: Sequence[np.ndarray], width: int) -> np.ndarray:
    """
    Return packed factors of `width` columns as one stack, shape (n_factors, n_rows, width).

    Factors with fewer rows are completed by rows of zeros.
    """
    indices = _indices_of_triangle(width)
    longest = max(map(len, factors))
    n_rows = indices[longest - 1] // width + 1 if longest else 0
    stack = np.zeros((len(factors), n_rows * width))
    for flat, factor in zip(stack, factors):
        flat[indices[: len(factor)]] = factor
    return stack.reshape(len(factors), n_rows, width)


@lru_cache(maxsize=8)
def _indices_of_triangle(width: int) -> np.ndarray:
    """Return the indices of the upper triangle in a flattened square matrix, row by row."""
    return np.flatnonzero(np.triu(np.ones((width, width), bool)))
