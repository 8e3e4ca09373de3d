"""`inspect` on a table fits a delay and zeros of encoders, or reports a residual unlike noise."""

import re
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.inspect import inspect_recording
from imu_calibration.api.recordings import Topics
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.cli.show import warn
from imu_calibration.core.samples import SampleBlock
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import DETERMINED
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import NOTE
from imu_calibration.references.turntable.table_reference import TableReference
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import (
    SimulationOptions,
    random_values,
    simulate_session,
)

from worlds.calibrated import calibrated_on_table
from worlds.candidates import FEW
from worlds.tables import joints_about

TIMES_AND_ZEROS = 'accel_quadratic+gyro_bandwidth+time_offset+encoder_zero'
OPTIONS = CalibrationOptions(catalogue=CATALOGUE.with_candidates(TIMES_AND_ZEROS))
MORE = CalibrationOptions(catalogue=CATALOGUE.with_candidates(f'{FEW}+encoder_zero'))
TABLE = Table.from_mapping(
    {
        'joints': joints_about('zxy'),
        'gravity': 9.81,
    }
)


@pytest.fixture(scope='module')
def session():
    """Return two minutes on the table."""
    model = SensorModel(joint_names=TABLE.joint_names)
    return SampleBlock(
        *simulate_session(
            model,
            random_values(model, seed=4),
            TABLE,
            profile=make_profile('quick', 3, TABLE),
            options=SimulationOptions(50.0, 50.0),
            seed=9,
        )
    )


def inspected(block, options=OPTIONS):
    """Return the summary of a recording on the table."""
    (summary,) = inspect_recording(block, [Topics()], TableReference(TABLE), options=options)
    return summary


def named(summary):
    """Return check -> text of the findings about the table and the residual."""
    checks = ('time_offset', 'encoder_zero', 'residual')
    return {each.check: each.text for each in summary.findings if each.check in checks}


def fitted(summary):
    """Return the values of the calibration by name."""
    calibration = summary.calibrated.calibration
    return dict(zip(calibration.param_names, calibration.values, strict=True))


def test_a_session_without_errors_has_no_finding(session):
    summary = inspected(session)
    assert named(summary) == {}
    assert not any('time_offset' in name for name in fitted(summary))


def test_a_delay_is_fitted_and_named_with_its_value(session, delay=-0.011):
    stamps = session.imu.stamp_ns + round(1e9 * delay)
    summary = inspected(replace(session, imu=replace(session.imu, stamp_ns=stamps)))
    assert list(named(summary)) == ['time_offset']
    assert f' {1e3 * abs(delay):.0f} +- ' in named(summary)['time_offset'].replace('.0 +-', ' +-')
    assert abs(fitted(summary)['reference.time_offset.offset'] - delay) < 1e-4
    status = summary.calibrated.calibration.status_by_name
    assert [name for name in status if 'matrix' in name and status[name] is not DETERMINED] == []


@pytest.mark.long
def test_a_zero_is_fitted_and_named_with_its_value(session):
    position = session.joints.position + np.radians([0.0, 0.7, 0.0])
    summary = inspected(replace(session, joints=replace(session.joints, position=position)))
    assert list(named(summary)) == ['encoder_zero']
    value = fitted(summary)['reference.encoder_zero.middle']
    assert abs(np.degrees(value) + 0.7) < 5e-3  # 0.5 % of it, several standard deviations


@pytest.mark.long
def test_another_cause_is_a_residual_that_is_not_noise(session):
    """The gyroscope reads 3 deg/s more about x above 20 deg/s about z."""
    rate = session.imu.rate_s.copy()
    rate[:, 0] += np.radians(3.0) * (np.abs(rate[:, 2]) > np.radians(20.0))
    summary = inspected(replace(session, imu=replace(session.imu, rate_s=rate)), MORE)
    assert 'residual' in named(summary)
    plain = inspected(
        replace(session, imu=replace(session.imu, rate_s=rate)), CalibrationOptions(as_asked=True)
    )
    assert named(plain) == {}


def test_a_small_zero_of_the_last_joint_is_a_note_with_its_size(session, capsys):
    """It exits with 0: the result is complete, and contains the turn."""
    position = session.joints.position + np.radians([0.0, 0.0, 0.9])
    block = replace(session, joints=replace(session.joints, position=position))
    found = calibrate_recordings([block], TABLE, model_as_asked=True)
    (note,) = [
        each for each in found.calibration.statistics['preflight'] if each['check'] == 'mount'
    ]
    assert note['severity'] == NOTE
    assert float(re.search(r'turn of ([\d.]+) deg', note['text'])[1]) == pytest.approx(0.9, abs=0.2)
    warn([note])
    assert capsys.readouterr().err == f'note: {note["text"]}\n'


@pytest.mark.long
def test_an_added_delay_gives_the_result_of_a_requested_one(session):
    """Levelling is not shrunk in one of them only: values within 0.05 standard deviations."""
    imu = replace(session.imu, stamp_ns=session.imu.stamp_ns + 6_000_000)
    block = replace(session, imu=imu)
    results = []
    for options in (
        replace(OPTIONS, added=(('reference', 'time_offset'),)),
        replace(OPTIONS, reference_model='table_tilt+earth_rate+time_offset'),
    ):
        found = calibrated_on_table([[block]], TABLE, options).calibration
        results.append({n: (v, sd) for n, v, sd in zip(found.param_names, found.values, found.sd)})
    added, requested = results
    assert added.keys() == requested.keys()
    for name, (value, sd) in requested.items():
        assert added[name][1] == pytest.approx(sd, rel=1e-3)
        assert abs(added[name][0] - value) <= 0.05 * sd
