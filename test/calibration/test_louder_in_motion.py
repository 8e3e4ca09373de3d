"""Noise that is larger in motion is no error of the model."""

import imu_calibration as imu
from imu_calibration.document.verdict import NOTED_MISFIT, misfit_ratios, motion_misfits
from imu_calibration.kinematics.table import Table

from worlds.moments import LouderInMotion
from worlds.physics import make_session


def test_noise_that_is_larger_in_motion_is_no_error_of_the_model():
    session = make_session(
        8, None, 'white', cause=LouderInMotion(4e-3), imu_rate=50.0, joint_rate=50.0
    )
    result = imu.calibrate(
        session.block,
        Table.from_mapping(session.table),
        accelerometer_model='bias+matrix',
        gyroscope_model='bias+matrix',
    )
    assert max(misfit_ratios(result.calibration.statistics, 'gyroscope').values()) > NOTED_MISFIT
    found = motion_misfits(result.calibration)
    assert found
    assert {(reason.key, reason.sensors) for reason in found} == {(None, ('gyroscope',))}
