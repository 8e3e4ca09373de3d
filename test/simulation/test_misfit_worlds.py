"""
The worlds with causes that no catalogue holds.

Each acts where it says, by its physics, and nowhere else.
"""

import numpy as np
import pytest

from imu_calibration.simulation.motion_builder import MotionBuilder, Profile

from worlds.misfit_worlds import CAUSES, FlexibleMount, make_pair
from worlds.physics_draw import generator


def half_turns():
    """Return a joint that turns half round and back, twice."""
    builder = MotionBuilder(1)
    builder.rest(5.0)
    for turn in range(4):
        builder.move([180.0 if turn % 2 == 0 else 0.0], shortest=False)
        builder.rest(0.3)
    builder.rest(5.0)
    return builder


MOVES = Profile('half turns', tuple(half_turns().segments))
TIME = np.arange(0.0, MOVES.duration, 1e-3)


def cause(name, size=1.0):
    return CAUSES[name](size, generator(0, name))


@pytest.mark.parametrize('name', ['motor_ripple', 'cogging'])
def test_what_a_motor_adds_is_a_motion_with_its_own_derivatives(name):
    motion, told = cause(name).moved(MOVES).at(TIME), MOVES.at(TIME)
    assert 1e-4 < np.abs(motion.position - told.position).max() < 1e-2
    for part, derivative in ((motion.position, motion.rate), (motion.rate, motion.acceleration)):
        np.testing.assert_allclose(
            np.gradient(part, TIME, axis=0)[2:-2],
            derivative[2:-2],
            atol=2e-2 * np.abs(derivative).max(),
        )


@pytest.mark.parametrize('name', ['backlash', 'encoder_eccentricity', 'gear_eccentricity'])
def test_what_an_encoder_adds_has_its_derivative(name):
    error, slope = cause(name).encoder_error(TIME, MOVES.at(TIME))
    assert 1e-4 < np.ptp(error) < 1e-2
    np.testing.assert_allclose(
        np.gradient(error[:, 0], TIME)[2:-2], slope[2:-2, 0], atol=2e-2 * np.abs(slope).max()
    )


def test_play_depends_on_where_the_joint_came_from_alone():
    error = cause('backlash').encoder_error(TIME, MOVES.at(TIME))[0][:, 0]
    stops = MOVES.find('rest')[1:-1, 1] - 1e-3
    np.testing.assert_allclose(
        np.interp(stops, TIME, error),
        0.125 * np.pi / 180 * np.array([1.0, -1.0, 1.0, -1.0]),
        rtol=0.01,
    )


def test_a_bracket_sags_under_gravity_and_rings_at_its_frequency():
    mount, still = cause('flexible_mount'), np.tile([0.0, 0.0, 9.80665], (4000, 1))
    force, rate = mount.carried(TIME[:4000], still, np.zeros((4000, 3)), np.zeros((4000, 3)))
    assert np.linalg.norm(force[-1, :2]) == pytest.approx(
        9.80665 * mount.SAG * np.hypot(0.6, 0.5), rel=1e-3
    )
    assert np.abs(rate).max() < 1e-9
    push = np.zeros((4000, 3))
    push[100:110, 2] = 10.0
    ringing = mount.carried(TIME[:4000], still, np.zeros((4000, 3)), push)[1][110:, 2]
    crossings = np.flatnonzero(np.diff(np.sign(ringing)))[:6]
    assert 0.5e3 / np.diff(crossings).mean() == pytest.approx(
        FlexibleMount.FREQUENCY * np.sqrt(1 - FlexibleMount.DAMPING**2), rel=0.02
    )


@pytest.mark.parametrize(('name', 'mean'), [('lag_jitter', 6e-3), ('stamp_bursts', 3.7e-4)])
def test_a_driver_delivers_late_and_in_order(name, mean):
    time = np.arange(0.0, 100.0, 0.01)
    late = cause(name).stamped(time, generator(1, 'driver'))
    assert late.min() > -1e-9 and late.mean() == pytest.approx(mean, rel=0.4)
    assert np.all(np.diff(np.round((time + late) * 1e9)) >= 0)


def test_both_sessions_are_of_one_unit_and_a_cause_changes_nothing_else():
    clean, bent = (
        make_pair(None, 3, table='shaft', profile='sweeps'),
        make_pair('driver_lag', 3, table='shaft', profile='sweeps'),
    )
    first, second = (session.truth for session in (bent.first, bent.second))
    np.testing.assert_array_equal(first['gyroscope'].matrix, second['gyroscope'].matrix)
    assert (
        first['profile'].at(np.arange(90.0)).rate.max()
        < second['profile'].at(np.arange(90.0)).rate.max()
    )
    np.testing.assert_array_equal(clean.first.joints.position, bent.first.joints.position)
    np.testing.assert_array_equal(clean.first.imu.stamp_ns, bent.first.imu.stamp_ns)
    late = np.arange(len(bent.first.imu)) - 1.2  # 12 ms at 100 Hz, the same noise in both
    shifted = np.interp(late, np.arange(len(late)), clean.first.imu.rate_s[:, 0])
    noise = np.std(clean.first.imu.rate_s[:400, 0])
    assert np.std(bent.first.imu.rate_s[:, 0] - shifted) < 0.03 * np.std(shifted) + 3 * noise


def test_a_cause_of_size_zero_is_a_clean_world():
    clean, nothing = (
        make_pair(None, 2, table='shaft', profile='sweeps'),
        make_pair('motor_ripple', 2, size=0.0, table='shaft', profile='sweeps'),
    )
    np.testing.assert_allclose(nothing.first.imu.force_s, clean.first.imu.force_s, atol=1e-9)
