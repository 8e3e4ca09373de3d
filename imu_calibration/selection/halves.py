"""Do both halves of a recording show an effect alike?"""

from collections.abc import Sequence

import numpy as np

from imu_calibration.chances import chi2_sf

DISAGREE = 1e-4
"""Significance level of the test that the halves differ."""
APART = 1 / 16
"""
Share of an effect's chi-square that is lost with one value for both halves, above which they disagree.

For halves of equal precision: values that differ by half of the joint estimate.
"""


def agree(halves: Sequence[tuple[np.ndarray, np.ndarray]], whole: tuple[np.ndarray, np.ndarray], at: Sequence[int]) -> bool:
    """
    Return whether the estimates of some parameters from two halves agree within their precision.

    They disagree when the difference is significant and one value for both loses more than `APART` of the chi-square.
    A half that hardly determines an effect loses little, for any value: before any rotation, an arm may be estimated at a metre.

    Parameters
    ----------
    halves, whole
        (values, covariance) of the same parameters, fitted to each half and to both.
    at : sequence of int
        Indices of the parameters under test.

    """
    at = list(at)
    difference = (halves[0][0] - halves[1][0])[at]
    apart = float(difference @ np.linalg.solve((halves[0][1] + halves[1][1])[np.ix_(at, at)], difference))
    value = whole[0][at]
    explained = float(value @ np.linalg.solve(whole[1][np.ix_(at, at)], value))
    return bool(chi2_sf(apart, len(at)) > DISAGREE or apart < APART * explained)
