"""``imu_calibration check``: does this file help on that recording?"""

from dataclasses import replace

import pytest
from refusal import refused

from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.cli.main import main
from imu_calibration.core.documents import to_text
from imu_calibration.core.errors import InputError
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.outcome import shortcomings
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.window_statistics import Regime
from imu_calibration.use_cases.calibrate import calibrate_recordings, check_recording

from worlds.misfit_worlds import make_pair
from worlds.physics import write_bag


@pytest.fixture(scope='module')
def pair():
    return make_pair(None, 1, imu_rate=50.0, joint_rate=50.0)


@pytest.fixture(scope='module')
def calibrated(pair):
    return calibrate_recordings(
        pair.first.block, Table.from_mapping(pair.table), model_as_asked=True
    )


def test_a_good_file_helps_in_another_session_of_its_imu(pair, calibrated):
    found = check_recording(
        pair.second.block, calibrated.calibration, Table.from_mapping(pair.table)
    )
    assert found.helps and found.exit_code == 0
    assert all(
        part.after < 0.6 * part.before
        for entry in found.proof.values()
        for part in entry.regimes.values()
    )


def test_a_file_of_another_imu_does_not_help(pair, calibrated):
    other = make_pair(None, 4, imu_rate=50.0, joint_rate=50.0)
    found = check_recording(
        other.second.block, calibrated.calibration, Table.from_mapping(other.table)
    )
    assert not found.helps and found.exit_code == 3


def test_a_bias_that_moved_is_named(pair, calibrated):
    imu = pair.second.imu
    moved = replace(pair.second.block, imu=replace(imu, rate_s=imu.rate_s + 0.02))
    found = check_recording(moved, calibrated.calibration, Table.from_mapping(pair.table))
    assert not found.helps and any('the bias has changed' in line for line in found.lines)


def test_the_recording_that_a_file_was_made_from_is_noticed(pair, calibrated):
    table = Table.from_mapping(pair.table)
    assert (
        check_recording(pair.first.block, calibrated.calibration, table).notes
        and not check_recording(pair.second.block, calibrated.calibration, table).notes
    )


def test_a_sensor_without_readings_is_unproven_and_a_3(pair, calibrated):
    imu = pair.second.imu
    alone = replace(pair.second.block, imu=replace(imu, absent=('gyroscope',)))
    found = check_recording(alone, calibrated.calibration, Table.from_mapping(pair.table))
    assert list(found.helped) == ['accelerometer'] and not found.helps
    assert found.decision('gyroscope') == 'unproven' and found.exit_code == 3
    assert [line for line in found.reasons if 'gyroscope unproven' in line]


def test_the_own_recording_gives_no_better_decision_than_its_file(pair, calibrated):
    table, why = Table.from_mapping(pair.table), 'none of its parameters is determined'
    known = replace(
        calibrated.calibration,
        decision={'accelerometer': 'unproven', 'gyroscope': 'helps'},
        decision_reasons={'accelerometer': why},
    )
    own, new = (check_recording(data.block, known, table) for data in (pair.first, pair.second))
    assert own.reasons == shortcomings(known)[:1] and why in own.reasons[0]
    assert list(own.helped) == ['gyroscope'] and own.exit_code == 3
    assert new.helps and new.exit_code == 0


def test_nothing_to_judge_on_is_no_proof():
    assert not CheckResult({}).helps and CheckResult({}).lines[0].startswith('unproven: ')


def test_the_verb_prints_errors_and_answers_with_its_exit_code(capsys, tmp_path, pair, calibrated):
    bag, table, file = (str(tmp_path / name) for name in ('bag', 'table.yaml', 'calibration.yaml'))
    write_bag(pair.second, bag)
    (tmp_path / 'table.yaml').write_text(to_text(pair.table))
    (tmp_path / 'calibration.yaml').write_text(calibration_to_text(calibrated.calibration))
    assert main(['check', bag, '--calibration', file, '--table', table]) == 0
    out = capsys.readouterr().out
    assert Regime.FAST in out
    spoiled = calibrated.calibration.values.copy()
    spoiled[calibrated.calibration.param_names.index('gyroscope.matrix.zz')] *= 1.5
    (tmp_path / 'calibration.yaml').write_text(
        calibration_to_text(replace(calibrated.calibration, values=spoiled))
    )
    assert main(['check', bag, '--calibration', file, '--table', table]) == 3


def test_an_earlier_calibration_is_proven_beside_a_new_one(pair, calibrated):
    spoiled = calibrated.calibration.values.copy()
    spoiled[calibrated.calibration.param_names.index('gyroscope.matrix.zz')] *= 1.05
    earlier = replace(calibrated.calibration, values=spoiled)
    found = calibrate_recordings(
        pair.second.block, Table.from_mapping(pair.table), model_as_asked=True, earlier=earlier
    )
    entry = found.calibration.proof['gyroscope']
    assert entry.earlier.after > 3 * entry.after
    with refused(InputError, 'table_missing'):
        calibrate_recordings(pair.second.block, earlier=earlier)
