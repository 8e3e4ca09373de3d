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

    Rows of zeros complete the shorter ones.
    """
    places = _places(width)
    longest = max(map(len, factors))
    rows = places[longest - 1] // width + 1 if longest else 0
    found = np.zeros((len(factors), rows * width))
    for row, factor in zip(found, factors):
        row[places[: len(factor)]] = factor
    return found.reshape(len(factors), rows, width)


@lru_cache(maxsize=8)
def _places(width: int) -> np.ndarray:
    """Return the places of the upper triangle among the elements of a square matrix, row by row."""
    return np.flatnonzero(np.triu(np.ones((width, width), bool)))
