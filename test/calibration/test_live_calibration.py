"""
The live answer is the offline answer; what is saved comes back; memory stays bounded. No ROS here.
"""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.calibration.calibrate import conclude
from imu_calibration.calibration.live import LiveSettings, SolvePacer
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import DocumentError, InputError, NotObservableError
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from imu_calibration.document.decision import HELPS
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.preprocessing.stream_watch import StreamWatch
from imu_calibration.references.turntable import collector
from imu_calibration.references.turntable.live_windows import LiveCalibration
from imu_calibration.references.turntable.table_calibration import (
    solved_windows,
)
from imu_calibration.references.turntable.window_observations import WindowObservations
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

from worlds.calibrated import calibrated_on_table
from worlds.tables import three_axis_table

TABLE = three_axis_table(height=150.0, mount={'rpy_deg': [0, 0, 0], 'xyz': None})
OPTIONS = CalibrationOptions(
    catalogue=CATALOGUE.with_candidates('accel_quadratic+gyro_g_sensitivity+time_offset')
)
SD = 1e-6
"""Live and offline agree to this share of the standard deviation."""


def session(tilt=(0.0, 0.0), seed=1):
    """IMU and joint samples of the quick profile, and the true values."""
    model = SensorModel(
        ('bias', 'matrix', 'accel_size_effect'),
        ('bias', 'matrix'),
        ('table_tilt',),
        TABLE.joint_names,
    )
    values = random_values(model, 'industrial', seed)
    values[model.slices['reference', 'table_tilt']] = tilt
    imu, joints, _ = simulate_session(
        model.at(values),
        values,
        TABLE,
        profile=make_profile('quick', seed, TABLE),
        options=SimulationOptions(50.0, 50.0),
        seed=seed,
    )
    return imu, joints


@pytest.fixture(scope='module')
def quick():
    """One session."""
    return session()


@pytest.fixture(scope='module')
def expected(quick):
    """What the offline tool says of it."""
    return offline(quick)


def blocks(*streams, seed=0, mean_seconds=0.5):
    """Cut a session into uneven blocks as they would come from topics."""
    rng = np.random.default_rng(seed)
    first, last = streams[0].stamp_ns[0] - 1, max(samples.stamp_ns[-1] for samples in streams) + 1
    edges = np.sort(rng.integers(first, last, int((last - first) * 1e-9 / mean_seconds)))
    edges = np.concatenate([[first], edges, [last]])
    cuts = [np.searchsorted(s.stamp_ns, edges) for s in streams]
    for k in range(len(edges) - 1):
        parts = [s.select(slice(c[k], c[k + 1])) for s, c in zip(streams, cuts)]
        yield SampleBlock(*parts)


def offline(*sessions, options=OPTIONS):
    """Return what the offline tool says."""
    return calibrated_on_table([[SampleBlock(*s)] for s in sessions], TABLE, options)


def run(live, *streams, seed=0):
    """Push a session and return the completed windows."""
    return [window for block in blocks(*streams, seed=seed) for window in live.push(block)]


def assert_same(a, b, share=SD):
    """
    Assert that two calibrations agree to a share of their standard deviations, status by status.
    """
    assert a.param_names == b.param_names and a.status == b.status
    assert np.max(np.abs(a.values - b.values) / b.sd) < share
    np.testing.assert_allclose(a.sd, b.sd, rtol=1e-6)


@pytest.fixture(scope='module')
def whole(quick):
    """Return a live calibration after the session; solutions do not change it."""
    live = LiveCalibration(TABLE, OPTIONS)
    run(live, *quick)
    return live


def test_the_live_answer_is_the_offline_answer(whole, expected):
    result = whole.solve(pending=True)
    assert_same(result.calibration, expected.calibration)
    for section in ('windows', 'samples_used', 'dropped', 'stream'):
        assert result.calibration.statistics[section] == expected.calibration.statistics[section]
    assert result.calibration.conditions == expected.calibration.conditions


def test_solving_on_the_way_changes_nothing(quick, expected):
    live, count = LiveCalibration(TABLE, OPTIONS), 0
    for number, block in enumerate(blocks(*quick, seed=3)):
        live.push(block)
        if number % 60 == 59:
            live.solve(pending=number % 120 == 119)
            count += 1
    assert count >= 3
    assert_same(live.solve(pending=True).calibration, expected.calibration)


def test_windows_that_are_open_count_only_when_asked_for(quick):
    """
    In the middle of a stretch.

    With them there are more samples, without them the windows that were completed.
    """
    live = LiveCalibration(TABLE, OPTIONS)
    completed = [window for part in list(blocks(*quick))[:280] for window in live.push(part)]
    used = sum(len(window) for window in completed if window.kind != 'unused')
    without, with_open = (
        sum(live.solve(pending=flag).calibration.statistics['samples_used'].values())
        for flag in (False, True)
    )
    assert without == used < with_open
    assert sum(live.solve().calibration.statistics['samples_used'].values()) == used


@pytest.fixture(scope='module')
def tilted():
    """A session on a table that stands far from level."""
    return session((0.004, -0.003), seed=2)


def test_a_tilted_table_is_linearised_anew_like_offline(tilted):
    live = LiveCalibration(TABLE, OPTIONS)
    run(live, *tilted)
    expected = offline(tilted)
    tilt = expected.calibration.value('reference', 'table_tilt')
    assert np.all(
        np.abs(tilt - [0.004, -0.003])
        < 4 * expected.calibration.sd[expected.model.slices['reference', 'table_tilt']]
    )
    assert_same(live.solve(pending=True).calibration, expected.calibration)
    assert not live.needs_linearising


def test_a_store_too_small_is_said_and_still_gives_the_first_pass(tilted):
    live = LiveCalibration(TABLE, OPTIONS, settings=LiveSettings(store_samples=100))
    run(live, *tilted)
    result = live.solve(pending=True)
    assert live.needs_linearising and not live._collector.store.complete
    tilt = result.calibration.value('reference', 'table_tilt')
    assert np.all(
        np.abs(tilt - [0.004, -0.003])
        < 6 * result.calibration.sd[result.model.slices['reference', 'table_tilt']] + 1e-5
    )


def cut(samples, start, stop):
    """The part of samples between two shares of their length."""
    return samples.select(slice(int(start * len(samples)), int(stop * len(samples))))


def test_a_session_resumed_from_its_state_equals_two_recordings(quick):
    halves = [tuple(cut(s, *part) for s in quick) for part in ((0.0, 0.5), (0.5, 1.0))]
    first = LiveCalibration(TABLE, OPTIONS)
    run(first, *halves[0])
    data = collector.to_bytes(first.gathered(pending=True), first.model)
    second = LiveCalibration(TABLE, OPTIONS, saved=data)
    assert second.n_windows > 20
    run(second, *halves[1])
    result, expected = second.solve(pending=True), offline(*halves)
    assert_same(result.calibration, expected.calibration)
    assert result.calibration.conditions == expected.calibration.conditions
    # Solving does not add the earlier run again.
    assert_same(second.solve(pending=True).calibration, expected.calibration)


WARMTH = np.array([0.004, -0.006, 0.0025])
"""What a kelvin adds to the readings of the accelerometers, m/s^2."""


def at_temperature(samples, temperature_c):
    """
    A part of a session, warmed up by 3 K about a temperature.

    With the readings of accelerometers that drift with it from 20 C on.
    """
    imu, joints = samples
    warm = temperature_c + np.linspace(-1.5, 1.5, len(imu))
    return (
        replace(imu, force_s=imu.force_s + (warm - 20.0)[:, None] * WARMTH),
        joints,
        TemperatureSamples(imu.stamp_ns, warm),
    )


def test_a_proven_session_is_proven_after_resume(whole):
    """
    Held-out blocks are saved.

    Without them the resumed session was unproven until as many windows had come again.
    """
    before = whole.solve(pending=True).calibration
    after = LiveCalibration(TABLE, OPTIONS, saved=whole.saved(pending=True)).solve().calibration
    assert set(before.decisions.values()) == {HELPS} and after.decisions == before.decisions
    for sensor in before.proof:
        assert after.proof[sensor].windows == before.proof[sensor].windows
        assert after.proof[sensor].after == pytest.approx(before.proof[sensor].after, rel=1e-3)


def test_a_session_resumed_30_kelvin_warmer_knows_both_temperatures(quick, expected):
    """
    Each part alone says little of the drift.

    The two together say it, about the temperature of the first.
    """
    parts = [
        at_temperature([cut(s, *part) for s in quick], temperature_c)
        for part, temperature_c in (((0.0, 0.5), 20.0), ((0.5, 1.0), 50.0))
    ]
    options = CalibrationOptions(
        accelerometer_model='bias+matrix+accel_size_effect+accel_thermal_bias'
    )
    first = LiveCalibration(TABLE, options)
    run(first, *parts[0])
    second = LiveCalibration(TABLE, options, saved=first.saved(pending=True))
    assert (
        second.model.temperature_ref_c
        == first.model.temperature_ref_c
        == pytest.approx(18.5, abs=0.6)
    )
    run(second, *parts[1])
    found = second.solve(pending=True).calibration
    assert_same(found, offline(*parts, options=options).calibration)
    plain = expected.calibration  # before it was warmed
    for effect, truth in (
        ('accel_thermal_bias', WARMTH),
        (
            'bias',
            plain.value('accelerometer', 'bias') + (second.model.temperature_ref_c - 20.0) * WARMTH,
        ),
    ):
        error = found.value('accelerometer', effect) - truth
        assert np.all(np.abs(error) < 4 * found.sd[found.model.slices['accelerometer', effect]]), (
            effect
        )
    assert found.sd[found.model.slices['accelerometer', 'accel_thermal_bias']].max() < 1e-4


def test_a_state_comes_back_to_the_last_bit(whole):
    gathered = whole.gathered()
    data = collector.to_bytes(gathered, whole.model)
    again = collector.from_bytes(data)[0]
    assert collector.to_bytes(again, whole.model) == data
    found, expected = (
        conclude(
            solved_windows(WindowObservations(TABLE, each, whole.model), CalibrationOptions())
        ).calibration
        for each in (again, gathered)
    )
    assert_same(found, expected, 1e-12)


def test_before_the_first_temperature_there_is_nothing_to_save():
    live = LiveCalibration(
        TABLE, CalibrationOptions(accelerometer_model='bias+matrix+accel_thermal_bias')
    )
    with refused(InputError, 'temperature_missing'):
        live.saved()


def test_a_state_of_another_model_or_a_broken_one_is_refused():
    live = LiveCalibration(TABLE, OPTIONS)
    data = collector.to_bytes(live.gathered(), live.model)
    with refused(DocumentError, 'other_model', 'accel_size_effect'):
        LiveCalibration(
            TABLE,
            CalibrationOptions(accelerometer_model='bias+matrix+accel_thermal_bias'),
            saved=data,
        )
    with refused(DocumentError, 'other_model', 25, 50):
        collector.require_columns(
            collector.from_bytes(data)[1], replace(live.model, temperature_ref_c=50.0)
        )
    for broken in (
        b'',
        b'nothing',
        data[: len(data) // 2],
        data.replace(b'accumulator/4', b'accumulator/9'),
    ):
        with refused(DocumentError, 'accumulator_damaged'):
            collector.from_bytes(broken)


def test_before_any_motion_it_waits_and_says_for_what():
    live = LiveCalibration(TABLE, OPTIONS)
    with pytest.raises(NotObservableError):
        live.solve()
    groups = {(g.sensor, g.effect): g for g in live.groups()}
    assert all(g.status == 'waiting' and g.needs for g in groups.values())
    assert ('accelerometer', 'accel_size_effect') in groups


def test_groups_name_the_motion_that_is_still_needed(quick):
    options = CalibrationOptions(accelerometer_model='bias+matrix+accel_size_effect')
    live = LiveCalibration(TABLE, options)
    still = [
        window for window in run(LiveCalibration(TABLE, OPTIONS), *quick) if window.kind == 'static'
    ]
    until = int(np.searchsorted(quick[0].stamp_ns, still[1].stamp_ns[-1]))
    run(live, *(s.select(slice(0, until)) for s in quick))
    live.solve(pending=True)
    groups = {(g.sensor, g.effect): g for g in live.groups()}
    lacking = [g for g in groups.values() if g.status != 'determined']
    assert lacking and all(g.needs and g.sd > g.tolerance for g in lacking)
    run(live, *(s.select(slice(until, None)) for s in quick), seed=1)
    live.solve(pending=True)
    done = {(g.sensor, g.effect): g for g in live.groups()}
    assert all(
        g.sd <= g.tolerance and not g.needs for g in done.values() if g.status == 'determined'
    )
    assert sum(g.status == 'determined' for g in done.values()) > sum(
        g.status == 'determined' for g in groups.values()
    )


def test_residuals_are_what_the_model_leaves(quick):
    live = LiveCalibration(TABLE, OPTIONS, settings=LiveSettings(residual_rate=10.0))
    windows = run(live, *quick)
    assert live.residuals(windows) is None
    result = live.solve(pending=True)
    residuals = live.residuals(windows)
    samples = sum(len(window) for window in windows)
    assert 0.15 * samples < len(residuals) < 0.25 * samples
    noise = result.solution.noise['gyroscope'].white_sd
    assert np.all(np.abs(residuals.rate_s.std(axis=0) / noise - 1) < 0.15)
    assert set(residuals.stamp_ns) <= set(quick[0].stamp_ns)


@pytest.mark.parametrize('column', [['array', [10**12, 0]], ['dict', 10**12, [], ['plain', []]]])
def test_a_column_of_more_values_than_any_session_has_is_refused(column):
    with pytest.raises(ValueError, match='at most'):
        collector._unpacked(column, collector._SavedNumbers(b'', 10**6))


def test_windows_of_one_kind_are_saved_in_common_columns(whole):
    """Each small array of each window was written alone, which took ten times as long."""
    rows = [row for row in whole.gathered().accumulator.rows if row.kind == 'static']
    counts = []
    for count in (len(rows) // 2, len(rows)):
        collector._packed([rows[:count]], arrays := [])
        counts.append(len(arrays))
    assert counts[0] == counts[1]


def test_memory_stays_bounded(quick):
    live = LiveCalibration(TABLE, OPTIONS, settings=LiveSettings(store_samples=2000))
    imu, joints = quick
    length = int(imu.stamp_ns[-1] - imu.stamp_ns[0]) + 10**10
    largest = []
    for turn in range(3):
        run(
            live,
            replace(imu, stamp_ns=imu.stamp_ns + turn * length),
            replace(joints, stamp_ns=joints.stamp_ns + turn * length),
        )
        collector = live._collector
        assert not collector.gathered.kept
        largest.append(collector.gatherer.n_buffered)
    assert max(largest) < 5000


def test_a_thermal_effect_waits_for_the_first_temperature(quick):
    options = CalibrationOptions(accelerometer_model='bias+matrix+accel_thermal_bias')
    live = LiveCalibration(TABLE, options)
    parts = list(blocks(*quick))[:5]
    for block in parts:
        assert live.push(block) == []
    with refused(InputError, 'temperature_missing', 'imu/temperature'):
        live.solve()
    warm = TemperatureSamples(parts[0].imu.stamp_ns[:1], np.array([31.4]))
    live.push(SampleBlock(temperature=warm))
    assert live.model.temperature_ref_c == 31.0
    assert live._collector.gathered.first_stamp_ns == parts[0].imu.stamp_ns[0]


def test_solving_takes_no_more_than_its_share():
    pacer = SolvePacer(0.1)
    assert pacer.due(0.0)
    pacer.note(0.0, 2.0)
    assert not pacer.due(19.9) and pacer.due(20.0)


def stream_block(n_imu, n_joints, start=0.0):
    """A block with so many samples at 100 Hz from `start` s on."""
    imu = ImuSamples(
        ((start + np.arange(n_imu) / 100) * 1e9).astype(np.int64),
        np.zeros((n_imu, 3)),
        np.zeros((n_imu, 3)),
    )
    joints = JointSamples(
        ((start + np.arange(n_joints) / 100) * 1e9).astype(np.int64),
        np.zeros((n_joints, 3)),
        np.zeros((n_joints, 3)),
    )
    return SampleBlock(imu, joints)


def test_streams_are_watched_by_silence_stamps_and_losses():
    watch = StreamWatch()
    assert watch.state(0.0).word == 'silent'
    watch.note(stream_block(100, 0), 0.0)
    assert 'no JointState messages received' in watch.state(1.0).message
    watch.note(stream_block(100, 100), 1.0)
    state = watch.state(1.0)
    assert state.word == 'good' and state.values['imu rate [Hz]'] == '100.0'
    watch.note_counts({'imu not finite': 3, 'static': 50}, 1.5)
    assert watch.state(1.6).word == 'trouble' and '3 imu not finite' in watch.state(1.6).message
    watch.note(stream_block(100, 100, 5.0), 12.0)
    assert watch.state(12.0).word == 'good'
    watch.note(
        SampleBlock(imu=stream_block(100, 0, 30.0).imu, joints=stream_block(0, 100, 6.0).joints),
        13.0,
    )
    assert watch.state(13.0).word == 'good'  # for a moment
    watch.note(
        SampleBlock(imu=stream_block(100, 0, 32.0).imu, joints=stream_block(0, 100, 8.0).joints),
        15.5,
    )
    assert 'ahead of the joint stamps' in watch.state(15.5).message
    assert watch.state(30.0).word == 'silent'
