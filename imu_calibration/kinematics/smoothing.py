"""
Quintic splines on uniform knots with a third-difference penalty.

The penalty that suits the noise and the resolution of encoders is included.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial
from typing import Any

import numpy as np
from scipy.linalg import solveh_banded

from imu_calibration.core.samples import runs_of

DEGREE = 5
SPLINE_ORDER = DEGREE + 1
_SPLINE_BLOCK_SAMPLES = 8192  # instants whose intermediates fit in the processor's cache


def _piece_matrix():
    """
    Return M with ``basis a on its interval = sum_k M[k, a] u^k``.

    Basis a belongs to coefficient ``interval + a``.
    """
    matrix = np.zeros((SPLINE_ORDER, SPLINE_ORDER))
    for basis in range(SPLINE_ORDER):
        piece = DEGREE - basis
        for shift in range(piece + 1):
            scale = (-1) ** shift * comb(SPLINE_ORDER, shift) / 120
            for power in range(SPLINE_ORDER):
                matrix[power, basis] += (
                    scale * comb(DEGREE, power) * float(piece - shift) ** (DEGREE - power)
                )
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


def design_values(
    knots: Knots, time: np.ndarray, derivative: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (interval, values).

    The six basis functions that are not zero at each instant, shape (6, n), or their derivative.
    """
    interval, place = knots.locate(time)
    matrix = PIECES
    for _ in range(derivative):
        matrix = np.arange(1, len(matrix))[:, None] * matrix[1:] / knots.step
    values = np.broadcast_to(matrix[-1][:, None], (SPLINE_ORDER, len(time)))
    for row in matrix[-2::-1]:
        values = values * place + row[:, None]
    return interval, values


def design_matrix(knots: Knots, interval: np.ndarray, values: np.ndarray) -> Any:
    """Return the sparse design, shape (n, n_coefficients)."""
    from scipy.sparse import csr_matrix  # here, because its import is slow

    columns = interval[:, None] + np.arange(SPLINE_ORDER)
    return csr_matrix(
        (
            np.ascontiguousarray(values.T).ravel(),
            columns.ravel(),
            np.arange(0, columns.size + 1, SPLINE_ORDER),
        ),
        shape=(len(interval), knots.n_coefficients),
    )


def normal_bands(knots: Knots, interval: np.ndarray, values: np.ndarray) -> np.ndarray:
    """
    Return the lower bands of design.T @ design.

    Shape (6, n_coefficients), in the format of `scipy.linalg.solveh_banded`.
    """
    size = knots.n_coefficients
    bands = np.zeros((SPLINE_ORDER, size))
    for first in range(SPLINE_ORDER):
        for second in range(first, SPLINE_ORDER):
            bands[second - first] += np.bincount(
                interval + first, values[first] * values[second], size
            )
    return bands


def penalty_bands(weights: np.ndarray) -> np.ndarray:
    """
    Return the lower bands of D.T @ diag(weights) @ D, shape (6, n_weights + 3).

    D is the matrix of the third differences of the coefficients.
    """
    bands = np.zeros((SPLINE_ORDER, len(weights) + 3))
    for first in range(4):
        for second in range(first, 4):
            bands[second - first, first : first + len(weights)] += (
                _THIRD_DIFFERENCE[first] * _THIRD_DIFFERENCE[second] * weights
            )
    return bands


def piece_coefficients(coefficients: np.ndarray) -> np.ndarray:
    """
    Return the polynomial of each interval in its place u, shape (6 powers, n_intervals, n_joints).
    """
    windows = np.lib.stride_tricks.sliding_window_view(coefficients, SPLINE_ORDER, axis=0)
    return np.ascontiguousarray(np.moveaxis(windows @ PIECES.T, -1, 0))


def evaluate_pieces(
    knots: Knots, pieces: np.ndarray, time: np.ndarray, *, derivatives: int
) -> np.ndarray:
    """
    Return the values and the first `derivatives` derivatives at `time`.

    Shape (derivatives + 1, n, n_joints).
    """
    n_joints = pieces.shape[2]
    result = np.zeros((derivatives + 1, len(time), n_joints))
    for start in range(0, len(time), _SPLINE_BLOCK_SAMPLES):
        part = slice(start, start + _SPLINE_BLOCK_SAMPLES)
        interval, place = knots.locate(time[part])
        _horner(pieces, interval, np.repeat(place, n_joints).reshape(-1, n_joints), result[:, part])
    for order in range(1, derivatives + 1):
        result[order] *= factorial(order) / knots.step**order
    return result


def _horner(pieces, interval, place, taylor):
    """
    Fill `taylor`, zeros.

    With the Taylor coefficients of the polynomials at `place` (repeated synthetic division).
    """
    for power in range(DEGREE, -1, -1):
        for order in range(min(DEGREE - power, len(taylor) - 1), 0, -1):
            taylor[order] *= place
            taylor[order] += taylor[order - 1]
        taylor[0] *= place
        taylor[0] += pieces[power].take(interval, axis=0)


# Decades of the penalty relative to the rows per knot: from interpolation to a bandwidth of 1/100
# of Nyquist's.
_COARSE = (-6.0, -3.0, 0.0, 3.0, 6.0, 9.0)
ROBUSTNESS = 0.7
"""
Parameter gamma of the robust criterion: 1 for plain cross-validation, less for fits that round
sharp ramps more.
"""
_PILOT = -2.0  # rough, but tame where readings lie close together
_TAPER = 0.2  # share of a record in which the weight of the ends rises
_LONG = 1000  # rows from which on the spectrum gives the residuals


@dataclass(frozen=True, eq=False)
class Smooth:
    """A penalised fit of one joint."""

    coefficients: np.ndarray
    """Spline coefficients, shape (n_coefficients,)."""
    dof: float
    """Effective number of parameters."""
    bandwidth: float
    """Frequency below which more than half the amplitude passes, rad per knot."""
    noise_sd: float
    """Standard deviation of the residuals, unit of the data, corrected for `dof`."""


class PenalisedSpline:
    """
    Least squares on rows ``design @ coefficients = values`` with a penalty.

    The penalty is ``lambda |third differences|^2``.

    Eilers and Marx 1996. Degrees of freedom come from the mean bands of the normal matrix, as for a
    long uniform record: the gain of the fit at the frequency theta is ``N / (N + lambda p)`` with
    ``p = (2 - 2 cos theta)^3``.

    Parameters
    ----------
    design : sparse array, shape (n_rows, n_coefficients)
        One row per reading; with readings of several kinds, each kind in the order of time, one
        kind after the other.
    bands : array, shape (6, n_coefficients)
        Lower bands of ``design.T @ design``.
    n_kinds : int
        Kinds of readings.

    """

    def __init__(self, design: Any, bands: np.ndarray, n_kinds: int = 1):
        self.design = design
        self.bands = bands
        self.penalty = penalty_bands(np.ones(design.shape[1] - 3))
        self.n_rows, self.n_coefficients = design.shape
        # Splines are worst at the ends, which callers keep out: the ends have weight zero in the
        # noise and the penalty.
        interior = np.tile(_taper(self.n_rows // n_kinds) ** 2, n_kinds)
        self._interior = interior / interior.sum()
        self.density = self.n_rows / self.n_coefficients
        self._mean_bands = (
            bands.sum(axis=1)
            / self.n_coefficients
            * np.where(np.arange(SPLINE_ORDER) == 0, 1.0, 2.0)
        )
        # The smallest penalty for which the factor exists: holes of m knots give it eigenvalues of
        # about (pi / m)^6.
        empty = self.bands[0] < 1e-9 * self.density
        hole = np.max(np.diff(runs_of(empty)), initial=0) + SPLINE_ORDER
        self.least_decade = max(_COARSE[0], 6 * np.log10(hole / np.pi) - 13)
        self._gains = {}
        self._theta = (np.arange(512) + 0.5) * np.pi / 512
        self._symbols = self.symbols(self._theta)

    def symbols(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return N and p, the normal matrix and the penalty at the frequencies `theta`, rad per knot.
        """
        normal = np.cos(theta[:, None] * np.arange(SPLINE_ORDER)) @ self._mean_bands
        return np.maximum(normal, 1e-6 * self.density), (2 - 2 * np.cos(theta)) ** 3

    def fit(
        self, values: np.ndarray, penalty: float, with_ends: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the coefficients for columns of `values`, and mean squared residuals.

        The mean squared residuals are away from the ends.
        """
        unit = penalty_bands(self._end_weights(penalty)) if with_ends else self.penalty
        coefficients = solveh_banded(
            self.bands + penalty * unit,
            self.design.T @ values,
            lower=True,
            overwrite_ab=True,
            overwrite_b=True,
            check_finite=False,
        )
        residual = values - self.design @ coefficients
        return coefficients, np.einsum('i,ij,ij->j', self._interior, residual, residual)

    def _end_weights(self, penalty):
        """
        Return weights of the penalty that fall towards both ends, shape (n_coefficients - 3,).

        A penalty reduces the third and higher derivatives towards zero at the ends. Weights that
        decrease with the cube of the distance, over a period of the bandwidth, remove this bias for
        some more noise: the error of the acceleration in the last hundredths of a second falls to a
        third and less.
        """
        distance = (
            np.minimum(np.arange(self.n_coefficients - 3), np.arange(self.n_coefficients - 3)[::-1])
            - 2
        )
        return np.clip(distance * self.bandwidth(penalty) / 6, 0.1, 1.0) ** 3

    def gains(self, penalty: float) -> tuple[float, float]:
        """
        Return the mean gain of the fit over all frequencies, and of its square.

        The mean gain is the degrees of freedom per row.
        """
        if penalty not in self._gains:
            normal, damping = self._symbols
            gain = normal / (normal + penalty * damping)
            least = 3 / self.n_rows
            self._gains[penalty] = (
                least + (1 - least) * np.mean(gain),
                least + (1 - least) * np.mean(gain**2),
            )
        return self._gains[penalty]

    def bandwidth(self, penalty: float) -> float:
        """Return the frequency, rad per knot, below which more than half the amplitude passes."""
        normal, damping = self._symbols
        return self._theta[np.searchsorted(penalty * damping / normal, 1.0) - 1]


def smooth(
    spline: PenalisedSpline, values: np.ndarray, noise_floor: Sequence[float] | np.ndarray
) -> list[Smooth]:
    """
    Return a `Smooth` per column of `values`, with the penalty that predicts best.

    The larger one of two penalties: that of robust generalised cross-validation (Lukas 2006), which
    needs no noise, and that of Mallows' Cp for `noise_floor`, which holds where the noise is not
    white (coarse encoders).

    Parameters
    ----------
    spline : PenalisedSpline
        Rows and penalty.
    values : array, shape (n, n_joints)
        Right-hand sides.
    noise_floor : array, shape (n_joints,)
        Standard deviation that the noise has at least.

    """
    squares = (_squares_by_spectrum if spline.n_rows >= _LONG else _squares_by_fits)(spline, values)
    decades = [
        _best_decade(
            (
                lambda decade, c=column: _cross_validation(spline, decade, squares(decade)[c]),
                lambda decade, c=column, f=floor: _mallows(spline, decade, squares(decade)[c], f),
            )
        )
        for column, floor in enumerate(noise_floor)
    ]
    results = {}
    for decade in set(decades):
        columns = np.flatnonzero(np.array(decades) == decade)
        penalty = _penalty(spline, decade)
        coefficients, residual = spline.fit(values[:, columns], penalty, with_ends=True)
        gain, _ = spline.gains(penalty)
        noise = np.sqrt(residual / (1 - gain))
        for place, column in enumerate(columns.tolist()):
            results[column] = Smooth(
                coefficients[:, place],
                gain * spline.n_rows,
                spline.bandwidth(penalty),
                float(noise[place]),
            )
    return [results[column] for column in range(len(decades))]


def _squares_by_fits(spline, values):
    return lru_cache(None)(lambda decade: spline.fit(values, _penalty(spline, decade))[1])


def _squares_by_spectrum(spline, values):
    """
    Return the function decade -> mean squared residuals, from one rough fit.

    With d the third differences of the unpenalised coefficients, the residuals have the power
    ``N lambda^2 p / (N + lambda p)^2 |d|^2``; the error of approximation by splines with these
    knots is added.
    """
    pilot = _penalty(spline, _PILOT)
    coefficients, floor = spline.fit(values, pilot)
    taper = _taper(len(coefficients) - 3)[:, None]
    power = np.abs(np.fft.rfft(taper * np.diff(coefficients, 3, axis=0), axis=0)) ** 2 / np.sum(
        taper**2
    )
    theta = np.arange(len(power)) * 2 * np.pi / len(taper)
    normal, damping = spline.symbols(theta)
    # Third differences of the rough fit lack the part removed by its own penalty.
    power *= ((1 + pilot * damping / normal) ** 2 * normal * damping)[:, None]
    power[1:] *= (
        2.0
        if len(taper) % 2
        else np.where(np.arange(1, len(power)) == len(power) - 1, 1.0, 2.0)[:, None]
    )
    power /= len(taper) * spline.density

    @lru_cache(None)
    def squares(decade):
        penalty = _penalty(spline, decade)
        return (penalty / (normal + penalty * damping)) ** 2 @ power

    beyond = np.maximum(floor - squares(_PILOT), 0.0)
    return lambda decade: squares(decade) + beyond


def _taper(size):
    """Return a window with raised-cosine edges (Tukey's; the import of scipy.signal is slow)."""
    inside = np.minimum(np.arange(size), np.arange(size)[::-1]) / max(
        0.5 * _TAPER * (size - 1), 1.0
    )
    return 0.5 - 0.5 * np.cos(np.pi * np.minimum(inside, 1.0))


def _penalty(spline, decade):
    return spline.density * 10.0 ** max(decade, spline.least_decade)


def _cross_validation(spline, decade, squares):
    gain, square = spline.gains(_penalty(spline, decade))
    return squares / (1 - gain) ** 2 * (ROBUSTNESS + (1 - ROBUSTNESS) * square)


def _mallows(spline, decade, squares, noise_sd):
    gain, _ = spline.gains(_penalty(spline, decade))
    # The guard of the robust criterion, to first order in the gain.
    return squares + (1 + 1 / ROBUSTNESS) * noise_sd**2 * gain


def _best_decade(scores):
    """
    Return the largest of the scores' minima: in coarse steps, then one decade, then half a one.
    """
    coarse = [min(_COARSE, key=score) for score in scores]
    return max(
        _refine(score, start)
        for score, start in zip(scores, coarse, strict=True)
        if start == max(coarse)
    )


def _refine(score, decade):
    for step in (1.0, 0.5):
        decade = min((decade, decade - step, decade + step), key=score)
    return decade
