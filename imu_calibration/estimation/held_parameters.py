"""Parameters that the windows do not determine, or that only misfit seems to determine."""

import numpy as np

from imu_calibration.estimation.scaled_solve import inverse_gram

HELD_SHARE = 0.5
"""A parameter whose standard deviation exceeds this share of its prior's is fixed at the prior."""
Factors = dict[str, list[np.ndarray]]
"""Sensor -> triangular factor of the whitened rows of each axis (`WeightedSystem.factors`)."""


def weak_alone(data: np.ndarray, prior_sd: np.ndarray) -> np.ndarray:
    """
    Return a mask of the parameters that are undetermined even if all other ones were known.

    `data`: weighted design without priors, shape (m, n).
    """
    return HELD_SHARE * prior_sd * np.linalg.norm(data, axis=0) < 1


def undetermined_parameters(
    rows: np.ndarray,
    prior_sd: np.ndarray,
    *,
    free: np.ndarray,
    held: np.ndarray,
    tie: float = 1.0,
) -> np.ndarray:
    """
    Return a mask of the parameters whose standard deviation exceeds a share of the prior's.

    One at a time, the one with the largest share, given the ones fixed before: of parameters of
    which only the sum is observable, one stays free.

    Parameters
    ----------
    rows : array, shape (m, n)
        Weighted design with rows of a prior, which may be as wide as to leave only the data.
    prior_sd : array, shape (n,)
    free, held : array of bool, shape (n,)
        Parameters under test, and those of them that are fixed in any case.
    tie : float
        Part of the largest share from which a parameter is as weak: the first of these is fixed,
        below 1 independent of rounding.

    """
    held = held.copy()
    while np.any(estimated := free & ~held):
        share = np.zeros(len(prior_sd))
        variances = np.diag(inverse_gram(rows[:, estimated]))
        share[estimated] = np.sqrt(variances) / prior_sd[estimated]
        if not np.any(share > HELD_SHARE):
            break
        held[np.argmax(share >= tie * share.max())] = True
    return held
