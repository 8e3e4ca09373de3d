"""
``imu_calibration check`` without a table: gravity at rest, rates at rest, and turns between poses.
"""

from dataclasses import replace

import pytest

from imu_calibration.cli.main import main
from imu_calibration.core.samples import SampleBlock, TemperatureSamples
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.use_cases.calibrate import calibrate_recordings, check_recording
from msg_adapters.write import write_session

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY
from worlds.physics_hand import hold_and_turn, warmed_up


@pytest.fixture(scope='module')
def first():
    """A session, and its truth."""
    imu, _, truth = hold_and_turn(3, rate_hz=50.0, n_poses=16)
    return imu, truth


@pytest.fixture(scope='module')
def second(first):
    """Another session with the same IMU, in other attitudes."""
    return hold_and_turn(4, rate_hz=50.0, n_poses=12, truth=first[1])[0]


@pytest.fixture(scope='module')
def calibrated(first):
    return calibrate_recordings(SampleBlock(first[0]), gravity=GRAVITY, candidates=FEW).calibration


def test_a_good_file_helps_at_rest_and_in_turns(second, calibrated):
    found = check_recording(SampleBlock(second), calibrated, gravity=GRAVITY)
    assert found.helps and found.exit_code == 0
    accelerometer, gyroscope = found.proof['accelerometer'], found.proof['gyroscope']
    # Scatter of the poses 2 mm/s^2, biases 0.2 m/s^2.
    assert accelerometer.after < 0.01 < 0.05 < accelerometer.before
    assert gyroscope.unit == 'rad per turn' and gyroscope.after < 0.3 * gyroscope.before
    assert gyroscope.regimes['rest'].unit == 'rad/s' and gyroscope.regimes['rest'].after < 1e-3
    assert accelerometer.windows == 12 and gyroscope.windows == 11


def test_a_bias_that_moved_is_named(second, calibrated):
    # It has passed zero, so that nothing at all would now be better.
    moved = second.rate_s - 3 * calibrated.value('gyroscope', 'bias')
    found = check_recording(SampleBlock(replace(second, rate_s=moved)), calibrated, gravity=GRAVITY)
    assert found.exit_code == 3 and found.proof['gyroscope'].regimes['rest'].ci95[0] > 1
    assert 'bias' in found.lines[1]


def test_a_file_of_another_imu_does_not_help(calibrated):
    other = hold_and_turn(11, rate_hz=50.0, n_poses=12)[0]
    assert check_recording(SampleBlock(other), calibrated, gravity=GRAVITY).exit_code == 3


def test_turns_alone_tell_a_wrong_scale_of_the_gyroscope(second, calibrated):
    """
    At rest nothing is the matter; the angle after a turn of two radians errs by five per cent.
    """
    bias = calibrated.value('gyroscope', 'bias')
    wrong = replace(second, rate_s=bias + 1.05 * (second.rate_s - bias))
    right, found = (
        check_recording(SampleBlock(imu), calibrated, gravity=GRAVITY).proof['gyroscope'].regimes
        for imu in (second, wrong)
    )
    assert (
        found['rest'].after == pytest.approx(right['rest'].after, rel=0.1)
        and found['turns'].after > 5 * right['turns'].after
    )


def test_the_gravity_of_the_calibration_is_taken_and_said(second, calibrated):
    found = check_recording(SampleBlock(second), calibrated)
    assert found.helps and any('9.81 m/s^2' in note for note in found.notes)
    stated = check_recording(SampleBlock(second), calibrated, gravity=GRAVITY)
    assert not any('9.81 m/s^2' in note for note in stated.notes)


def test_check_gives_3_when_the_error_by_hand_has_changed(first, second, calibrated):
    """A gravity that is wrong by 0.05 m/s^2 leaves that error at rest, and turns as they are."""
    block = SampleBlock(first[0])
    for recording in (block, SampleBlock(second)):
        same = check_recording(recording, calibrated, gravity=GRAVITY)
        assert same.exit_code == 0 and not same.changed
        kinds = {(each.sensor, each.regime) for each in same.changes}
        assert kinds == {('accelerometer', 'rest'), ('gyroscope', 'turns')}
    found = check_recording(block, calibrated, gravity=GRAVITY + 0.05)
    (change,) = found.changed
    assert found.helps and found.exit_code == 3
    assert (change.sensor, change.regime) == ('accelerometer', 'rest')
    assert change.now == pytest.approx(0.05, rel=0.05)
    assert change.stored == calibrated.proof['accelerometer'].after


def test_temperatures_reach_the_correction(first):
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


def test_two_attitudes_tell_nothing():
    imu, ranges, _ = hold_and_turn(3, rate_hz=50.0, n_poses=2)
    good = calibrate_recordings(
        SampleBlock(hold_and_turn(3, rate_hz=50.0)[0]), gravity=GRAVITY, candidates=FEW
    ).calibration
    found = check_recording(SampleBlock(imu), good)
    assert found.exit_code == 3 and not found.proof and '4 different attitudes' in str(found)


def test_the_verb_needs_no_table(capsys, tmp_path, second, calibrated):
    bag, file = tmp_path / 'bag', tmp_path / 'calibration.yaml'
    write_session(bag, second)
    file.write_text(calibration_to_text(calibrated))
    assert main(['check', str(bag), '--calibration', str(file)]) == 0
    printed = capsys.readouterr().out
    assert 'deg per turn' in printed
