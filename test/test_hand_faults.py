"""Recordings by hand as they really are: wrong full-scale settings, clipped turns, late stamps, slow turns, warm-up, creeping poses."""

import numpy as np
import pytest

from imu_calibration.by_hand.calibrate import calibrate_by_hand
from imu_calibration.by_hand.model import unpack
from imu_calibration.by_hand.options import HandOptions
from imu_calibration.by_hand.turns import at_range_end, rising
from imu_calibration.by_hand.workflow import read_by_hand
from imu_calibration.preflight.checks import Preflight
from imu_calibration.samples import SampleBlock

from worlds.hand_sessions import GRAVITY
from worlds.physics_hand import clipped, hold_and_turn, with_stamp_jitter, with_wrong_full_scale

ANGULAR = np.random.default_rng(0).normal(0, 1, (300, 3))


@pytest.fixture(scope='module')
def session():
    """(imu, ranges at rest, truth) of fourteen poses."""
    return hold_and_turn(3)


def calibrated(imu):
    return calibrate_by_hand(read_by_hand([SampleBlock(imu)]).imu, HandOptions(GRAVITY))


def rate_error(found, truth, factor=1.0):
    """Rms error of compensated rates of 1 rad/s per axis, rad/s; `factor`: what the readings were multiplied by."""
    _, _, bias, matrix = unpack(truth)
    measured = factor * (ANGULAR @ matrix.T + bias)
    bias, matrix, _ = found.gyroscope
    return np.sqrt(np.mean((np.linalg.solve(matrix, (measured - bias).T).T - ANGULAR)**2))


def looked_at(imu):
    preflight = Preflight(GRAVITY, strict=False)
    read_by_hand([SampleBlock(imu)], watchers=[preflight])
    return preflight.findings


# a gyroscope at the wrong full-scale setting

@pytest.mark.parametrize('factor', [2.0, 0.5, 8.0, 3.0])
def test_the_solver_reaches_a_wrong_full_scale(session, factor):
    """Half a turn that is read as a whole one is far outside what steps from the identity reach."""
    imu, _, truth = session
    found = calibrated(with_wrong_full_scale(imu, factor))
    assert rate_error(found, truth, factor) < 2 * rate_error(calibrated(imu), truth)
    assert found.statistics['gyro_factor'] == pytest.approx(factor, rel=0.15)
    assert 'held' not in found.statuses


def test_a_right_full_scale_stays_one(session):
    assert calibrated(session[0]).statistics['gyro_factor'] == 1.0
    assert calibrated(with_wrong_full_scale(session[0], 1.08)).statistics['gyro_factor'] == 1.0


@pytest.mark.parametrize('factor', [2.0, 0.5, 4.0])
def test_preflight_names_the_full_scale_factor(session, factor):
    found, = (f for f in looked_at(with_wrong_full_scale(session[0], factor)) if f.check == 'full_scale')
    assert found.severity == 'warning' and f'are {factor:g} times' in found.text and 'full-scale range' in found.text
    assert not [f for f in looked_at(session[0]) if f.check == 'full_scale' and f.severity != 'good']


# clipped turns

@pytest.mark.parametrize('rate_hz', [100.0, 10.0])
def test_turns_with_clipped_samples_are_left_out(rate_hz):
    """At 10 Hz one or two samples of a turn stands at the end of the range."""
    imu, _, truth = hold_and_turn(4, n_poses=18, rate_hz=rate_hz, rate_sd=0.001, duration=1.6 if rate_hz > 20 else 1.0)
    limit = (0.8 if rate_hz > 20 else 0.9) * np.abs(imu.rate_s).max()
    spoiled = clipped(imu, limit)
    at = np.abs(spoiled.rate_s).max(axis=1) == limit
    assert at_range_end(spoiled.rate_s).tolist() == at.tolist()
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]))))[::2]
    assert rate_hz > 20 or runs.max() < 3
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
    assert at_range_end(rate).sum() == np.count_nonzero((rate >= 2.499 - 1e-9).any(axis=1) | (rate <= -2.5 + 1e-9).any(axis=1)) > 2


# late stamps

def test_late_stamps_of_even_samples_do_not_reach_the_turns(session):
    imu, _, truth = session
    late = with_stamp_jitter(imu, 0.003, 1)
    assert rate_error(calibrated(late), truth) < 2 * rate_error(calibrated(imu), truth)


def test_repeated_stamps_are_spread_over_the_step_that_follows():
    np.testing.assert_allclose(rising(np.array([0.0, 0.01, 0.01, 0.02])), [0.0, 0.01, 0.015, 0.02], atol=1e-6)
