"""
A warm-up that the user requests converges from the prior time constant of 300 s.

It converges live as from a recording.
"""

from dataclasses import replace

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.samples import SampleBlock
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.live_windows import LiveCalibration

from worlds.physics import make_session
from worlds.physics_hand import hold_and_turn

pytestmark = pytest.mark.long
MODEL = 'bias+matrix+gyro_bias_drift'
TRUE = np.array([0.01, -0.02, 0.015, 15.0])


@pytest.fixture(scope='module')
def session():
    return make_session(
        21,
        {'gyro_bias_drift': TRUE},
        profile='six_faces',
        noise='realistic',
        imu_rate=50.0,
        joint_rate=50.0,
    )


@pytest.fixture(scope='module')
def calibration(session):
    return imu.calibrate(
        session.block, Table.from_mapping(session.table), gyroscope_model=MODEL, model_as_asked=True
    ).calibration


def test_a_requested_warm_up_has_its_time_constant(calibration):
    """
    The iteration stayed at 300 s, with amplitudes of twice the truth and an sd of ten times them.
    """
    part = calibration.model.slices['gyroscope', 'gyro_bias_drift']
    assert np.all(calibration.sd[part] < 0.05 * np.abs(TRUE))
    # Means of windows of a third of the time constant bend the exponential by a hundredth.
    assert np.all(
        np.abs(calibration.values[part] - TRUE) < 4 * calibration.sd[part] + 0.02 * np.abs(TRUE)
    )


def test_live_a_requested_warm_up_is_that_of_the_recording(session, calibration):
    live = LiveCalibration(
        Table.from_mapping(session.table), CalibrationOptions(gyroscope_model=MODEL, as_asked=True)
    )
    live.push(session.block)
    found = live.solve(pending=True).calibration
    assert found.param_names == calibration.param_names
    assert np.all(np.abs(found.values - calibration.values) <= 1e-6 * calibration.sd)
    assert found.proof['gyroscope'].windows == calibration.proof['gyroscope'].windows


@pytest.mark.parametrize('constant', [60.0])
def test_by_hand_a_requested_warm_up_has_its_time_constant(constant):
    """The iteration left the prior for thousands of seconds, with amplitudes of the wrong sign."""
    samples, *_ = hold_and_turn(21, n_poses=16, rate_hz=50.0)
    time, amplitudes = (
        1e-9 * (samples.stamp_ns - samples.stamp_ns[0]),
        np.array([0.01, -0.02, 0.015]),
    )
    samples = replace(
        samples, rate_s=samples.rate_s - np.outer(np.expm1(-time / constant), amplitudes)
    )
    found = imu.calibrate(
        SampleBlock(samples), gravity=9.81, gyroscope_model=MODEL, model_as_asked=True
    ).calibration
    part = found.model.slices['gyroscope', 'gyro_bias_drift']
    assert (
        np.all(np.abs(found.values[part] - [*amplitudes, constant]) < 4 * found.sd[part])
        and found.sd[part][-1] < 0.1 * constant
    )
