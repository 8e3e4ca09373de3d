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
"""Share of the excess variance of a range that its reported part must contain."""
LOUDER = 1.5
"""Least ratio of the variances inside and outside of a regime of larger scatter."""
FISHER_STEPS = 12
"""Steps of Fisher scoring for a variance that is a smooth function of a variable."""
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
        in a range. Its distribution by chance is that with the blocks exchanged.

        Parameters
        ----------
        axis : str
        rough : ndarray, shape (b,)
            Variance of the samples within each block.
        weight : ndarray, shape (b,)
            Degrees of freedom of these variances.
        level : float
            Largest probability of a regime by chance.

        """
        # 1. In units of the median. The exchanges are slow, and not needed without a louder range.
        median = float(np.median(rough))
        if median <= 0:
            return []
        rough = rough / median
        if not any(fall.any() for fall in self._falls(rough[:, None], weight)):
            return []

        # 2. Permutation test: column 0 has the blocks in their order, the others exchanged.
        exchanged = np.column_stack([rough, rough[self.exchange].T])
        p_value, likely = self.tested(self._falls(exchanged, weight))
        if p_value > level:
            return []

        # 3. A regime must fit clearly better than a variance that follows a smooth curve of any
        #    variable with a scale.
        fits = []  # (cost, dispersion)
        for ranges in self.ranges:
            if len(ranges.variable.edges):
                fits.append(_smooth_scatter(ranges.variable.curves, rough, weight))
        one_variance = (variance_cost(weight @ rough, weight.sum()), 1.0)
        smooth_cost, dispersion = min(fits, default=one_variance)
        largest_cost = smooth_cost - SURE * dispersion

        # 4. The likeliest ranges, each shortened to the bins with nearly all of its excess.
        squares = weight * rough
        regimes = []
        for ranges, number in likely:
            variable = ranges.variable
            excess_of_bins = np.maximum(ranges.marks.T @ (weight * (rough - 1.0)), 0.0)
            bins = _shortest_part(variable.chosen(ranges.member[number]), excess_of_bins)
            inside = ranges.marks[:, bins].sum(axis=1)  # share of each block
            outside = 1.0 - inside

            # Inside and outside: sum of squares, degrees of freedom, and the excess over the
            # median, 1 for each degree of freedom.
            energy = np.array([(inside * squares).sum(), (outside * squares).sum()])
            count = np.array([(inside * weight).sum(), (outside * weight).sum()])
            variance = energy / np.maximum(count, 1.0)
            excess = np.maximum(energy - count, 0.0)
            share = excess[0] / max(excess.sum(), TINY)
            cost = np.sum(variance_cost(energy, count))
            if not (share >= MOST_OF_IT and cost < largest_cost):  # also where a cost is NaN
                continue
            bounds = variable.bounds(bins)
            regimes.append(
                RestRegime(
                    sensor=self.sensor,
                    axis=axis,
                    variable=variable.name,
                    text=variable.words(bins, bounds) + ', by larger scatter',
                    share=float(share),
                    p_value=p_value,
                    size=float(np.sqrt(median * max(variance[0] - variance[1], 0.0))),
                    inside=inside > 0.5,
                    time=self.time,
                    offset=False,
                    bounds=bounds,
                    is_rate=variable.is_rate,
                )
            )
        return largest_share_first(regimes)

    def _falls(self, rough: np.ndarray, weight: np.ndarray) -> list[np.ndarray]:
        """
        Return per variable the fall of the cost by a separate variance in each range.

        With the sums of squares E and the degrees of freedom n of all blocks, and those inside the
        range; the fall is zero where the variance inside is not larger by `LOUDER`::

            fall = cost(E, n) - cost(E_in, n_in) - cost(E - E_in, n - n_in)
            louder: E_in / n_in > LOUDER max((E - E_in) / (n - n_in), 1)

        Parameters
        ----------
        rough : ndarray, shape (b, m)
            Variances of the blocks over their median; each column is one order of the blocks.
        weight : ndarray, shape (b,)
            Degrees of freedom.

        Returns
        -------
        list of ndarray, shape (r, m)
            For each variable, with r ranges.

        """
        squares = rough * weight[:, None]
        count = weight.sum()
        energy = squares.sum(axis=0)
        falls = []
        for ranges in self.ranges:
            count_inside = (ranges.member @ (ranges.marks.T @ weight))[:, None]
            energy_inside = ranges.member @ (ranges.marks.T @ squares)
            # The condition of `louder`, multiplied by n_in (n - n_in).
            count_outside = count - count_inside
            least_outside = np.maximum(energy - energy_inside, count_outside)
            louder = energy_inside * count_outside > LOUDER * least_outside * count_inside

            # Logarithms only where they are needed: (row, column) are range and order of blocks.
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


def _shortest_part(bins: Sequence[int], excess: np.ndarray) -> Sequence[int]:
    """
    Return the shortest run of `bins` with at least `NEARLY_ALL` of their excess.

    `excess` is that of every bin of the variable, shape (k,).
    """
    sums = np.append(0.0, np.cumsum(excess[bins]))
    parts = []  # (length, minus the excess in it, first): the shortest, then the largest excess
    for first in range(len(bins)):
        for last in range(first + 1, len(bins) + 1):
            inside = sums[last] - sums[first]
            if inside >= NEARLY_ALL * sums[-1]:
                parts.append((last - first, -inside, first))
    length, _, first = min(parts)
    return bins[first : first + length]


def _smooth_scatter(
    columns: np.ndarray, variance: np.ndarray, weight: np.ndarray
) -> tuple[float, float]:
    """
    Return (minus twice the log likelihood, dispersion) of a smooth curve of variances.

    The variances follow ``exp(X a)``, X a constant and the `columns`, shape (b, k), with the
    amplitudes a by Fisher scoring. The dispersion is 1 where they scatter about the curve as those
    of Gaussian noise with `weight` degrees of freedom.
    """
    design = np.column_stack([np.ones(len(columns)), columns])
    root = np.sqrt(weight)
    values = np.zeros(design.shape[1])
    for _ in range(FISHER_STEPS):
        # d(log likelihood) / d(log variance) = n (ratio - 1) / 2, information n / 2. In units of
        # the median the curve is at least 1.
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
