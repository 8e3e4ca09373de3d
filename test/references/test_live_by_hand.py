"""
By hand while it goes on.

The live answer is that of the recording, poses are counted, what is missing is named. No ROS here.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from refusal import refused
from scipy.spatial.transform import Rotation
from test_hand_calibration import GRAVITY, load, simulate

from imu_calibration.calibration.live import LiveByHandSettings, LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import DocumentError, InputError, NotObservableError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.references.gravity.advice import missing_motion
from imu_calibration.references.gravity.live_poses import FACE_DIRECTIONS, LiveByHand, unseen

from worlds.calibrated import calibrated_by_hand
from worlds.physics_table import stand_up

CANDIDATES = 'accel_quadratic+gyro_g_sensitivity'
OPTIONS = CalibrationOptions(catalogue=CATALOGUE.with_candidates(CANDIDATES))


def blocks(imu, seed=0, mean=80):
    """Cut samples into uneven blocks as they would come from a topic."""
    edges = np.sort(np.random.default_rng(seed).integers(0, len(imu), len(imu) // mean))
    for start, stop in zip([0, *edges], [*edges, len(imu)]):
        yield SampleBlock(imu.select(slice(start, stop)))


def make_live(saved=None, options=OPTIONS, **by_hand):
    """Return a LiveByHand that looks for rest as often as it can."""
    settings = LiveByHandSettings(**{'gravity': GRAVITY, **by_hand})
    return LiveByHand(options, LiveSettings(), settings, saved=saved, clock=lambda: 0.0)


def run(live, imu, seed=0):
    """Push samples and return the poses that were handed back."""
    return [pose for block in blocks(imu, seed) for pose in live.push(block)]


def offline(imu, gravity=GRAVITY):
    """What the offline tool says."""
    return calibrated_by_hand([[SampleBlock(imu)]], replace(OPTIONS, gravity=gravity))


def all_kept(live):
    """
    What a live calibration remembers, with the few samples that the filter of spikes still holds.
    """
    return make_live(live.saved())._store.samples()


def assert_same(live, expected, share=1e-6):
    """Assert that two calibrations agree to a share of their standard deviations."""
    a, b = live.calibration, expected.calibration
    assert a.param_names == b.param_names and a.status == b.status
    known = b.sd > 0
    assert np.max(np.abs(a.values - b.values)[known] / b.sd[known]) < share
    np.testing.assert_allclose(a.sd, b.sd, rtol=1e-6)


def test_another_gravity_changes_the_next_solution(session):
    live = make_live()
    run(live, session)
    before = live.solve(pending=True)
    live.change(LiveByHandSettings(gravity=GRAVITY + 0.01))
    after = live.solve(pending=True)
    assert_same(after, offline(session, GRAVITY + 0.01))
    assert after.gravity - before.gravity == pytest.approx(0.01)


@pytest.fixture(scope='module')
def session():
    """Twelve attitudes."""
    return simulate(1)[0]


@pytest.fixture(scope='module')
def expected(session):
    """What the offline tool says of it."""
    return offline(session)


def test_the_live_answer_is_that_of_the_recording(session, expected):
    live = make_live()
    poses = run(live, session)
    result = live.solve(pending=True)
    assert_same(result, expected)
    for section in ('windows', 'samples_used', 'dropped'):
        assert result.calibration.statistics[section] == expected.calibration.statistics[section]
    assert result.calibration.conditions == expected.calibration.conditions
    assert len(poses) == 11  # the last rest goes on
    assert live.status().values['poses'] == 12 and live.status().values['turns'] == 11


@pytest.mark.long
def test_solving_on_the_way_changes_nothing(session, expected):
    live, solved = make_live(), 0
    for number, block in enumerate(blocks(session, 3)):
        live.push(block)
        if number % 6 == 5 and live.scan.attitudes >= 4:
            live.solve(pending=number % 12 == 11)
            solved += 1
    assert solved >= 3
    assert_same(live.solve(pending=True), expected)


@pytest.mark.long
@pytest.mark.real_data
def test_a_real_recording_live(recordings):
    whole = load(recordings, 'mpu9150_0')
    imu = whole.select(slice(0, len(whole) // 2))
    live = make_live(gravity=0.0)
    run(live, imu)
    assert_same(live.solve(pending=True), offline(imu, None))


def test_before_any_motion_it_asks_for_attitudes():
    live = make_live()
    with refused(NotObservableError, 'no_samples', 4):
        live.solve()
    status = live.status()
    assert (
        status.word == 'waiting'
        and re.search(r'[+-][xyz] up', status.message)
        and set(unseen(live.scan)) == set(FACE_DIRECTIONS)
    )
    assert all(group.status == 'waiting' and group.needs for group in live.groups())


def test_the_direction_that_is_missing_is_named():
    """
    Faces up one after the other.

    Those that have not been up are named beside the step of the picture.
    """
    ups = [FACE_DIRECTIONS[name] for name in ('+z', '+x', '-z', '+y', '-x', '-y')]
    imu = simulate(5, n_poses=6, attitudes=[Rotation.from_matrix(stand_up(up)) for up in ups])[0]
    live, asked = make_live(), {}
    for block in blocks(imu):
        live.push(block)
        asked[live.scan.attitudes] = live.status(), unseen(live.scan)
        assert f'next: {live.coverage().next.text}' in live.status().message
    assert {name for name, count in ((n, k) for k in asked for n in asked[k][1])} == set(
        FACE_DIRECTIONS
    )
    assert asked[1][1][0] == '-z' and set(asked[1][1]) == set(FACE_DIRECTIONS) - {'+z'}
    assert set(asked[2][1]) == set(FACE_DIRECTIONS) - {'+z', '+x'}
    assert asked[6][1] == []
    status = asked[2][0]
    assert status.values['directions of gravity not seen'].split() == asked[2][1]
    assert (
        f'faces not seen yet: {", ".join(asked[2][1])}' in status.message
        and '2 poses in 2 attitudes, 1 turn' in status.message
    )


def test_after_a_solution_the_motion_that_helps_most_is_named(session):
    few = session.select(slice(0, len(session) * 5 // 12))
    live = make_live()
    run(live, few)
    live.solve(pending=True)
    status, groups = live.status(), {(g.sensor, g.effect): g for g in live.groups()}
    shown = live.coverage().next
    # The terminal, the status and the picture say one step.
    assert status.values['next'] == shown.text and shown.up is not None
    assert shown.text in {item['needs'] for item in missing_motion(live.result.applied)}
    assert status.word == 'weak' and re.search(r'[+-][xyz] up', status.message.split('next: ')[1])
    assert groups['accelerometer', 'matrix'].status != 'determined' and re.search(
        r'[+-][xyz] up', groups['accelerometer', 'matrix'].needs
    )


def test_without_a_gravity_the_scales_ask_for_it():
    live = make_live(gravity=0.0)
    run(live, simulate(2, force_sd=0.002, rate_sd=1e-4)[0])
    live.solve(pending=True)
    assert 'gravity' in live.status().message


def test_residuals_of_poses_are_what_the_model_leaves(session, expected):
    live = make_live()
    poses = run(live, session)
    assert live.residuals(poses) is None
    live.solve(pending=True)
    residuals = live.residuals(poses)
    norms = expected.applied.norm_residuals()[: len(poses)]
    along = np.linalg.norm(residuals.force_s, axis=1)
    np.testing.assert_allclose(along, np.abs(norms), rtol=0.1, atol=1e-6)
    assert set(residuals.stamp_ns) <= set(session.stamp_ns)
    assert np.all(np.abs(residuals.rate_s) < 5 * np.max(expected.applied.poses.rate_sem))


def paused(first, second, seconds=100.0):
    """Two recordings one after the other."""
    shift = int(first.stamp_ns[-1] - second.stamp_ns[0] + seconds * 1e9)
    return ImuSamples.concatenate(
        [first, ImuSamples(second.stamp_ns + shift, second.force_s, second.rate_s, second.frame_id)]
    )


@pytest.fixture(scope='module')
def parts(session):
    """The halves of the session."""
    half = len(session) // 2
    return session.select(slice(0, half)), session.select(slice(half, None))


@pytest.fixture(scope='module')
def of_parts(parts):
    """What the offline tool says of the halves with a pause."""
    return offline(paused(*parts))


def test_a_session_resumed_from_its_samples_is_one_recording_with_a_pause(parts, of_parts):
    first = make_live()
    run(first, parts[0])
    second = make_live(first.saved())
    assert second.n_windows >= 5
    run(second, parts[1])
    assert_same(second.solve(pending=True), of_parts)


def test_a_clock_set_back_is_a_pause(parts, of_parts):
    live = make_live()
    run(live, parts[0])
    earlier = ImuSamples(parts[1].stamp_ns - 10**12, parts[1].force_s, parts[1].rate_s)
    poses = run(live, earlier)
    assert live.counts['imu clock reset'] == 1
    assert_same(live.solve(pending=True), of_parts)
    assert poses[-1].stamp_ns[0] in earlier.stamp_ns


@pytest.mark.parametrize('broken', [b'', b'nothing'])
def test_a_broken_file_is_refused(broken):
    with refused(DocumentError, 'samples_damaged'):
        make_live(broken)


@pytest.mark.long
def test_a_night_on_the_desk_does_not_push_the_poses_out(session, expected):
    """
    Memory stays bounded; of the long rest the inside goes, and the answer is that of what is left.
    """
    rng = np.random.default_rng(6)
    live = make_live(hand_samples=len(session) + 4000)
    run(live, session)
    n, largest = 9_000, 0
    mean = session.force_s[-50:].mean(0), session.rate_s[-50:].mean(0)
    noise = rng.normal(0, [[[0.02]], [[0.002]]], (2, n, 3))
    still = ImuSamples(
        session.stamp_ns[-1] + 20_000_000 * np.arange(1, n + 1),
        mean[0] + noise[0],
        mean[1] + noise[1],
    )
    for block in blocks(still, mean=300):
        live.push(block)
        largest = max(largest, len(live._store))
    assert largest < len(session) + 5000 and live.status().values['samples forgotten'] > 4_000
    result = live.solve(pending=True)
    assert live.scan.attitudes == 12 and live.scan.turns == 11
    assert_same(result, offline(all_kept(live)), 1e-4)
    assert np.all(
        np.abs(result.calibration.values - expected.calibration.values)
        < 4 * expected.calibration.sd + 1e-12
    )


def test_without_a_long_rest_the_oldest_go(session):
    live = make_live(hand_samples=len(session) * 6 // 10)
    run(live, session)
    assert len(live._store) <= len(session) * 6 // 10 + 100
    assert_same(live.solve(pending=True), offline(all_kept(live)), 1e-4)


@pytest.mark.parametrize(
    ('model', 'code'),
    [
        ('bias+matrix+accel_thermal_bias', 'offline_only'),
        ('bias+matrix+accel_size_effect', 'table_needed'),
    ],
)
def test_an_effect_that_cannot_be_seen_live_is_refused_at_the_start(model, code):
    with refused(InputError, code, model.rpartition('+')[2]):
        LiveByHand(CalibrationOptions(accelerometer_model=model), LiveSettings())


def test_further_effects_are_estimated_as_offline(session):
    options = replace(OPTIONS, accelerometer_model='bias+matrix+accel_quadratic')
    live = LiveByHand(
        options, LiveSettings(), LiveByHandSettings(gravity=GRAVITY), clock=lambda: 0.0
    )
    run(live, session)
    expected = calibrated_by_hand([[SampleBlock(session)]], replace(options, gravity=GRAVITY))
    assert any('accel_quadratic' in name for name in expected.calibration.param_names)
    assert_same(live.solve(pending=True), expected)
