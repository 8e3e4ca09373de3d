"""
Health of a calibration while driving.

Drifts that the estimator does not know are seen at stops, in time and with their size; quiet robots
are left in peace.
"""

import re
from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.compensation.health import (
    FOLLOWED,
    HARMS,
    HOLDS,
    MAX_STOP_SECONDS,
    MIN_STOP_SECONDS,
    MOST_MOVED,
    MOVED,
    UNIT,
    WAITING,
    CalibrationHealth,
    GyroBiasUpdate,
    HealthOptions,
    Stop,
    StopDetector,
    StopWatch,
)
from imu_calibration.core.units import DEG

from worlds.drives import RATE, SD, G, drive, plain_calibration


def follow(world, *, offset=0.0, cut=None, **options):
    """Run a drive through a StopWatch; return (watch, corrected rates)."""
    calibration = plain_calibration(offset)
    watch = StopWatch(CalibrationHealth(calibration, None, HealthOptions(**options)))
    out, imu = [], world.imu
    for stamp, rate, force in zip(
        imu.stamp_ns[:cut].tolist(),
        imu.rate_s[:cut].tolist(),
        imu.force_s[:cut].tolist(),
        strict=True,
    ):
        corrected = (rate[0], rate[1], rate[2] - offset, *force)
        out.append(watch.follow(stamp, (*rate, *force), corrected)[:3])
    return watch, np.array(out)


@pytest.mark.parametrize('shake', [0.0, 0.15])
def test_stops_are_found_where_the_robot_stands_and_nowhere_else(shake):
    world = drive(3, 5, shake=shake)
    detector, time = (
        StopDetector(np.repeat([0.02, 0.002], 3)),
        (world.imu.stamp_ns - world.imu.stamp_ns[0]) * 1e-9,
    )
    rows = np.column_stack([time, world.imu.force_s, world.imu.rate_s])
    seen = np.zeros(len(time), bool)
    for a in range(0, len(rows), 25):
        stop = detector.push(rows[a : a + 25])
        if stop is not None:
            seen[(time >= stop.start) & (time < stop.end)] = True
    assert not (seen & ~world.still).any()
    assert (seen & world.still).sum() > 0.7 * world.still.sum()


def test_how_a_stream_is_cut_does_not_change_the_stops():
    world = drive(4, 2)
    rows = np.column_stack(
        [(world.imu.stamp_ns - world.imu.stamp_ns[0]) * 1e-9, world.imu.force_s, world.imu.rate_s]
    )
    whole, pieces = StopDetector(np.full(6, 0.01)), StopDetector(np.full(6, 0.01))
    upto = int(39.5 * RATE)
    expected = whole.push(rows[:upto])
    for a in range(0, upto, 7):
        found = pieces.push(rows[a : min(a + 7, upto)])
    assert found.start == expected.start and found.n_samples == expected.n_samples
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-12)


def test_a_robot_that_is_parked_counts_as_several_stops():
    world = drive(5, 3, period=200.0, stop=150.0)
    watch, _ = follow(world)
    assert watch.health.n_stops == int(130 // MAX_STOP_SECONDS) + 1


def test_while_nothing_moves_the_calibration_holds():
    for seed in range(8):
        watch, _ = follow(drive(seed, 5))
        assert watch.health.state.word == HOLDS and watch.health.n_stops == 7, watch.health.state


def test_the_error_of_a_mean_includes_the_decay_of_a_slow_stop():
    """
    The rate decays from 0.02 rad/s with time constants of 0.3 to 6 s into stops of 8 s.

    It was reported as a moved bias; a moved bias is reported.
    """
    rng, words = np.random.default_rng(77), {0.0: set(), 0.2 * DEG: set()}
    for moved, found in words.items():
        for seconds in (0.3, 0.7, 1.5, 3.0, 6.0):
            time = np.arange(0, 60, 1 / RATE)
            phase = time % 15.0
            rate = (
                np.where(phase < 7.0, 0.3, 0.02 * np.exp(-(phase - 7.0) / seconds))[:, None]
                * [0.1, -0.2, 1.0]
                + moved
            )
            force = np.array([0.0, 0.0, G]) + rng.normal(0, 0.02, (len(time), 3))
            health = CalibrationHealth(plain_calibration(), None, HealthOptions())
            detector, rate = (
                StopDetector(health.noise_sd),
                rate + rng.normal(0, 0.002, (len(time), 3)),
            )
            rows = np.column_stack([time, force, rate, force, rate])
            for start in range(0, len(rows), 25):
                stop = detector.push(rows[start : start + 25])
                if stop is not None:
                    health.judge(stop)
                    found.add(health.state.word)
            assert health.n_stops >= 3
    assert words[0.0] <= {WAITING, HOLDS} and MOVED in words[0.2 * DEG], words


def test_readings_in_g_are_the_cause():
    world = drive(9, 2)
    watch, _ = follow(replace(world, imu=replace(world.imu, force_s=world.imu.force_s / G)))
    assert watch.health.state.word == UNIT and 'unit is g' in watch.health.state.message
    assert 'calibrate again' not in watch.health.state.message


def test_before_the_first_stop_it_waits():
    watch, _ = follow(drive(0, 1), cut=int(30 * RATE))
    assert watch.health.state.word == WAITING
    short, _ = follow(drive(0, 1, stop=MIN_STOP_SECONDS), cut=int(41 * RATE))
    assert short.health.state.word == WAITING


def test_a_bias_that_warms_up_is_named_with_its_size():
    world = drive(6, 12, warm_up=(0.0, 0.0, 0.2 * DEG))
    watch, _ = follow(world)
    assert watch.health.state.word == MOVED
    assert watch.health.update is None
    told, axis = re.search(
        r'([+-][\d.e-]+) deg/s [a-z ]*\b([xyz])\b', watch.health.state.message
    ).groups()
    assert axis == 'z' and float(told) == pytest.approx(world.bias[-1, 2] / DEG, abs=0.01)


def test_gravity_that_reads_wrong_is_named_and_a_place_is_not_blamed():
    assert follow(drive(7, 2, gravity=1.004 * G))[0].health.state.word == HOLDS
    wrong, _ = follow(drive(7, 2, gravity=1.02 * G))
    assert wrong.health.state.word == MOVED and 'gravity reads 10.00' in wrong.health.state.message
    known, _ = follow(drive(7, 2, gravity=1.004 * G), gravity=G)
    assert known.health.state.word == MOVED  # where gravity is known, a place is no excuse


def test_a_calibration_of_another_sensor_does_harm():
    watch, _ = follow(drive(8, 2), offset=1.0 * DEG)
    assert (
        watch.health.state.word == HARMS
        and 'without the calibration it would be less' in watch.health.state.message
    )


@pytest.mark.long
def test_an_update_takes_the_drift_off_and_knows_how_well():
    errors, without, ratios = [], [], []
    for seed in range(2):
        world = drive(20 + seed, 15, warm_up=(0.1 * DEG, -0.15 * DEG, 0.3 * DEG), walk=2e-5)
        watch, corrected = follow(world, update=True)
        late = slice(round(240 * RATE), None)
        # What is left of the bias, seen without the noise of the samples.
        left = corrected[late] - world.imu.rate_s[late] + world.bias[late]
        errors.append(left)
        without.append(world.bias[late])
        ratios.append(left[-1] / np.sqrt(np.diag(watch.rate_cov)))
        assert watch.health.state.word in (FOLLOWED, HOLDS)
    rms, before = (np.sqrt(np.mean(np.square(parts))) for parts in (errors, without))
    assert rms < 0.15 * before, (rms / DEG, before / DEG)
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_without_a_drift_an_update_adds_next_to_nothing():
    watch, corrected = follow(drive(30, 10), update=True)
    added = corrected[-6000:] - drive(30, 10).imu.rate_s[-6000:]
    assert np.abs(added).max() < 0.5 * SD + 1e-4


def test_an_update_fades_and_its_uncertainty_grows_back():
    update = GyroBiasUpdate(np.full(3, SD), 600.0)
    prior = update.predict(0.0)[1]
    np.testing.assert_allclose(prior, SD**2)
    update.measure(0.0, 5.0, rate=np.full(3, 0.1 * DEG), variance=np.full(3, 1e-12))
    bias, variance = zip(
        *(update.predict(5.0 + after) for after in (0.0, 60.0, 600.0, 6000.0)), strict=True
    )
    assert (np.diff(np.array(bias)[:, 0]) < 0).all() and (
        np.diff(np.array(variance)[:, 0]) > 0
    ).all()
    assert bias[0][0] == pytest.approx(0.1 * DEG, rel=0.02) and bias[2][0] == pytest.approx(
        0.1 * DEG * np.exp(-1), rel=0.02
    )
    # As wide as what was seen, no longer as the calibration said.
    assert np.sqrt(variance[-1][0]) == pytest.approx(0.1 * DEG, rel=0.05)


def test_a_stop_that_grows_is_one_measurement():
    once, often = (GyroBiasUpdate(np.full(3, SD), 600.0) for _ in range(2))
    once.measure(10.0, 20.0, rate=np.full(3, SD), variance=np.full(3, SD**2))
    for end in (14.0, 16.0, 18.0, 20.0):
        often.measure(10.0, end, rate=np.full(3, SD), variance=np.full(3, SD**2))
    np.testing.assert_array_equal(once.predict(20.0), often.predict(20.0))
    assert often.n_stops == 1


def test_a_turn_faster_than_any_bias_moves_is_no_stop():
    calm, turning = (
        CalibrationHealth(plain_calibration(), None, HealthOptions(update=True)) for _ in range(2)
    )
    for health, rate in ((calm, 0.0), (turning, 1.2 * MOST_MOVED)):
        health.judge(
            Stop(
                0.0,
                5.0,
                500,
                np.array([0.0, 0.0, G, 0.0, 0.0, rate]),
                np.array([0.0, 0.0, G, 0.0, 0.0, rate]),
                np.full(6, 1e-3),
                np.zeros(6),
            )
        )
    assert calm.state.word == HOLDS and turning.state.word == WAITING
