"""Variances in excess of known noise in groups of rows of a linear system, by restricted maximum likelihood."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from imu_calibration.estimation.restricted_likelihood import RestrictedLikelihood

STEPS = 2
"""Scoring steps per call; for rows of one variance a single step is exact."""
DOF_LEAST = 2.0
"""With fewer degrees of freedom a group's variance is not estimated from the data."""
DOF_SEPARATE = 3.0
"""With fewer degrees of freedom the misfit of a group is not separable from that of the others."""
ATTRIBUTION_STEPS = 6
"""Scoring steps for the variance of one group if all misfit is its own."""
SPARE_LEAST = 0.1
"""With fewer degrees of freedom no misfit is attributed to a group."""
UPPER = 0.975
"""Probability of the quantile whose ratio between Student's t and the normal distribution widens standard deviations."""


@dataclass(frozen=True, eq=False)
class GroupVariances:
    """Variances in addition to the known noise."""

    variance: np.ndarray
    """Additional variance of each group, shape (n_groups,)."""
    dof: np.ndarray
    """Degrees of freedom from which each was estimated, shape (n_groups,)."""
    upper: np.ndarray
    """Variance for standard deviations, which allows for the error of `variance`, shape (n_groups,)."""

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


def estimate_group_variances(design: np.ndarray, residual: np.ndarray, noise: np.ndarray, *, group: np.ndarray, start: np.ndarray,
                             fallback: np.ndarray) -> GroupVariances:
    """
    Estimate the additional variance of each group of rows.

    The rows are ``residual = design @ x + e`` with independent errors of variance ``noise + variance[group]``. Scoring on
    the restricted likelihood, which charges for the parameters that were fitted.

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
    rows = np.column_stack([design, residual])[:, None]
    problem = _Groups(RestrictedLikelihood(rows, np.zeros(len(rows)), [np.arange(len(rows))]), noise, group, len(start))
    # at a large variance the degrees of freedom depend on the layout of the rows only
    none, large = np.zeros(len(start), bool), 100 * (np.asarray(fallback, float) + problem.typical(np.zeros(len(start))))
    spare = problem.step(large, none)[1]
    free = spare >= DOF_LEAST
    current = np.where(free, start, fallback)
    for _ in range(STEPS):
        typical, (changed, dof) = problem.typical(current), problem.step(current, free)
        settled = np.all(np.abs(changed - current) <= 1e-3 * typical)
        current = changed
        if settled:
            break
    dof = np.where(free, dof, 0.0)
    upper = current * np.where(dof > DOF_LEAST, student_factor(dof), 1.0)
    for alone in np.eye(len(free), dtype=bool)[spare < DOF_SEPARATE]:
        upper[alone] = np.maximum(upper[alone], _attributed(problem, alone, fallback)[alone])
    return GroupVariances(current, dof, upper)


def student_factor(dof: np.ndarray) -> np.ndarray:
    """Return the squared ratio of the 97.5 % quantiles of Student's t with `dof` (at least 1) degrees of freedom and of the normal law."""
    return (stdtrit(np.maximum(dof, 1.0), UPPER) / ndtri(UPPER))**2


def _attributed(problem, alone, fallback):
    """Return the variance of one group if all misfit is its own, at least `fallback`, widened by Student's t, shape (n_groups,)."""
    least = np.where(alone, fallback, 0.0)
    current, dof = problem.step(least, np.zeros(len(alone), bool))
    for _ in range(ATTRIBUTION_STEPS if dof[alone] > SPARE_LEAST else 0):
        current = problem.step(current, alone)[0]
    current = np.where(alone, np.maximum(current, fallback), 0.0)
    return current * student_factor(problem.step(current, np.zeros(len(alone), bool))[1])


class _Groups:
    """The likelihood as a function of the additional variances of groups."""

    def __init__(self, likelihood, noise, group, count):
        self.likelihood, self.noise, self.group = likelihood, noise, group
        self.members = np.array([group == number for number in range(count)], float)

    def variance(self, extra):
        """Return the variance of each row."""
        return self.noise + np.append(extra, 0.0)[self.group]

    def typical(self, extra):
        """Return the mean variance of each group's rows."""
        return (self.members @ self.variance(extra)) / np.maximum(self.members.sum(1), 1)

    def step(self, extra, free):
        """Return the next variances, a scoring step over the free groups that are not pinned at zero, and each one's degrees of freedom."""
        score, information = self.likelihood.scoring(self.variance(extra)[:, None], self.members)
        index, step, typical = np.flatnonzero(free & ~((extra <= 0) & (score < 0))), np.zeros(len(extra)), self.typical(extra)
        if len(index):
            step[index] = np.linalg.solve(information[np.ix_(index, index)], score[index])
        return np.clip(extra + step, 0.0, extra + 100 * typical), 2 * np.diag(information) * typical**2
