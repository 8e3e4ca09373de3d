"""
Which way the temperature came.

The branch, its way through windows and live compensation, and the hysteresis that is found by it.
"""

import numpy as np
import pytest

from imu_calibration.compensation.stream import CompensationStream, SampleCompensation
from imu_calibration.core.samples import ImuSamples, SampleBlock, TemperatureSamples
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.signal_history import HALF_WIDTH, ThermalBranch
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable.selection.testable_effects import (
    testable_effects as asked_of,
)

from worlds.compensation_cases import random_calibration
from worlds.diagnosing import diagnose
from worlds.hiding import record
from worlds.physics import make_session

HYSTERESIS = ('accel_thermal_hysteresis', 'gyro_thermal_hysteresis')
FEW = '+'.join(HYSTERESIS) + (
    '+accel_thermal_bias+gyro_thermal_bias+accel_bias_drift+gyro_bias_drift'
)
SHORT = {
    'profile': 'random_short',
    'duration': 180.0,
    'imu_rate': 50.0,
    'joint_rate': 50.0,
    'temperature': 'cycle',
}


def test_the_branch_is_one_where_it_warms_up_and_minus_one_where_it_cools_however_fast():
    up, down = np.arange(20.0, 30.0, 0.1), np.arange(30.0, 20.0, -0.1)
    branch = ThermalBranch().of(np.concatenate([up, down]))
    assert (
        branch[0] == 0.0 and branch[100] == pytest.approx(1.0) and branch[-1] == pytest.approx(-1.0)
    )
    between = np.searchsorted(-branch[100:], 0.0)
    assert abs((30.0 - down[between]) - HALF_WIDTH) < 0.11, 'half way after one half width'
    slow = ThermalBranch().of(np.concatenate([np.repeat(up, 3), np.repeat(down, 3)]))
    np.testing.assert_allclose(slow[2::3], branch, atol=1e-12)


def test_noise_and_a_glance_back_change_no_branch():
    rng = np.random.default_rng(0)
    warm = np.linspace(20.0, 40.0, 500)
    assert np.all(ThermalBranch().of(warm + rng.normal(0.0, 0.05, 500))[100:] > 0.6)
    parts = ThermalBranch()
    np.testing.assert_array_equal(
        np.concatenate([parts.of(warm[:17]), parts.of(warm[17:])]), ThermalBranch().of(warm)
    )


@pytest.fixture(scope='module')
def cycled():
    return make_session(21210, {name: None for name in HYSTERESIS}, 'white', **SHORT)


def test_windows_carry_the_branch_however_the_stream_is_cut(cycled):
    table = Table.from_mapping(cycled.table)

    def gathered(edges):
        gatherer, windows = MotionGatherer(table), []
        for first, stop in zip(edges, edges[1:]):
            parts = [
                s.select((s.stamp_ns >= first) & (s.stamp_ns < stop))
                for s in (cycled.imu, cycled.joints, cycled.temperature)
            ]
            windows += gatherer.push(SampleBlock(*parts))
        return windows + gatherer.finish()

    start, stop = int(cycled.joints.stamp_ns[0]) - 10**9, int(cycled.imu.stamp_ns[-1]) + 10**9
    whole, cut = gathered([start, stop]), gathered(list(range(start, stop + 7 * 10**9, 7 * 10**9)))
    assert len(whole) == len(cut) > 5
    for one, other in zip(whole, cut):
        np.testing.assert_array_equal(one.motion.thermal_branch, other.motion.thermal_branch)
        assert one.motion.thermal_branch.shape == one.motion.time.shape
    every = np.concatenate([window.motion.thermal_branch for window in whole])
    assert every.min() < -0.9 and every.max() > 0.9


def test_compensation_live_and_of_a_recording_take_the_branch_out(cycled):
    calibration = random_calibration(4, ('accel_thermal_hysteresis',), ('gyro_thermal_hysteresis',))
    stamps = np.arange(400, dtype=np.int64) * 10**9
    temperature = TemperatureSamples(stamps, 25.0 + 5.0 * np.sin(2 * np.pi * stamps * 1e-9 / 150.0))
    imu = ImuSamples(stamps, np.tile([0.0, 0.0, 9.8], (400, 1)), np.zeros((400, 3)))
    whole = CompensationStream(calibration, temperature).correct(imu)
    live, rows = SampleCompensation(calibration), []
    for k, warmth in enumerate(temperature.temperature_c):
        live.set_temperature(warmth)
        rows.append(live.correct(int(stamps[k]), *imu.rate_s[k], *imu.force_s[k]))
    np.testing.assert_allclose(rows, np.column_stack([whole.rate, whole.force]), atol=1e-12)
    between = whole.force[215] - whole.force[160]  # the same temperature, cooling and warming up
    matrix, size = (
        calibration.value('accelerometer', 'matrix'),
        calibration.value('accelerometer', 'accel_thermal_hysteresis'),
    )
    assert abs(temperature.temperature_c[215] - temperature.temperature_c[160]) < 1e-9
    np.testing.assert_allclose(between, 2.0 * np.linalg.solve(matrix, size), rtol=1e-6)
    later = SampleCompensation(random_calibration(5, ('accel_thermal_hysteresis',)))
    later.prepare(live)
    later.follow(live)
    assert later.branch.now == live.branch.now and later.warming == pytest.approx(live.warming)


def test_it_is_asked_only_where_the_temperature_turned(cycled):
    table = Table.from_mapping(cycled.table)
    for temperature, asked in (('cycle', True), ('warm_up', False)):
        session = (
            cycled
            if asked
            else make_session(21210, None, 'white', **SHORT | {'temperature': temperature})
        )
        gatherer = MotionGatherer(table)
        known, lacking = asked_of(
            SensorModel(joint_names=tuple(table.joint_names)),
            table,
            gatherer.push(session.block) + gatherer.finish(),
        )
        assert (set(HYSTERESIS) <= {effect.name for effect in known}) is asked
        assert asked or {entry['why'] for entry in lacking if entry['effect'] in HYSTERESIS} == {
            'the temperature did not reverse: one branch only'
        }


@pytest.mark.parametrize('hidden', ['accel_thermal_hysteresis', 'gyro_thermal_bias'])
def test_it_is_found_and_told_from_what_follows_the_temperature(hidden):
    recording = record(21212, {hidden: None}, through_bag=False, **SHORT)
    found = diagnose(recording.windows, recording.table, recording.model, candidates=FEW)
    assert [finding.effect for finding in found.findings] == [hidden] and not found.findings[
        0
    ].indistinguishable_from
    true = recording.truth[hidden]
    # One play stands for grains of unlike friction: to six hundredths.
    assert all(
        abs(value - t) < 5 * sd + 0.06 * abs(t)
        for (value, sd, _), t in zip(found.findings[0].parameters.values(), true)
    )
