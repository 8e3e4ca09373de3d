"""Rows of the prior of the parameters."""

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior, zero_sum_rows


def test_the_rows_that_carry_information_are_those_of_parameters_and_sums():
    """Rows of the gauge stand between them, where arms and sums are estimated together."""
    model = SensorModel(
        accelerometer=('bias', 'matrix', 'accel_size_effect', 'lever_arm'),
        gyroscope=('bias', 'matrix', 'gyro_force_squared'),
    )
    prior = make_prior(model)
    sums = zero_sum_rows(model)
    n_params = len(prior.mean)
    assert len(prior.gauge) == len(sums) == 3
    assert len(prior.root) == n_params + 6
    root = prior.root_without_gauge
    np.testing.assert_array_equal(root[:n_params], prior.root[:n_params])
    np.testing.assert_array_equal(root[n_params:], sums)
