"""Regimes of the motion that contain most of a sensor's residual, found on every other window and tested on the remaining ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.core.distributions import f_sf
from imu_calibration.effects.base import AXES
from imu_calibration.selection.attempt import Attempt
from imu_calibration.selection.regime_variables import FEWEST, variables_of
from imu_calibration.selection.residual_blocks import RestBlocks

FALSE_DISCOVERIES = 0.05
"""False discovery rate of reported regimes."""
MOST_OF_IT, MUCH_OF_IT = 0.8, 0.5
"""Least share of the excess in a regime, and least share that an offset in it removes, which the bin width reduces."""
NEARLY_ALL = 0.95
"""Share of the scatter of a range in its reported part."""
ALIKE = 16.0
"""Twice the difference of log likelihood, nats, up to which the order of variables decides: joints before the sensor."""
WIDEST = 0.6
"""Largest share of the blocks in a regime; a larger one does not localise the residual."""
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
    """Variable: 'angle of NAME', 'rate of NAME', 'time', ..."""
    text: str
    """Description of the condition."""
    share: float
    """Share of the axis' rest that lies in it, on windows that it was not found on."""
    p_value: float
    """Probability of the contrast by noise."""
    inside: np.ndarray
    """Whether each block lies in it, shape (b,)."""
    time: np.ndarray
    """Middle of each block, s, shape (b,)."""
    offset: bool
    """Whether the output differs by a constant offset there; the complement could then have it as well."""
    cost: float
    """Minus twice the log likelihood of the test windows: the smallest is reported first."""
    bounds: tuple[float, float] | None
    """Where it begins and ends, SI or degrees for angles; an angle may begin beyond where it ends."""
    bins: tuple = ()
    """Bins of the variable that it was found in, in order."""

    def to_mapping(self) -> dict:
        """Return the regime as plain data."""
        return {'axis': self.axis, 'variable': self.variable, 'text': self.text, 'share': self.share, 'p_value': self.p_value,
                'bounds': None if self.bounds is None else list(self.bounds)}


def find_regimes(blocks: RestBlocks, attempt: Attempt, used: Sequence[int], *, joint_names: Sequence[str]) -> list[RestRegime]:
    """
    Return the regimes of a sensor's axes, the clearest of each axis first.

    For every range of every variable either the model is fitted outside and the blocks inside have additional scatter, or the blocks
    inside have a separate offset. The likeliest range is found on every other window and tested on the remaining ones, by an F test with
    windows as degrees of freedom. The false discovery rate of all tests is 5 %. The bounds of an offset
    are refined on all windows to between blocks, with p-values times the number of trials: one window on the wrong side of a step
    hides all of it. For scatter the shortest part with nearly all of it is reported.
    """
    variables = variables_of(blocks, joint_names)
    white = blocks.whitener(np.ones(len(blocks.time), bool))
    axes = [_AxisRest(blocks, axis, attempt, used=used, white=white) for axis in range(3)]
    found = [(rest, variable, regime) for rest in axes for variable in variables for regime in rest.regimes(variable)]
    limit = _few_false([regime.p_value for *_, regime in found])
    sharp = [rest.sharpened(variable, regime) for rest, variable, regime in found if regime.p_value <= limit]
    kept = [regime for regime in sharp if regime.p_value <= limit and regime.share >= (MUCH_OF_IT if regime.offset else MOST_OF_IT)]
    return [regime for axis in AXES for regime in _likeliest_first([each for each in kept if each.axis == axis])]


def _few_false(p_values):
    """Return the p-value up to which regimes are reported (Benjamini, Hochberg 1995)."""
    order = np.sort(p_values)
    return max(order[order <= FALSE_DISCOVERIES * np.arange(1, len(order) + 1) / max(len(order), 1)], default=-1.0)


def _likeliest_first(regimes):
    """
    Return the regimes of an axis in order; among nearly equal likelihoods the first variable precedes.

    Scatter is reported only where no offset explains most of it.
    """
    if any(regime.offset and regime.share >= MOST_OF_IT for regime in regimes):
        regimes = [regime for regime in regimes if regime.offset]
    alike = min((regime.cost for regime in regimes), default=0.0) + ALIKE
    return sorted(regimes, key=lambda regime: max(regime.cost, alike))


class _AxisRest:
    """The rest of one axis, its blocks made independent."""

    def __init__(self, blocks, axis, attempt, *, used, white):
        at = np.flatnonzero(np.isin(blocks.index[axis], list(used)))
        own = blocks.index[axis][at]
        self.blocks, self.axis, self._white = blocks, axis, white
        self.rows = self._of(blocks.design[axis][:, [*at, -1]])
        self.prior = (1 / attempt.space.prior_sd[own]**2, attempt.space.prior_mean[own])
        self.training = blocks.window % 2 == 0

    def _of(self, columns):
        return self._white(columns) / self._white.scale[self.axis]

    def regimes(self, variable):
        """Yield the regimes of one variable: by offset, and by scatter."""
        training = self.training
        found = cleanest(self.rows[training], self._of(variable.marks)[training], self.prior, bins=variable.bins[training],
                         cyclic=variable.cyclic)
        for best, offset in reversed(found):
            chosen = np.isin(variable.bins, best)
            if not FEWEST <= chosen.sum() <= WIDEST * len(chosen):
                continue
            bounds = variable.bounds(best)
            made = self._with_offset(variable, best, chosen, bounds) if offset else self._with_scatter(variable, best, chosen)
            if made is not None:
                yield made

    def _windows(self, chosen):
        """Return (blocks inside, blocks outside, windows of both) that the range was not found on, or None where they are too few."""
        inside, outside = ~self.training & chosen, ~self.training & ~chosen
        windows = [len(np.unique(self.blocks.window[part])) for part in (inside, outside)]
        return None if windows[0] < 1 or windows[1] < 3 else (inside, outside, windows)

    def _with_offset(self, variable, best, chosen, bounds, tried=1):
        parts = self._windows(chosen)
        if parts is None:
            return None
        mark, test = self._of(chosen[:, None].astype(float))[:, 0], ~self.training
        share, p_value = tested_offset(self.rows[test], mark[test], self.prior, n_windows=sum(parts[2]))
        wide = _wider(self.rows, mark)
        left = wide @ np.append(-_solved(wide[self.training], _for_one_more(self.prior))[0], 1.0)
        cost = _cost(float((left[test]**2).sum()), test.sum())
        return self._regime(variable, best, chosen, share=share, p_value=min(p_value * tried, 1.0), offset=True, cost=cost, bounds=bounds)

    def _with_scatter(self, variable, best, chosen):
        left = self.rows @ np.append(-_solved(self.rows[self.training & ~chosen], self.prior)[0], 1.0)
        best = _tightened(best, variable.bins[self.training], left[self.training]**2 - 1.0)
        chosen = np.isin(variable.bins, best)
        parts = self._windows(chosen)
        if parts is None or chosen.sum() < FEWEST:
            return None
        share, p_value = _tested_scatter(left, *parts)
        cost = sum(_cost(float((left[part]**2).sum()), part.sum()) for part in parts[:2])
        return self._regime(variable, best, chosen, share=share, p_value=p_value, offset=False, cost=cost, bounds=variable.bounds(best))

    def _regime(self, variable, best, chosen, *, share, p_value, offset, cost, bounds):
        return RestRegime(self.blocks.sensor, AXES[self.axis], variable.name, variable.words(best, bounds) + ', by another offset' * offset,
                          share, p_value, chosen, self.blocks.time, offset, float(cost), bounds, tuple(best))

    def sharpened(self, variable, regime):
        """
        Return a regime of another offset with bounds between blocks: the likeliest of some about the edges of its bins.

        Unless the test windows confirm them the edges are unchanged.
        """
        bounds, tried = regime.bounds, 1
        for end in (0, 1) if bounds and regime.offset else ():
            options = [(place, bounds[1]) if end == 0 else (bounds[0], place) for place in variable.near(regime.bins, end)]
            if options:
                marks = self._of(np.stack([variable.inside(*each) for each in options], axis=1).astype(float))
                bounds = options[int(np.argmin(_squares_left(self.rows, marks, np.eye(len(options)), self.prior)))]
                tried *= len(options)
        other = self._with_offset(variable, regime.bins, variable.inside(*bounds), bounds, 2 * tried) if tried > 1 else None
        return regime if other is None or other.cost > regime.cost else other


def _tightened(best, bins, excess):
    """Return the shortest part of a range of bins that holds nearly all of the excess in it."""
    each = np.maximum([excess[bins == number].sum() for number in best], 0.0)
    sums = np.append(0.0, np.cumsum(each))
    parts = [(first, last) for first in range(len(best)) for last in range(first + 1, len(best) + 1)
             if sums[last] - sums[first] >= NEARLY_ALL * sums[-1]]
    first, last = min(parts, key=lambda part: (part[1] - part[0], sums[part[0]] - sums[part[1]]))
    return best[first:last]


def _tested_scatter(left, inside, outside, windows):
    """Return (share of the rest that lies inside, p-value of the ratio of variances); degrees of freedom count windows."""
    energy = [float((left[part]**2).sum()) for part in (inside, outside)]
    ratio = (energy[0] / inside.sum()) / max(energy[1] / outside.sum(), 1e-300)
    excess = [max(e - part.sum(), 0.0) for e, part in zip(energy, (inside, outside))]
    return excess[0] / max(sum(excess), 1e-300), float(f_sf(ratio, *windows))


def tested_offset(rows: np.ndarray, mark: np.ndarray, prior: tuple, *, n_windows: int) -> tuple[float, float]:
    """
    Return (share of the excess that an offset inside removes, its p-value).

    Parameters
    ----------
    rows : ndarray, shape (b, q + 1)
        ``[columns of the model | rest]``, independent and of unit variance.
    mark : ndarray, shape (b,)
        The offset's column, made independent as the rows were.
    prior : (ndarray, ndarray)
        Prior information and mean of the parameters, shape (q,).
    n_windows : int
        Number of degrees of freedom.

    """
    before = _solved(rows, prior)[1]
    after = _solved(_wider(rows, mark), _for_one_more(prior))[1]
    dof = max(n_windows - rows.shape[1], 3)
    ratio = max(before - after, 0.0) / max(after / len(rows), 1.0)
    return 1.0 - max(after - len(rows), 0.0) / max(before - len(rows), 1e-300), float(f_sf(ratio, 1, dof))


def _wider(rows, mark):
    return np.column_stack([rows[:, :-1], mark, rows[:, -1]])


def _for_one_more(prior):
    return tuple(np.append(part, 0.0) for part in prior)


def _solved(rows, prior):
    """Return (values, residual sum of squares)."""
    design = rows[:, :-1]
    values = np.linalg.solve(design.T @ design + np.diag(prior[0] + TINY), design.T @ rows[:, -1] + prior[0] * prior[1])
    return values, float(((rows[:, -1] - design @ values)**2).sum())


def cleanest(rows: np.ndarray, marks: np.ndarray, prior: tuple, *, bins: np.ndarray, cyclic: bool) -> list[tuple[list[int], bool]]:
    """
    Return ranges of bins in order of likelihood of the residual outside, each with whether it differs by an offset.

    Either the blocks inside have additional scatter, and the model is fitted outside; or they have a separate offset.
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
    offset = _cost(_squares_left(rows, marks, member, prior), len(rows))
    return [(ranges[int(np.argmin(cost))], by_offset) for cost, by_offset in ((scatter, False), (offset, True))]


def _energies(inside, outside, prior):
    """Return the sums of squares inside and outside under the model fitted outside, each (r,)."""
    right = (outside[:, :-1, -1] + prior[0] * prior[1])[..., None]
    values = np.linalg.solve(outside[:, :-1, :-1] + np.diag(prior[0] + TINY), right)[..., 0]
    weights = np.concatenate([-values, np.ones((len(values), 1))], axis=1)
    return [np.einsum('ri,rij,rj->r', weights, part, weights) for part in (inside, outside)]


def _squares_left(rows, marks, member, prior):
    """Return the residual sum of squares of the model with a separate offset for each range, shape (r,)."""
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
