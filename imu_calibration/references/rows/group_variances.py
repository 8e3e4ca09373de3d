"""Variances of groups of rows in addition to the known noise, by restricted likelihood."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from imu_calibration.estimation.whitening import RestrictedLikelihood

SCORING_STEPS = 2
"""Scoring steps per call; for rows of one variance a single step is exact."""
DOF_LEAST = 2.0
"""With fewer degrees of freedom a group's variance is not estimated from the data."""
DOF_SEPARATE = 3.0
"""With fewer degrees of freedom the misfit of a group is not separable from that of the others."""
ATTRIBUTION_STEPS = 6
"""Scoring steps for the variance of one group if all misfit is its own."""
SPARE_LEAST = 0.1
"""With fewer degrees of freedom no misfit is attributed to a group."""
WIDENING_PROBABILITY = 0.975
"""
Probability of the quantile whose ratio between Student's t and the normal distribution widens
standard deviations.
"""


@dataclass(frozen=True, eq=False)
class GroupVariances:
    """Variances in addition to the known noise."""

    variance: np.ndarray
    """Additional variance of each group, shape (n_groups,)."""
    dof: np.ndarray
    """Degrees of freedom from which each was estimated, shape (n_groups,)."""
    upper: np.ndarray
    """
    Variance for standard deviations, which allows for the error of `variance`, shape (n_groups,).
    """

    def total(self, noise: np.ndarray, group: np.ndarray, inflated: bool = False) -> np.ndarray:
        """
        Return the variance of each row, shape (m,).

        Parameters
        ----------
        noise : array, shape (m,)
            Known variance.
        group : array, shape (m,)
            Group of each row, -1 for none.
        inflated : bool
            Use `upper`, so that 95 % intervals from few poses are correct.

        """
        return noise + np.append(self.upper if inflated else self.variance, 0.0)[group]


def estimate_group_variances(
    design: np.ndarray,
    residual: np.ndarray,
    noise: np.ndarray,
    *,
    group: np.ndarray,
    start: np.ndarray,
    fallback: np.ndarray,
) -> GroupVariances:
    """
    Estimate the additional variance of each group of rows.

    The rows are ``residual = design @ x + e`` with independent errors of variance ``noise +
    variance[group]``. Scoring on the restricted likelihood, which charges for the parameters that
    were fitted.

    Parameters
    ----------
    design : array, shape (m, p)
        Columns; full column rank (add weak priors as rows of group -1 where needed).
    residual, noise, group : arrays, shape (m,)
        Left-hand side, known variance (above zero), index of the group or -1.
    start : array, shape (n_groups,)
        First guess of the variances.
    fallback : array, shape (n_groups,)
        Variance of a group with fewer than two degrees of freedom.

    """
    likelihood = RestrictedLikelihood(
        np.column_stack([design, residual])[:, None],
        np.zeros(len(design)),
        [np.arange(len(design))],
    )
    problem = _Groups(likelihood, noise, group, len(start))
    none = np.zeros(len(start), bool)

    # Groups with enough degrees of freedom are estimated. At a large variance these depend on the
    # layout of the rows only.
    large = 100 * (np.asarray(fallback, float) + problem.typical(np.zeros(len(start))))
    spare = problem.step(large, none).dof
    free = spare >= DOF_LEAST

    current = np.where(free, start, fallback)
    for _ in range(SCORING_STEPS):
        typical, step = problem.typical(current), problem.step(current, free)
        settled = np.all(np.abs(step.variance - current) <= 1e-3 * typical)
        current = step.variance
        if settled:
            break
    dof = np.where(free, step.dof, 0.0)

    # Few degrees of freedom widen the intervals. A group with almost none may have all the misfit.
    upper = current * np.where(dof > DOF_LEAST, student_factor(dof), 1.0)
    for index in np.flatnonzero(spare < DOF_SEPARATE):
        alone = np.arange(len(free)) == index
        upper[index] = max(upper[index], _attributed(problem, alone, fallback)[index])
    return GroupVariances(current, dof, upper)


def student_factor(dof: np.ndarray) -> np.ndarray:
    """
    Return the squared ratio of Student's and normal 97.5 % quantiles.

    Student's t has `dof` (at least 1) degrees of freedom and is compared with the normal law.
    """
    return (stdtrit(np.maximum(dof, 1.0), WIDENING_PROBABILITY) / ndtri(WIDENING_PROBABILITY)) ** 2


@dataclass(frozen=True, eq=False)
class _ScoringStep:
    """Result of one scoring step."""

    variance: np.ndarray
    """Next additional variance of each group, shape (n_groups,)."""
    dof: np.ndarray
    """Degrees of freedom of each, shape (n_groups,)."""


class _Groups:
    """The likelihood as a function of the additional variances of groups."""

    def __init__(
        self, likelihood: RestrictedLikelihood, noise: np.ndarray, group: np.ndarray, count: int
    ):
        self.likelihood, self.noise, self.group = likelihood, noise, group
        self.members = np.array([group == number for number in range(count)], float)

    def variance(self, extra: np.ndarray) -> np.ndarray:
        """Return the variance of each row, shape (m,)."""
        return self.noise + np.append(extra, 0.0)[self.group]

    def typical(self, extra: np.ndarray) -> np.ndarray:
        """Return the mean variance of each group's rows, shape (n_groups,)."""
        return (self.members @ self.variance(extra)) / np.maximum(self.members.sum(1), 1)

    def step(self, extra: np.ndarray, free: np.ndarray) -> _ScoringStep:
        """
        Return the next variances and the degrees of freedom of each.

        The variances follow from a scoring step over the free groups that are not pinned at zero.
        """
        score, information = self.likelihood.scoring(self.variance(extra)[:, None], self.members)
        typical = self.typical(extra)
        index = np.flatnonzero(free & ~((extra <= 0) & (score < 0)))
        step = np.zeros(len(extra))
        if len(index):
            step[index] = np.linalg.solve(information[np.ix_(index, index)], score[index])
        return _ScoringStep(
            np.clip(extra + step, 0.0, extra + 100 * typical),
            2 * np.diag(information) * typical**2,
        )


def _attributed(problem: _Groups, alone: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """
    Return the variance of one group if all misfit is its own, shape (n_groups,).

    It is at least `fallback` and widened by Student's t.
    """
    none = np.zeros(len(alone), bool)
    first = problem.step(np.where(alone, fallback, 0.0), none)
    current = first.variance
    if first.dof[alone] > SPARE_LEAST:
        for _ in range(ATTRIBUTION_STEPS):
            current = problem.step(current, alone).variance
    current = np.where(alone, np.maximum(current, fallback), 0.0)
    return current * student_factor(problem.step(current, none).dof)
