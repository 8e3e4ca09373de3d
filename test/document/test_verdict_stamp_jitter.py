"""Scatter by the errors of stamps is no incomplete model."""

from dataclasses import replace

import pytest

import imu_calibration as imu
from imu_calibration.document.decision import WARNING
from imu_calibration.document.verdict import NOTED_MISFIT, misfit_ratios, motion_misfits
from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.table import Table

from worlds.candidates import FEW
from worlds.physics import make_session


def test_a_calibration_does_not_call_scatter_by_the_stamps_an_incomplete_model():
    session = make_session(6, None, 'realistic', grade='navigation', profile='quick')
    result = imu.calibrate(session.block, Table.from_mapping(session.table), candidates=FEW)
    entry = result.calibration.statistics['stamp_jitter']
    assert (
        entry['sd_s'] == pytest.approx(50e-6, rel=0.1)
        and entry['variance_ratio']['gyroscope']['spin'] > 100
    )
    assert max(misfit_ratios(result.calibration.statistics, 'gyroscope').values()) < NOTED_MISFIT
    assert not motion_misfits(result.calibration)
    without = replace(
        result.calibration,
        statistics={k: v for k, v in result.calibration.statistics.items() if k != 'stamp_jitter'},
    )
    # Scatter by the stamps is white: it is louder noise, with structure in time it is a misfit.
    assert {reason.key for reason in motion_misfits(without)} == {None}
    unjudged = {
        key: {k: v for k, v in part.items() if k != 'slow_over_fast'} if key in SENSORS else part
        for key, part in without.statistics.items()
    }
    found = motion_misfits(replace(without, statistics=unjudged))
    assert {reason.word for reason in found} >= {WARNING}
