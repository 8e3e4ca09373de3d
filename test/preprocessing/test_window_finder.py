"""
Windows found in simulated sessions, whatever the rates, the faults and the way the streams arrive.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.rest_detection import find_still
from imu_calibration.preprocessing.spike_filter import SPIKE_REACH
from imu_calibration.preprocessing.stream_alignment import JOINT_WAIT
from imu_calibration.preprocessing.window import (
    WINDOW_GROUP_SAMPLES,
    StoredWindows,
    WindowSettings,
    chunks,
)
from imu_calibration.preprocessing.window_cutter import MIN_MOVING_SECONDS, WanderLimit
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.preprocessing.wrap_filter import WRAP_REACH
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile

from worlds.tables import Z_Y_X

START = 1_700_000_000 * 10**9
NAMES = ('outer', 'middle', 'inner')
TABLE = Table.from_mapping(
    {
        'joints': Z_Y_X,
        'gravity': 9.81,
    }
)
COARSE = np.radians(0.088)


def tour():
    """Rests, moves, a spin in both senses and an oscillation, 55 s."""
    builder = MotionBuilder(3)
    builder.rest(3)
    builder.move([90, 0, 0])
    builder.rest(4)
    builder.move([90, 45, 30])
    builder.rest(14)
    builder.spin([[60, 0, 0], [-120, 0, 30]], 5)
    builder.rest(4)
    builder.oscillate([20, 10, 0], 0.5, 8)
    builder.rest(4)
    return Profile('tour', tuple(builder.segments))


def rest(duration, angles=(0, 0, 0)):
    builder = MotionBuilder(3)
    builder.move(angles)
    builder.rest(duration)
    return Profile('rest', tuple(builder.segments[-1:]))


def record(
    profile,
    imu_hz=200,
    joint_hz=100,
    joint_noise=1e-5,
    step=0.0,
    seed=0,
    phase=0.0013,
    force_noise=5e-3,
):
    rng = np.random.default_rng(seed)
    imu_ns = np.round(np.arange(0, profile.duration, 1 / imu_hz) * 1e9).astype(np.int64)
    joint_ns = np.round(
        (phase + np.arange(0, profile.duration - phase, 1 / joint_hz)) * 1e9
    ).astype(np.int64)
    reference = reference_motion(TABLE, profile.at(imu_ns / 1e9))
    position = profile.at(joint_ns / 1e9).position
    position = position + joint_noise * rng.standard_normal(position.shape)
    position = np.round(position / step) * step if step else position
    imu = ImuSamples(
        START + imu_ns,
        reference.force_s + force_noise * rng.standard_normal((len(imu_ns), 3)),
        reference.rate_s + 5e-4 * rng.standard_normal((len(imu_ns), 3)),
        'imu_link',
    )
    return imu, JointSamples(START + joint_ns, position, np.full(position.shape, np.nan), NAMES)


def gather(imu, joints, temperature=None, keep_unused=False, **changed):
    gatherer = MotionGatherer(TABLE, WindowSettings(**changed), keep_unused)
    windows = gatherer.push(SampleBlock(imu, joints, temperature)) + gatherer.finish()
    return windows, gatherer.counts


def seconds(samples):
    return (samples.stamp_ns - START) / 1e9


def of_kind(windows, kind):
    return [window for window in windows if window.kind == kind]


def covered(windows, low, high):
    """Return how much of [low, high] the windows cover, s."""
    return sum(max(0.0, min(high, w.time[-1]) - max(low, w.time[0])) for w in windows)


def same(window, other):
    assert window.kind == other.kind
    for name in ('stamp_ns', 'time', 'force_s', 'rate_s', 'temperature_c'):
        np.testing.assert_array_equal(getattr(window, name), getattr(other, name))
    for name in ('time', 'position', 'rate', 'acceleration', 'jerk'):
        np.testing.assert_array_equal(getattr(window.motion, name), getattr(other.motion, name))


# name: imu_hz, joint_hz, joint noise, encoder step, margin of the edges s, error of position rad,
# rate rad/s, acceleration rad/s^2
STREAMS = {
    'slow': (50, 50, 1e-5, 0.0, 0.15, 5e-5, 3e-3, 0.1),
    'usual': (200, 100, 1e-5, 0.0, 0.15, 5e-5, 2e-3, 0.1),
    'sparse_joints': (400, 50, 1e-5, 0.0, 0.15, 5e-5, 3e-3, 0.1),
    'fast': (2000, 1000, 1e-4, 0.0, 0.15, 2e-4, 5e-3, 0.2),
    'coarse_encoder': (100, 100, 0.0, COARSE, 0.25, 1.5e-3, 3e-2, 1.0),
    'fine_encoder': (400, 200, 0.0, np.radians(0.01), 0.15, 2e-4, 5e-3, 0.2),
}


@pytest.mark.parametrize('name', STREAMS)
def test_every_kind_is_found_where_it_is(name):
    imu_hz, joint_hz, noise, step, edge, *limits = STREAMS[name]
    profile = tour()
    windows, counts = gather(*record(profile, imu_hz, joint_hz, noise, step))
    for kind, segment in (('static', 'rest'), ('spin', 'spin')):
        found, true = of_kind(windows, kind), profile.find(segment)
        for low, high in true:
            settling = 0.5 if low > 0 else 0.0
            assert covered(found, low, high) > high - low - settling - edge
            assert covered(found, low, low + settling - edge) == 0
        total = sum(window.time[-1] - window.time[0] for window in found)
        assert total - sum(covered(found, low, high) for low, high in true) < edge * len(true), (
            f'{kind} outside its segments'
        )
    moving = np.concatenate([profile.find(kind) for kind in ('move', 'ramp', 'oscillation')])
    dynamic = of_kind(windows, 'dynamic')
    for low, high in moving:
        assert covered(dynamic, low, high) > high - low - 0.5 - 2 * edge
    assert set(counts) <= {
        'static',
        'spin',
        'dynamic',
        'settling',
        'not quiet',
        'too short',
        'rest too short',
    }
    check_motion(windows, profile, *limits)


def check_motion(windows, profile, position, rate, acceleration):
    for window in windows:
        truth = profile.at(window.time)
        if window.kind == 'static':
            assert len(window.motion) == 1 and not window.motion.rate.any()
            assert np.abs(truth.position.mean(axis=0) - window.motion.position).max() < position
        else:
            np.testing.assert_array_equal(window.motion.time, window.time)
            assert np.abs(truth.position - window.motion.position).max() < position
            assert np.abs(truth.rate - window.motion.rate).max() < rate
            assert np.abs(truth.acceleration - window.motion.acceleration).max() < acceleration


def test_windows_hold_the_samples_of_the_stream():
    imu, joints = record(tour())
    windows, _ = gather(imu, joints)
    for window in windows:
        place = np.searchsorted(imu.stamp_ns, window.stamp_ns)
        np.testing.assert_array_equal(np.diff(place), 1)
        np.testing.assert_array_equal(imu.force_s[place], window.force_s)
        np.testing.assert_array_equal(imu.rate_s[place], window.rate_s)
        np.testing.assert_allclose(window.time, seconds(imu)[place], rtol=0, atol=1e-12)
    assert len(windows[0]) == len(windows[0].time) and windows[0].period == pytest.approx(0.005)
    np.testing.assert_allclose(windows[0].noise_sd, [[5e-3] * 3, [5e-4] * 3], rtol=0.15)


def test_unused_windows_complete_the_session():
    imu, joints = record(tour())
    imu.force_s[2000:2010] += 3.0
    windows, counts = gather(imu, joints, keep_unused=True)
    np.testing.assert_array_equal(
        np.concatenate([window.stamp_ns for window in windows]), imu.stamp_ns
    )
    assert sum(counts.values()) == len(imu)
    assert {window.reason for window in windows} == {'', 'settling', 'not quiet'}
    used, _ = gather(imu, joints)
    for window, other in zip(used, [w for w in windows if w.kind != 'unused'], strict=True):
        same(window, other)


def faulty_session():
    """Streams with a knock, NaN, a joint gap, late and repeated samples and a temperature; 64 s."""
    profile = tour()
    imu, joints = record(profile, 50, 50, seed=3)
    imu.force_s[820:826] += np.random.default_rng(1).normal(0, 1, (6, 3))
    imu.rate_s[1500:1503] = np.nan
    joints = joints.select(np.delete(np.arange(len(joints)), np.r_[300:330, 1200]))
    order = np.arange(len(imu))
    order[[400, 401]] = [401, 400]
    order[700] = 699
    stamps = START + np.arange(0, int(profile.duration), 2, dtype=np.int64) * 10**9
    return imu.select(order), joints, TemperatureSamples(stamps, 20 + 0.1 * np.arange(len(stamps)))


def with_reset(samples, place):
    """Set the clock back by seven seconds from sample `place` on."""
    stamps = samples.stamp_ns.copy()
    stamps[place:] -= 7 * 10**9
    values = {name: getattr(samples, name) for name in type(samples).__dataclass_fields__}
    return type(samples)(**{**values, 'stamp_ns': stamps})


def pieces(samples, cuts):
    bounds = sorted({0, len(samples), *(int(cut * len(samples)) for cut in cuts)})
    return [
        samples.select(slice(low, high)) for low, high in zip(bounds[:-1], bounds[1:], strict=True)
    ]


CUTS = st.lists(st.floats(0, 1), max_size=8)


@pytest.mark.parametrize('reset', [False, True])
def test_outcome_does_not_depend_on_how_the_streams_arrive(reset):
    imu, joints, temperature = faulty_session()
    if reset:
        imu, joints, temperature = with_reset(imu, 2000), with_reset(joints, 2000 - 31), None
    changed = {'chunk': 6.0, 'overlap': 1.0, 'window_maximum': 5.0}
    expected, expected_counts = gather(imu, joints, temperature, keep_unused=True, **changed)
    assert {window.kind for window in expected} == {'static', 'spin', 'dynamic', 'unused'}
    assert len(expected) > 25

    @settings(max_examples=6, deadline=None, derandomize=True)
    @given(CUTS, CUTS, st.randoms(use_true_random=False), st.sampled_from([1, 50, 100000]))
    def check(imu_cuts, joint_cuts, random, largest):
        queue = (
            [('imu', part) for part in pieces(imu, imu_cuts)],
            [('joints', part) for part in pieces(joints, joint_cuts)],
        )
        gatherer = MotionGatherer(TABLE, WindowSettings(**changed), keep_unused=True)
        windows, told = [], 0
        while queue[0] or queue[1]:
            name, part = random.choice([q for q in queue if q]).pop(0)
            if name == 'imu' and temperature is not None:
                known = int(
                    np.searchsorted(temperature.stamp_ns, part.stamp_ns.max(), side='right')
                )
                if known > told:
                    windows += gatherer.push(
                        SampleBlock(temperature=temperature.select(slice(told, known)))
                    )
                told = max(told, known)
            for start in range(0, len(part), largest) if len(part) < 100 else [None]:
                chosen = part if start is None else part.select(slice(start, start + largest))
                windows += gatherer.push(SampleBlock(**{name: chosen}))
        windows += gatherer.finish()
        assert gatherer.counts == expected_counts
        for window, other in zip(windows, expected, strict=True):
            same(window, other)

    check()


def test_knock_stays_out_of_static_windows():
    imu, joints = record(rest(16), imu_hz=1000)
    time = seconds(imu)
    ringing = np.where(
        time >= 8, np.exp(-(time - 8) / 0.02) * np.sin(2 * np.pi * 80 * (time - 8)), 0.0
    )
    imu.force_s[:, 1] += 0.5 * ringing
    windows, counts = gather(imu, joints)
    assert [window.kind for window in windows] == ['static', 'static']
    assert 7.7 < windows[0].time[-1] < 8.0
    assert 8.5 < windows[1].time[0] < 8.8
    assert 0 < counts['not quiet'] < 300


@pytest.mark.parametrize(
    'hertz, swells, rests',
    [(31.0, 0.0, True), (1.5, 0.0, False), (31.0, 8.0, False)],
    ids=['vibration', 'hand', 'knocks'],
)
def test_a_vibrating_table_rests_while_its_joints_rest_and_a_moved_or_knocked_one_does_not(
    hertz, swells, rests
):
    imu, joints = record(rest(20), imu_hz=200)
    time = seconds(imu)
    size = 0.5 * np.exp(-swells * (time % 0.7))
    imu.force_s[:, 2] += np.where(
        (time > 8) & (time < 12), size * np.sin(2 * np.pi * hertz * time), 0.0
    )
    windows, _ = gather(imu, joints)
    assert (
        bool(covered(windows, 8, 12) > 2.0) is rests
        and covered(windows, 0, 8) > 7.5
        and covered(windows, 12, 20) > 6.5
    )
    in_hand = find_still(imu)
    assert not any(piece.start < 1610 and piece.stop > 2390 for piece in in_hand), (
        'without joints it may be a hand'
    )
    assert sum(time[piece][-1] - time[piece][0] for piece in in_hand) < 16.5


def test_settling_can_be_longer():
    profile = tour()
    windows, _ = gather(*record(profile), settling=2.0)
    found = of_kind(windows, 'static')
    for low, high in profile.find('rest')[1:]:
        assert (
            covered(found, low, low + 1.85) == 0
            and covered(found, low + 2.1, high) > high - low - 2.3
        )


def test_turn_on_is_kept_out():
    windows, counts = gather(*record(rest(10)), turn_on=4.0)
    assert windows[0].time[0] == pytest.approx(4.0) and counts == {'turn-on': 800, 'static': 1200}


def test_long_windows_are_cut_in_equal_pieces():
    windows, _ = gather(*record(rest(50), imu_hz=50))
    assert [len(window) for window in windows] == [1000, 750, 750]


def test_cutting_leaves_no_piece_too_short():
    imu, joints = record(rest(10.5))
    windows, counts = gather(imu, joints, window_maximum=1.5)
    assert (
        counts == {'static': len(imu)}
        and all(len(window) >= 200 for window in windows)
        and len(windows) >= 5
    )


@pytest.mark.parametrize('chunk, overlap', [(2.0, 0.2), (7.3, 1.0), (600.0, 60.0)])
def test_grid_of_the_chunks_hardly_matters(chunk, overlap):
    profile = tour()
    imu, joints = record(profile)
    usual, _ = gather(imu, joints)
    windows, _ = gather(imu, joints, chunk=chunk, overlap=overlap)
    for window, other in zip(windows, usual, strict=True):
        assert (
            window.kind == other.kind
            and abs(window.time[0] - other.time[0]) < 0.1
            and abs(window.time[-1] - other.time[-1]) < 0.1
        )
    check_motion(windows, profile, 1e-4, 5e-3, 0.3)


def test_dropped_imu_samples_end_a_window():
    imu, joints = record(rest(20))
    keep = (seconds(imu) < 9) | (seconds(imu) > 11)
    windows, counts = gather(imu.select(keep), joints)
    assert [window.kind for window in windows] == ['static', 'static']
    assert windows[0].time[-1] < 9 and windows[1].time[0] > 11
    assert counts == {'static': int(keep.sum())}


def test_samples_in_a_joint_gap_are_not_used():
    profile = tour()
    imu, joints = record(profile)
    start, stop = profile.find('spin')[0]
    middle = (start + stop) / 2
    keep = np.abs(seconds(joints) - middle) > 0.3
    windows, counts = gather(imu, joints.select(keep))
    assert covered(windows, middle - 0.29, middle + 0.29) == 0
    assert counts['no joint state'] == pytest.approx(0.6 * 200, abs=4)
    check_motion(windows, profile, 5e-5, 4e-3, 0.3)


def test_lost_messages_do_not_cut_windows():
    imu, joints = record(tour(), seed=2)
    rng = np.random.default_rng(5)
    whole, _ = gather(imu, joints)
    windows, _ = gather(
        imu.select(rng.random(len(imu)) > 0.05), joints.select(rng.random(len(joints)) > 0.05)
    )
    assert [window.kind for window in windows] == [window.kind for window in whole]


def test_nan_burst_is_counted():
    imu, joints = record(rest(10))
    imu.force_s[500:540] = np.nan
    imu.rate_s[800, 0] = np.inf
    windows, counts = gather(imu, joints)
    assert counts == {'imu not finite': 41, 'static': len(imu) - 41}
    assert len(windows) == 2  # 40 samples at 200 Hz are longer than the longest gap, one is not


def test_dithering_encoder_is_at_rest():
    imu, joints = record(rest(20, (30, 0, 0)), imu_hz=100)
    rng = np.random.default_rng(0)
    joints.position[:] = (
        np.round((joints.position + rng.normal(0, 2e-4, joints.position.shape)) / COARSE + 0.5)
        * COARSE
    )
    assert np.count_nonzero(np.diff(joints.position[:, 0])) > 50
    windows, counts = gather(imu, joints)
    assert counts == {'static': len(imu)}
    assert not windows[0].motion.rate.any()


def test_single_encoder_step_at_rest_is_no_motion():
    imu, joints = record(rest(12), imu_hz=100, joint_noise=0.0)
    joints.position[600:, 1] += COARSE
    windows, counts = gather(imu, joints)
    assert counts == {'static': len(imu)} and not windows[0].motion.rate.any()


def test_creep_is_told_as_a_rate():
    imu, joints = record(rest(15))
    joints.position[:, 0] += 1e-3 * seconds(joints)
    (window,), _ = gather(imu, joints)
    np.testing.assert_allclose(window.motion.rate, [[1e-3, 0, 0]], atol=2e-6)
    np.testing.assert_allclose(window.motion.position[0, 0], 7.5e-3, atol=2e-5)


def test_short_stop_between_moves_is_dynamic():
    builder = MotionBuilder(3)
    builder.rest(3)
    for angle in (40, 80, 120):
        builder.move([angle, 0, 0])
        builder.rest(0.4)
    builder.rest(3)
    profile = Profile('steps', tuple(builder.segments))
    windows, _ = gather(*record(profile))
    assert [window.kind for window in windows] == ['static', 'dynamic', 'static']
    check_motion(windows[1:2], profile, 5e-5, 2e-3, 0.1)


def test_whole_turns_in_the_readings_do_not_matter():
    profile = rest(10, (180, 0, 0))
    imu, joints = record(profile, joint_noise=1e-4)
    wrapped = JointSamples(
        joints.stamp_ns, (joints.position + np.pi) % (2 * np.pi) - np.pi, joints.velocity, NAMES
    )
    assert np.ptp(wrapped.position[:, 0]) > 6
    windows, counts = gather(imu, wrapped, chunk=3.0)
    assert counts == {'static': len(imu)}
    assert np.cos(windows[0].motion.position[0, 0]) == pytest.approx(-1.0, abs=1e-8)


def test_wrapped_spin_is_the_same_motion():
    profile = tour()
    imu, joints = record(profile, joint_noise=0.0)
    wrapped = JointSamples(
        joints.stamp_ns, (joints.position + np.pi) % (2 * np.pi) - np.pi, joints.velocity, NAMES
    )
    for window, other in zip(gather(imu, joints)[0], gather(imu, wrapped)[0], strict=True):
        assert window.kind == other.kind
        np.testing.assert_allclose(other.motion.rate, window.motion.rate, atol=1e-6)


def test_temperature_is_interpolated_and_held():
    imu, joints = record(rest(10))
    temperature = TemperatureSamples(
        START + np.array([2, 3, 5], np.int64) * 10**9, np.array([20.0, 21.0, 25.0])
    )
    (window,), _ = gather(imu, joints, temperature)
    np.testing.assert_allclose(
        window.temperature_c, np.interp(window.time, [2, 3, 5], [20, 21, 25]), atol=1e-9
    )
    assert gather(imu, joints)[0][0].temperature_c is None


def test_joints_are_ordered_by_the_table():
    imu, joints = record(tour())
    shuffled = JointSamples(
        joints.stamp_ns,
        joints.position[:, [2, 0, 1]],
        joints.velocity[:, [2, 0, 1]],
        ('inner', 'outer', 'middle'),
    )
    for window, other in zip(gather(imu, joints)[0], gather(imu, shuffled)[0], strict=True):
        same(window, other)


def test_unknown_joint_names_are_refused():
    imu, joints = record(rest(3))
    wrong = JointSamples(joints.stamp_ns, joints.position, joints.velocity, ('pan', 'tilt', 'roll'))
    with refused(InputError, 'joint_names', 'outer, middle, inner', 'pan, tilt, roll'):
        gather(imu, wrong)


def test_clock_set_back_starts_again():
    profile = tour()
    imu, joints = record(profile)
    imu, joints = with_reset(imu, 4000), with_reset(joints, 2000)
    windows, counts = gather(imu, joints, keep_unused=True)
    assert counts['imu clock reset'] == counts['joints clock reset'] == 1
    assert 'no joint state' not in counts and counts.get('edge of joints', 0) <= 4
    time = np.concatenate([window.time for window in windows])
    assert np.all(np.diff(time) > 0) and len(time) >= len(imu) - 4
    assert not any(np.any(np.diff(window.stamp_ns) < 0) for window in windows)
    assert {'static', 'spin', 'dynamic'} <= {
        window.kind for window in windows if window.time[0] > 20
    }


def test_one_clock_set_back_alone_goes_on():
    builder = MotionBuilder(3)
    builder.rest(200)
    imu, joints = record(Profile('long', tuple(builder.segments)), imu_hz=50, joint_hz=50)
    imu = with_reset(imu, 2500)
    gatherer, windows = MotionGatherer(TABLE), []
    for start in range(0, len(imu), 100):
        windows += gatherer.push(
            SampleBlock(
                imu.select(slice(start, start + 100)), joints.select(slice(start, start + 100))
            )
        )
    windows += gatherer.finish()
    assert covered(windows, 55, 190) > 120


def stream(n_seconds, imu_hz=20, joint_hz=20, with_imu=lambda k: True, with_joints=lambda k: True):
    """
    Push a resting session second by second and return the sizes.

    They are the largest number of samples held, the counts and the windows.
    """
    gatherer = MotionGatherer(TABLE)
    held, windows = 0, []
    rng = np.random.default_rng(0)
    for k in range(n_seconds):
        at = START + (k * 10**9 + np.arange(imu_hz) * (10**9 // imu_hz)).astype(np.int64)
        imu = ImuSamples(
            at,
            [0, 0, 9.81] + 0.01 * rng.standard_normal((imu_hz, 3)),
            1e-3 * rng.standard_normal((imu_hz, 3)),
        )
        joints = JointSamples(
            at[:joint_hz], np.zeros((joint_hz, 3)), np.zeros((joint_hz, 3)), NAMES
        )
        windows += gatherer.push(
            SampleBlock(imu if with_imu(k) else None, joints if with_joints(k) else None)
        )
        held = max(held, gatherer.n_buffered)
    return held, gatherer, windows + gatherer.finish()


SILENCE = {
    'no joints': {'with_joints': lambda k: False},
    'no imu': {'with_imu': lambda k: False},
    'joints stop': {'with_joints': lambda k: k < 100},
    'imu stops': {'with_imu': lambda k: k < 100},
    'both there': {},
}


@pytest.mark.parametrize('case', SILENCE)
def test_memory_is_bounded_when_a_stream_is_silent(case):
    held, gatherer, windows = stream(600, **SILENCE[case])
    longest = JOINT_WAIT + 2 * 20 + 4 * 2 + 5  # waiting, two chunks or windows, margins, batch
    assert held < 2 * 20 * longest
    used = sum(len(window) for window in windows)
    # By the filters of spikes and wraps, and late when the joints have gone on for so long.
    held_back = SPIKE_REACH + WRAP_REACH if case == 'imu stops' else 0
    assert used == {'no joints': 0, 'no imu': 0, 'both there': 12000}.get(case, 2000 - held_back)
    expected = {'no joints': 12000, 'joints stop': 10000}.get(case, 0)
    assert gatherer.counts.get('no joint state', 0) == expected


def test_joints_that_come_back_are_used_again():
    _, gatherer, windows = stream(400, with_joints=lambda k: not 100 <= k < 250)
    assert gatherer.counts['no joint state'] == pytest.approx(150 * 20, abs=5)
    assert (
        covered(windows, 0, 100) > 97
        and covered(windows, 251, 400) > 145
        and covered(windows, 101, 249) == 0
    )


def test_joints_stuck_while_the_imu_turns_give_no_static_window():
    imu, joints = record(tour())
    still = JointSamples(joints.stamp_ns, np.zeros(joints.position.shape), joints.velocity, NAMES)
    profile = tour()
    windows, _ = gather(imu, still)
    for kind in ('move', 'oscillation'):
        for low, high in profile.find(kind):
            assert covered(windows, low + 0.3, high - 0.3) == 0


def test_stream_statistics_are_at_hand():
    imu, joints = record(rest(10))
    gatherer = MotionGatherer(TABLE)
    gatherer.push(SampleBlock(imu, joints))
    statistics = gatherer.cleaner.statistics()
    assert statistics['imu'].rate == pytest.approx(200) and statistics[
        'joints'
    ].rate == pytest.approx(100)
    assert statistics['temperature'].count == 0


def test_the_quieter_the_accelerometer_the_shorter_its_moving_windows():
    """
    A bias that wanders by 10 ug shows within 20 s with noise of 1 ug/sqrt(Hz).

    It does not show with 120, nor where late stamps turn gravity by more.
    """
    rng, time = np.random.default_rng(4), np.arange(2000) * 0.01
    cuts = {}
    for density, jitter in ((1e-5, 0.0), (1e-4, 0.0), (1.2e-3, 0.0), (1e-5, 5e-5)):
        limit = WanderLimit()
        samples = SimpleSamples(
            time + rng.normal(0.0, jitter, 2000),
            rng.normal(0.0, 10.0 * density, (2000, 3)),
            np.ones((2000, 3)),
        )
        assert limit.n_windows(samples) == 1
        limit.add_rest(samples)
        cuts[density, jitter] = limit.n_windows(samples)
    assert list(cuts.values()) == [np.ceil(time[-1] / MIN_MOVING_SECONDS), 3, 1, 1]


class SimpleSamples:
    """Time, force and rate of samples."""

    def __init__(self, time, force_s, rate_s):
        self.time, self.force_s, self.rate_s = time, force_s, rate_s

    def __len__(self):
        return len(self.time)


def test_long_motion_of_a_quiet_imu_is_cut_short_and_rests_are_not():
    builder = MotionBuilder(3)
    builder.rest(8.0)
    builder.oscillate([[40.0], [30.0], [20.0]], [[0.3], [0.4], [0.5]], 12.0)
    builder.rest(8.0)
    found = [
        gather(*record(Profile('', tuple(builder.segments)), force_noise=noise))[0]
        for noise in (1e-4, 5e-3)
    ]
    longest = [
        max(window.time[-1] - window.time[0] for window in of_kind(windows, kind))
        for windows in found
        for kind in ('dynamic', 'static')
    ]
    assert (
        longest[0] <= MIN_MOVING_SECONDS + 0.01
        and longest[2] > 10.0
        and min(longest[1], longest[3]) > 7.0
    )


def test_columns_of_a_chunk_need_the_memory_of_one_chunk():
    """
    Windows in groups of at most WINDOW_GROUP_SAMPLES samples, a longer one alone.

    The columns of a group are in memory at once.
    """
    sizes = [WINDOW_GROUP_SAMPLES - 1, WINDOW_GROUP_SAMPLES - 1, 1, 1, 3 * WINDOW_GROUP_SAMPLES, 5]
    groups = [
        [len(window.motion) for window in group]
        for group in chunks([SimpleNamespace(motion=range(size)) for size in sizes])
    ]
    assert groups == [
        [WINDOW_GROUP_SAMPLES - 1],
        [WINDOW_GROUP_SAMPLES - 1, 1],
        [1],
        [3 * WINDOW_GROUP_SAMPLES],
        [5],
    ]
    assert list(chunks([])) == []


def test_stored_windows_are_the_windows():
    """
    In order, in turn and out of turn, while more are appended, and in a file instead of memory.
    """
    windows, _ = gather(*record(rest(5)))
    windows, stored = [*windows, *gather(*record(rest(3), seed=1))[0]], StoredWindows()
    for window in windows:
        stored.extend([window])
        same(stored[0], windows[0])
    stored._file.rollover()
    stored.extend(windows[:1])
    for found, window in zip(stored, [*windows, windows[0]], strict=True):
        same(found, window)
