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
"""Bins of a variable, at most; of an angle of a complete turn exactly."""
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
    A variable of regimes at the n rows of b blocks, in k bins.

    A range of it is a sequence of neighbouring bins.
    """

    name: str
    """Name, as printed."""
    bins: np.ndarray
    """Bin of each row, shape (n,)."""
    edges: np.ndarray
    """Where bins begin, and where the last one ends, shape (k + 1,); none for classes."""
    cyclic: bool
    """Whether it is an angle of an endless joint, in degrees: the last bin adjoins the first."""
    words: Callable[..., str]
    """
    ``words(chosen, bounds)`` describes a range from its bins in order and its two bounds (None for
    classes).
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
        """All r ranges: 1 in each bin of a range, else 0, the shortest first, shape (r, k)."""
        n_bins = int(self.bins.max()) + 1
        places = np.arange(n_bins)
        ranges = []
        for length in range(1, n_bins):
            n_starts = n_bins if self.cyclic else n_bins - length + 1
            ranges += [(places - first) % n_bins < length for first in range(n_starts)]
        return np.array(ranges, float).reshape(-1, n_bins)

    @property
    def curves(self) -> np.ndarray:
        """
        Means over the blocks of smooth functions of the variable, shape (b, number of functions).

        Harmonics of an angle, Legendre polynomials of other values, up to `SMOOTH_ORDER`; no
        function of classes.
        """
        if not len(self.edges):
            return np.zeros((len(self.starts), 0))
        if self.cyclic:
            turns = np.arange(1, SMOOTH_ORDER + 1) * (self.values * DEG)[:, None]
            return block_means(np.concatenate([np.cos(turns), np.sin(turns)], axis=1), self.starts)
        low = self.values.min()
        high = self.values.max()
        scaled = 2 * (self.values - low) / (high - low) - 1
        polynomials = np.polynomial.legendre.legvander(scaled, SMOOTH_ORDER)[:, 1:]
        return block_means(polynomials, self.starts)

    def chosen(self, member: np.ndarray) -> list[int]:
        """Return the bins of a range in order; `member`: 1 in each of its bins, shape (k,)."""
        bins = np.flatnonzero(member)
        # A cyclic range may pass from the last bin to the first: it begins after the gap.
        gap = np.flatnonzero(np.diff(bins) > 1)
        if len(gap):
            bins = np.roll(bins, -gap[0] - 1)
        return bins.tolist()

    def bounds(self, chosen: Sequence[int]) -> tuple[float, float] | None:
        """Return the values at which a range of bins begins and ends, or None for classes."""
        if not len(self.edges):
            return None
        return float(self.edges[chosen[0]]), float(self.edges[chosen[-1] + 1])

    def inside(self, low: float, high: float) -> np.ndarray:
        """
        Return the share of each block between two bounds, shape (b,).

        A bound at the first or last edge is no bound.
        """
        if self.cyclic:
            # Equal bounds are a complete turn.
            rows = (self.values - low) % 360.0 < ((high - low) % 360.0 or 360.0)
        else:
            above = (self.values >= low) | (low <= self.edges[0])
            below = (self.values < high) | (high >= self.edges[-1])
            rows = above & below
        return block_means(rows.astype(float), self.starts)

    def near(self, chosen: Sequence[int], end: int) -> list[float]:
        """
        Return values near an edge at which a range of bins may begin (`end` 0) or end (1).

        They are middles between values in the bins on both sides of the edge, at most
        `MOST_BOUNDS` of them, evenly spread, and the edge itself. Empty where the range is open.
        """
        number = chosen[0] if end == 0 else chosen[-1] + 1
        if not self.cyclic and number in (0, len(self.edges) - 1):
            return []

        # Values relative to the edge, and the two adjoining bins.
        edge = self.edges[number]
        if self.cyclic:
            distances = (self.values - edge + 180.0) % 360.0 - 180.0
            low, high = -360.0 / N_BINS, 360.0 / N_BINS
        else:
            distances = self.values - edge
            low, high = self.edges[[number - 1, number + 1]] - edge
        distances = np.sort(distances)
        middles = np.unique(0.5 * (distances[1:] + distances[:-1]))
        middles = middles[(middles > low) & (middles < high)]
        if len(middles):
            spread = np.linspace(0, len(middles) - 1, MOST_BOUNDS).round().astype(int)
            middles = middles[np.unique(spread)]
        return [*(edge + middles), float(edge)]


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
    Return [the Variable of a value at each row], in bins of equal numbers of blocks.

    The list is empty if the edges of the bins differ by less than `least`, in `unit`, or are fewer
    than four. `starts`: first row of each block.
    """
    quantiles = np.quantile(block_means(values, starts), np.linspace(0.0, 1.0, N_BINS + 1))
    edges = np.unique(np.round(quantiles, 3))
    if len(edges) < 4 or np.ptp(edges) < least:
        return []

    def words(chosen: Sequence[int], bounds: tuple[float, float]) -> str:
        """Return the condition of a range; the first and the last one are open."""
        low, high = bounds
        if chosen[0] == 0:
            return f'while the {name} is below {high:.3g} {unit}'
        if chosen[-1] == len(edges) - 2:
            return f'while the {name} is {low:.3g} {unit} or more'
        return f'while the {name} is {low:.3g} to {high:.3g} {unit}'

    bins = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, len(edges) - 2)
    return [
        Variable(
            name,
            bins,
            edges,
            cyclic=False,
            words=words,
            values=values,
            starts=starts,
            is_rate=is_rate,
        )
    ]
