"""Halves of a recording that show an effect alike, or not."""

import numpy as np
import pytest

from imu_calibration.selection.evidence import FitsOfHalves, agree


@pytest.mark.parametrize(
    'first, second, alike',
    [
        ((1.05, 0.01), (0.95, 0.01), True),  # differ by a tenth
        ((1.4, 0.01), (0.6, 0.01), False),  # differ by eight tenths
        ((-3.0, 0.01), (-1.0, 0.01), False),
        ((3.0, 1.5), (1.0, 0.01), True),  # by chance
        ((50.0, 0.2), (1.0, 0.001), True),  # one that hardly shows it, by its misfit
    ],
)
def test_halves_disagree_where_both_show_an_effect_and_differently(first, second, alike):
    halves = [(np.array([value, 7.0]), np.diag([sd**2, 1.0])) for value, sd in (first, second)]
    information = [1 / sd**2 for _, sd in (first, second)]
    value = np.average([first[0], second[0]], weights=information)
    whole = np.array([value, 7.0]), np.diag([1 / sum(information), 1.0])
    assert agree(FitsOfHalves(*halves, whole), [0]) == alike
