"""
Regimes of the motion that contain most of a sensor's residual.

Permutation test, and comparison with smooth curves and formulas.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from imu_calibration.core.units import DEG
from imu_calibration.selection.regime_variables import FEWEST, Variable

REGIME_LEVEL = 0.05
"""
Probability that a recording without a place has one reported, for all axes of a sensor together.
"""
PERMUTED = 199
"""Random exchanges of the residual between windows."""
INTENSITIES, LEAST_ALIKE = 3, 4
"""
Classes of motion intensity within a kind of window, at most, and windows of each, at least: the
residual is exchanged within them.
"""
MOST_OF_IT = 0.8
"""
Least share of the excess that an offset in a regime removes, or that lies in a regime of larger
scatter.
"""
REGIME_SHARE_TIE = 0.01
"""
Difference of the shares of two regimes up to which the order of variables decides: joints before
the sensor.
"""
SURE = 16.0
"""
Least advantage of a regime over a smooth curve or a formula, twice the difference of log
likelihood, nats.
"""
MAX_REGIME_SHARE = 0.6
"""Largest share of the blocks in a regime; a larger one does not localise the residual."""
REPORTED = 4
"""Variables whose likeliest range is described, at most."""
TINY = 1e-9
"""Keeps columns that a part of the recording does not have from making a system singular."""


@dataclass(frozen=True, eq=False)
class RestRegime:
    """One condition under which the residual of one axis appears."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    axis: str
    """Axis of the sensor; 'norm' where only the length of its output is known."""
    variable: str
    """Variable: 'angle of NAME', 'rate of NAME', 'time', ..."""
    text: str
    """Description of the condition."""
    share: float
    """Share of the axis' excess that an offset there removes, or that lies there."""
    p_value: float
    """
    Probability of an equal gain with the residual exchanged between windows, for all ranges of all
    variables.
    """
    size: float
    """Offset, or sd of the additional scatter, m/s^2 or rad/s."""
    inside: np.ndarray
    """Whether most of each block lies in it, shape (b,)."""
    time: np.ndarray
    """Middle of each block, s, shape (b,)."""
    offset: bool
    """
    Whether the output differs by a constant offset there; the complement could then have it as
    well.
    """
    bounds: tuple[float, float] | None
    """
    Where it begins and ends, SI or degrees for angles; an angle may begin beyond where it ends.
    """
    is_rate: bool = False
    """Whether the variable is a rate or speed of the motion."""

    def to_mapping(self) -> dict:
        """Return the regime as plain data."""
        return {
            'axis': self.axis,
            'variable': self.variable,
            'text': self.text,
            'share': self.share,
            'p_value': self.p_value,
            'size': self.size,
            'bounds': None if self.bounds is None else list(self.bounds),
        }


def exchanges(window: np.ndarray, kind: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    """
    Return random exchanges of the residual between windows of one kind and intensity of motion.

    Whole windows are exchanged, since the residual within a window is correlated; the sequence of
    blocks of a window is repeated or cut to the length of its new window.

    Parameters
    ----------
    window : ndarray, shape (b,)
        Number of the window of each block, in order.
    kind : ndarray, shape (b,)
        Kind of that window.
    intensity : ndarray, shape (b,)
        Rate of rotation, rad/s.

    Returns
    -------
    ndarray, shape (PERMUTED, b)
        Block of which each block has the residual.

    """
    rng = np.random.default_rng(0)
    # First block of each window, number of the window of each block, blocks of each window.
    _, starts, number, count = np.unique(
        window, return_index=True, return_inverse=True, return_counts=True
    )
    # Rms rate of rotation of each window.
    speed = np.sqrt(np.add.reduceat(intensity**2, starts) / count)

    # Window whose residual each window has, shape (PERMUTED, n_windows).
    # Exchanged within classes of similar speed, unless all windows of a kind turn alike.
    partner = np.tile(np.arange(len(starts)), (PERMUTED, 1))
    for name in np.unique(kind):
        of_kind = np.flatnonzero(kind[starts] == name)
        of_kind = of_kind[np.argsort(speed[of_kind], kind='stable')]
        n_classes = 1
        if np.ptp(speed[of_kind]) > DEG:
            n_classes = max(min(INTENSITIES, len(of_kind) // LEAST_ALIKE), 1)
        for of_class in np.array_split(of_kind, n_classes):
            partner[:, of_class] = rng.permuted(np.tile(of_class, (PERMUTED, 1)), axis=1)

    # Block k of a window has the residual of block k of its partner, modulo the partner's length.
    source = partner[:, number]
    return starts[source] + (np.arange(len(window)) - starts[number]) % count[source]


class ColumnWhitening(Protocol):
    """Whitening of the rows of one axis."""

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Return columns over the blocks, shape (b, k), with errors of unit variance."""


@dataclass(frozen=True, eq=False)
class IndependentErrors:
    """Whitening of blocks with independent errors."""

    sd: np.ndarray
    """Standard deviation of the error of each block, shape (b,)."""

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """Return columns over the blocks, shape (b, k), over the sd of each block."""
        return 1.0 / self.sd[:, None] * columns


class AxisResidual:
    """
    The residual of one axis at the fit of the model, independent and of unit variance.

    With the columns A of the model, its prior mean m and information W::

        residual = y - A (A'A + W)^-1 (A'y + W m)

    Parameters
    ----------
    rows : ndarray, shape (b, q + 1)
        ``[columns of the model | measured]`` of each block.
    information, mean : ndarray, shape (q,)
        Prior of the parameters.

    """

    def __init__(self, rows: np.ndarray, information: np.ndarray, mean: np.ndarray):
        self.design = rows[:, :-1]
        """Columns of the model, shape (b, q)."""
        self._inverse = np.linalg.inv(self.design.T @ self.design + np.diag(information + TINY))
        fitted = self._inverse @ (self.design.T @ rows[:, -1] + information * mean)
        self.values = rows[:, -1] - self.design @ fitted
        """The residual, shape (b,)."""

    def free(self, columns: np.ndarray) -> np.ndarray:
        """Return columns (b, k) without the part that the model imitates, shape (b, k)."""
        return columns - self.design @ (self._inverse @ (self.design.T @ columns))

    def offsets(self, marks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (amplitude, residual sum of squares) with one more column in the model, each (k,).

        Each of the columns `marks`, shape (b, k), is added to the model without the other ones.
        """
        size = np.maximum((marks * self.free(marks)).sum(axis=0), TINY)
        product = marks.T @ self.values
        return product / size, self.values @ self.values - product**2 / size

    def energy(self, columns: np.ndarray) -> float:
        """Return the residual sum of squares with all these columns (b, k) added to the model."""
        norm = np.sqrt((columns**2).sum(axis=0)) + TINY
        scaled = columns / norm
        free = self.free(scaled)
        amplitudes = np.linalg.lstsq(
            scaled.T @ free + TINY * np.eye(len(norm)), scaled.T @ self.values, rcond=1e-10
        )[0]
        return float(((self.values - free @ amplitudes) ** 2).sum())


@dataclass(frozen=True, eq=False)
class Ranges:
    """The ranges of a variable under test."""

    variable: Variable
    """The variable."""
    marks: np.ndarray
    """Share of each block in each bin, shape (b, k)."""
    member: np.ndarray
    """1 in each bin of a range, shape (r, k)."""


@dataclass(frozen=True, eq=False)
class _RefinedRange:
    """A range of a variable in which the residual has another offset."""

    inside: np.ndarray
    """Share of each block in the range, shape (b,)."""
    bounds: tuple[float, float] | None
    """Bounds of the variable; None where it has no scale."""
    words: str
    """Description of the range."""
    offset: float
    """The offset, in the unit of the residual."""
    squares: float
    """Residual sum of squares with the offset."""


class RegimeSearch:
    """
    Search for ranges of variables in which the residual of a sensor has another offset.

    Parameters
    ----------
    sensor : str
    time : ndarray, shape (b,)
        Middle of each block, s.
    variables : sequence of Variable
    exchange : ndarray, shape (m, b)
        See `exchanges`.

    """

    def __init__(
        self, sensor: str, time: np.ndarray, variables: Sequence[Variable], *, exchange: np.ndarray
    ):
        self.sensor = sensor
        self.time = time
        self.exchange = exchange
        self.ranges: list[Ranges] = []
        """Of each variable, the ranges with neither too few nor too many of the blocks."""
        for variable in variables:
            # At least `FEWEST` blocks inside, or an eighth of few blocks.
            marks = variable.marks
            member = variable.ranges
            n_inside = member @ marks.sum(axis=0)
            allowed = n_inside >= min(FEWEST, len(marks) / 8)
            allowed &= n_inside <= MAX_REGIME_SHARE * len(marks)
            if allowed.any():
                self.ranges.append(Ranges(variable, marks, member[allowed]))

    def offsets(
        self,
        axis: str,
        rest: AxisResidual,
        whitening: ColumnWhitening,
        *,
        level: float,
        formula: np.ndarray | None = None,
    ) -> list[RestRegime]:
        """
        Return the ranges with another offset, the largest share of the excess first.

        Ranges that a smooth curve or a formula describes as well are omitted.

        The statistic is the largest share of the squares that one offset explains. With the
        residual r and the indicator x of a range, both white and without the model::

            share = (x'r)^2 / (x'x r'r)

        Its distribution by chance is that of residuals whose blocks are exchanged.

        Parameters
        ----------
        axis : str
            Axis of the sensor.
        rest : AxisResidual
            Its residual.
        whitening : ColumnWhitening
            Of the rows of `rest`.
        level : float
            Largest probability of a regime by chance.
        formula : ndarray, shape (b, k), optional
            Columns of a formula for the residual.

        """
        # Column 0 is the residual, the others are exchanges of its blocks.
        exchanged = np.column_stack([rest.values, rest.free(rest.values[self.exchange].T)])
        energy = (exchanged**2).sum(axis=0)
        shares = []
        for ranges in self.ranges:
            marks = whitening.whiten(ranges.marks)
            products = marks.T @ rest.free(marks)  # of the bins; a range is a sum of bins
            size = np.einsum('rk,kl,rl->r', ranges.member, products, ranges.member)
            projection = ranges.member @ (marks.T @ exchanged)
            shares.append(projection**2 / np.maximum(size, TINY)[:, None] / energy)
        p_value, likeliest = self.tested(shares)
        if p_value > level:
            return []

        # A regime must fit clearly better than any smooth curve of a variable, and the formula.
        smooth = [ranges.variable.curves for ranges in self.ranges if len(ranges.variable.edges)]
        if formula is not None:
            smooth.append(formula)
        least_energy = energy[0]
        for columns in smooth:
            least_energy = min(least_energy, rest.energy(whitening.whiten(columns)))
        limit = variance_cost(least_energy, len(self.time)) - SURE

        # The likeliest ranges with their best bounds.
        regimes = []
        for ranges, number in likeliest:
            refined = self._refined(rest, whitening, ranges, number)
            # Share of the excess over noise, which is 1 for each block.
            n_blocks = len(refined.inside)
            excess = max(energy[0] - n_blocks, TINY)
            share = 1.0 - max(refined.squares - n_blocks, 0.0) / excess
            fits_better = variance_cost(refined.squares, n_blocks) < limit
            if not (share >= MOST_OF_IT and fits_better):
                continue
            regimes.append(
                RestRegime(
                    sensor=self.sensor,
                    axis=axis,
                    variable=ranges.variable.name,
                    text=refined.words + ', by another offset',
                    share=float(share),
                    p_value=p_value,
                    size=float(refined.offset),
                    inside=refined.inside > 0.5,
                    time=self.time,
                    offset=True,
                    bounds=refined.bounds,
                    is_rate=ranges.variable.is_rate,
                )
            )
        return largest_share_first(regimes)

    def _refined(
        self, rest: AxisResidual, whitening: ColumnWhitening, ranges: Ranges, number: int
    ) -> _RefinedRange:
        """Return range `number` of a variable with the bounds at which the residual is least."""
        variable = ranges.variable
        chosen = variable.chosen(ranges.member[number])
        bounds = variable.bounds(chosen)
        mark = ranges.marks[:, chosen].sum(axis=1)

        # One end after the other; the candidates are between the edges of the bins too.
        for end in (0, 1):
            if not bounds:  # classes have no bounds
                break
            low, high = bounds
            options = []
            for place in variable.near(chosen, end):
                options.append((place, high) if end == 0 else (low, place))
            if not options:
                continue
            inside = np.stack([variable.inside(*option) for option in options], axis=1)
            _, squares = rest.offsets(whitening.whiten(inside))
            best = int(np.argmin(squares))
            bounds = options[best]
            mark = inside[:, best]
        offsets, squares = rest.offsets(whitening.whiten(mark[:, None]))
        return _RefinedRange(
            inside=mark,
            bounds=bounds,
            words=variable.words(chosen, bounds),
            offset=offsets[0],
            squares=squares[0],
        )

    def tested(self, gains: Sequence[np.ndarray]) -> tuple[float, list[tuple[Ranges, int]]]:
        """
        Return (p-value of the largest gain, the likeliest range of each of some variables).

        The p-value is the share of the exchanges with at least this gain. The variables with the
        largest gains are returned, at most `REPORTED`, in their order, as (`Ranges`, number of the
        range).

        Parameters
        ----------
        gains : sequence of array, shape (r, 1 + m)
            Gain of each range of a variable in the recording and in m exchanges of its blocks.

        """
        if not gains:
            return 1.0, []
        largest = np.max([gain.max(axis=0) for gain in gains], axis=0)  # of the recording first
        p_value = float((largest >= largest[0]).mean())
        of_recording = [gain[:, 0] for gain in gains]
        order = np.argsort([-gain.max() for gain in of_recording], kind='stable')[:REPORTED]
        likeliest = [(self.ranges[k], int(np.argmax(of_recording[k]))) for k in sorted(order)]
        return p_value, likeliest


def largest_share_first(found: Iterable[RestRegime]) -> list[RestRegime]:
    """Return regimes in order of their shares; among nearly equal ones the order is kept."""
    nearly_largest = max((regime.share for regime in found), default=0.0) - REGIME_SHARE_TIE
    return sorted(found, key=lambda regime: -min(regime.share, nearly_largest))


def variance_cost(energy: float | np.ndarray, count: float | np.ndarray) -> float | np.ndarray:
    """
    Return ``n log v + S / v``, minus twice the log likelihood of n residuals with one variance v.

    With their sum of squares S (`energy`) in units of the noise, ``v = max(S / n, 1)``.
    """
    variance = np.maximum(energy / np.maximum(count, 1.0), 1.0)
    return count * np.log(variance) + energy / variance
