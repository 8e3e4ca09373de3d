"""Outliers among windows or poses, by the p-values of their tests."""

from collections.abc import Mapping
from dataclasses import dataclass

OUTLIER_P_VALUE = 1e-3
"""False positive rate per sensor and kind for a recording without outliers."""


@dataclass(frozen=True)
class Outliers:
    """Outliers among the windows or poses of one kind."""

    least_p_value: float
    """Of all under test, corrected for their number (Bonferroni)."""
    numbers: tuple[int, ...]
    """Numbers of the outliers."""


def find_outliers(p_values: Mapping[int, float], *, n_tests: int, most: int) -> Outliers:
    """
    Return the outliers among windows or poses, the least p-value first.

    Parameters
    ----------
    p_values : dict
        Number of a window or pose -> p-value of its test; those with the largest residuals.
    n_tests : int
        Number of windows or poses that might have been tested.
    most : int
        Largest number of outliers.

    """
    corrected = sorted((p_value * n_tests, number) for number, p_value in p_values.items())
    outliers = [number for p_value, number in corrected[:most] if p_value < OUTLIER_P_VALUE]
    return Outliers(corrected[0][0] if corrected else 1.0, tuple(outliers))
