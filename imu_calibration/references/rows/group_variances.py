"""Variances of groups of rows in addition to the known noise, by restricted likelihood."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import ndtri, stdtrit

from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.estimation.scaled_solve import triangular_of_band

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


def estimate_group_variances(
    rows: Rows, *, start: np.ndarray, fallback: np.ndarray
) -> GroupVariances:
    """
    Estimate the variance of each component of rows.

    Scoring on the restricted likelihood, which charges for the parameters that were fitted.

    Parameters
    ----------
    rows : Rows
        With independent errors of one axis and columns of full rank (add weak priors as rows
        without component where needed).
    start : array, shape (n_groups,)
        First guess of the variances.
    fallback : array, shape (n_groups,)
        Variance of a group with fewer than two degrees of freedom.

    """
    problem = _Groups(rows, len(start))
    no_group = np.zeros(len(start), bool)

    # Groups with enough degrees of freedom are estimated. At a large variance these depend on the
    # layout of the rows only.
    large = 100 * (np.asarray(fallback, float) + problem.typical(np.zeros(len(start))))
    dof_of_layout = problem.step(large, no_group).dof
    free = dof_of_layout >= DOF_LEAST

    current = np.where(free, start, fallback)
    for _ in range(SCORING_STEPS):
        typical = problem.typical(current)
        step = problem.step(current, free)
        settled = np.all(np.abs(step.variance - current) <= 1e-3 * typical)
        current = step.variance
        if settled:
            break
    dof = np.where(free, step.dof, 0.0)

    # Few degrees of freedom widen the intervals. A group with almost none may have all the misfit.
    upper = current * np.where(dof > DOF_LEAST, student_factor(dof), 1.0)
    for index in np.flatnonzero(dof_of_layout < DOF_SEPARATE):
        alone = np.arange(len(free)) == index
        upper[index] = max(upper[index], _attributed(problem, alone, fallback)[index])
    return GroupVariances(current, dof, upper)


def scoring(rows: Rows, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return score and information of the variances of groups of independent rows (Fisher scoring).

    Parameters
    ----------
    rows : Rows
    members : ndarray, shape (n_groups, m n_axes)
        Which equations belong to each group, as ones and zeros.

    Returns
    -------
    tuple
        First derivative of the restricted log likelihood by the variances, shape (n_groups,), and
        minus the expected second one, (n_groups, n_groups).

    """
    white = flat(rows.white())
    factor = triangular_of_band(white)
    # Only the rows of groups: the cost grows with the square of their number.
    in_group = members.any(axis=0)
    white = white[in_group]
    weighted = (members / rows.variance.ravel())[:, in_group]
    # With A = Q R, the Q of these rows: residuals e = y - Q Q'y, hat matrix H = Q Q'.
    q = solve_triangular(factor[:-1, :-1], white[:, :-1].T, trans='T').T
    residual = white[:, -1] - q @ factor[:-1, -1]
    redundancy = 1 - np.einsum('ij,ij->i', q, q)
    # Score (e^2 - (1 - h)) / 2 and information (I - H)^2 / 2, summed over the groups; the squares
    # are of each element.
    squares = q @ q.T
    squares[np.diag_indices_from(squares)] -= 1
    np.square(squares, out=squares)  # in place: the memory is the square of the number of rows
    return 0.5 * weighted @ (residual**2 - redundancy), 0.5 * weighted @ squares @ weighted.T


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


@dataclass(frozen=True, eq=False)
class _Groups:
    """The restricted likelihood of rows as a function of the additional variances of groups."""

    rows: Rows
    """Rows of one axis; their component is the group."""
    n_groups: int
    """Number of groups."""

    @cached_property
    def members(self) -> np.ndarray:
        """1 for the rows of each group, else 0, shape (n_groups, m)."""
        return np.array([self.rows.component == k for k in range(self.n_groups)], float)

    def typical(self, extra: np.ndarray) -> np.ndarray:
        """Return the mean variance of each group's rows, `extra` included, shape (n_groups,)."""
        variance = self.rows.with_scatter(extra).variance.ravel()
        return (self.members @ variance) / np.maximum(self.members.sum(1), 1)

    def step(self, extra: np.ndarray, free: np.ndarray) -> _ScoringStep:
        """
        Return the next variances after `extra`, and the degrees of freedom of each group.

        The variances change by a scoring step over the free groups (mask). Groups at zero whose
        likelihood rises below zero keep zero.
        """
        score, information = scoring(self.rows.with_scatter(extra), self.members)
        typical = self.typical(extra)
        is_at_bound = (extra <= 0) & (score < 0)
        index = np.flatnonzero(free & ~is_at_bound)
        step = np.zeros(len(extra))
        if len(index):
            step[index] = np.linalg.solve(information[np.ix_(index, index)], score[index])
        # Not below zero, and by at most a hundred typical variances in one step.
        return _ScoringStep(
            variance=np.clip(extra + step, 0.0, extra + 100 * typical),
            dof=2 * np.diag(information) * typical**2,
        )


def _attributed(problem: _Groups, alone: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """
    Return the variance of the group `alone` (mask) if it causes all misfit, shape (n_groups,).

    The variance is at least `fallback`, widened by Student's t; that of the other groups is zero.
    """
    no_group = np.zeros(len(alone), bool)
    first = problem.step(np.where(alone, fallback, 0.0), no_group)
    current = first.variance
    if first.dof[alone] > SPARE_LEAST:
        for _ in range(ATTRIBUTION_STEPS):
            current = problem.step(current, alone).variance
    current = np.where(alone, np.maximum(current, fallback), 0.0)
    return current * student_factor(problem.step(current, no_group).dof)
