"""A warm-up that the user asks for converges from the prior time constant of 300 s."""

from dataclasses import replace

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.core.samples import SampleBlock
from imu_calibration.kinematics.table import Table

from worlds.physics import make_session
from worlds.physics_hand import hold_and_turn


@pytest.mark.parametrize('constant', [15.0])
def test_a_requested_warm_up_has_its_time_constant(constant):
    """The iteration stayed at 300 s, with amplitudes of twice the truth and an sd of ten times them."""
    true = np.array([0.01, -0.02, 0.015, constant])
    session = make_session(21, {'gyro_bias_drift': true}, profile='quick', noise='realistic', imu_rate=50.0, joint_rate=50.0)
    found = imu.calibrate(session.block, Table.from_mapping(session.table), gyroscope_model='bias+matrix+gyro_bias_drift',
                          model_as_asked=True).calibration
    part = found.model.slices['gyroscope', 'gyro_bias_drift']
    assert np.all(found.sd[part] < 0.05 * np.abs(true))
    # Means of windows of a third of the time constant bend the exponential by a hundredth.
    assert np.all(np.abs(found.values[part] - true) < 4 * found.sd[part] + 0.02 * np.abs(true))


@pytest.mark.parametrize('constant', [60.0])
def test_by_hand_a_requested_warm_up_has_its_time_constant(constant):
    """The iteration left the prior for thousands of seconds, with amplitudes of the wrong sign."""
    samples, *_ = hold_and_turn(21, n_poses=24, rate_hz=50.0)
    time, amplitudes = 1e-9 * (samples.stamp_ns - samples.stamp_ns[0]), np.array([0.01, -0.02, 0.015])
    samples = replace(samples, rate_s=samples.rate_s - np.outer(np.expm1(-time / constant), amplitudes))
    found = imu.calibrate(SampleBlock(samples), gravity=9.81, gyroscope_model='bias+matrix+gyro_bias_drift', model_as_asked=True).calibration
    part = found.model.slices['gyroscope', 'gyro_bias_drift']
    assert np.all(np.abs(found.values[part] - [*amplitudes, constant]) < 4 * found.sd[part]) and found.sd[part][-1] < 0.1 * constant
