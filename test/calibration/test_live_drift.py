"""A requested warm-up during the motion starts from the same time constants as from a recording, and has the same proof."""

import numpy as np

import imu_calibration as imu
from imu_calibration.calibration.live import LiveCalibration
from imu_calibration.kinematics.table import Table
from imu_calibration.references.options import CalibrationOptions

from worlds.physics import make_session


def test_a_requested_warm_up_of_15_s_is_that_of_the_recording():
    session = make_session(21, {'gyro_bias_drift': np.array([0.01, -0.02, 0.015, 15.0])}, profile='quick', noise='realistic')
    table, asked = Table.from_mapping(session.table), 'bias+matrix+gyro_bias_drift'
    live = LiveCalibration(table, CalibrationOptions(gyroscope_model=asked, as_asked=True))
    live.push(session.block)
    found = live.solve(pending=True).calibration
    expected = imu.calibrate(session.block, table, gyroscope_model=asked, model_as_asked=True).calibration
    assert found.param_names == expected.param_names
    assert np.all(np.abs(found.values - expected.values) <= 1e-6 * expected.sd)
    assert found.values[found.param_names.index('gyroscope.gyro_bias_drift.time_constant')] < 17.0
    assert found.proof['gyroscope']['windows'] == expected.proof['gyroscope']['windows']
