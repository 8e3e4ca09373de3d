"""Triangular factors without their zeros."""

import numpy as np

from imu_calibration.estimation.scaled_solve import triangular
from imu_calibration.references.turntable.packed_factors import packed, unpacked


def test_packed_factors_come_back_bit_by_bit():
    """Square, trapezoidal and empty factors, alone and beside one another."""
    rng = np.random.default_rng(3)
    factors = [triangular(rng.normal(size=(count, 7))) for count in (40, 7, 3, 0)]
    every = [packed(factor) for factor in factors]
    assert [len(each) for each in every] == [28, 28, 18, 0]
    together = unpacked(every, 7)
    assert together.shape == (4, 7, 7)
    for factor, each, padded in zip(factors, every, together):
        assert np.array_equal(unpacked([each], 7)[0], factor)
        assert np.array_equal(padded[: len(factor)], factor) and not padded[len(factor) :].any()
