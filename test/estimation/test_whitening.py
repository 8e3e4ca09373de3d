"""Rows without weight do not disturb the whitening of precise rows."""

import numpy as np
import pytest

from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.whitening import Whitening


@pytest.mark.parametrize('without_weight', [1.0, 1e8])
def test_the_inverse_covariance_is_that_of_noise_and_a_bias_process(without_weight):
    rng = np.random.default_rng(5)
    n_rows, process = 12, BiasProcess(1e-3, 50.0)
    time = np.cumsum(rng.uniform(4.0, 9.0, n_rows))
    variance = rng.uniform(1e-8, 3e-8, n_rows)
    variance[5:7] = without_weight
    between = np.abs(time[:, None] - time)
    covariance = np.diag(variance) + process.sd**2 * np.exp(-between / process.time)
    # Both sides in units of the standard deviations, in which the covariance is well conditioned.
    unit = np.sqrt(np.diag(covariance))
    expected = np.linalg.inv(covariance / np.outer(unit, unit))
    whitening = Whitening(variance[:, None], time, [np.arange(n_rows)], processes=[process])
    rows = np.diag(unit)[:, None, :]
    white = whitening(rows.copy())[:, 0]
    assert np.allclose(white.T @ white, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
