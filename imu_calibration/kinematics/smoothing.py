"""
Quintic splines on uniform knots with a third-difference penalty.

The penalty is chosen from the data, for the noise and the resolution of encoders.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial
from typing import Any

import numpy as np
from scipy.linalg import solveh_banded

from imu_calibration.core.samples import runs_of

DEGREE = 5
SPLINE_ORDER = DEGREE + 1
_SPLINE_BLOCK_SAMPLES = 8192
"""Instants per block, so that intermediate arrays fit in the processor's cache."""


def _piece_matrix() -> np.ndarray:
    """
    Return the polynomials of the six basis functions on an interval, shape (6 powers, 6 bases).

    ``basis_a(u) = sum_k M[k, a] u^k`` with u from 0 to 1 in the interval; basis a has the
    coefficient with number ``interval + a``. It is ``B(u + 5 - a)`` of the uniform B-spline::

        B(x) = sum_s (-1)^s C(6, s) max(x - s, 0)^5 / 5!

    whose terms ``(u + 5 - a - s)^5`` are expanded in powers of u.
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
"""`_piece_matrix`."""
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
        """
        Return the number of the interval of each instant, and the place in it in steps.

        The first and the last interval are extended, with places below 0 and above 1.
        """
        scaled = (time - self.start) / self.step
        interval = np.clip(scaled.astype(np.intp), 0, self.n_intervals - 1)
        return interval, scaled - interval


def design_values(
    knots: Knots, time: np.ndarray, derivative: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the interval of each instant, shape (n,), and the basis functions there, shape (6, n).

    The six that are not zero, or their derivative of an order, 1/s^order.
    """
    interval, place = knots.locate(time)
    matrix = PIECES
    for _ in range(derivative):
        # The derivative of u^k is k u^(k-1).
        matrix = np.arange(1, len(matrix))[:, None] * matrix[1:] / knots.step
    # Horner's rule.
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
    # Band d has ``sum B_j B_(j + d)`` over the instants at column j.
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
    # Third difference k has the factors `_THIRD_DIFFERENCE` of the coefficients k to k + 3.
    bands = np.zeros((SPLINE_ORDER, len(weights) + 3))
    for first in range(4):
        for second in range(first, 4):
            bands[second - first, first : first + len(weights)] += (
                _THIRD_DIFFERENCE[first] * _THIRD_DIFFERENCE[second] * weights
            )
    return bands


def piece_coefficients(coefficients: np.ndarray) -> np.ndarray:
    """
    Return the polynomial of each interval, shape (6 powers, n_intervals, n_joints).

    ``sum_k pieces[k] u^k`` with the place u in the interval, in steps; `coefficients`: of the
    spline, shape (n_coefficients, n_joints).
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


def _horner(
    pieces: np.ndarray, interval: np.ndarray, place: np.ndarray, taylor: np.ndarray
) -> None:
    """
    Write the Taylor coefficients of polynomials by repeated synthetic division.

    Parameters
    ----------
    pieces : array, shape (6 powers, n_intervals, n_joints)
    interval : array, shape (n,)
        Interval of each instant.
    place : array, shape (n, n_joints)
        Place in the interval, in steps, for each joint.
    taylor : array, shape (n_orders, n, n_joints)
        Zeros; receives the derivatives over the factorial of their order.

    """
    # Each power is one step of Horner's rule for the value. The derivative of order k follows from
    # the same rule with the results of order k - 1 as coefficients; it is zero before k steps.
    for power in range(DEGREE, -1, -1):
        for order in range(min(DEGREE - power, len(taylor) - 1), 0, -1):
            taylor[order] *= place
            taylor[order] += taylor[order - 1]
        taylor[0] *= place
        taylor[0] += pieces[power].take(interval, axis=0)


_COARSE_DECADES = (-6.0, -3.0, 0.0, 3.0, 6.0, 9.0)
"""
Decades of the penalty, relative to the rows per knot, that are tried first: from interpolation to a
bandwidth of 1/100 of Nyquist's.
"""
ROBUSTNESS = 0.7
"""
Parameter gamma of the robust criterion: 1 for plain cross-validation, less for fits that round
sharp ramps more.
"""
_PILOT_DECADE = -2.0
"""Decade of the penalty of a rough fit, which has no large derivatives between close readings."""
_TAPER_SHARE = 0.2
"""Share of a record, half of it at each end, in which a weight rises from 0 to 1."""
_MIN_ROWS_FOR_SPECTRUM = 1000
"""Rows from which the residuals for all penalties are computed from the spectrum of one fit."""


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
    Least squares with a penalty, ``|values - design @ c|^2 + lambda |D c|^2``.

    D c are the third differences of the coefficients c (Eilers and Marx 1996). Degrees of freedom
    come from the mean bands of the normal matrix, as for a long uniform record: the gain of the fit
    at the frequency theta is ``N / (N + lambda p)`` with ``p = (2 - 2 cos theta)^3``.

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
        """Lower bands of D' D, shape (6, n_coefficients)."""
        self.n_rows, self.n_coefficients = design.shape
        # Splines have the largest errors at the ends, which have weight zero in the noise and in
        # the choice of the penalty.
        interior = np.tile(_taper(self.n_rows // n_kinds) ** 2, n_kinds)
        self._interior = interior / interior.sum()
        """Weight of each row in the mean squared residual, shape (n_rows,)."""
        self.density = self.n_rows / self.n_coefficients
        """Rows per knot."""
        # The bands below the diagonal occur above it too.
        is_diagonal = np.arange(SPLINE_ORDER) == 0
        self._mean_bands = bands.sum(axis=1) / self.n_coefficients * np.where(is_diagonal, 1.0, 2.0)
        """Mean of each band of the normal matrix, on both sides of the diagonal, shape (6,)."""
        # Without a penalty the normal matrix is singular where there are no readings: a hole of m
        # knots has eigenvalues of about (pi / m)^6 times the penalty, which must exceed 1e-13 of
        # the other ones, the rows per knot.
        empty = self.bands[0] < 1e-9 * self.density
        hole = np.max(np.diff(runs_of(empty)), initial=0) + SPLINE_ORDER
        self.least_decade = max(_COARSE_DECADES[0], 6 * np.log10(hole / np.pi) - 13)
        """Decade of the smallest penalty for which the normal matrix can be factorised."""
        self._gains: dict[float, tuple[float, float]] = {}
        """Penalty -> `gains`."""
        self._theta = (np.arange(512) + 0.5) * np.pi / 512
        """Frequencies up to Nyquist's, rad per knot."""
        self._symbols = self.symbols(self._theta)
        """N and p at these frequencies."""

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
        Return the coefficients for columns of `values`, and their mean squared residuals.

        The residuals near the ends have small weights. `with_ends`: the penalty falls towards the
        ends (`_end_weights`).
        """
        unit_penalty = penalty_bands(self._end_weights(penalty)) if with_ends else self.penalty
        coefficients = solveh_banded(
            self.bands + penalty * unit_penalty,
            self.design.T @ values,
            lower=True,
            overwrite_ab=True,
            overwrite_b=True,
            check_finite=False,
        )
        residual = values - self.design @ coefficients
        return coefficients, np.einsum('i,ij,ij->j', self._interior, residual, residual)

    def _end_weights(self, penalty: float) -> np.ndarray:
        """
        Return weights of the penalty that fall towards both ends, shape (n_coefficients - 3,).

        A penalty reduces the third and higher derivatives towards zero at the ends. Weights that
        decrease with the cube of the distance, over a period of the bandwidth, remove this bias for
        some more noise: the error of the acceleration in the last hundredths of a second falls to a
        third and less.
        """
        number = np.arange(self.n_coefficients - 3)
        distance = np.minimum(number, number[::-1]) - 2  # from the closer end, in knots
        # The weight is 1 from about a period of the bandwidth on, 2 pi / bandwidth knots.
        return np.clip(distance * self.bandwidth(penalty) / 6, 0.1, 1.0) ** 3

    def gains(self, penalty: float) -> tuple[float, float]:
        """
        Return the means of the gain of the fit and of its square over all frequencies.

        The mean gain is the number of degrees of freedom per row, at least 3 of all rows: the
        penalty does not constrain a parabola.
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
    Return the fit of each column of `values` with the penalty that predicts best.

    The penalty is the larger one of two: that of robust generalised cross-validation (Lukas 2006),
    which needs no noise, and that of Mallows' Cp for `noise_floor`, which holds where the noise is
    not white (coarse encoders).

    Parameters
    ----------
    spline : PenalisedSpline
        Rows and penalty.
    values : array, shape (n, n_joints)
        Right-hand sides.
    noise_floor : array, shape (n_joints,)
        Standard deviation that the noise has at least.

    """
    if spline.n_rows >= _MIN_ROWS_FOR_SPECTRUM:
        squares = _squares_by_spectrum(spline, values)
    else:
        squares = _squares_by_fits(spline, values)
    decades = []
    for column, floor in enumerate(noise_floor):
        criteria = _Criteria(spline, squares, column, floor)
        decades.append(_best_decade((criteria.cross_validation, criteria.mallows)))

    # Columns with the same penalty are solved together.
    results = {}
    for decade in set(decades):
        columns = np.flatnonzero(np.array(decades) == decade)
        penalty = _penalty(spline, decade)
        coefficients, residual = spline.fit(values[:, columns], penalty, with_ends=True)
        gain, _ = spline.gains(penalty)
        noise = np.sqrt(residual / (1 - gain))
        for place, column in enumerate(columns.tolist()):
            results[column] = Smooth(
                coefficients=coefficients[:, place],
                dof=gain * spline.n_rows,
                bandwidth=spline.bandwidth(penalty),
                noise_sd=float(noise[place]),
            )
    return [results[column] for column in range(len(decades))]


SquaresOfDecade = Callable[[float], np.ndarray]
"""Maps the decade of a penalty to the mean squared residuals of each column."""


def _squares_by_fits(spline: PenalisedSpline, values: np.ndarray) -> SquaresOfDecade:
    """Return the mean squared residuals as a function that fits with each penalty once."""

    @lru_cache(None)
    def squares(decade: float) -> np.ndarray:
        """Return the mean squared residuals of each column."""
        _, residual = spline.fit(values, _penalty(spline, decade))
        return residual

    return squares


def _squares_by_spectrum(spline: PenalisedSpline, values: np.ndarray) -> SquaresOfDecade:
    """
    Return the mean squared residuals as a function, from the spectrum of one rough fit.

    With d the spectrum of the third differences of the unpenalised coefficients, the residuals have
    the power ``N lambda^2 p / (N + lambda p)^2 |d|^2``. The residual of the rough fit beyond that,
    the error of approximation by splines with these knots, is added for every penalty.
    """
    pilot = _penalty(spline, _PILOT_DECADE)
    coefficients, pilot_squares = spline.fit(values, pilot)
    # Power |d|^2 of the third differences at each frequency, per coefficient.
    taper = _taper(len(coefficients) - 3)[:, None]
    power = np.abs(np.fft.rfft(taper * np.diff(coefficients, 3, axis=0), axis=0)) ** 2 / np.sum(
        taper**2
    )
    theta = np.arange(len(power)) * 2 * np.pi / len(taper)
    normal, damping = spline.symbols(theta)
    # Third differences of the rough fit lack the part removed by its penalty.
    power *= ((1 + pilot * damping / normal) ** 2 * normal * damping)[:, None]
    # In a one-sided spectrum all frequencies count twice, except zero and that of Nyquist.
    power[1:] *= 2.0
    if len(taper) % 2 == 0:
        power[-1] /= 2.0
    # A sum over the frequencies is then the mean over the rows.
    power /= len(taper) * spline.density

    @lru_cache(None)
    def squares(decade: float) -> np.ndarray:
        """Return the mean squared residuals of each column without the error of approximation."""
        penalty = _penalty(spline, decade)
        return (penalty / (normal + penalty * damping)) ** 2 @ power

    approximation = np.maximum(pilot_squares - squares(_PILOT_DECADE), 0.0)
    return lambda decade: squares(decade) + approximation


def _taper(size: int) -> np.ndarray:
    """Return a window with raised-cosine edges (Tukey's; the import of scipy.signal is slow)."""
    number = np.arange(size)
    edge = max(0.5 * _TAPER_SHARE * (size - 1), 1.0)
    inside = np.minimum(number, number[::-1]) / edge
    return 0.5 - 0.5 * np.cos(np.pi * np.minimum(inside, 1.0))


def _penalty(spline: PenalisedSpline, decade: float) -> float:
    """Return the penalty lambda of a decade relative to the rows per knot."""
    return spline.density * 10.0 ** max(decade, spline.least_decade)


@dataclass(frozen=True, eq=False)
class _Criteria:
    """Criteria of the penalty of one column; the best penalty has the smallest value."""

    spline: PenalisedSpline
    """Rows and penalty."""
    squares: SquaresOfDecade
    """Mean squared residuals of all columns."""
    column: int
    """The column."""
    noise_floor: float
    """Standard deviation that the noise has at least."""

    def cross_validation(self, decade: float) -> float:
        """Return the robust generalised cross-validation, which needs no noise."""
        gain, square = self.spline.gains(_penalty(self.spline, decade))
        squares = self.squares(decade)[self.column]
        return squares / (1 - gain) ** 2 * (ROBUSTNESS + (1 - ROBUSTNESS) * square)

    def mallows(self, decade: float) -> float:
        """Return Mallows' Cp for the least noise."""
        gain, _ = self.spline.gains(_penalty(self.spline, decade))
        squares = self.squares(decade)[self.column]
        # The factor of the robust criterion, to first order in the gain.
        return squares + (1 + 1 / ROBUSTNESS) * self.noise_floor**2 * gain


Criterion = Callable[[float], float]
"""Maps the decade of a penalty to its value."""


def _best_decade(criteria: Sequence[Criterion]) -> float:
    """
    Return the largest of the decades that minimise each criterion.

    Only the criteria with the largest coarse minimum are refined.
    """
    coarse = [min(_COARSE_DECADES, key=criterion) for criterion in criteria]
    refined = []
    for criterion, start in zip(criteria, coarse, strict=True):
        if start == max(coarse):
            refined.append(_refine(criterion, start))
    return max(refined)


def _refine(score: Criterion, decade: float) -> float:
    """Return the minimum of a criterion near a decade, in steps of one, then of a half."""
    for step in (1.0, 0.5):
        decade = min((decade, decade - step, decade + step), key=score)
    return decade
