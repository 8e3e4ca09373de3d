"""An accelerometer without a gyroscope, or the reverse, on a table: calibrated by itself."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.api.compensate import compensate_recording
from imu_calibration.api.diagnose import diagnose
from imu_calibration.api.inspect import inspect_recording
from imu_calibration.api.recordings import Topics
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.exports.export import export, find_target
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.live_windows import LiveCalibration
from imu_calibration.references.turntable.table_reference import TableReference
from imu_calibration.report.calibration_sections import calibration_report
from msg_adapters.csv_log import read_csv

from worlds.physics import make_session

READINGS = {'accelerometer': 'force_s', 'gyroscope': 'rate_s'}
N_PARAMETERS = {'accelerometer': 21, 'gyroscope': 12}
"""Bias and matrix; sensitive points of the accelerometers."""
FEW = (
    'accel_size_effect+lever_arm+accel_quadratic+accel_bandwidth+gyro_g_sensitivity+'
    'gyro_bandwidth+table_tilt+time_offset'
)


def alone(sensor, seed=9420, value=np.nan, **options):
    """Return (session, block) of a session with the readings of one sensor."""
    options = {'imu_rate': 50.0, 'joint_rate': 50.0, 'arms': True} | options
    session = make_session(seed, profile='quick', noise='realistic', **options)
    (other,) = set(READINGS) - {sensor}
    column = READINGS[other]
    gone = np.full_like(getattr(session.imu, column), value)
    imu = replace(session.imu, **{column: gone})
    return session, SampleBlock(imu, session.joints, session.temperature)


def calibrated(sensor, session, block, **choices):
    choices.setdefault('model_as_asked', True)
    return calibrate_recordings(
        [block], Table.from_mapping(session.table), **choices, candidates=FEW
    )


@cache
def calibrated_alone(sensor):
    """Return (session, block, result) of a session with the readings of one sensor."""
    session, block = alone(sensor)
    return session, block, calibrated(sensor, session, block)


def errors_in_sd(sensor, session, calibration):
    """Return the errors of bias and matrix in standard deviations, shape (12,)."""
    true = session.truth[sensor]
    truth = np.concatenate([true.bias, true.matrix.ravel()])
    at = [k for k, name in enumerate(calibration.param_names) if name.startswith(sensor)][:12]
    return (calibration.values[at] - truth) / calibration.sd[at]


@pytest.mark.long
@pytest.mark.parametrize('sensor', READINGS)
@pytest.mark.parametrize('value', [np.nan, 0.0], ids=['absent', 'zeros'])
def test_it_is_calibrated_checked_and_applied(sensor, value):
    if np.isnan(value):
        session, block, result = calibrated_alone(sensor)
    else:
        session, block = alone(sensor, value=value)
        result = calibrated(sensor, session, block)
    calibration = result.calibration
    (other,) = set(READINGS) - {sensor}
    assert calibration.absent == (other,)
    assert calibration.decisions == {sensor: 'helps'}
    assert len(calibration.requested) == N_PARAMETERS[sensor]
    assert set(calibration.requested.values()) == {'determined'}
    assert list(calibration.proof) == [sensor]
    assert other not in calibration.statistics
    # Readings that cannot be used are a reason; a sensor that is not there is none.
    is_dead = value == 0.0
    assert (other in calibration.statistics.get('unusable_sensors', {})) == is_dead
    assert result.exit_code == (3 if is_dead else 0)
    # 12 values: chi-square beyond 48 has a chance of 3e-6.
    assert np.sqrt(np.mean(errors_in_sd(sensor, session, calibration) ** 2)) < 2.0

    # The check measures the error that the proof states: both as compensation applies it.
    table = Table.from_mapping(session.table)
    checked = check_recording(block, calibration, table)
    assert list(checked.proof) == [sensor]
    assert checked.exit_code == 0
    proof = calibration.proof[sensor]
    assert checked.proof[sensor].after == pytest.approx(proof.after, rel=0.05)
    corrected = compensate_recording(block, calibration).imu
    assert np.isfinite(getattr(corrected, READINGS[sensor])).all()
    if not is_dead:
        assert np.isnan(getattr(corrected, READINGS[other])).all()


def test_the_document_and_the_report_keep_what_is_absent():
    result = calibrated_alone('accelerometer')[2]
    read = calibration_from_text(calibration_to_text(result.calibration))
    assert read.absent == ('gyroscope',)
    assert read.decisions == result.calibration.decisions
    report = calibration_report(result.result)
    assert 'accelerometer' in report
    # What compensation cannot do without rates is stated, by the name of the effect.
    (note,) = [line for line in read.notes if 'gyroscope' in line]
    assert 'accel_size_effect' in note


@pytest.mark.parametrize(
    ('sensor', 'hidden'),
    [('accelerometer', 'accel_quadratic'), ('gyroscope', 'gyro_g_sensitivity')],
)
def test_its_effects_are_found(sensor, hidden):
    session, block = alone(sensor, seed=9422, hidden={hidden: None})
    found = calibrated(sensor, session, block, model_as_asked=False)
    assert found.calibration.statistics['added'] == [hidden]
    session, block = alone(sensor, seed=9423)
    nothing = calibrated(sensor, session, block, model_as_asked=False)
    assert not nothing.calibration.statistics.get('added')
    assert not nothing.calibration.statistics.get('unexplained')


@pytest.mark.parametrize('sensor', READINGS)
def test_live_is_as_from_the_recording(sensor):
    session, block = alone(sensor)
    table = Table.from_mapping(session.table)
    live = LiveCalibration(table)
    windows = []
    for start in range(0, len(block.imu), 500):
        part = slice(start, start + 500)
        span = block.imu.stamp_ns[part][[0, -1]]
        joints = block.joints.select(
            (block.joints.stamp_ns >= span[0]) & (block.joints.stamp_ns <= span[1] + 10**7)
        )
        windows += live.push(SampleBlock(block.imu.select(part), joints))
    result = live.solve(pending=True)
    calibration = result.calibration
    assert list(calibration.decisions) == [sensor]
    assert {state.sensor for state in live.groups()} <= {sensor, 'reference'}
    assert np.sqrt(np.mean(errors_in_sd(sensor, session, calibration) ** 2)) < 2.0
    residuals = live.residuals(windows[-3:])
    (other,) = set(READINGS) - {sensor}
    assert np.isnan(getattr(residuals, READINGS[other])).all()
    assert np.isfinite(getattr(residuals, READINGS[sensor])).all()
    assert live.coverage() is not None
    resumed = LiveCalibration(table, saved=live.saved(pending=True)).gathered()
    assert resumed.absent == (other,)


def test_it_is_inspected():
    session, block = alone('gyroscope')
    table = Table.from_mapping(session.table)
    (look,) = inspect_recording(
        block, [Topics()], TableReference(table), options=CalibrationOptions(as_asked=True)
    )
    assert not look.refused
    assert [finding.check for finding in look.findings if finding.check == 'absent'] == ['absent']


def test_recordings_of_other_sensors_are_not_joined():
    session, block = alone('gyroscope')
    with refused(InputError, 'other_sensors'):
        calibrate_recordings(
            [block, session.block], Table.from_mapping(session.table), model_as_asked=True
        )


def test_it_is_diagnosed():
    session, block = alone('gyroscope', seed=9422, hidden={'gyro_g_sensitivity': None})
    found = diagnose(block, Table.from_mapping(session.table), candidates=FEW)
    assert [each.effect for each in found.findings] == ['gyro_g_sensitivity']
    assert list(found.document['unexplained']) == ['gyroscope']


@pytest.mark.parametrize('name', ['px4', 'ardupilot'])
def test_an_export_leaves_the_other_sensor_as_it_is(name):
    calibration = calibrated_alone('accelerometer')[2].calibration
    stated = replace(calibration, readings=replace(calibration.readings, axes='flu'))
    found = export(stated, find_target(name))
    lines = [line for line in found.content.decode().splitlines() if not line.startswith('#')]
    assert any('ACC' in line for line in lines)
    assert not any('GYR' in line for line in lines)


def test_a_text_log_with_one_sensor_and_joints_in_degrees(tmp_path):
    """The accelerometer in mg: calibrated, and corrected into a log with the same columns."""
    session, block = alone('accelerometer', seed=10298)
    degrees = np.degrees(session.joints.position)
    columns = [
        (session.imu.stamp_ns - session.imu.stamp_ns[0]) * 1e-6,
        *(session.imu.force_s.T / STANDARD_GRAVITY * 1e3),
    ]
    table = Table.from_mapping(session.table)
    for angles in degrees.T:
        columns.append(np.interp(session.imu.stamp_ns, session.joints.stamp_ns, angles))
    names = ['t_ms', 'ax_mg', 'ay_mg', 'az_mg', *(f'joint_{n} (deg)' for n in table.joint_names)]
    log, output = tmp_path / 'log.csv', tmp_path / 'corrected.csv'
    np.savetxt(log, np.column_stack(columns), '%.8f', ';', header=';'.join(names), comments='')
    calibration = calibrated('accelerometer', session, log).calibration
    assert calibration.absent == ('gyroscope',)
    assert np.sqrt(np.mean(errors_in_sd('accelerometer', session, calibration) ** 2)) < 2.0
    compensate_recording(log, calibration, output=output)
    written = read_csv(output)
    expected = compensate_recording(block, calibration).imu.force_s
    np.testing.assert_allclose(written.imu.force_s, expected, atol=1e-6)
    assert len(output.read_text().split('\n', 1)[0].split(';')) == len(names)
