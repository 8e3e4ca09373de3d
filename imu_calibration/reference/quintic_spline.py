"""Quintic splines on uniform knots: rows of the design, normal equations with a third-difference penalty, values."""

from dataclasses import dataclass
from math import comb, factorial
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

DEGREE = 5
ORDER = DEGREE + 1
_BLOCK = 8192  # instants whose intermediates fit in the processor's cache


def _piece_matrix():
    """Return M with ``basis a on its interval = sum_k M[k, a] u^k``; basis a belongs to coefficient ``interval + a``."""
    matrix = np.zeros((ORDER, ORDER))
    for basis in range(ORDER):
        piece = DEGREE - basis
        for shift in range(piece + 1):
            scale = (-1) ** shift * comb(ORDER, shift) / 120
            for power in range(ORDER):
                matrix[power, basis] += scale * comb(DEGREE, power) * float(piece - shift) ** (DEGREE - power)
    return matrix


PIECES = _piece_matrix()
_THIRD_DIFFERENCE = (-1.0, 3.0, -3.0, 1.0)


@dataclass(frozen=True)
class Knots:
    """Uniform knots ``start + i * step`` for i = 0 .. n_intervals."""

    start: float
    """First knot, s."""
    step: float
    """Distance of the knots, s."""
    n_intervals: int
    """Number of intervals."""

    @property
    def n_coefficients(self) -> int:
        """Number of spline coefficients."""
        return self.n_intervals + DEGREE

    def locate(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the interval of each instant (ends extended) and the place inside it, in steps."""
        scaled = (time - self.start) / self.step
        interval = np.clip(scaled.astype(np.intp), 0, self.n_intervals - 1)
        return interval, scaled - interval


def design_values(knots: Knots, time: np.ndarray, derivative: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return (interval, values): the six basis functions that are not zero at each instant, shape (6, n), or their derivative."""
    interval, place = knots.locate(time)
    matrix = PIECES
    for _ in range(derivative):
        matrix = np.arange(1, len(matrix))[:, None] * matrix[1:] / knots.step
    values = np.broadcast_to(matrix[-1][:, None], (ORDER, len(time)))
    for row in matrix[-2::-1]:
        values = values * place + row[:, None]
    return interval, values


def design_matrix(knots: Knots, interval: np.ndarray, values: np.ndarray) -> Any:
    """Return the sparse design, shape (n, n_coefficients)."""
    columns = interval[:, None] + np.arange(ORDER)
    return csr_matrix((np.ascontiguousarray(values.T).ravel(), columns.ravel(), np.arange(0, columns.size + 1, ORDER)),
                      shape=(len(interval), knots.n_coefficients))


def normal_bands(knots: Knots, interval: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the lower bands of design.T @ design, shape (6, n_coefficients), in the format of `scipy.linalg.solveh_banded`."""
    size = knots.n_coefficients
    bands = np.zeros((ORDER, size))
    for first in range(ORDER):
        for second in range(first, ORDER):
            bands[second - first] += np.bincount(interval + first, values[first] * values[second], size)
    return bands


def penalty_bands(weights: np.ndarray) -> np.ndarray:
    """Return the lower bands of D.T @ diag(weights) @ D with D the third differences of the coefficients, shape (6, n_weights + 3)."""
    bands = np.zeros((ORDER, len(weights) + 3))
    for first in range(4):
        for second in range(first, 4):
            bands[second - first, first:first + len(weights)] += _THIRD_DIFFERENCE[first] * _THIRD_DIFFERENCE[second] * weights
    return bands


def piece_coefficients(coefficients: np.ndarray) -> np.ndarray:
    """Return the polynomial of each interval in its place u, shape (6 powers, n_intervals, n_joints)."""
    windows = np.lib.stride_tricks.sliding_window_view(coefficients, ORDER, axis=0)
    return np.ascontiguousarray(np.moveaxis(windows @ PIECES.T, -1, 0))


def evaluate_pieces(knots: Knots, pieces: np.ndarray, time: np.ndarray, *, derivatives: int) -> np.ndarray:
    """Return the values and the first `derivatives` derivatives at `time`, shape (derivatives + 1, n, n_joints)."""
    n_joints = pieces.shape[2]
    result = np.zeros((derivatives + 1, len(time), n_joints))
    for start in range(0, len(time), _BLOCK):
        part = slice(start, start + _BLOCK)
        interval, place = knots.locate(time[part])
        _horner(pieces, interval, np.repeat(place, n_joints).reshape(-1, n_joints), result[:, part])
    for order in range(1, derivatives + 1):
        result[order] *= factorial(order) / knots.step ** order
    return result


def _horner(pieces, interval, place, taylor):
    """Fill `taylor`, zeros, with the Taylor coefficients of the polynomials at `place` (repeated synthetic division)."""
    for power in range(DEGREE, -1, -1):
        for order in range(min(DEGREE - power, len(taylor) - 1), 0, -1):
            taylor[order] *= place
            taylor[order] += taylor[order - 1]
        taylor[0] *= place
        taylor[0] += pieces[power].take(interval, axis=0)
