"""Values of effects that nobody asked for, as far as the recording asks for them; standard deviations stay those of the whole model."""

import numpy as np

from imu_calibration.estimation.covariance_terms import of_fit
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import Solution

SURE = 1e-9
"""Directions of a covariance, scaled to a unit diagonal, below this share of the largest are conventions."""


def shrunk(solution: Solution, parts: list[slice]) -> Solution:
    """
    Return a Solution whose values of some effects go towards their prior as far as the recording does not ask for them.

    By the share ``k / chi2`` of the way (James and Stein), chi2 the squared distance from the prior in standard deviations, k its
    directions, at most all of it; the other parameters follow as if the effect had been known there. An effect that is not there costs the
    others hardly any of their certainty then, one that is plain stays, and the standard deviations hold in both cases.

    Parameters
    ----------
    solution : Solution
    parts : list of slice
        Parameters of each effect.

    """
    if solution.model_error is None:
        return solution
    values, prior = solution.values.copy(), make_prior(solution.model).mean
    covariance = of_fit(solution.terms)
    for part in parts:
        at = np.arange(part.start, part.stop)[~solution.held[part]]
        if not len(at):
            continue
        sd = np.sqrt(np.diag(covariance)[at])
        sizes, directions = np.linalg.eigh(covariance[np.ix_(at, at)] / np.outer(sd, sd))
        known = sizes > SURE * sizes[-1]
        far = directions[:, known].T @ ((values[at] - prior[at]) / sd)
        chi2 = float((far**2 / sizes[known]).sum())
        step = directions[:, known] @ (far / sizes[known]) / sd   # inverse covariance times the distance
        values -= min(1.0, known.sum() / max(chi2, 1e-300)) * np.where(solution.held, 0.0, covariance[:, at] @ step)
    return solution.at(values)
