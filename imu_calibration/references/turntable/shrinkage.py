"""Values of effects that nobody requested, shrunk towards their prior."""

import numpy as np

from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import CONVENTION_SHARE, Solution, of_fit


def shrunk(solution: Solution, parts: list[slice]) -> Solution:
    """
    Return a Solution in which the values of some effects are shrunk towards their prior.

    The factor is ``1 - k / chi2``, at least 0 (James and Stein), chi2 the squared distance from the
    prior in standard deviations, k its number of directions. The other parameters are updated as if
    the effect were known at the shrunk value. An absent effect then hardly raises the error of the
    other parameters, a significant effect is kept, and the standard deviations hold in both cases.

    Parameters
    ----------
    solution : Solution
    parts : list of slice
        Parameters of each effect.

    """
    values = solution.values.copy()
    prior = make_prior(solution.model).mean
    covariance = of_fit(solution.terms)
    for part in parts:
        at = np.arange(part.start, part.stop)[~solution.held[part]]
        if not len(at):
            continue
        sd = np.sqrt(np.diag(covariance)[at])
        sizes, directions = np.linalg.eigh(covariance[np.ix_(at, at)] / np.outer(sd, sd))
        known = sizes > CONVENTION_SHARE * sizes[-1]
        far = directions[:, known].T @ ((values[at] - prior[at]) / sd)
        chi2 = float((far**2 / sizes[known]).sum())
        # Inverse covariance times the distance.
        step = directions[:, known] @ (far / sizes[known]) / sd
        values -= min(1.0, known.sum() / max(chi2, 1e-300)) * np.where(
            solution.held, 0.0, covariance[:, at] @ step
        )
    return solution.at(values)
