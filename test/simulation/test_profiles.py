"""
Profiles: derivatives are derivatives, limits hold, and every name can be made.

The designs agree with the text of the papers.
"""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.motion_builder import MotionBuilder, Profile
from imu_calibration.simulation.motion_primitives import PAPER_PROFILES, avrutov_rates_deg
from imu_calibration.simulation.profiles import make_profile, profile_names

NAMES = sorted(profile_names())


def reference(profile, time, **changes):
    axes = dict(zip(profile.joint_names, ([0, 0, 1], [0, 1, 0], [1, 0, 0])))
    mapping = profile.table or {
        'joints': [{'name': name, 'axis': axis} for name, axis in axes.items()],
        'latitude': 45.0,
    }
    return reference_motion(Table.from_mapping(mapping | changes), profile.at(time))


@pytest.mark.parametrize('name', NAMES)
def test_derivatives_agree_with_differences(name):
    profile = make_profile(name)
    time = np.random.default_rng(1).uniform(0, profile.duration, 400)
    step = 1e-4
    before, here, after = (profile.at(time + shift) for shift in (-step, 0.0, step))
    for low, high in (('position', 'rate'), ('rate', 'acceleration'), ('acceleration', 'jerk')):
        slope = (getattr(after, low) - getattr(before, low)) / (2 * step)
        # Error of the central difference: third derivative times step^2 / 6; jerks stay below 1e3
        # rad/s^3.
        scale = np.abs(getattr(here, high)).max() + 1.0
        np.testing.assert_allclose(slope, getattr(here, high), atol=2e-4 * scale)


@pytest.mark.parametrize('name', NAMES)
def test_motion_is_smooth_and_gentle(name):
    profile = make_profile(name)
    edges = profile.edges[1:-1]
    before, after = profile.at(edges - 1e-9), profile.at(edges + 1e-9)
    for part in ('position', 'rate', 'acceleration', 'jerk'):
        np.testing.assert_allclose(getattr(before, part), getattr(after, part), atol=1e-5)
    motion = profile.at(np.linspace(0, profile.duration, 20000))
    assert np.degrees(np.abs(motion.rate).max()) <= 310
    assert np.degrees(np.abs(motion.acceleration).max()) <= 3000


def test_evaluation_does_not_depend_on_order_or_cutting():
    profile = make_profile('quick')
    time = np.random.default_rng(2).uniform(-1, profile.duration + 1, 500)
    together = profile.at(time).position
    one_by_one = np.concatenate([profile.at(t).position for t in time])
    np.testing.assert_array_equal(together, one_by_one)
    outside = profile.at([-5.0, profile.duration + 5.0])
    assert not outside.rate.any() and not outside.acceleration.any()


def test_moves_end_where_asked():
    builder = MotionBuilder(2)
    builder.move([350.0, np.nan])
    builder.spin([[0.0, 90.0]], 2.0)
    builder.move([0.0, 0.0])
    profile = Profile('test', tuple(builder.segments))
    end = profile.at(profile.duration).position[0]
    np.testing.assert_allclose(np.exp(1j * end), 1.0, atol=1e-12)
    assert profile.at(builder.segments[0].duration).position[0, 0] == pytest.approx(np.radians(-10))


def test_calibration_session_is_rich():
    profile = make_profile('calibration')
    assert 600 < profile.duration < 900
    rests = profile.find('rest').mean(axis=1)
    ref = reference(profile, rests)
    up_s = ref.force_s / ref.gravity
    different = np.unique(np.round(up_s, 3), axis=0)
    assert len(different) >= 24
    # Spread: no direction is farther than 36 deg from a pose (26 directions of a cube: 32 deg at
    # most, plus slack).
    sphere = np.random.default_rng(3).normal(size=(500, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    assert np.degrees(np.arccos(np.max(sphere @ different.T, axis=1))).max() < 36
    rates = np.degrees(
        reference(profile, profile.find('spin').mean(axis=1), latitude=None, gravity=9.8).rate_s
    )
    for axis in range(3):
        along = rates[np.linalg.norm(np.delete(rates, axis, 1), axis=1) < 1, axis]
        assert set(np.round(along)) >= {-200, -120, -60, 60, 120, 200}


def test_seed_draws_the_session():
    time = np.linspace(0, 200, 50)
    first, same, other = (make_profile('random', seed=seed).at(time).position for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 0.1


def test_duration_is_reached():
    for seed in range(3):
        assert make_profile('random', seed=seed, duration=300.0).duration == pytest.approx(
            300.0, abs=1e-6
        )
    with refused(InputError, 'too_short', 30):
        make_profile('calibration', duration=30.0)


def test_other_tables():
    two = {
        'joints': [{'name': 'tilt', 'axis': [0, 1, 0]}, {'name': 'plate', 'axis': [0, 0, 1]}],
        'latitude': 45.0,
    }
    assert make_profile('calibration', table=Table.from_mapping(two)).joint_names == (
        'tilt',
        'plate',
    )
    assert make_profile('two_axis').at(0.0).position.shape == (1, 2)
    one = {'joints': two['joints'][:1], 'latitude': 45.0}
    assert make_profile('quick', table=one).at(0.0).position.shape == (1, 1)
    with refused(InputError, 'joint_count', 3):
        make_profile('navigation', table=one)
    with refused(InputError, 'profile_unknown'):
        make_profile('no_such_profile')


@pytest.mark.parametrize(
    'name',
    sorted(name for name in PAPER_PROFILES if name.startswith('avrutov_') and name[8] in 'XYZ'),
)
def test_equal_angles_determine_the_linear_model(name):
    """
    All 36 cases of gimbal order and gravity have rank 4, and rank 7 with products.

    They are for the 41 positions of samples 1 and 2.
    """
    profile = make_profile(name)
    times = profile.find('rest').mean(axis=1)[-41:]
    angles = np.degrees(profile.at(times).position)
    np.testing.assert_allclose(angles, np.arange(0, 401, 10)[:, None] * np.ones(3), atol=1e-9)
    ref = reference(profile, times)
    x, y, z = ref.force_s.T / ref.gravity
    linear = np.stack([np.ones(41), x, y, z], axis=1)
    assert np.linalg.matrix_rank(linear) == 4
    assert np.linalg.matrix_rank(np.column_stack([linear, x * y, y * z, x * z]), tol=1e-6) == 7


def test_conditions_of_equal_angles_are_those_of_the_analysis():
    for name, expected in (('avrutov_ZYX', 3.767), ('avrutov_XYX_up_x', 3.596)):
        profile = make_profile(name)
        ref = reference(profile, profile.find('rest').mean(axis=1)[-41:])
        assert np.linalg.cond(
            np.column_stack([np.ones(41), ref.force_s / ref.gravity])
        ) == pytest.approx(expected, abs=1e-3)


def test_the_literal_simultaneous_turn_is_degenerate():
    profile = make_profile('avrutov_111')
    ref = reference(profile, profile.find('rest').mean(axis=1))
    assert np.linalg.matrix_rank(np.column_stack([np.ones(len(ref)), ref.force_s]), tol=1e-9) == 3


@pytest.mark.parametrize('sample, condition', [(3, 1131.43), (4, 2.3256e5)])
def test_gyroscope_series_give_the_rates_of_the_paper(sample, condition):
    profile = make_profile(f'avrutov_rates_{sample}')
    spins = profile.find('spin').mean(axis=1)
    rates = np.degrees(reference(profile, spins, latitude=None, gravity=9.8).rate_s)
    wanted = avrutov_rates_deg(sample)
    np.testing.assert_allclose(rates, wanted[-len(rates) :], atol=1e-9)
    x, y, z = wanted.T
    columns = [np.ones(11), x, y, z] + ([x * y, y * z, x * z] if sample == 4 else [])
    assert np.linalg.cond(np.column_stack(columns)) == pytest.approx(condition, rel=1e-4)


def test_commanded_gimbal_rates_are_not_body_rates():
    profile = make_profile('avrutov_gimbals_3')
    start, end = profile.find('spin')[-1]
    rates = np.degrees(
        reference(profile, np.linspace(start, end, 3000), latitude=None, gravity=9.8).rate_s
    )
    assert np.abs(rates.mean(axis=0) - avrutov_rates_deg(3)[-1]).max() > 4.0


def test_skewed_fixture_shares_every_spin_among_the_sensor_axes():
    profile = make_profile('zhang_z60')
    rates = reference(profile, profile.find('spin').mean(axis=1), latitude=None, gravity=9.8).rate_s
    cosines = np.abs(rates) / np.linalg.norm(rates, axis=1)[:, None]
    np.testing.assert_allclose(
        np.sort(cosines, axis=1), np.tile([1 / 3, 2 / 3, 2 / 3], (9, 1)), atol=1e-9
    )


def test_example_tables_are_valid():
    yaml = pytest.importorskip('yaml')
    from pathlib import Path

    for name, joints in (('table_simulated', 3), ('table_two_axis', 2)):
        table = Table.from_mapping(
            {
                **yaml.safe_load(
                    (Path(__file__).parents[2] / 'config' / f'{name}.yaml').read_text()
                ),
                'gravity': 9.8,
            }
        )
        assert len(table.joints) == joints
        assert make_profile('calibration', table=table).joint_names == table.joint_names.read
