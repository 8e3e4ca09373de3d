"""Variables of regimes: angles, rates and sides of the joints, speed, force, time, temperature, in ranges of values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.units import DEG
from imu_calibration.effects.base import AXES
from imu_calibration.selection.residual_blocks import RestBlocks

FEWEST = 6
"""Blocks that a regime holds at least."""
N_BINS = 24
MOST_BOUNDS = 16
"""Places at which a range is tried to begin, and to end, about the edge of a bin."""


@dataclass(frozen=True, eq=False)
class Variable:
    """A variable of regimes: a bin for each block, and the description of a range of values."""

    name: str
    bins: np.ndarray
    edges: np.ndarray
    """Where bins begin, and where the last one ends; none for classes."""
    cyclic: bool
    words: Callable
    """``words(chosen, bounds)``: the condition, from the bins in order and where they begin and end."""
    values: np.ndarray
    """Value of each block, in the unit of the edges; none for classes."""

    @property
    def marks(self) -> np.ndarray:
        """One column for each bin, 1 in the blocks that lie there, shape (b, k)."""
        return np.eye(int(self.bins.max()) + 1)[self.bins]

    def bounds(self, chosen: Sequence[int]) -> tuple[float, float] | None:
        """Return where a range of bins begins and ends, or None for classes."""
        return (float(self.edges[chosen[0]]), float(self.edges[chosen[-1] + 1])) if len(self.edges) else None

    def inside(self, low: float, high: float) -> np.ndarray:
        """Return the mask of blocks with a value between two bounds, the last range open at its end, shape (b,)."""
        if self.cyclic:
            return (self.values - low) % 360.0 < ((high - low) % 360.0 or 360.0)
        return ((self.values >= low) | (low <= self.edges[0])) & ((self.values < high) | (high >= self.edges[-1]))

    def near(self, chosen: Sequence[int], end: int) -> list[float]:
        """Return where a range of bins may begin (`end` 0) or end (1): between blocks that lie in the bins on both sides, evenly spread."""
        first = chosen[0] if end == 0 else chosen[-1] + 1
        if not self.cyclic and first in (0, len(self.edges) - 1):
            return []
        places = np.sort((self.values - self.edges[first] + 180.0) % 360.0 - 180.0 if self.cyclic else self.values - self.edges[first])
        low, high = ((-360.0 / N_BINS, 360.0 / N_BINS) if self.cyclic else self.edges[[first - 1, first + 1]] - self.edges[first])
        between = np.unique(0.5 * (places[1:] + places[:-1]))
        between = between[(between > low) & (between < high)]
        some = between[np.unique(np.linspace(0, len(between) - 1, MOST_BOUNDS).round().astype(int))] if len(between) else between
        return [*(self.edges[first] + some), float(self.edges[first])]


def variables_of(blocks: RestBlocks, joint_names: Sequence[str]) -> list[Variable]:
    """Return the variables of regimes in this recording; the first is reported among equals."""
    ref, found = blocks.ref, []
    angles, rates = blocks.means(ref.joint_angle), blocks.means(ref.joint_rate)
    for k, name in enumerate(joint_names):
        if np.ptp(angles[:, k]) > 0.5:
            found.append(_cyclic(f'angle of {name}', angles[:, k] / DEG))
        found += ranged(f'rate of {name}', rates[:, k] / DEG, 'deg/s')
        found += _before_rest(name, rates[:, k])
    speed, force = np.linalg.norm(blocks.means(ref.rate_s), axis=1), np.linalg.norm(blocks.means(ref.force_s), axis=1)
    found += ranged('speed', speed / DEG, 'deg/s') + ranged('specific force', force, 'm/s^2', least=0.5)
    for k, axis in enumerate(AXES):
        found += ranged(f'rate about {axis}', blocks.means(ref.rate_s)[:, k] / DEG, 'deg/s')
        found += ranged(f'specific force along {axis}', blocks.means(ref.force_s)[:, k], 'm/s^2', least=0.5)
    found += ranged('time', blocks.time, 's')
    if blocks.warms and ref.temperature_c is not None:
        warm = blocks.means(ref.temperature_c)
        found += ranged('temperature', warm, 'C', least=0.5)
        slope = np.gradient(np.polynomial.Chebyshev.fit(blocks.time, warm, min(12, len(warm) // 10))(blocks.time))
        found += _classes('temperature', slope > 0, ('while it cools', 'while it warms up'))
    moving = speed > DEG
    found += _classes('kind', moving, ('at rest', 'while it moves'))
    last = np.maximum.accumulate(np.where(moving, blocks.time, -np.inf))
    return found + ranged('time since motion', np.where(np.isfinite(last), np.minimum(blocks.time - last, 1e3), 1e3), 's')


def _before_rest(name, rate):
    """Return from which side a joint reached its rest."""
    moving = np.abs(rate) > 0.5 * DEG
    side = np.where(moving, np.sign(rate), 0.0)
    place = np.maximum.accumulate(np.where(moving, np.arange(len(rate)), -1))
    came = np.where(place >= 0, side[np.maximum(place, 0)], 0.0)
    if min((came > 0).sum(), (came < 0).sum()) < FEWEST:
        return []
    return _classes(f'approach of {name}', came > 0, (f'after {name} turned backwards', f'after {name} turned forwards'))


def _cyclic(name, degrees):
    edges = np.linspace(0.0, 360.0, N_BINS + 1)

    def words(_, bounds):
        low, high = (round(bound % 360.0) % 360 if bound != 360.0 else 360 for bound in bounds)
        return f'while the {name} is {low} to {high} deg'
    return Variable(name, np.minimum((degrees % 360.0 / 360.0 * N_BINS).astype(int), N_BINS - 1), edges, True, words, degrees % 360.0)


def ranged(name: str, values: np.ndarray, unit: str, *, least: float = 1e-3) -> list[Variable]:
    """Return the variable of a value of each block in bins of equal numbers of blocks, or none where it hardly changes."""
    edges = np.unique(np.round(np.quantile(values, np.linspace(0.0, 1.0, N_BINS + 1)), 3))
    if len(edges) < 4 or np.ptp(edges) < least:
        return []

    def words(chosen, bounds):
        low, high = bounds
        if chosen[0] == 0:
            return f'while the {name} is below {high:.3g} {unit}'
        span = f'{low:.3g} {unit} or more' if chosen[-1] == len(edges) - 2 else f'{low:.3g} to {high:.3g} {unit}'
        return f'while the {name} is {span}'
    bins = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, len(edges) - 2)
    return [Variable(name, bins, edges, False, words, values)]


def _classes(name, mask, words):
    if not FEWEST <= mask.sum() <= len(mask) - FEWEST:
        return []
    return [Variable(name, mask.astype(int), np.zeros(0), False, lambda chosen, _: words[chosen[0]], np.zeros(0))]
