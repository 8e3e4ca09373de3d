"""Do both halves of a recording show an effect alike?"""

from collections.abc import Sequence

import numpy as np

from imu_calibration.chances import chi2_sf

DISAGREE = 1e-4
"""Chance that halves which agree are taken to disagree."""
APART = 1 / 16
"""
Share of what an effect explains that is lost where both halves share one value, from which they disagree.

With halves that know the same, values that differ by half of what the whole says.
"""


def agree(halves: Sequence[tuple[np.ndarray, np.ndarray]], whole: tuple[np.ndarray, np.ndarray], at: Sequence[int]) -> bool:
    """
    Return whether halves show some parameters alike, as far as they show them.

    They disagree when what they say differs by more than chance, and when one value for both loses more than `APART` of what it explains.
    A half that hardly shows an effect loses little, whatever its misfit makes of the value: before anything turns, an arm may be a metre.

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
    value = whole[0][at]
    explained = float(value @ np.linalg.solve(whole[1][np.ix_(at, at)], value))
    return bool(chi2_sf(apart, len(at)) > DISAGREE or apart < APART * explained)
