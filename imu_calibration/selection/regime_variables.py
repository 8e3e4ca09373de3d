"""
Variables of regimes.

Angles, rates and sides of the joints, speed, force, time, temperature, in ranges of values.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.units import DEG

FEWEST = 6
"""Blocks that a regime holds at least."""
N_BINS = 24
SMOOTH_ORDER = 3
"""Order of smooth functions of a variable."""
MOST_BOUNDS = 16
"""Places at which a range is tried to begin, and to end, about the edge of a bin."""


def block_means(rows: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return means over the blocks that begin at `starts`, shape (b, ...)."""
    counts = np.diff(np.append(starts, len(rows)))
    return np.add.reduceat(rows, starts, axis=0) / counts.reshape(-1, *[1] * (rows.ndim - 1))


@dataclass(frozen=True, eq=False)
class Variable:
    """
    A variable of regimes at the rows of all blocks, in bins.

    It also holds the description of a range of values.
    """

    name: str
    bins: np.ndarray
    """Bin of each row, shape (n,)."""
    edges: np.ndarray
    """Where bins begin, and where the last one ends; none for classes."""
    cyclic: bool
    words: Callable
    """
    ``words(chosen, bounds)``: the condition, from the bins in order and where they begin and end.
    """
    values: np.ndarray
    """Value at each row, in the unit of the edges, shape (n,)."""
    starts: np.ndarray
    """First row of each block, shape (b,)."""
    is_rate: bool = False
    """Whether it is a rate or speed of the motion."""

    @property
    def marks(self) -> np.ndarray:
        """Share of each block in each bin, shape (b, k)."""
        return block_means(np.eye(int(self.bins.max()) + 1)[self.bins], self.starts)

    @property
    def ranges(self) -> np.ndarray:
        """
        Ranges of neighbouring bins, 1 in each bin of a range, the shortest first, shape (r, k).
        """
        count = int(self.bins.max()) + 1
        places = np.arange(int(self.bins.max()) + 1)
        parts = []
        for length in range(1, count):
            starts = count if self.cyclic else count - length + 1
            parts += [(places - first) % count < length for first in range(starts)]
        return np.array(parts, float).reshape(-1, count)

    @property
    def curves(self) -> np.ndarray:
        """
        Means over the blocks of smooth functions of the variable, cubic or of the third order.

        None of classes; shape (b, k).
        """
        if not len(self.edges):
            return np.zeros((len(self.starts), 0))
        if self.cyclic:
            turns = np.arange(1, SMOOTH_ORDER + 1) * (self.values * DEG)[:, None]
            return block_means(np.concatenate([np.cos(turns), np.sin(turns)], axis=1), self.starts)
        low = self.values.min()
        high = self.values.max()
        return block_means(
            np.polynomial.legendre.legvander(
                2 * (self.values - low) / (high - low) - 1, SMOOTH_ORDER
            )[:, 1:],
            self.starts,
        )

    def chosen(self, member: np.ndarray) -> list[int]:
        """Return the bins of a range, in order."""
        bins = np.flatnonzero(member)
        gap = np.flatnonzero(np.diff(bins) > 1)  # a cyclic range may begin beyond where it ends
        return np.roll(bins, -gap[0] - 1).tolist() if len(gap) else bins.tolist()

    def bounds(self, chosen: Sequence[int]) -> tuple[float, float] | None:
        """Return where a range of bins begins and ends, or None for classes."""
        return (
            (float(self.edges[chosen[0]]), float(self.edges[chosen[-1] + 1]))
            if len(self.edges)
            else None
        )

    def inside(self, low: float, high: float) -> np.ndarray:
        """
        Return the share of each block between two bounds, shape (b,).

        The first and the last range are open at their ends.
        """
        if self.cyclic:
            rows = (self.values - low) % 360.0 < ((high - low) % 360.0 or 360.0)
        else:
            rows = ((self.values >= low) | (low <= self.edges[0])) & (
                (self.values < high) | (high >= self.edges[-1])
            )
        return block_means(rows.astype(float), self.starts)

    def near(self, chosen: Sequence[int], end: int) -> list[float]:
        """
        Return where a range of bins may begin (`end` 0) or end (1).

        Between values that lie in the bins on both sides, evenly spread.
        """
        first = chosen[0] if end == 0 else chosen[-1] + 1
        if not self.cyclic and first in (0, len(self.edges) - 1):
            return []
        places = np.sort(
            (self.values - self.edges[first] + 180.0) % 360.0 - 180.0
            if self.cyclic
            else self.values - self.edges[first]
        )
        low, high = (
            (-360.0 / N_BINS, 360.0 / N_BINS)
            if self.cyclic
            else self.edges[[first - 1, first + 1]] - self.edges[first]
        )
        between = np.unique(0.5 * (places[1:] + places[:-1]))
        between = between[(between > low) & (between < high)]
        some = (
            between[np.unique(np.linspace(0, len(between) - 1, MOST_BOUNDS).round().astype(int))]
            if len(between)
            else between
        )
        return [*(self.edges[first] + some), float(self.edges[first])]


def ranged(
    name: str,
    values: np.ndarray,
    unit: str,
    *,
    starts: np.ndarray,
    least: float = 1e-3,
    is_rate: bool = False,
) -> list[Variable]:
    """
    Return the variable of a value at each row, in bins of equal numbers of blocks.

    Return none where the value hardly changes.
    """
    edges = np.unique(
        np.round(np.quantile(block_means(values, starts), np.linspace(0.0, 1.0, N_BINS + 1)), 3)
    )
    if len(edges) < 4 or np.ptp(edges) < least:
        return []

    def words(chosen: Sequence[int], bounds: tuple[float, float]) -> str:
        low, high = bounds
        if chosen[0] == 0:
            return f'while the {name} is below {high:.3g} {unit}'
        span = (
            f'{low:.3g} {unit} or more'
            if chosen[-1] == len(edges) - 2
            else f'{low:.3g} to {high:.3g} {unit}'
        )
        return f'while the {name} is {span}'

    bins = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, len(edges) - 2)
    return [Variable(name, bins, edges, False, words, values, starts, is_rate)]
