"""
How much it vibrates.

The running variance, its way through windows and live compensation, and the rectification that is
found by it.
"""

import numpy as np
import pytest

from imu_calibration.compensation.stream import CompensationStream, SampleCompensation
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.signal_history import BandVariance
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable.estimation.session_noise import white_noise
from imu_calibration.references.turntable.selection.investigation import investigate
from imu_calibration.references.turntable.selection.testable_effects import (
    testable_effects as asked_of,
)
from imu_calibration.references.turntable.window_statistics import reduce_windows
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.sensor_noise import SimulatedNoise
from imu_calibration.simulation.session import (
    SimulationOptions,
    noiseless_outputs,
    simulate_session,
)

from worlds.candidates import with_candidates
from worlds.compensation_cases import random_calibration
from worlds.diagnosing import diagnose
from worlds.hiding import record
from worlds.physics import TABLES, make_session

RECTIFICATION = ('accel_vibration_rectification', 'gyro_vibration_rectification')
FEW = '+'.join(RECTIFICATION) + (
    '+accel_quadratic+gyro_quadratic+gyro_g_sensitivity+accel_bias_drift+gyro_bias_drift'
)
SHORT = {'profile': 'random_short', 'duration': 180.0}
COARSE = {'imu_rate': 50.0, 'joint_rate': 50.0}


def test_the_variance_is_that_of_a_hum_whatever_turns_below_it():
    time = np.arange(0.0, 20.0, 0.01)
    force = np.stack(
        [9.8 * np.sin(0.5 * time), 0.4 * np.sin(2 * np.pi * 31.0 * time), np.full(len(time), 9.8)],
        axis=1,
    )
    variance = BandVariance().of(0.01, force)
    assert abs(variance[500:, 1].mean() - 0.08) < 0.004
    assert variance[500:, [0, 2]].max() < 1e-4
    one = BandVariance()
    np.testing.assert_allclose(
        [one.push(0.01, row) for row in force[:300].tolist()], variance[:300], atol=1e-15
    )
    parts = BandVariance()
    np.testing.assert_allclose(
        np.concatenate([parts.of(0.01, force[:17]), parts.of(0.01, force[17:])]),
        variance,
        atol=1e-15,
    )


@pytest.fixture(scope='module')
def shaken():
    return make_session(21310, None, 'white', machine=True, **SHORT)


@pytest.fixture(scope='module')
def windows(shaken):
    gatherer = MotionGatherer(Table.from_mapping(shaken.table))
    return gatherer.push(shaken.block) + gatherer.finish()


def test_windows_carry_the_vibration_however_the_stream_is_cut(shaken, windows):
    gatherer, cut = MotionGatherer(Table.from_mapping(shaken.table)), []
    start, stop = int(shaken.joints.stamp_ns[0]) - 10**9, int(shaken.imu.stamp_ns[-1]) + 10**9
    for first in range(start, stop, 7 * 10**9):
        parts = [
            s.select((s.stamp_ns >= first) & (s.stamp_ns < first + 7 * 10**9))
            for s in (shaken.imu, shaken.joints, shaken.temperature)
        ]
        cut += gatherer.push(SampleBlock(*parts))
    cut += gatherer.finish()
    assert len(windows) == len(cut) > 5
    for one, other in zip(windows, cut):
        np.testing.assert_array_equal(one.motion.vibration, other.motion.vibration)
        assert one.motion.vibration.shape == (len(one.motion.time), 3)
    loudness = [
        window.motion.vibration.sum(axis=1).mean() for window in windows if window.kind == 'static'
    ]
    assert max(loudness) > 20 * min(loudness), 'rests, loud and quiet'


def test_rests_that_vibrate_do_not_make_the_noise_of_the_quiet_ones(shaken, windows):
    rows = reduce_windows(
        windows,
        SensorModel(joint_names=shaken.table and tuple(j['name'] for j in shaken.table['joints'])),
        Table.from_mapping(shaken.table),
    )
    variances = np.array(
        [row.sensors['accelerometer'].noise_variance for row in rows if row.kind == 'static']
    )
    assert np.all(np.median(variances, axis=0) > 5 * np.sort(variances, axis=0)[1]), 'most vibrate'
    white, inflation = white_noise(rows, 'accelerometer')
    assert np.all(white < 2 * np.sort(variances, axis=0)[1])


def test_it_is_asked_only_where_rests_vibrate_unlike(shaken, windows):
    table, model = (
        Table.from_mapping(shaken.table),
        SensorModel(joint_names=tuple(joint['name'] for joint in shaken.table['joints'])),
    )
    quiet = [
        window
        for window in windows
        if window.kind != 'static' or window.motion.vibration.sum() < 2e-3
    ]
    assert sum(window.kind == 'static' for window in quiet) > 1
    for some, asked in ((windows, True), (quiet, False)):
        known, lacking = asked_of(model, table, some)
        assert (set(RECTIFICATION) <= {effect.name for effect in known}) is asked
        assert asked or {entry['why'] for entry in lacking if entry['effect'] in RECTIFICATION} == {
            'it did not vibrate now more, now less at rest'
        }


def test_a_machine_shakes_simulated_sensors_whose_bias_follows_vibration_recorded_and_live():
    table = Table.from_mapping(
        TABLES['three_axis']
        | {'gravity': 9.8, 'azimuth_deg': None, 'mount': {'rpy_deg': [0, 0, 0], 'xyz': [0, 0, 0]}}
    )
    plain = SensorModel(joint_names=table.joint_names)
    model, size = plain.with_effect('accelerometer', RECTIFICATION[0]), np.array([0.5, -0.4, 0.3])
    values = model.start()
    values[model.slices['accelerometer', RECTIFICATION[0]]] = size
    profile, options = (
        make_profile('static_only', seed=1, table=TABLES['three_axis']),
        SimulationOptions(noise=SimulatedNoise()),
    )
    imu, joints, _ = simulate_session(model, values, table, profile=profile, options=options)
    bare = simulate_session(plain, plain.start(), table, profile=profile, options=options)[0]
    gatherer = MotionGatherer(table)
    vibration = np.concatenate(
        [
            w.motion.vibration
            for w in gatherer.push(SampleBlock(imu, joints)) + gatherer.finish()
            if w.kind == 'static'
        ]
    )
    assert (
        np.count_nonzero(vibration.min(axis=1) > 0.005) >= 3
        and np.count_nonzero(vibration.max(axis=1) < 1e-4) >= 1
    )
    added = (imu.force_s - bare.force_s).mean(axis=0)
    np.testing.assert_allclose(
        added, size * BandVariance().of(0.01, imu.force_s).mean(axis=0), rtol=0.1
    )
    time = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    live = noiseless_outputs(
        model, values, table, motion=profile.at(time[:900]), time=time[:900], options=options
    )
    np.testing.assert_allclose(live[0], imu.force_s[:900], atol=1e-12)


def test_compensation_live_and_of_a_recording_take_the_rectification_out():
    calibration = random_calibration(4, RECTIFICATION[:1], RECTIFICATION[1:])
    stamps = np.arange(1000, dtype=np.int64) * 10**7
    loud = 0.5 * (stamps > 5 * 10**9)
    hum = np.outer(loud * np.sin(2 * np.pi * 31.0 * stamps * 1e-9), [1.0, 0.5, -0.7])
    imu = ImuSamples(stamps, hum + [0.0, 0.0, 9.8], np.zeros((1000, 3)))
    stream = CompensationStream(calibration)
    whole = stream.correct(imu)
    live, rows = SampleCompensation(calibration), []
    live.slope.settle(stream.slope.line)
    for k in range(1000):
        rows.append(live.correct(int(stamps[k]), *imu.rate_s[k], *imu.force_s[k]))
    np.testing.assert_allclose(rows, np.column_stack([whole.rate, whole.force]), atol=1e-12)
    variance = BandVariance().of(0.01, imu.force_s)[800:].mean(axis=0)
    for sensor, corrected in (('accelerometer', whole.force), ('gyroscope', whole.rate)):
        matrix = calibration.value(sensor, 'matrix')
        size = calibration.value(
            sensor, f'{"accel" if sensor == "accelerometer" else "gyro"}_vibration_rectification'
        )
        taken = corrected[100:400].mean(axis=0) - corrected[800:].mean(axis=0)
        rectified = size * variance if size.ndim == 1 else size @ variance
        leak = 0.0 if sensor == 'gyroscope' else np.linalg.solve(matrix, hum[800:].mean(axis=0))
        assert (
            np.abs(taken + leak - np.linalg.solve(matrix, rectified)).max()
            < 0.02 * np.abs(np.linalg.solve(matrix, rectified)).max()
        )
    later = SampleCompensation(calibration)
    later.prepare(live)
    later.follow(live)
    assert later.vibration.now == live.vibration.now


def test_those_of_both_sensors_are_found_and_told():
    hidden = dict.fromkeys(RECTIFICATION)
    recording = record(21312, hidden, through_bag=False, machine=True, **SHORT, **COARSE)
    found = diagnose(recording.windows, recording.table, recording.model, candidates=FEW)
    assert {finding.effect for finding in found.findings} == set(RECTIFICATION)
    for finding in found.findings:
        assert not finding.indistinguishable_from
        true = np.ravel(recording.truth[finding.effect])
        # The variance above 5 Hz is not all of what is left in the band: to a fifth.
        assert all(
            abs(value - t) < 4 * sd + 0.2 * abs(t)
            for (value, sd, _), t in zip(finding.parameters.values(), true, strict=True)
        )


def test_that_of_one_sensor_is_not_found_in_the_other():
    hidden = RECTIFICATION[1]
    kind = {'profile': 'quick', **COARSE}
    recording = record(21312, {hidden: None}, through_bag=False, machine=True, **kind)
    model = with_candidates(recording.model, '+'.join(RECTIFICATION))
    found = investigate(recording.windows, recording.table, model)
    assert {question.name for question in found.problem.questions} == set(RECTIFICATION)
    assert [question.name for question in found.named] == [hidden]
