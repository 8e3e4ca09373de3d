"""
Recordings by hand as they really are.

Wrong full-scale settings, clipped turns, late stamps, slow turns, warm-up, creeping poses.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock, runs_of
from imu_calibration.core.units import STANDARD_GRAVITY, STANDARD_GRAVITY_SD
from imu_calibration.document.calibration import scale_questions
from imu_calibration.document.trust import refused_sensors
from imu_calibration.estimation.solution import of_fit, reasons_held, with_weak_replaced
from imu_calibration.kinematics.rotations import EARTH_RATE
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.preprocessing.sample_recording import SampleRecording, read_recording
from imu_calibration.references.gravity.advice import missing_motion
from imu_calibration.references.gravity.bias_movement import notes
from imu_calibration.references.gravity.g_sensitivity import g_sensitivity_evidence, shown
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import (
    CROSS_TERMS,
    UPPER_TERMS,
    HandOptions,
    hand_options,
)
from imu_calibration.references.gravity.hand_workflow import calibrate_poses
from imu_calibration.references.gravity.poses import (
    at_range_end,
    average_poses,
    rising,
    sample_times,
)

from worlds.hand_sessions import FACES, GRAVITY, PARAM_NAMES, random_truth, unpack
from worlds.hand_trials import clean, jitter
from worlds.physics_hand import (
    clipped,
    drifting,
    hold_and_turn,
    warmed_up,
    with_slow_turn,
    with_stamp_jitter,
    with_wrong_full_scale,
)
from worlds.physics_table import stand_up

ANGULAR = np.random.default_rng(0).normal(0, 1, (300, 3))


@pytest.fixture(scope='module')
def session():
    """(imu, ranges at rest, truth) of fourteen poses."""
    return hold_and_turn(3)


@pytest.fixture(scope='module')
def usual(session):
    """Return the calibration of that session."""
    return calibrated(session[0])


def calibrated(imu):
    return calibrate_by_hand(read_recording([SampleBlock(imu)]).imu, HandOptions(GRAVITY))


def rate_error(found, truth, factor=1.0):
    """
    Rms error of compensated rates of 1 rad/s per axis, rad/s.

    `factor`: what the readings were multiplied by.
    """
    _, _, bias, matrix = unpack(truth)
    measured = factor * (ANGULAR @ matrix.T + bias)
    bias, matrix, _ = found.gyroscope
    return np.sqrt(np.mean((np.linalg.solve(matrix, (measured - bias).T).T - ANGULAR) ** 2))


def looked_at(imu):
    return read_recording([SampleBlock(imu)], preflight=Preflight(GRAVITY, strict=False)).findings


# a gyroscope at the wrong full-scale setting


@pytest.mark.parametrize('factor', [0.5, 8.0])
def test_the_solver_reaches_a_wrong_full_scale(session, usual, factor):
    """Half a turn that is read as a whole one is far outside what steps from the identity reach."""
    imu, _, truth = session
    found = calibrated(with_wrong_full_scale(imu, factor))
    assert rate_error(found, truth, factor) < 2 * rate_error(usual, truth)
    assert found.statistics['gyro_factor'] == pytest.approx(factor, rel=0.15)
    assert 'held' not in found.statuses


def test_a_right_full_scale_stays_one(session, usual):
    assert usual.statistics['gyro_factor'] == 1.0
    assert calibrated(with_wrong_full_scale(session[0], 1.08)).statistics['gyro_factor'] == 1.0


@pytest.mark.parametrize('factor', [2.0, 0.5, 4.0])
def test_preflight_names_the_full_scale_factor(session, factor):
    (found,) = (
        f for f in looked_at(with_wrong_full_scale(session[0], factor)) if f.check == 'full_scale'
    )
    assert found.severity == 'warning' and f' {factor:g} ' in found.text
    assert not [
        f for f in looked_at(session[0]) if f.check == 'full_scale' and f.severity != 'good'
    ]


# scales and biases far from the nominal ones


@pytest.mark.parametrize('factor', [0.43, 2.4])
def test_force_at_another_scale_does_not_end_on_the_mirrored_branch(session, usual, factor):
    """Steps from the identity passed zero for half of the scale: the matrix was -0.5."""
    imu, _, _ = session
    scaled = calibrated(replace(imu, force_s=factor * imu.force_s))
    assert scaled.accelerometer[1] == pytest.approx(factor * usual.accelerometer[1], abs=2e-4)
    assert 'held' not in scaled.statuses


@pytest.mark.parametrize('bias', [(0.0, 0.0, 11.0), (-14.0, 0.0, 9.0), (0.0, 23.0, 0.0)])
def test_a_large_bias_does_not_spoil_the_gyroscope(session, usual, bias):
    """The directions of gravity contained the bias; the rates were called 4.76 times too high."""
    imu, _, truth = session
    biased = calibrated(replace(imu, force_s=imu.force_s + np.array(bias)))
    assert biased.statistics['gyro_factor'] == 1.0
    assert biased.accelerometer[0] == pytest.approx(usual.accelerometer[0] + bias, abs=2e-3)
    assert rate_error(biased, truth) < 1.5 * rate_error(usual, truth)


def test_a_scale_far_from_one_is_questioned_and_applied_where_the_data_support_it(session):
    halved = replace(session[0], force_s=0.52 * session[0].force_s, rate_s=2.2 * session[0].rate_s)
    options = CalibrationOptions(gravity=GRAVITY)
    result = calibrate_poses(read_recording([SampleBlock(halved)]), options)
    _, matrix_f, _, matrix_w = unpack(session[2])
    for sensor, wanted in (('accelerometer', 0.52 * matrix_f), ('gyroscope', 2.2 * matrix_w)):
        part = result.calibration.model.slices[sensor, 'matrix']
        found = result.calibration.values[part].reshape(3, 3)
        # 5 sd of the rates' matrix: 2e-4 of the noise and 6e-4 of biases that change by the pose
        assert found == pytest.approx(wanted, abs=5e-3 if sensor == 'gyroscope' else 1e-3)
    assert set(scale_questions(result.calibration)) == {'accelerometer', 'gyroscope'}
    assert not refused_sensors(result.calibration)
    unit = [f for f in looked_at(halved) if f.check in ('gravity', 'full_scale')]
    assert [f.severity for f in unit] == ['warning', 'warning']


# clipped turns


@pytest.mark.parametrize('rate_hz', [100.0, 10.0])
def test_turns_with_clipped_samples_are_left_out(rate_hz):
    """At 10 Hz one or two samples of a turn stands at the end of the range."""
    imu, _, truth = hold_and_turn(
        4, n_poses=18, rate_hz=rate_hz, rate_sd=0.001, duration=1.6 if rate_hz > 20 else 1.0
    )
    limit = (0.8 if rate_hz > 20 else 0.9) * np.abs(imu.rate_s).max()
    spoiled = clipped(imu, limit)
    at = np.abs(spoiled.rate_s).max(axis=1) == limit
    assert at_range_end(spoiled.rate_s).tolist() == at.tolist()
    assert rate_hz > 20 or np.diff(runs_of(at)).max() < 3
    found = calibrated(spoiled)
    assert found.statistics['turns_dropped'].get('clipped', 0) > 0
    assert rate_error(found, truth) < 3 * rate_error(calibrated(imu), truth) + 1e-4


def test_an_unclipped_gyroscope_has_no_end_of_range(session):
    rate = session[0].rate_s
    for readings in (rate, np.round(rate, 3), np.round(rate, 2), np.repeat(rate, 2, axis=0)):
        assert not at_range_end(readings).any()


def test_ranges_of_two_s_complement_end_one_step_apart():
    step, rng = 1e-3, np.random.default_rng(5)
    rate = np.clip(np.round(rng.normal(0, 1.0, (2000, 3)) / step), -2500, 2499) * step
    assert (
        at_range_end(rate).sum()
        == np.count_nonzero((rate >= 2.499 - 1e-9).any(axis=1) | (rate <= -2.5 + 1e-9).any(axis=1))
        > 2
    )


# slow turns


def test_a_slow_turn_about_the_vertical_is_no_pose():
    """
    At 1.7 deg/s gravity stays where it is and the gyroscope is as quiet as at rest.

    Only its mean tells.
    """
    imu, _, turn = with_slow_turn(6)
    covered = sum(
        max(min(piece.stop, turn.stop) - max(piece.start, turn.start), 0)
        for piece in find_still(imu)
    )
    assert covered == 0 and len(find_still(imu)) >= 14


def test_poses_of_a_gyroscope_that_warms_up_stay_poses():
    imu, ranges, _ = hold_and_turn(7)
    for time_constant in (10.0, 60.0):
        assert (
            len(find_still(warmed_up(imu, 1, rate=0.03, time_constant=time_constant)[0]))
            >= len(ranges) - 1
        )


# biases that move


def test_a_warm_up_is_not_sold_as_g_sensitivity():
    imu, ranges, _ = hold_and_turn(8, n_poses=20, rate_hz=50.0, still=2.0)
    warm, temperature_c = warmed_up(imu, 2, rate=0.02, time_constant=20.0)
    for temperature in (None, temperature_c):
        found = calibrate_by_hand(warm, HandOptions(GRAVITY), ranges, temperature_c=temperature)
        assert not any('g_sensitivity' in name for name in found.param_names)


def test_a_drift_is_not_named_g_sensitivity_if_attitudes_are_sorted():
    """Tipped over step by step: gravity's direction and the bias both go with time."""
    imu, ranges, _ = hold_and_turn(8, n_poses=20, rate_hz=50.0, still=2.0)
    poses = average_poses(imu, [(r.start, r.stop) for r in ranges])
    share = np.linspace(0, 1, len(poses.force))
    tipped = GRAVITY * np.column_stack(
        [np.sin(1.5 * share), 0.1 * np.sin(9 * share), np.cos(1.5 * share)]
    )
    drift = 1e-2 * np.column_stack([share**2, share, -share]) + np.random.default_rng(4).normal(
        0, 1e-4, (len(share), 3)
    )
    assert not shown(
        g_sensitivity_evidence(replace(poses, force=tipped, rate=drift, time=100 * share))
    )


def test_the_earth_is_not_sold_as_g_sensitivity():
    """
    Its rate about the vertical follows gravity, alike in every axis.

    What is larger, or another axis, is none of it.
    """
    imu, ranges, _ = hold_and_turn(8, n_poses=20, rate_hz=50.0, still=2.0)
    poses = average_poses(imu, [(r.start, r.stop) for r in ranges])
    noise = np.random.default_rng(5).normal(0, 1e-5, poses.rate.shape)
    for size, axis, wanted in (
        (0.9, slice(None), False),
        (-0.7, slice(None), False),
        (3.0, slice(None), True),
        (0.9, 2, True),
    ):
        response = np.zeros((3, 3))
        response[axis, axis] = np.eye(3)[axis, axis] * size * EARTH_RATE / GRAVITY
        assert (
            shown(g_sensitivity_evidence(replace(poses, rate=poses.force @ response.T + noise)))
            == wanted
        )


def test_the_latitude_that_nobody_said_is_in_the_sd_of_a_g_sensitivity(session):
    imu, ranges, _ = session
    hand = calibrate_by_hand(
        imu, HandOptions(GRAVITY, gyroscope=('bias', 'matrix', 'gyro_g_sensitivity')), ranges
    )
    diagonal = [
        hand.param_names.index(f'gyroscope.gyro_g_sensitivity.{name}')
        for name in ('xx', 'yy', 'zz')
    ]
    assert min(hand.sd[diagonal]) >= EARTH_RATE / np.sqrt(3) / GRAVITY


def test_g_sensitivity_is_seen_beside_a_warm_up():
    truth = random_truth(np.random.default_rng(9), 3e-4)
    imu, ranges, _ = hold_and_turn(9, n_poses=20, rate_hz=50.0, still=2.0, truth=truth)
    warm, _ = warmed_up(imu, 2, rate=0.02, time_constant=20.0)
    assert shown(g_sensitivity_evidence(average_poses(warm, [(r.start, r.stop) for r in ranges])))


def test_biases_that_drift_carry_it_in_their_sd_and_a_note_with_its_size():
    imu, ranges, truth = hold_and_turn(10, n_poses=24, rate_hz=50.0, still=3.0)
    moved = drifting(imu, force=0.0981, rate=0.004)
    still, found = (
        calibrate_by_hand(samples, HandOptions(GRAVITY), ranges) for samples in (imu, moved)
    )
    assert still.statistics['bias_moved'] == {}
    assert found.statistics['bias_moved'] == {
        'accelerometer': pytest.approx(0.0981, rel=0.15),
        'gyroscope': pytest.approx(0.004, rel=0.15),
    }
    (first,) = (
        note.text
        for note in notes(found.statistics['bias_moved'], 600.0)
        if note.text.startswith('accelerometer')
    )
    assert re.search(r'\b(9|1\d)(\.\d+)? mg\b', first) and ' 10 ' in first
    for name, change in (('accelerometer.bias.x', 0.0981), ('gyroscope.bias.x', 0.004)):
        middle = truth[PARAM_NAMES.index(name)] + change / 2
        assert abs(found.value(name) - middle) < 0.1 * change and found.sd_of(name) > 0.4 * change
    assert found.sd_of('accelerometer.bias.y') < 0.1 * found.sd_of('accelerometer.bias.x')
    error = np.abs(
        np.array([found.value(name) - truth[PARAM_NAMES.index(name)] for name in PARAM_NAMES[3:9]])
    )
    assert np.all(error < 4.5 * np.array([found.sd_of(name) for name in PARAM_NAMES[3:9]]))


# what does not belong to the others


def test_a_pose_a_rest_and_a_turn_that_were_disturbed_are_left_out():
    """
    Somebody leans on the IMU in one pose and turns it slowly in another.

    A glitch of a tenth of a second is in one turn.
    """
    imu, ranges, truth = hold_and_turn(0, rate_hz=50.0, still=2.0)
    force, rate = imu.force_s.copy(), imu.rate_s.copy()
    force[ranges[5], 0] += 0.3
    rate[ranges[8], 2] += 0.02
    rate[ranges[3].stop + 20 : ranges[3].stop + 25, 1] += 2.0
    clean, found = (
        calibrate_by_hand(samples, HandOptions(GRAVITY), ranges)
        for samples in (imu, replace(imu, force_s=force, rate_s=rate))
    )
    assert clean.statistics['left_out'] == {}
    assert found.statistics['left_out'] == {
        'outlying pose': 1,
        'outlying drift': 1,
        'outlying turn': 1,
    }
    assert rate_error(found, truth) < 3 * rate_error(clean, truth)
    assert np.max(np.abs(found.values - clean.values)[:3]) < 0.01


def test_what_was_left_out_does_not_come_back_in_the_proof():
    """The steps from the solution without some poses take the equations as they were solved."""
    imu, ranges, _ = hold_and_turn(0, rate_hz=50.0, still=2.0, n_poses=16)
    rate = imu.rate_s.copy()
    rate[ranges[3].stop + 20 : ranges[3].stop + 25, 1] += 4.0
    clean, found = (
        calibrate_poses(
            SampleRecording(samples, None, {}), CalibrationOptions(gravity=GRAVITY), stills=ranges
        )
        for samples in (imu, replace(imu, rate_s=rate))
    )
    assert found.applied.statistics['left_out'] == {'contradicted by gravity': 1}
    assert (
        found.calibration.proof['gyroscope'].after < 2 * clean.calibration.proof['gyroscope'].after
    )


def six_faces(seed=1):
    return hold_and_turn(
        seed, n_poses=6, attitudes=[Rotation.from_matrix(stand_up(up)) for up in FACES], still=4.0
    )


def test_six_faces_give_what_they_determine():
    imu, ranges, truth = six_faces()
    found = calibrated(imu)
    status = dict(zip(found.param_names, found.statuses))
    for name in (
        *(f'accelerometer.bias.{axis}' for axis in 'xyz'),
        *(f'accelerometer.matrix.{axis}{axis}' for axis in 'xyz'),
    ):
        assert status[name] == 'determined' and abs(
            found.value(name) - truth[PARAM_NAMES.index(name)]
        ) < 5 * found.sd_of(name)


def test_a_weak_cross_term_is_zero_unless_zero_is_significantly_worse():
    """
    The likelihood ratio of a value is its squared ratio to the sd of the fit.

    The profile near six faces is a parabola.
    """
    hand = calibrated(six_faces()[0])
    # No other replacement moves it.
    hand = replace(hand, terms={term: np.diag(np.diag(part)) for term, part in hand.terms.items()})
    name = next(
        name for name in CROSS_TERMS if hand.statuses[hand.param_names.index(name)] == 'weak'
    )
    for ratio, moves in ((1.8, True), (2.2, False)):
        at = np.arange(len(hand.values)) == hand.param_names.index(name)
        other = replace(
            hand, values=np.where(at, ratio * np.sqrt(np.diag(of_fit(hand.terms))), hand.values)
        )
        assert (name in with_weak_replaced(other, other.tolerances).replaced) == moves
    assert reasons_held([True], [name], [name], tested=CROSS_TERMS) == {name: 'likelihood ratio'}


def test_faces_without_the_turns_between_them_give_bias_and_scale():
    """
    A recorder that was stopped for each turn and went on with the next stamp.

    Gravity jumps, the rates know nothing of it.
    """
    imu, ranges, _ = six_faces()
    cut = ImuSamples.concatenate([imu.select(piece) for piece in ranges])
    cut = replace(cut, stamp_ns=imu.stamp_ns[: len(cut)])
    found = calibrated(cut)
    assert (
        found.statistics['left_out'] == {'contradicted by gravity': 5}
        and found.statistics['poses'] == 6
    )
    status = dict(zip(found.param_names, found.statuses))
    assert {
        status[f'accelerometer.{name}']
        for name in ('bias.x', 'bias.y', 'bias.z', 'matrix.xx', 'matrix.yy', 'matrix.zz')
    } <= {'determined', 'weak'}
    assert status['gyroscope.bias.x'] == 'determined' and status['gyroscope.matrix.xx'] == 'held'


# late stamps


def test_late_stamps_of_even_samples_do_not_reach_the_turns(session, usual):
    imu, _, truth = session
    late = with_stamp_jitter(imu, 0.003, 1)
    assert rate_error(calibrated(late), truth) < 2 * rate_error(usual, truth)


def test_repeated_stamps_are_spread_over_the_step_that_follows():
    np.testing.assert_allclose(
        rising(np.array([0.0, 0.01, 0.01, 0.02])), [0.0, 0.01, 0.015, 0.02], atol=1e-6
    )


def test_times_are_those_of_the_clock_that_jittering_stamps_follow():
    steady, jittering = (
        clean(4, rests=10)[0],
        read_recording([SampleBlock(jitter(4, rests=10)[0])]).imu,
    )
    off = sample_times(jittering) - 1e-9 * (steady.stamp_ns - steady.stamp_ns[0])
    # Over a turn: of 3 ms, and 0.3 ms in the times that the cleaning draws over 64 samples.
    assert np.std(np.diff(off[::150])) < 1e-4
    lost = np.ones(len(steady), bool)
    lost[[700, 1500, 1501, 2200]] = False
    np.testing.assert_allclose(
        np.diff(sample_times(steady.select(lost))),
        np.diff(steady.select(lost).stamp_ns) * 1e-9,
        atol=1e-6,
    )


def test_times_of_a_sensor_that_is_polled_at_uneven_moments_are_its_stamps():
    steady = clean(4, rests=10)[0]
    time = 1e-9 * (steady.stamp_ns - steady.stamp_ns[0])
    polled = time + np.random.default_rng(2).uniform(-2e-3, 2e-3, len(time))
    rate = np.column_stack([np.interp(polled, time, axis) for axis in steady.rate_s.T])
    stamps = 10**18 + np.round(1e9 * polled).astype(np.int64)
    found = sample_times(ImuSamples(stamps, steady.force_s, rate, 'imu_link'))
    np.testing.assert_allclose(found, 1e-9 * (stamps - stamps[0]), atol=1e-9)


@pytest.mark.parametrize('gravity', [981.0, -9.81, float('nan')])
def test_a_gravity_of_no_place_on_the_earth_is_refused(gravity):
    with pytest.raises(InputError) as refused:
        hand_options(CalibrationOptions(gravity=gravity))
    assert refused.value.key == 'gravity'


def test_the_error_budget_lists_an_unknown_gravity_and_not_a_given_one():
    imu, ranges, _ = hold_and_turn(3, n_poses=14)
    unknown, given = (
        calibrate_poses(
            SampleRecording(imu, None, {}),
            CalibrationOptions(gravity=gravity, as_asked=True),
            stills=ranges,
        )
        for gravity in (None, STANDARD_GRAVITY)
    )
    scale = unknown.calibration.param_names.index('accelerometer.matrix.xx')
    budgets = [result.error_budget() for result in (unknown, given)]
    assert budgets[0].causes['gravity'][scale] == pytest.approx(
        STANDARD_GRAVITY_SD / STANDARD_GRAVITY, rel=0.05
    )
    assert budgets[0].causes['noise'][scale] == pytest.approx(
        budgets[1].causes['noise'][scale], rel=0.05
    )
    assert budgets[1].causes['gravity'][scale] < 0.1 * budgets[0].causes['gravity'][scale]
    assert (
        unknown.calibration.common_scale['status'] == 'weak'
        and given.calibration.common_scale == {}
    )
    assert (
        unknown.calibration.status == given.calibration.status
        and unknown.calibration.status[scale] == 'determined'
    )
    assert [
        name for name, status in unknown.calibration.status_by_name.items() if status == 'fixed'
    ] == list(UPPER_TERMS)


def test_an_unknown_gravity_does_not_change_the_recommended_poses():
    imu, ranges, _ = hold_and_turn(3, n_poses=6)
    unknown, given = (
        calibrate_by_hand(imu, HandOptions(STANDARD_GRAVITY, sd), ranges)
        for sd in (STANDARD_GRAVITY_SD, 0.0)
    )
    assert missing_motion(unknown) == missing_motion(given) != ()
    assert (
        with_weak_replaced(unknown, unknown.tolerances).replaced
        == with_weak_replaced(given, given.tolerances).replaced
    )
