"""
Noise that is not the same at every rest.

Intervals at rest differ in attitude, support and nearby machines. Their noise differs by some per cent, near a hand by half. The
precision of the sensor's noise is then limited by the number of intervals, however many samples each has.
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class Parts:
    """The Allan variances of one axis, one row for each part at rest."""

    variance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Shape (n_parts, n_scales); anything where a part has no term."""
    terms: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Second differences that each is the mean of, shape (n_parts, n_scales)."""

    def share(self) -> np.ndarray:
        """Return the variance of the mean of all parts over that of a part, if only their levels differ, shape (n_scales,)."""
        return (self.terms**2).sum(axis=0) / self.terms.sum(axis=0)**2

    def scatter(self, used: np.ndarray, chance: np.ndarray) -> float:
        """
        Return the standard deviation between parts of the level of the variances, over the level, in excess of sampling error.

        The moment estimate of DerSimonian and Laird (Controlled Clinical Trials 7:177, 1986) with the numbers of terms for weights,
        averaged over the averaging times, weighted by precision.

        Parameters
        ----------
        used : ndarray of bool, shape (n_scales,)
            Which averaging times count.
        chance : ndarray, shape (n_used,)
            Sampling variance of the mean of all parts over the square of its expectation.

        """
        if len(self.terms) < 2:
            return 0.0
        terms, variance = self.terms[:, used], self.variance[:, used]
        total, freedom = terms.sum(axis=0), (terms > 0).sum(axis=0) - 1
        level = (terms * variance).sum(axis=0) / total
        squares = (terms * (variance / level - 1.0)**2).sum(axis=0)
        spread = total - (terms**2).sum(axis=0) / total
        known = freedom > 0
        if not known.any():
            return 0.0
        between = (squares - freedom * chance * total)[known] / spread[known]
        precision = (spread / (chance * total))[known]**2 / freedom[known]
        return float(np.sqrt(max(np.sum(precision * between) / precision.sum(), 0.0)))
