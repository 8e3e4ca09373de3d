"""
A sensor that the calibration does not help is not corrected, and the other one is.

On a vertical shaft gravity acts along one axis of the accelerometer.
"""

from dataclasses import replace

import numpy as np
import pytest

import imu_calibration as imu
from imu_calibration.cli.main import main
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock
from imu_calibration.document import files, trust
from imu_calibration.document.calibration import with_nominal
from imu_calibration.document.calibration_text import calibration_from_text, calibration_to_text
from imu_calibration.document.decision import HARMS as HARMFUL
from imu_calibration.document.decision import HELPS, UNPROVEN, decisions_text
from imu_calibration.document.exports.export import export, find_target
from imu_calibration.document.proof_entry import ProofEntry
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.kinematics.table import Table
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session

from worlds.compensation_cases import random_calibration
from worlds.misfit_worlds import SHAFT, sweeps
from worlds.physics import make_session

VERTICAL = SHAFT | {'joints': [{'name': 'shaft', 'axis': [0, 0, 1]}], 'up': [0, 0, 1]}
PROOF = {
    'accelerometer': ProofEntry(0.2, 0.01, (0.03, 0.08), unit='m/s^2', windows=8),
    'gyroscope': ProofEntry(0.02, 0.001, (0.03, 0.08), unit='rad/s', windows=8),
}
HARMS = {'after': 0.3, 'ci95': (1.2, 1.8)}
GOOD = random_calibration(1, proof=PROOF)


@pytest.fixture(scope='module')
def block():
    """
    A session on a vertical shaft, of an IMU with a gyroscope that is off.

    Its accelerometer is as its data sheet has it, and its gyroscope is not.
    """
    session = make_session(
        7,
        table=VERTICAL,
        profile=sweeps(seconds=50.0),
        noise='realistic',
        imu_rate=50.0,
        joint_rate=50.0,
    )
    triad = session.truth['accelerometer']
    force = (session.imu.force_s - triad.bias) @ np.linalg.inv(triad.matrix).T
    return SampleBlock(replace(session.imu, force_s=force), session.joints)


@pytest.fixture(scope='module')
def yaw(block):
    return imu.calibrate(block, Table.from_mapping(VERTICAL))


def harmed(sensor, **changes):
    """A calibration that is good but for the proof of one sensor."""
    return replace(GOOD, proof=PROOF | {sensor: replace(PROOF[sensor], **HARMS)}, **changes)


@pytest.mark.parametrize(
    ('sensor', 'other'), (('accelerometer', 'gyroscope'), ('gyroscope', 'accelerometer'))
)
def test_the_proof_of_one_sensor_decides_on_it_alone(sensor, other):
    decisions = harmed(sensor).decisions
    assert decisions[sensor] is not HELPS and decisions[other] is HELPS


def test_each_sensor_has_its_own_decision(yaw):
    """The accelerometer, whose errors are below what one attitude shows, is not helped."""
    calibration = yaw.calibration
    assert (
        calibration.decisions['gyroscope'] is HELPS
        and calibration.decisions['accelerometer'] is not HELPS
        and yaw.exit_code == 3
    )
    read = calibration_from_text(calibration_to_text(calibration))
    assert read.decisions == calibration.decisions
    for text in (str(yaw), yaw.report, repr(read)):
        assert decisions_text(read.decisions) in text.replace('Accelerometer', 'accelerometer')


def test_compensate_corrects_the_one_and_leaves_the_other(yaw, block, tmp_path, capsys):
    known = replace(yaw.calibration, decision={'accelerometer': 'harms', 'gyroscope': 'helps'})
    values = known.values.copy()
    values[known.model.part('accelerometer', Role.OFFSET)] = 0.1
    known = replace(known, values=values)
    before, after, whole = (
        block.imu,
        imu.compensate(block, known),
        imu.compensate(block, known, anyway=True),
    )
    np.testing.assert_array_equal(after.imu.force_s, before.force_s)
    np.testing.assert_allclose(after.imu.rate_s, whole.imu.rate_s, rtol=0, atol=1e-12)
    assert (
        np.abs(after.imu.rate_s - before.rate_s).max() > 1e-3
        and np.abs(whole.imu.force_s - before.force_s).max() > 1e-4
    )
    assert after.refused.keys() == {'accelerometer'} and after.refused['accelerometer'].startswith(
        HARMFUL
    )
    assert after.refused['accelerometer'] in after.warnings[0]
    assert not whole.refused and len(whole.cautions) == 1 and whole.exit_code == 3
    write_session(tmp_path / 'bag', block.imu, block.joints)
    files.write_text(tmp_path / 'calibration.yaml', calibration_to_text(known))
    assert (
        main(
            [
                'compensate',
                str(tmp_path / 'bag'),
                '--calibration',
                str(tmp_path / 'calibration.yaml'),
                '--output',
                str(tmp_path / 'out'),
            ]
        )
        == 3
    )
    printed = capsys.readouterr().out
    assert printed.count(after.refused['accelerometer']) == 1 and str(tmp_path / 'out') in printed


def test_other_programs_get_nominal_numbers_for_the_sensor_that_is_refused(tmp_path, capsys):
    known = harmed('accelerometer')
    whole, found = (export(known, find_target('px4'), anyway=anyway) for anyway in (True, False))
    plain = export(with_nominal(known, ['accelerometer']), find_target('px4'), anyway=True)
    assert (
        found.numbers == plain.numbers != whole.numbers
        and found.numbers.keys() == whole.numbers.keys()
    )
    assert (
        found.refused.keys() == {'accelerometer'}
        and any(found.refused['accelerometer'] in line for line in found.lines)
        and found.exit_code == whole.exit_code == 3
        and len(whole.reasons) == 1
    )
    files.write_text(tmp_path / 'calibration.yaml', calibration_to_text(known))
    command = [
        'export',
        str(tmp_path / 'calibration.yaml'),
        '--to',
        'px4',
        '--output',
        str(tmp_path / 'px4.params'),
    ]
    assert main(command) == 3
    printed = capsys.readouterr().out
    assert (
        all(line in printed for line in found.lines)
        and main([*command, '--anyway', '--force']) == 3
    )


def test_the_loss_of_a_refused_sensor_is_its_whole_error():
    """
    It was reported as none, because the full compensation of nominal parameters changes nothing.
    """
    known = harmed('accelerometer')
    whole, found = (export(known, find_target('px4'), anyway=anyway) for anyway in (True, False))
    assert found.loss.remaining['accelerometer'] == pytest.approx(
        found.loss.raw['accelerometer'], rel=1e-9
    )
    assert (
        found.loss.raw['accelerometer'] == pytest.approx(whole.loss.raw['accelerometer'], rel=1e-9)
        and whole.loss.raw['accelerometer'] > 1e-3
    )
    assert (
        found.loss.remaining['gyroscope']
        == pytest.approx(whole.loss.remaining['gyroscope'], rel=1e-9)
        and not found.loss.nothing
    )


def test_what_the_refused_sensor_would_correct_goes_as_well():
    rich = random_calibration(
        2, ('accel_size_effect', 'accel_quadratic'), ('gyro_g_sensitivity', 'gyro_quadratic')
    )
    still, blind = (with_nominal(rich, [sensor]).model for sensor in SENSORS)
    assert still.accelerometer == ('bias', 'matrix') and still.gyroscope == (
        'bias',
        'matrix',
        'gyro_quadratic',
    )
    assert blind.accelerometer == ('bias', 'matrix', 'accel_quadratic') and blind.gyroscope == (
        'bias',
        'matrix',
    )


def test_the_covariance_of_what_is_left_alone_is_that_of_a_data_sheet():
    found = with_nominal(GOOD, ['accelerometer'])
    for role in (Role.OFFSET, Role.LINEAR):
        effect, part = (
            found.model.find('accelerometer', role),
            found.model.part('accelerometer', role),
        )
        np.testing.assert_array_equal(found.values[part], effect.prior_values())
        np.testing.assert_allclose(found.sd[part], effect.prior_sds())
        assert (
            set(found.status[part]) == {'held'}
            and not np.delete(found.covariance[part], np.r_[part], axis=1).any()
        )
        kept, was = found.model.part('gyroscope', role), GOOD.model.part('gyroscope', role)
        np.testing.assert_array_equal(found.covariance[kept, kept], GOOD.covariance[was, was])


def test_check_says_which_sensor_it_helps(yaw, block):
    values = yaw.calibration.values.copy()
    values[yaw.calibration.model.part('accelerometer', Role.OFFSET)] += 0.1
    found = imu.check(block, replace(yaw.calibration, values=values), Table.from_mapping(VERTICAL))
    assert list(found.helped) == ['gyroscope'] and found.exit_code == 3
    first, *lines = str(found).splitlines()
    assert (
        'gyroscope' in first
        and 'accelerometer' not in first
        and any('gyroscope' in line and HELPS in line for line in lines)
    )


@pytest.mark.long
@pytest.mark.real_data
def test_a_part_of_a_yaw_recording_helps_the_gyroscope_on_another_part(recordings):
    """
    A vertical shaft.

    The accelerometer, unproven at other attitudes, doubled its error with a free matrix and reduces
    it with a fixed one.
    """
    folder = recordings / 'shaft_yaw_slow_later'
    table = files.read_table(folder / 'table.yaml')
    with open_recording(folder) as recording:
        blocks = list(recording.blocks(table.joint_names))
    whole = [
        kind.concatenate([part for block in blocks if (part := getattr(block, name)) is not None])
        for kind, name in ((ImuSamples, 'imu'), (JointSamples, 'joints'))
    ]
    middle = int(whole[0].stamp_ns[len(whole[0]) // 2])

    def part(start_s, end_s):
        """Return the samples between two times from the middle."""
        seconds = [1e-9 * (each.stamp_ns - middle) for each in whole]
        return SampleBlock(
            *(each.select((t >= start_s) & (t < end_s)) for each, t in zip(whole, seconds))
        )

    # The bandwidth is not significant in 130 s: the error is then 0.67 of that before.
    first, second = part(-160.0, 0.0), part(0.0, 80.0)
    found = imu.calibrate(first, table, candidates='gyro_bandwidth+time_offset')
    assert (
        found.calibration.decisions['gyroscope'] is HELPS
        and found.calibration.decisions['accelerometer'] is UNPROVEN
        and found.exit_code == 3
    )
    used = trust.usable(
        replace(found.calibration, decision={'accelerometer': 'harms', 'gyroscope': 'helps'})
    )
    here = imu.check(second, found.calibration, table)
    assert (
        list(here.helped) == ['accelerometer', 'gyroscope']
        and here.proof['gyroscope'].after < 0.6 * here.proof['gyroscope'].before
    )
    left = imu.check(second, used.calibration, table).proof
    assert left['accelerometer'].after == pytest.approx(left['accelerometer'].before, rel=0.02)
    assert left['gyroscope'].after == pytest.approx(here.proof['gyroscope'].after, rel=0.02)
