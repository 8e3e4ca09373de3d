"""Restricted maximum likelihood for scatter that comes on top of known noise, in groups of rows of a linear system."""

from dataclasses import dataclass

import numpy as np

STEPS = 2
"""Scoring steps per call; for rows of one variance a single step is exact."""
DOF_LEAST = 2.0
"""With fewer degrees of freedom a group's scatter is not estimated from the data."""
DOF_CORRECTION_MOST = 3.0
"""Largest factor by which the variance grows because it was itself estimated."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """Variances beside the known noise."""

    variance: np.ndarray
    """Additional variance of each group, shape (n_groups,)."""
    dof: np.ndarray
    """Degrees of freedom from which each was estimated, shape (n_groups,)."""
    chi2_per_dof: np.ndarray
    """Weighted squares of each group over its redundancy with the known noise alone, shape (n_groups,)."""

    def total(self, noise, group, inflated=False):
        """
        Return the variance of each row, shape (m,).

        Parameters
        ----------
        noise : array, shape (m,)
            Known variance.
        group : array, shape (m,)
            Group of each row, -1 for none.
        inflated : bool
            Multiply by dof / (dof - 2) as far as the scatter and not the known noise makes the variance: that of the
            t distribution, so that intervals from few poses hold.

        """
        extra = np.append(self.variance, 0.0)[group]
        if not inflated:
            return noise + extra
        factor = np.where(self.dof > DOF_LEAST, np.minimum(self.dof / np.maximum(self.dof - 2, 1e-9), DOF_CORRECTION_MOST), 1.0)
        return noise + extra * np.append(factor, 1.0)[group]


def estimate_scatter(design, residual, noise, group, start, fallback):
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
        Variance taken for a group with fewer than two degrees of freedom.

    Returns
    -------
    Scatter

    """
    count = len(start)
    member = np.array([group == c for c in range(count)], float)
    # at a large scatter only the layout of the rows counts: can they tell it at all?
    large = 100 * (np.asarray(fallback, float) + (member @ noise) / np.maximum(member.sum(1), 1))
    free = _evaluate(design, residual, noise, group, member, large)[2] >= DOF_LEAST
    current = np.where(free, start, fallback)
    for _ in range(STEPS):
        score, information, dof, typical = _evaluate(design, residual, noise, group, member, current)
        changed = _stepped(current, score, information, free, typical)
        settled = np.all(np.abs(changed - current) <= 1e-3 * typical)
        current = changed
        if settled:
            break
    return Scatter(current, np.where(free, dof, 0.0), _chi2(current, design, residual, noise, group, member))


def _complement(design, residual, variance):
    root = np.sqrt(variance)
    left = np.linalg.qr(design / root[:, None])[0]
    white = residual / root
    return left, white - left @ (left.T @ white)


def _evaluate(design, residual, noise, group, member, extra):
    """Return (score, information, degrees of freedom, typical variance) of the groups at additional variances `extra`."""
    variance = noise + np.append(extra, 0.0)[group]
    left, projected = _complement(design, residual, variance)
    redundancy = 1 - np.einsum('ij,ij->i', left, left)
    score = 0.5 * member @ ((projected**2 - redundancy) / variance)
    weighted = member / variance
    information = 0.5 * weighted @ (np.eye(len(variance)) - left @ left.T)**2 @ weighted.T
    typical = (member @ variance) / np.maximum(member.sum(1), 1)
    return score, information, 2 * np.diag(information) * typical**2, typical


def _stepped(variance, score, information, free, typical):
    """Return the next variances: a scoring step over the free groups that are not pinned at zero."""
    active = free & ~((variance <= 0) & (score < 0))
    step = np.zeros(len(variance))
    index = np.flatnonzero(active)
    if len(index):
        step[index] = np.linalg.solve(information[np.ix_(index, index)], score[index])
    return np.clip(variance + step, 0.0, variance + 100 * typical)


def _chi2(extra, design, residual, noise, group, member):
    """Chi-square per degree of freedom of each group against the known noise, at the weights that were found."""
    variance = noise + np.append(extra, 0.0)[group]
    left, projected = _complement(design, residual, variance)
    redundancy = 1 - np.einsum('ij,ij->i', left, left)
    with np.errstate(divide='ignore', invalid='ignore'):
        return (member @ (projected**2 * variance / noise)) / (member @ redundancy)
