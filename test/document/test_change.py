"""The error of a calibration now against the error on the day it was made."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.core.errors import InputError
from imu_calibration.document.change import changes_since
from imu_calibration.document.proof_entry import ProofEntry, RegimeErrors
from imu_calibration.kinematics.table import Table

from worlds.physics import make_session


def proof(unit='m/s^2', **regimes):
    """Return a proof of one sensor: regime -> (after, low, high of after / before)."""
    errors = {
        name: RegimeErrors(1.0, after, (low, high), unit=unit)
        for name, (after, low, high) in regimes.items()
    }
    return {'accelerometer': ProofEntry(1.0, 0.5, (0.4, 0.6), unit=unit, regimes=errors)}


def test_the_interval_of_a_change_has_the_spread_of_both_errors():
    """ln 4 / 3.92 and ln 9 / 3.92 are the sds of the logarithms."""
    stored = proof(rest=(0.001, 0.1, 0.4), fast=(0.002, 0.1, 0.2))
    (found,) = changes_since(stored, proof(rest=(0.005, 0.1, 0.9), slow=(0.001, 0.1, 0.2)))
    spread = np.exp(0.5 * np.hypot(np.log(4.0), np.log(9.0)))
    assert found.regime == 'rest' and found.factor == pytest.approx(5.0)
    assert (found.low, found.high) == pytest.approx((5.0 / spread, 5.0 * spread))
    assert found.exceeds(1.0) and not found.exceeds(1.8)
    assert not changes_since(stored, proof('rad', rest=(0.005, 0.1, 0.9)))


@pytest.mark.long
def test_check_gives_3_when_the_error_has_changed_even_if_it_still_helps():
    """The error in the file is a fifth of that of the recording, but the raw error is larger."""
    session = make_session(
        3, profile='quick', noise='realistic', grade='industrial', imu_rate=50.0, joint_rate=50.0
    )
    table = Table.from_mapping(session.table)
    block = session.block
    calibration = calibrate_recordings(block, table, model_as_asked=True).calibration
    same = check_recording(block, calibration, table)
    assert same.exit_code == 0 and same.changes and not same.changed
    assert all(each.factor == pytest.approx(1.0, abs=0.15) for each in same.changes)
    better = {
        sensor: replace(
            entry,
            regimes={
                name: replace(part, after=part.after / 5.0) for name, part in entry.regimes.items()
            },
        )
        for sensor, entry in calibration.proof.items()
    }
    changed = check_recording(block, replace(calibration, proof=better), table)
    assert changed.exit_code == 3 and changed.helps and len(changed.reasons) == 2
    assert {each.sensor for each in changed.changed} == {'accelerometer', 'gyroscope'}
    assert (
        check_recording(block, replace(calibration, proof=better), table, change=20.0).exit_code
        == 0
    )
    with refused(InputError, 'change_limit', 0.5):
        check_recording(block, calibration, table, change=0.5)
