"""
A recording with rests of which no static window is used gets a warning.

Sds of biases then come from motion alone.
"""

import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.document.decision import WARNING
from imu_calibration.kinematics.table import Table

from worlds.physics import make_session


@pytest.fixture(scope='module')
def session():
    """Return a session with 18 rests."""
    return make_session(20, profile='quick', noise='realistic', imu_rate=50.0, joint_rate=50.0)


def calibrated(session, minimum):
    return calibrate_recordings(
        session.block,
        Table.from_mapping(session.table),
        setting={'static_minimum': minimum},
        model_as_asked=True,
    ).calibration


def unused_rests(calibration):
    return [
        reason
        for reason in calibration.judgement.reasons
        if reason.word is WARNING and reason.key == 'setting'
    ]


def test_a_static_minimum_that_removes_all_rests_is_reported_with_the_number_of_samples(session):
    calibration = calibrated(session, 30.0)
    assert 'static' not in calibration.statistics['windows']
    (warning,) = unused_rests(calibration)
    count = calibration.statistics['stream']['rest too short']
    assert count > 500 and str(count) in warning.what and 'static_minimum' in warning.next


def test_rests_that_are_used_are_no_warning(session):
    calibration = calibrated(session, 1.0)
    assert calibration.statistics['windows']['static'] > 10 and not unused_rests(calibration)
