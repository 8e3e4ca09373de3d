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

    Then the standard deviation of parameter i would be ``1 / |data_i|``, with its column of the
    weighted design without priors `data`, shape (m, n).
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
    Return a mask of the parameters whose standard deviation exceeds `HELD_SHARE` of the prior's.

    The parameter with the largest ratio of standard deviation to prior is fixed, then the ratios of
    the other ones are computed again: of parameters of which only the sum is observable, one
    remains free.

    Parameters
    ----------
    rows : array, shape (m, n)
        Weighted design with rows of a prior, which may be as wide as to leave only the data.
    prior_sd : array, shape (n,)
    free, held : array of bool, shape (n,)
        Parameters under test, and those of them that are fixed in any case.
    tie : float
        Parameters with at least this part of the largest ratio count as equally weak, and the first
        of them is fixed: below 1 the choice does not depend on rounding.

    """
    held = held.copy()
    while True:
        estimated = free & ~held
        if not estimated.any():
            return held
        ratio = np.zeros(len(prior_sd))
        variances = np.diag(inverse_gram(rows[:, estimated]))
        ratio[estimated] = np.sqrt(variances) / prior_sd[estimated]
        if not np.any(ratio > HELD_SHARE):
            return held
        is_weakest = ratio >= tie * ratio.max()
        held[np.argmax(is_weakest)] = True
