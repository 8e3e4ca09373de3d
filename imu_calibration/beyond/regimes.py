"""Where the rest of a sensor sits: regimes of the motion in which most of it lies, found on some windows and tested on others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from imu_calibration.beyond.blocks import RestBlocks
from imu_calibration.constants import DEG
from imu_calibration.effects.base import AXES
from imu_calibration.selection.attempt import Attempt

FALSE_DISCOVERIES = 0.05
"""Share of false regimes among those told."""
MOST_OF_IT, MUCH_OF_IT = 0.8, 0.5
"""Share of the rest that lies in a regime, and that an offset in it takes away, which bins of finite width make smaller."""
WIDEST = 0.6
"""Share of the blocks that a regime may hold: what is everywhere is nowhere."""
FEWEST = 6
"""Blocks that a regime holds at least."""
N_BINS = 24
TINY = 1e-9
"""Keeps columns that a part of the recording does not have from making a system singular."""


@dataclass(frozen=True, eq=False)
class RestRegime:
    """One condition under which the rest of one axis appears."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    axis: str
    """Axis of the sensor; 'norm' where only the length of its output is known."""
    variable: str
    """What it goes by: 'angle of NAME', 'rate of NAME', 'time', ..."""
    text: str
    """The condition in words."""
    share: float
    """Share of the axis' rest that lies in it, on windows that it was not found on."""
    p_value: float
    """Chance of the contrast there by noise."""
    inside: np.ndarray
    """Whether each block lies in it, shape (b,)."""
    time: np.ndarray
    """Middle of each block, s, shape (b,)."""
    offset: bool
    """Whether the output differs by an offset there, rather than by something that changes; then it could as well be everywhere else."""
    cost: float
    """Minus twice the log likelihood of the windows that it was not found on: the smallest is told first."""
    bounds: tuple[float, float] | None
    """Where it begins and ends, SI or degrees for angles; an angle may begin beyond where it ends."""

    def to_mapping(self) -> dict:
        """Return the regime as plain data."""
        return {'axis': self.axis, 'variable': self.variable, 'text': self.text, 'share': self.share, 'p_value': self.p_value,
                'bounds': None if self.bounds is None else list(self.bounds)}


@dataclass(frozen=True, eq=False)
class Variable:
    """What a regime may go by: a bin for each block, and the words for a range of bins."""

    name: str
    bins: np.ndarray
    edges: np.ndarray | None
    cyclic: bool
    words: object

    @property
    def marks(self) -> np.ndarray:
        """One column for each bin, 1 in the blocks that lie there, shape (b, k)."""
        return np.eye(int(self.bins.max()) + 1)[self.bins]


def find_regimes(blocks: RestBlocks, attempt: Attempt, used: Sequence[int], *, joint_names: Sequence[str]) -> list[RestRegime]:
    """
    Return the regimes of a sensor's axes, the clearest of each axis first.

    For every variable and every range of it either the model is fitted to the blocks outside and those inside scatter by themselves, or
    those inside have an offset of their own; the likeliest range is found on every other window and tested on those between, by an F test
    whose degrees of freedom count windows. Of all tests the false discoveries are held at 5 % (Benjamini, Hochberg 1995).
    """
    variables = _variables(blocks, joint_names)
    white = blocks.whitener(np.ones(len(blocks.time), bool))
    found = []
    for axis in range(3):
        at = np.flatnonzero(np.isin(blocks.index[axis], list(used)))
        rows = white(blocks.design[axis][:, [*at, -1]]) / white.scale[axis]
        own = blocks.index[axis][at]
        prior = (1 / attempt.space.prior_sd[own]**2, attempt.space.prior_mean[own])
        found += [regime for variable in variables for regime in _of_variable(blocks, axis, rows, prior, variable, white)]
    kept = _few_false(found)
    return sorted(kept, key=lambda regime: (regime.axis, regime.cost))


def _few_false(regimes):
    order = sorted(regimes, key=lambda regime: regime.p_value)
    passed = [k for k, regime in enumerate(order, 1) if regime.p_value <= FALSE_DISCOVERIES * k / len(order)]
    return [regime for regime in order[:max(passed, default=0)] if regime.share >= (MUCH_OF_IT if regime.offset else MOST_OF_IT)]


def _of_variable(blocks, axis, rows, prior, variable, white):
    """Return the regimes of one variable, found on every other window and tested on those between: by scatter and by offset."""
    marks = white(variable.marks) / white.scale[axis]
    training = blocks.window % 2 == 0
    found = cleanest(rows[training], marks[training], prior, bins=variable.bins[training], cyclic=variable.cyclic)
    return [regime for best, offset in found if (regime := _tested(blocks, axis, rows, marks, prior, variable, best, offset)) is not None]


def _tested(blocks, axis, rows, marks, prior, variable, best, offset):
    """Return the RestRegime of a range of bins, tested on windows that it was not found on, or None where it is too many or too few."""
    training, chosen = blocks.window % 2 == 0, np.isin(variable.bins, best)
    inside, outside = ~training & chosen, ~training & ~chosen
    windows = [len(np.unique(blocks.window[part])) for part in (inside, outside)]
    if not FEWEST <= chosen.sum() <= WIDEST * len(chosen) or windows[0] < 1 or windows[1] < 3:
        return None
    if offset:
        mark = marks[:, best].sum(axis=1)
        share, p_value = tested_offset(rows[~training], mark[~training], prior, n_windows=sum(windows))
        left = _wider(rows, mark) @ np.append(-_solved(_wider(rows, mark)[training], _for_one_more(prior))[0], 1.0)
        cost = _cost(float((left[~training]**2).sum()), (~training).sum())
    else:
        left = rows @ np.append(-_solved(rows[training & ~chosen], prior)[0], 1.0)
        share, p_value = _tested_scatter(left, inside, outside, windows)
        cost = sum(_cost(float((left[part]**2).sum()), part.sum()) for part in (inside, outside))
    bounds = None if variable.edges is None else (float(variable.edges[best[0]]), float(variable.edges[best[-1] + 1]))
    return RestRegime(blocks.sensor, AXES[axis], variable.name, variable.words(best) + (', by another offset' if offset else ''), share,
                      p_value, chosen,
                  blocks.time, offset, float(cost), bounds)


def _tested_scatter(left, inside, outside, windows):
    """Return (share of the rest that lies inside, p-value of the ratio of variances); degrees of freedom count windows."""
    energy = [float((left[part]**2).sum()) for part in (inside, outside)]
    ratio = (energy[0] / inside.sum()) / max(energy[1] / outside.sum(), 1e-300)
    excess = [max(e - part.sum(), 0.0) for e, part in zip(energy, (inside, outside))]
    return excess[0] / max(sum(excess), 1e-300), float(f_distribution.sf(ratio, *windows))


def tested_offset(rows: np.ndarray, mark: np.ndarray, prior: tuple, *, n_windows: int) -> tuple[float, float]:
    """
    Return (share of the rest that an offset inside takes away, p-value of that).

    Parameters
    ----------
    rows : ndarray, shape (b, q + 1)
        ``[columns of the model | rest]``, independent and of unit variance.
    mark : ndarray, shape (b,)
        The offset's column, made independent as the rows were.
    prior : (ndarray, ndarray)
        Information and mean that the parameters come with, shape (q,).
    n_windows : int
        What counts as degrees of freedom.

    """
    before = _solved(rows, prior)[1]
    after = _solved(_wider(rows, mark), _for_one_more(prior))[1]
    dof = max(n_windows - rows.shape[1], 3)
    ratio = max(before - after, 0.0) / max(after / len(rows), 1.0)
    return 1.0 - max(after - len(rows), 0.0) / max(before - len(rows), 1e-300), float(f_distribution.sf(ratio, 1, dof))


def _wider(rows, mark):
    return np.column_stack([rows[:, :-1], mark, rows[:, -1]])


def _for_one_more(prior):
    return tuple(np.append(part, 0.0) for part in prior)


def _solved(rows, prior):
    """Return (values, sum of squares that they leave)."""
    design = rows[:, :-1]
    values = np.linalg.solve(design.T @ design + np.diag(prior[0] + TINY), design.T @ rows[:, -1] + prior[0] * prior[1])
    return values, float(((rows[:, -1] - design @ values)**2).sum())


def cleanest(rows: np.ndarray, marks: np.ndarray, prior: tuple, *, bins: np.ndarray, cyclic: bool) -> list[tuple[list[int], bool]]:
    """
    Return the ranges of bins in order that leave the cleanest rest by likelihood, each with whether it differs by an offset.

    Either what lies inside scatters by itself, and the model is fitted outside; or it has an offset of its own.
    """
    count = marks.shape[1]
    parts = np.stack([rows[bins == k].T @ rows[bins == k] for k in range(count)])
    ranges = [[(first + k) % count for k in range(length)] for length in range(1, count) for first in range(count)
              if cyclic or first + length <= count]
    member = np.zeros((len(ranges), count))
    for number, chosen in enumerate(ranges):
        member[number, chosen] = 1.0
    n_inside = member @ np.bincount(bins, minlength=count)
    allowed = (n_inside >= 3) & (n_inside <= WIDEST * len(rows))
    if not allowed.any():
        return []
    ranges, member, n_inside = [r for r, ok in zip(ranges, allowed) if ok], member[allowed], n_inside[allowed]
    inside = np.einsum('rk,kij->rij', member, parts)
    energy = _energies(inside, parts.sum(axis=0) - inside, prior)
    scatter = sum(_cost(e, n) for e, n in zip(energy, (n_inside, len(rows) - n_inside)))
    offset = _cost(_with_offset(rows, marks, member, prior), len(rows))
    return [(ranges[int(np.argmin(cost))], by_offset) for cost, by_offset in ((scatter, False), (offset, True))]


def _energies(inside, outside, prior):
    """Return the sums of squares inside and outside under the model fitted outside, each (r,)."""
    right = (outside[:, :-1, -1] + prior[0] * prior[1])[..., None]
    values = np.linalg.solve(outside[:, :-1, :-1] + np.diag(prior[0] + TINY), right)[..., 0]
    weights = np.concatenate([-values, np.ones((len(values), 1))], axis=1)
    return [np.einsum('ri,rij,rj->r', weights, part, weights) for part in (inside, outside)]


def _with_offset(rows, marks, member, prior):
    """Return the sum of squares that the model and an offset of its own for each range leave, shape (r,)."""
    design = rows[:, :-1]
    values, left = _solved(rows, prior)
    inverse = np.linalg.inv(design.T @ design + np.diag(prior[0] + TINY))
    free = marks - design @ (inverse @ (design.T @ marks))
    rest = rows[:, -1] - design @ values
    size = np.einsum('rk,kl,rl->r', member, free.T @ marks, member)
    return left - (member @ (free.T @ rest))**2 / np.maximum(size, 1e-9)


def _cost(energy, count):
    variance = np.maximum(energy / np.maximum(count, 1), 1.0)
    return count * np.log(variance) + energy / variance


def _variables(blocks, joint_names):
    """Return what a regime may go by in this recording."""
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
    if ref.temperature_c is not None:
        warm = blocks.means(ref.temperature_c)
        found += ranged('temperature', warm, 'C', least=0.5)
        slope = np.gradient(np.polynomial.Chebyshev.fit(blocks.time, warm, min(12, len(warm) // 10))(blocks.time))
        found += _classes('temperature', slope > 0, ('while it cools', 'while it warms up'))
    moving = speed > DEG
    found += _classes('kind', moving, ('at rest', 'while it moves'))
    last = np.maximum.accumulate(np.where(moving, blocks.time, -np.inf))
    return found + ranged('time since motion', np.where(np.isfinite(last), np.minimum(blocks.time - last, 1e3), 1e3), 's')


def _before_rest(name, rate):
    """Return whether a joint came to a rest from one side or the other."""
    moving = np.abs(rate) > 0.5 * DEG
    side = np.where(moving, np.sign(rate), 0.0)
    place = np.maximum.accumulate(np.where(moving, np.arange(len(rate)), -1))
    came = np.where(place >= 0, side[np.maximum(place, 0)], 0.0)
    if min((came > 0).sum(), (came < 0).sum()) < FEWEST:
        return []
    return _classes(f'approach of {name}', came > 0, (f'after {name} turned backwards', f'after {name} turned forwards'))


def _cyclic(name, degrees):
    edges = np.linspace(0.0, 360.0, N_BINS + 1)

    def words(chosen):
        return f'while the {name} is {edges[chosen[0]]:.0f} to {edges[chosen[-1] + 1]:.0f} deg'
    return Variable(name, np.minimum((degrees % 360.0 / 360.0 * N_BINS).astype(int), N_BINS - 1), edges, True, words)


def ranged(name: str, values: np.ndarray, unit: str, *, least: float = 1e-3) -> list[Variable]:
    """Return the variable of a value of each block in bins of as many blocks, or none where it hardly changes."""
    edges = np.unique(np.round(np.quantile(values, np.linspace(0.0, 1.0, N_BINS + 1)), 3))
    if len(edges) < 4 or np.ptp(edges) < least:
        return []

    def words(chosen):
        low, high = edges[chosen[0]], edges[chosen[-1] + 1]
        if chosen[0] == 0:
            return f'while the {name} is below {high:.3g} {unit}'
        span = f'{low:.3g} {unit} or more' if chosen[-1] == len(edges) - 2 else f'{low:.3g} to {high:.3g} {unit}'
        return f'while the {name} is {span}'
    return [Variable(name, np.clip(np.searchsorted(edges, values, side='right') - 1, 0, len(edges) - 2), edges, False, words)]


def _classes(name, mask, words):
    if not FEWEST <= mask.sum() <= len(mask) - FEWEST:
        return []
    return [Variable(name, mask.astype(int), None, False, lambda chosen: words[chosen[0]])]
