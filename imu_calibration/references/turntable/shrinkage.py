"""Values of effects that were not requested, shrunk towards their prior."""

import numpy as np

from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import CONVENTION_SHARE, Solution, of_fit


def shrunk(solution: Solution, parts: list[slice]) -> Solution:
    """
    Return a solution in which the values of some effects are shrunk towards their prior.

    With the distance d of an effect from its prior, its covariance C and ``chi2 = d' C^-1 d`` in k
    directions, d is multiplied by ``1 - k / chi2``, at least 0 (James and Stein). The other
    parameters are updated as if the effect were known at the shrunk value. An absent effect then
    adds little error to the other parameters, and a significant effect is kept. The effects are
    shrunk one after the other, each from the values that the one before left; covariance and
    standard deviations remain those of the estimate.

    Parameters
    ----------
    solution : Solution
    parts : list of slice
        Parameters of each effect.

    """
    values = solution.values.copy()
    prior = make_prior(solution.model).mean
    covariance = of_fit(solution.terms)  # of the least squares, without allowances for the model
    for part in parts:
        index = np.arange(part.start, part.stop)[~solution.held[part]]
        if not len(index):
            continue
        sd = np.sqrt(np.diag(covariance)[index])
        variances, directions = np.linalg.eigh(covariance[np.ix_(index, index)] / np.outer(sd, sd))
        # Without the directions that a convention fixes.
        is_free = variances > CONVENTION_SHARE * variances[-1]
        distance = directions[:, is_free].T @ ((values[index] - prior[index]) / sd)
        chi2 = float((distance**2 / variances[is_free]).sum())
        weighted = directions[:, is_free] @ (distance / variances[is_free]) / sd  # C^-1 d
        # The shift of all parameters if the effect is set to its prior: cov(all, effect) C^-1 d.
        to_prior = np.where(solution.held, 0.0, covariance[:, index] @ weighted)
        values -= min(1.0, is_free.sum() / max(chi2, 1e-300)) * to_prior
    return solution.at(values)
