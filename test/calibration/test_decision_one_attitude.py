"""
A vertical shaft has one attitude.

Parameters that it does not separate are fixed, and other attitudes are unproven.
"""

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.decision import UNPROVEN, decide, reason_of
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.effects.base import Role
from imu_calibration.estimation.solution import HELD
from imu_calibration.kinematics.table import Table

from worlds.misfit_worlds import SHAFT, make_pair

VERTICAL = {**SHAFT, 'joints': [{'name': 'shaft', 'axis': [0, 0, 1]}], 'up': [0, 0, 1]}


@pytest.fixture(scope='module')
def vertical():
    """Return two sessions of a shaft with motor ripple and the calibration of the first."""
    pair = make_pair(
        'motor_ripple', 3, table=VERTICAL, profile='sweeps', imu_rate=50.0, joint_rate=50.0
    )
    return pair, calibrate_recordings(
        pair.first.block, Table.from_mapping(pair.table), model_as_asked=True
    ).calibration


def test_matrix_and_size_effect_are_fixed_and_bias_and_common_arm_are_estimated(vertical):
    calibration = vertical[1]
    for role, nominal in ((Role.LINEAR, np.eye(3).ravel()), (Role.ARMS, np.zeros(9))):
        part = calibration.model.part('accelerometer', role)
        assert set(calibration.status[part]) == {HELD} and np.array_equal(
            calibration.values[part], nominal
        )
    statuses = calibration.status[calibration.model.part('accelerometer', Role.OFFSET)]
    assert set(statuses) != {HELD}
    arm = calibration.status[calibration.model.part('accelerometer', Role.ARM)]
    assert len(arm) == 3 and set(arm) != {HELD}, (
        'without the arm, centripetal acceleration would be a bias'
    )


def test_a_calibration_of_one_attitude_is_unproven_for_others_and_applies_to_the_same_one(vertical):
    pair, calibration = vertical
    assert calibration.decisions['accelerometer'] is UNPROVEN
    assert calibration.decisions['gyroscope'] is not UNPROVEN
    assert 'the same attitude' in calibration.decision_reasons['accelerometer']
    again = calibration_from_text(calibration_to_text(calibration))
    assert (
        again.proof['accelerometer'].one_attitude is True
        and again.decisions == calibration.decisions
    )
    gravity = np.array([0.0, 0.0, pair.second.truth['gravity']])
    raw, corrected = (
        np.linalg.norm(imu.force_s.mean(axis=0) - gravity)
        for imu in (pair.second.imu, calibration.compensate(pair.second.imu))
    )
    assert corrected < 0.05 * raw


def test_check_on_the_same_attitude_reports_the_error_of_that_recording(vertical):
    pair, calibration = vertical
    proof = check_recording(pair.second.block, calibration, Table.from_mapping(pair.table)).proof
    assert not proof['accelerometer'].one_attitude


def test_one_attitude_is_never_called_harmful():
    entry = ProofEntry(0.01, 0.03, (2.9, 3.2), unit='m/s^2', windows=24, one_attitude=True)
    assert decide(entry) is UNPROVEN and 'the same attitude' in reason_of(entry)


def test_a_horizontal_shaft_has_many_attitudes():
    pair = make_pair(None, 3, table='shaft', profile='sweeps', imu_rate=50.0, joint_rate=50.0)
    calibration = calibrate_recordings(
        pair.first.block, Table.from_mapping(pair.table), model_as_asked=True
    ).calibration
    assert not calibration.proof['accelerometer'].one_attitude
    assert set(calibration.status[calibration.model.part('accelerometer', Role.LINEAR)]) != {HELD}


@pytest.mark.real_data
def test_a_vertical_motor_shaft_gives_no_size_effect_of_centimetres(recordings):
    """It was -29 mm on a chip of 4 mm."""
    folder = recordings / 'shaft_yaw_slow_later'
    calibration = calibrate_recordings(
        folder, folder / 'table.yaml', model_as_asked=True
    ).calibration
    assert not calibration.values[calibration.model.part('accelerometer', Role.ARMS)].any()
    assert calibration.decisions['accelerometer'] is UNPROVEN
