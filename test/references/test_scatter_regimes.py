"""Which part of a range of larger scatter is told."""

import numpy as np

from imu_calibration.references.turntable.residuals import scatter_regimes


def test_of_what_scatters_the_shortest_part_that_holds_nearly_all_is_told():
    excess = np.array([0.0, 1.0, 30.0, 60.0, 8.0, 1.0, 500.0])
    assert scatter_regimes._shortest_part([1, 2, 3, 4, 5], excess) == [2, 3, 4]
