"""``imu_calibration check``: does this file help on that recording, on a table and by hand?"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api.calibrate import calibrate_recordings, check_recording
from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.cli.main import main
from imu_calibration.core.documents import to_text
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.outcome import shortcomings
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.window_statistics import Regime
from msg_adapters.write import write_session

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY
from worlds.misfit_worlds import make_pair
from worlds.physics_hand import hold_and_turn, warmed_up


@dataclass(frozen=True, eq=False)
class Case:
    """An IMU that was calibrated in one session, and other sessions."""

    first: SampleBlock
    """The session of the calibration."""
    second: SampleBlock
    """Another session of this IMU."""
    other: SampleBlock
    """A session of another IMU."""
    calibration: Calibration
    moved_by: np.ndarray
    """A change of the gyroscope's bias, rad/s."""
    printed: str
    """Words of the verb about this reference."""
    choices: dict
    """Stand or gravity, as functions take them."""
    table: dict | None = None
    """The stand as a mapping."""

    def checked(self, block, **choices):
        """Return what the check says of a session."""
        return check_recording(block, self.calibration, **{**self.choices, **choices})

    @cached_property
    def of_first(self):
        """What the check says of the session of the calibration."""
        return self.checked(self.first)

    @cached_property
    def of_second(self):
        """What the check says of another session."""
        return self.checked(self.second)


@pytest.fixture(scope='module')
def on_table():
    rates = {'imu_rate': 50.0, 'joint_rate': 50.0}
    pair, other = make_pair(None, 1, **rates), make_pair(None, 4, **rates)
    choices = {'table': Table.from_mapping(pair.table)}
    calibrated = calibrate_recordings(pair.first.block, **choices, model_as_asked=True)
    return Case(
        pair.first.block,
        pair.second.block,
        other.second.block,
        calibrated.calibration,
        np.full(3, 0.02),
        Regime.FAST,
        choices,
        pair.table,
    )


@pytest.fixture(scope='module')
def by_hand():
    first, _, truth = hold_and_turn(3, rate_hz=50.0, n_poses=16)
    second = hold_and_turn(4, rate_hz=50.0, n_poses=12, truth=truth)[0]
    other = hold_and_turn(11, rate_hz=50.0, n_poses=12)[0]
    choices = {'gravity': GRAVITY}
    calibration = calibrate_recordings(SampleBlock(first), **choices, candidates=FEW).calibration
    return Case(
        SampleBlock(first),
        SampleBlock(second),
        SampleBlock(other),
        calibration,
        # It has passed zero, so that nothing at all would now be better.
        -3 * calibration.value('gyroscope', 'bias'),
        'deg per turn',
        choices,
    )


@pytest.fixture(params=['on_table', 'by_hand'])
def case(request):
    """Return the case of each reference."""
    return request.getfixturevalue(request.param)


def test_a_good_file_helps_in_another_session_of_its_imu(case):
    found = case.of_second
    assert found.helps and found.exit_code == 0
    assert all(
        part.after < 0.6 * part.before
        for entry in found.proof.values()
        for part in entry.regimes.values()
    )


def test_a_file_of_another_imu_does_not_help(case):
    found = case.checked(case.other)
    assert not found.helps and found.exit_code == 3


def test_a_bias_that_moved_is_named(case):
    imu = case.second.imu
    found = case.checked(replace(case.second, imu=replace(imu, rate_s=imu.rate_s + case.moved_by)))
    assert not found.helps and found.exit_code == 3
    assert found.proof['gyroscope'].regimes['rest'].ci95[0] > 1
    assert any('the bias has changed' in line for line in found.lines)


def test_the_verb_prints_errors_and_answers_with_its_exit_code(capsys, tmp_path, case):
    bag, file = tmp_path / 'bag', tmp_path / 'calibration.yaml'
    block, known = case.second, case.calibration
    write_session(bag, block.imu, block.joints, temperature=block.temperature)
    arguments = ['check', str(bag), '--calibration', str(file)]
    if case.table is not None:
        (tmp_path / 'table.yaml').write_text(to_text(case.table))
        arguments += ['--table', str(tmp_path / 'table.yaml')]
    file.write_text(calibration_to_text(known))
    assert main(arguments) == 0
    assert case.printed in capsys.readouterr().out
    spoiled = known.values.copy()
    spoiled[known.param_names.index('gyroscope.matrix.zz')] *= 1.5
    file.write_text(calibration_to_text(replace(known, values=spoiled)))
    assert main(arguments) == 3


def test_the_recording_that_a_file_was_made_from_is_noticed(on_table):
    assert on_table.of_first.notes
    assert not on_table.of_second.notes


def test_a_sensor_without_readings_is_unproven_and_a_3(on_table):
    imu = on_table.second.imu
    found = on_table.checked(replace(on_table.second, imu=replace(imu, absent=('gyroscope',))))
    assert list(found.helped) == ['accelerometer'] and not found.helps
    assert found.decision('gyroscope') == 'unproven' and found.exit_code == 3
    assert [line for line in found.reasons if 'gyroscope unproven' in line]


def test_the_own_recording_gives_no_better_decision_than_its_file(on_table):
    why = 'none of its parameters is determined'
    known = replace(
        on_table.calibration,
        decision={'accelerometer': 'unproven', 'gyroscope': 'helps'},
        decision_reasons={'accelerometer': why},
    )
    own, new = (
        check_recording(block, known, **on_table.choices)
        for block in (on_table.first, on_table.second)
    )
    assert own.reasons == shortcomings(known)[:1] and why in own.reasons[0]
    assert list(own.helped) == ['gyroscope'] and own.exit_code == 3
    assert new.helps and new.exit_code == 0


def test_nothing_to_judge_on_is_no_proof():
    assert not CheckResult({}).helps and CheckResult({}).lines[0].startswith('unproven: ')


def test_an_earlier_calibration_is_proven_beside_a_new_one(on_table):
    spoiled = on_table.calibration.values.copy()
    spoiled[on_table.calibration.param_names.index('gyroscope.matrix.zz')] *= 1.05
    earlier = replace(on_table.calibration, values=spoiled)
    found = calibrate_recordings(
        on_table.second, **on_table.choices, model_as_asked=True, earlier=earlier
    )
    entry = found.calibration.proof['gyroscope']
    assert entry.earlier.after > 3 * entry.after
    with refused(InputError, 'table_missing'):
        calibrate_recordings(on_table.second, earlier=earlier)


def test_by_hand_the_errors_are_those_at_rest_and_of_turns(by_hand):
    found = by_hand.of_second
    accelerometer, gyroscope = found.proof['accelerometer'], found.proof['gyroscope']
    # Scatter of the poses 2 mm/s^2, biases 0.2 m/s^2.
    assert accelerometer.after < 0.01 < 0.05 < accelerometer.before
    assert gyroscope.unit == 'rad per turn' and gyroscope.after < 0.3 * gyroscope.before
    assert gyroscope.regimes['rest'].unit == 'rad/s' and gyroscope.regimes['rest'].after < 1e-3
    assert accelerometer.windows == 12 and gyroscope.windows == 11


def test_turns_alone_tell_a_wrong_scale_of_the_gyroscope(by_hand):
    """
    At rest nothing is the matter; the angle after a turn of two radians errs by five per cent.
    """
    second, bias = by_hand.second.imu, by_hand.calibration.value('gyroscope', 'bias')
    wrong = replace(second, rate_s=bias + 1.05 * (second.rate_s - bias))
    right, found = (
        checked.proof['gyroscope'].regimes
        for checked in (by_hand.of_second, by_hand.checked(SampleBlock(wrong)))
    )
    assert (
        found['rest'].after == pytest.approx(right['rest'].after, rel=0.1)
        and found['turns'].after > 5 * right['turns'].after
    )


def test_the_gravity_of_the_calibration_is_taken_and_said(by_hand):
    found = check_recording(by_hand.second, by_hand.calibration)
    assert found.helps and any('9.81 m/s^2' in note for note in found.notes)
    assert not any('9.81 m/s^2' in note for note in by_hand.of_second.notes)


def test_check_gives_3_when_the_error_by_hand_has_changed(by_hand):
    """A gravity that is wrong by 0.05 m/s^2 leaves that error at rest, and turns as they are."""
    for same in (by_hand.of_first, by_hand.of_second):
        assert same.exit_code == 0 and not same.changed
        kinds = {(each.sensor, each.regime) for each in same.changes}
        assert kinds == {('accelerometer', 'rest'), ('gyroscope', 'turns')}
    found = by_hand.checked(by_hand.first, gravity=GRAVITY + 0.05)
    (change,) = found.changed
    assert found.helps and found.exit_code == 3
    assert (change.sensor, change.regime) == ('accelerometer', 'rest')
    assert change.now == pytest.approx(0.05, rel=0.05)
    assert change.stored == by_hand.calibration.proof['accelerometer'].after


def test_temperatures_reach_the_correction():
    imu, ranges, truth = hold_and_turn(5, rate_hz=50.0, n_poses=24)
    warm, temperature_c = warmed_up(imu, 5, rate=0.05, kelvin=10.0)
    block = SampleBlock(warm, temperature=TemperatureSamples(warm.stamp_ns, temperature_c))
    asked = calibrate_recordings(
        block, gravity=GRAVITY, gyroscope_model='bias+matrix+gyro_thermal_bias', model_as_asked=True
    ).calibration
    plain = calibrate_recordings(
        block, gravity=GRAVITY, gyroscope_model='bias+matrix', model_as_asked=True
    ).calibration
    errors = [
        check_recording(block, found, gravity=GRAVITY).proof['gyroscope'].regimes['rest'].after
        for found in (asked, plain)
    ]
    assert errors[0] < 0.3 * errors[1]


def test_two_attitudes_tell_nothing(by_hand):
    imu, ranges, _ = hold_and_turn(3, rate_hz=50.0, n_poses=2)
    found = check_recording(SampleBlock(imu), by_hand.calibration)
    assert found.exit_code == 3 and not found.proof and '4 different attitudes' in str(found)
