"""Squares of the force whose sum acts as a bias, requested by hand."""

import numpy as np

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.base import Role

from worlds.hand_sessions import GRAVITY, simulate, unpack

SIZE = 2e-5
"""Response of the y axis to the square of the force along x, (rad/s)/(m/s^2)^2."""


def squared(force, rate, time, pose):
    """Return what the response adds to both outputs."""
    added = np.zeros_like(rate)
    added[:, 1] = SIZE * force[:, 0] ** 2
    return np.zeros_like(force), added


def test_a_sum_of_squares_is_part_of_the_bias():
    """Before, the biases had sds of 0.2 deg/s and squares were held; a turn was recommended."""
    imu, _, truth = simulate(77, n_poses=16, force_sd=0.004, rate_sd=4e-4, spoil=squared)
    found = calibrate_recordings(
        SampleBlock(imu=imu),
        gravity=GRAVITY,
        gyroscope_model='bias+matrix+gyro_force_squared',
        model_as_asked=True,
    )
    assert found.exit_code == 0
    # The mean of the three squares times g^2 is a bias; the rest has the sum zero.
    calibration = found.calibration
    model = calibration.model
    names = list(model.param_names)
    at = [names.index(f'gyroscope.gyro_force_squared.y_{pair}') for pair in ('xx', 'yy', 'zz')]
    squares = SIZE * np.array([2.0, -1.0, -1.0]) / 3.0
    assert np.all(np.abs(calibration.values[at] - squares) < 4 * calibration.sd[at])
    bias = unpack(truth)[2] + np.array([0.0, SIZE * GRAVITY**2 / 3.0, 0.0])
    part = model.part('gyroscope', Role.OFFSET)
    error = calibration.values[part] - bias
    assert np.all(np.abs(error) < 4 * calibration.sd[part])
    assert np.all(calibration.sd[part] < 2e-4)
