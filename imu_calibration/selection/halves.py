"""Do both halves of a recording show an effect alike?"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

DISAGREE = 1e-4
"""Chance that halves which agree are taken to disagree."""


def agree(halves: Sequence[tuple[np.ndarray, np.ndarray]], whole: tuple[np.ndarray, np.ndarray], at: Sequence[int]) -> bool:
    """
    Return whether halves show some parameters alike, as far as they show them.

    They disagree when what they say differs by more than chance and by more than half of what the whole says.

    Parameters
    ----------
    halves, whole
        (values, covariance) of the same parameters, fitted to each half and to everything.
    at : sequence of int
        Places of the parameters that are asked about.

    """
    at = list(at)
    difference = (halves[0][0] - halves[1][0])[at]
    apart = float(difference @ np.linalg.solve((halves[0][1] + halves[1][1])[np.ix_(at, at)], difference))
    known, value = np.linalg.inv(whole[1][np.ix_(at, at)]), whole[0][at]
    return bool(chi2.sf(apart, len(at)) > DISAGREE or difference @ known @ difference < 0.25 * value @ known @ value)
