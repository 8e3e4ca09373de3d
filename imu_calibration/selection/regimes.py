"""
Regimes of the motion that contain most of a sensor's residual.

Permutation test, and comparison with smooth curves and formulas.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

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
    Return random exchanges of the blocks' residuals.

    Each window has the sequence of another of its kind and intensity of motion.

    Exchanged are whole windows, since the residual within a window is correlated; a sequence is
    repeated or cut to the length of its new window.

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
    _, starts, place, count = np.unique(
        window, return_index=True, return_inverse=True, return_counts=True
    )
    speed = np.sqrt(np.add.reduceat(intensity**2, starts) / count)
    partner = np.tile(np.arange(len(starts)), (PERMUTED, 1))
    for each in np.unique(kind):
        own = np.flatnonzero(kind[starts] == each)
        own = own[np.argsort(speed[own], kind='stable')]
        classes = min(INTENSITIES, len(own) // LEAST_ALIKE) if np.ptp(speed[own]) > DEG else 1
        for part in np.array_split(own, max(classes, 1)):
            partner[:, part] = rng.permuted(np.tile(part, (PERMUTED, 1)), axis=1)
    taken = partner[:, place]
    return starts[taken] + (np.arange(len(window)) - starts[place]) % count[taken]


class AxisResidual:
    """
    The residual of one axis, independent and of unit variance, beside the columns of the model.

    Parameters
    ----------
    rows : ndarray, shape (b, q + 1)
        ``[columns of the model | measured]``.
    information, mean : ndarray, shape (q,)
        Prior of the parameters.

    """

    def __init__(self, rows: np.ndarray, information: np.ndarray, mean: np.ndarray):
        self.design = rows[:, :-1]
        self._inverse = np.linalg.inv(self.design.T @ self.design + np.diag(information + TINY))
        self.values = rows[:, -1] - self.design @ (
            self._inverse @ (self.design.T @ rows[:, -1] + information * mean)
        )

    def free(self, columns: np.ndarray) -> np.ndarray:
        """Return columns without the part that the model imitates, shape of the columns."""
        return columns - self.design @ (self._inverse @ (self.design.T @ columns))

    def offsets(self, marks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (amplitude, residual sum of squares) per column, both shape (k,).

        Each one of some columns is in the model in turn.
        """
        size = np.maximum((marks * self.free(marks)).sum(axis=0), TINY)
        product = marks.T @ self.values
        return product / size, self.values @ self.values - product**2 / size

    def energy(self, columns: np.ndarray) -> float:
        """Return the residual sum of squares with more columns in the model."""
        norm = np.sqrt((columns**2).sum(axis=0)) + TINY
        free = self.free(columns / norm)
        amplitudes = np.linalg.lstsq(
            (columns / norm).T @ free + TINY * np.eye(len(norm)),
            (columns / norm).T @ self.values,
            rcond=1e-10,
        )[0]
        return float(((self.values - free @ amplitudes) ** 2).sum())


@dataclass(frozen=True, eq=False)
class Ranges:
    """The ranges of a variable under test."""

    variable: Variable
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
        # Ranges with neither too few nor too many of the blocks.
        self.ranges: list[Ranges] = []
        for variable in variables:
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
        white: Callable,
        *,
        level: float,
        formula: np.ndarray | None = None,
    ) -> list[RestRegime]:
        """
        Return the ranges with another offset, the likeliest first.

        Without those that a smooth curve or a formula describes as well.

        The statistic is the largest share of the squares that one offset explains. With the
        residual r and the indicator x of a range, both white and without the model::

            share = (x'r)^2 / (x'x r'r)

        Its distribution by chance is that of residuals whose blocks are exchanged.

        Parameters
        ----------
        axis : str
        rest : AxisResidual
        white : callable
            Makes columns over the blocks independent and of unit variance, as the rows of `rest`.
        level : float
            Largest probability of a regime by chance.
        formula : ndarray, shape (b, k), optional
            Columns of a formula for the residual.

        """
        exchanged = np.column_stack([rest.values, rest.free(rest.values[self.exchange].T)])
        energy = (exchanged**2).sum(axis=0)
        shares = []
        for each in self.ranges:
            marks = white(each.marks)
            products = marks.T @ rest.free(marks)  # of the bins; a range is a sum of bins
            size = np.einsum('rk,kl,rl->r', each.member, products, each.member)
            projection = each.member @ (marks.T @ exchanged)
            shares.append(projection**2 / np.maximum(size, TINY)[:, None] / energy)
        p_value, likely = self.tested(shares)
        if p_value > level:
            return []

        # A regime must fit clearly better than any smooth curve of a variable, and the formula.
        smooth = [each.variable.curves for each in self.ranges if len(each.variable.edges)]
        if formula is not None:
            smooth.append(formula)
        least_energy = min([energy[0], *(rest.energy(white(columns)) for columns in smooth)])
        limit = variance_cost(least_energy, len(self.time)) - SURE
        regimes = []
        for each, number in likely:
            refined = self._refined(rest, white, each, number)
            # Share of the excess over noise, which is 1 for each block.
            count = len(refined.inside)
            excess = max(energy[0] - count, TINY)
            share = 1.0 - max(refined.squares - count, 0.0) / excess
            if share >= MOST_OF_IT and variance_cost(refined.squares, count) < limit:
                regimes.append(
                    RestRegime(
                        self.sensor,
                        axis,
                        each.variable.name,
                        refined.words + ', by another offset',
                        float(share),
                        p_value,
                        float(refined.offset),
                        refined.inside > 0.5,
                        self.time,
                        True,
                        refined.bounds,
                        each.variable.is_rate,
                    )
                )
        return largest_share_first(regimes)

    def _refined(
        self, rest: AxisResidual, white: Callable, each: Ranges, number: int
    ) -> _RefinedRange:
        """Return a range with refined bounds."""
        variable = each.variable
        chosen = variable.chosen(each.member[number])
        bounds = variable.bounds(chosen)
        mark = each.marks[:, chosen].sum(axis=1)

        # Each end in turn where the residual is least, between the edges of the bins too.
        for end in (0, 1):
            if not bounds:
                break
            low, high = bounds
            options = []
            for place in variable.near(chosen, end):
                options.append((place, high) if end == 0 else (low, place))
            if not options:
                continue
            inside = np.stack([variable.inside(*option) for option in options], axis=1)
            _, squares = rest.offsets(white(inside))
            best = int(np.argmin(squares))
            bounds = options[best]
            mark = inside[:, best]
        (size,), (after,) = rest.offsets(white(mark[:, None]))
        return _RefinedRange(mark, bounds, variable.words(chosen, bounds), size, after)

    def tested(self, gains: Sequence[np.ndarray]) -> tuple[float, list[tuple[Ranges, int]]]:
        """
        Return (p-value of the largest gain, the likeliest ranges (Ranges, number)).

        The gains have shape (r, 1 + m), and the ranges are in order of variables.
        """
        if not gains:
            return 1.0, []
        # Column 0 is the recording, the others are exchanges of its blocks.
        largest = np.max([gain.max(axis=0) for gain in gains], axis=0)
        p_value = float((largest >= largest[0]).mean())
        of_recording = [gain[:, 0] for gain in gains]
        order = np.argsort([-gain.max() for gain in of_recording], kind='stable')[:REPORTED]
        likeliest = [(self.ranges[k], int(np.argmax(of_recording[k]))) for k in sorted(order)]
        return p_value, likeliest


def largest_share_first(found: Iterable[RestRegime]) -> list[RestRegime]:
    """Return regimes in order of their shares; among nearly equal ones the order is kept."""
    alike = max((regime.share for regime in found), default=0.0) - REGIME_SHARE_TIE
    return sorted(found, key=lambda regime: -min(regime.share, alike))


def variance_cost(energy: float | np.ndarray, count: float | np.ndarray) -> float | np.ndarray:
    """
    Return minus twice the log likelihood of residuals with one variance, at least that of noise.
    """
    variance = np.maximum(energy / np.maximum(count, 1.0), 1.0)
    return count * np.log(variance) + energy / variance
