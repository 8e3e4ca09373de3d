"""Noise that is larger in motion is no error of the model."""

import imu_calibration as imu
from imu_calibration.document.verdict import NOTED_MISFIT, misfit_ratios, motion_misfits
from imu_calibration.kinematics.table import Table

from worlds.candidates import FEW
from worlds.moments import LouderInMotion, LouderWithSpeed
from worlds.physics import make_session

QUICK = {'profile': 'quick', 'imu_rate': 50.0, 'joint_rate': 50.0}


def test_noise_that_is_larger_in_motion_is_no_error_of_the_model():
    session = make_session(8, None, 'white', cause=LouderInMotion(4e-3), **QUICK)
    result = imu.calibrate(
        session.block,
        Table.from_mapping(session.table),
        accelerometer_model='bias+matrix',
        gyroscope_model='bias+matrix',
        candidates=FEW,
    )
    assert max(misfit_ratios(result.calibration.statistics, 'gyroscope').values()) > NOTED_MISFIT
    found = motion_misfits(result.calibration)
    assert found
    assert {(reason.key, reason.sensors) for reason in found} == {(None, ('gyroscope',))}


def test_noise_that_grows_with_the_speed_is_no_unexplained_residual():
    # It was a place ("while the speed is 56 deg/s or more"), and effects were not applied.
    cause = LouderWithSpeed((0.02, 2.6e-3))
    session = make_session(9242, None, 'white', cause=cause, **QUICK)
    result = imu.calibrate(session.block, Table.from_mapping(session.table), candidates=FEW)
    assert 'unexplained' not in result.calibration.statistics
    assert max(misfit_ratios(result.calibration.statistics, 'gyroscope').values()) > 1.5
    assert {reason.key for reason in motion_misfits(result.calibration)} == {None}
