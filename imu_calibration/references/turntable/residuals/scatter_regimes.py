"""Regimes of the motion in which the scatter within windows on a table is larger."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.selection.regimes import (
    MOST_OF_IT,
    SURE,
    TINY,
    RegimeSearch,
    RestRegime,
    largest_share_first,
    variance_cost,
)

NEARLY_ALL = 0.95
"""Share of the scatter of a range in its reported part."""
LOUDER = 1.5
"""Least ratio of the variances inside and outside of a regime of larger scatter."""
SCORINGS = 12
"""Steps of the fit of a variance that is a smooth function of a variable."""
MAX_VARIANCE_RATIO = 1e3
"""
Largest ratio of a square and its variance in a step, which limits the influence of few residuals.
"""


class ScatterSearch(RegimeSearch):
    """Search for ranges in which the residual has another offset, or a larger scatter."""

    def scatters(
        self, axis: str, rough: np.ndarray, weight: np.ndarray, *, level: float
    ) -> list[RestRegime]:
        """
        Return the ranges with a larger variance within blocks, the likeliest first.

        The statistic is the largest fall of minus twice the log likelihood by a separate variance
        in a range.

        Parameters
        ----------
        axis : str
        rough : ndarray, shape (b,)
            Variance within the blocks.
        weight : ndarray, shape (b,)
            Its degrees of freedom.
        level : float
            Largest probability of a regime by chance.

        """
        # In units of the median; without a louder range no exchange has to be computed.
        median = float(np.median(rough))
        if median <= 0:
            return []
        rough = rough / median
        if not any(fall.any() for fall in self._falls(rough[:, None], weight)):
            return []

        # By chance: with the blocks exchanged.
        exchanged = np.column_stack([rough, rough[self.exchange].T])
        p_value, likely = self.tested(self._falls(exchanged, weight))
        if p_value > level:
            return []

        # A regime must fit clearly better than a variance that follows a smooth curve.
        smooth = []
        for each in self.ranges:
            if len(each.variable.edges):
                smooth.append(_smooth_scatter(each.variable.curves, rough, weight))
        one_variance = (variance_cost(weight @ rough, weight.sum()), 1.0)
        smooth_cost, dispersion = min(smooth, default=one_variance)
        regimes = []
        for each, number in likely:
            variable = each.variable
            excess_of_bins = np.maximum(each.marks.T @ (weight * (rough - 1.0)), 0.0)
            chosen = _tightened(variable.chosen(each.member[number]), excess_of_bins)
            inside = each.marks[:, chosen].sum(axis=1)
            outside = 1.0 - inside

            # Inside and outside: sums of squares, degrees of freedom, and their ratio.
            squares = weight * rough
            energy = np.array([(inside * squares).sum(), (outside * squares).sum()])
            count = np.array([(inside * weight).sum(), (outside * weight).sum()])
            variance = energy / np.maximum(count, 1.0)
            excess = np.maximum(energy - count, 0.0)
            share = excess[0] / max(excess.sum(), TINY)
            cost = np.sum(variance_cost(energy, count))
            if share >= MOST_OF_IT and cost < smooth_cost - SURE * dispersion:
                bounds = variable.bounds(chosen)
                regimes.append(
                    RestRegime(
                        self.sensor,
                        axis,
                        variable.name,
                        variable.words(chosen, bounds) + ', by larger scatter',
                        float(share),
                        p_value,
                        float(np.sqrt(median * max(variance[0] - variance[1], 0.0))),
                        inside > 0.5,
                        self.time,
                        False,
                        bounds,
                        variable.is_rate,
                    )
                )
        return largest_share_first(regimes)

    def _falls(self, rough: np.ndarray, weight: np.ndarray) -> list[np.ndarray]:
        """
        Return per variable the fall of the cost by a separate variance in each range.

        It is zero where the variance is hardly larger, and the shape is (r, m). With the sums of
        squares E and the degrees of freedom n of all blocks, and those inside the range::

            fall = cost(E, n) - cost(E_in, n_in) - cost(E - E_in, n - n_in)
            louder: E_in / n_in > LOUDER max((E - E_in) / (n - n_in), 1)

        """
        squares = rough * weight[:, None]
        count = weight.sum()
        energy = squares.sum(axis=0)
        falls = []
        for each in self.ranges:
            count_inside = (each.member @ (each.marks.T @ weight))[:, None]
            energy_inside = each.member @ (each.marks.T @ squares)
            count_outside = count - count_inside
            least_outside = np.maximum(energy - energy_inside, count_outside)
            louder = energy_inside * count_outside > LOUDER * least_outside * count_inside

            # Logarithms only where they are needed.
            row, column = np.nonzero(louder)
            whole = energy[column]
            inside = energy_inside[louder]
            n_inside = count_inside[row, 0]
            fall = np.zeros(energy_inside.shape)
            fall[louder] = (
                variance_cost(whole, count)
                - variance_cost(inside, n_inside)
                - variance_cost(whole - inside, count - n_inside)
            )
            falls.append(fall)
        return falls


def _tightened(chosen: Sequence[int], excess: np.ndarray) -> Sequence[int]:
    """Return the shortest part of a range of bins that holds nearly all of the excess in it."""
    sums = np.append(0.0, np.cumsum(excess[chosen]))
    parts = []  # (length, minus the excess in it, first): the shortest, then the largest excess
    for first in range(len(chosen)):
        for last in range(first + 1, len(chosen) + 1):
            inside = sums[last] - sums[first]
            if inside >= NEARLY_ALL * sums[-1]:
                parts.append((last - first, -inside, first))
    length, _, first = min(parts)
    return chosen[first : first + length]


def _smooth_scatter(
    columns: np.ndarray, variance: np.ndarray, weight: np.ndarray
) -> tuple[float, float]:
    """
    Return (minus twice the log likelihood, dispersion) by Fisher scoring.

    The variances are exp(a combination of columns).

    The dispersion is 1 where the variances scatter about the curve as those of Gaussian noise with
    `weight` degrees of freedom.
    """
    design = np.column_stack([np.ones(len(columns)), columns])
    root = np.sqrt(weight)
    values = np.zeros(design.shape[1])
    for _ in range(SCORINGS):
        # d(log likelihood) / d(log variance) = n (ratio - 1) / 2, information n / 2.
        log_variance = np.maximum(design @ values, 0.0)
        ratio = np.minimum(variance * np.exp(-log_variance), MAX_VARIANCE_RATIO)
        step = np.linalg.lstsq(root[:, None] * design, root * (ratio - 1.0), rcond=1e-9)[0]
        values = values + step
    log_variance = np.maximum(design @ values, 0.0)
    ratio = variance * np.exp(-log_variance)
    cost = float((weight * (log_variance + ratio)).sum())
    # The variance of a ratio is 2 / n.
    dispersion = float((weight * (ratio - 1.0) ** 2).mean()) / 2
    return cost, max(dispersion, 1.0)
