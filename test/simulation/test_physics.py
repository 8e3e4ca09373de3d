"""
The truth simulator.

Its kinematics agree with the package's and with differences, and each effect does what its physics
says.
"""

import ast
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calibration.kinematics.chain import reference_motion, tilt
from imu_calibration.kinematics.rotations import normal_gravity
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile

from worlds import physics, physics_table
from worlds.hiding import options_of
from worlds.physics import TABLES, Session, make_session
from worlds.physics_draw import EFFECTS, OUTSIDE, G
from worlds.physics_sensor import Triad, low_pass
from worlds.physics_table import EARTH_RATE, local_gravity, move_table

SHORT = {'profile': 'random_short', 'duration': 180.0, 'imu_rate': 50.0, 'joint_rate': 50.0}


def odd_table():
    rng = np.random.default_rng(5)
    joints = [
        {'name': name, 'axis': list(rng.normal(size=3)), 'xyz': list(0.1 * rng.normal(size=3))}
        for name in ('a', 'b', 'c')
    ]
    return {
        'joints': joints,
        'up': [0.3, -0.2, 0.9],
        'gravity': 9.81,
        'latitude': -33.0,
        'height': 10.0,
        'azimuth_deg': 77.0,
        'mount': {'rpy_deg': [10.0, -40.0, 130.0], 'xyz': [0.05, -0.1, 0.2]},
    }


@pytest.mark.parametrize('mapping', [*TABLES.values(), odd_table()], ids=[*TABLES, 'odd'])
def test_kinematics_agree_with_the_package(mapping):
    profile = make_profile('random', seed=3, table=mapping)
    time = np.linspace(0.0, profile.duration, 700)
    gravity = mapping['gravity'] or normal_gravity(mapping['latitude'], mapping['height'])
    world = move_table(mapping, time, profile.at(time), gravity)
    ref = reference_motion(Table.from_mapping(mapping), profile.at(time))
    np.testing.assert_allclose(world.mat_ns.transpose(0, 2, 1), ref.mat_sn, atol=1e-12)
    np.testing.assert_allclose(world.to_sensor(world.rate_n), ref.rate_s, atol=1e-12)
    np.testing.assert_allclose(world.to_sensor(world.force_n), ref.force_s, atol=1e-11)
    np.testing.assert_allclose(world.to_sensor(world.alpha_n), ref.alpha_s, atol=1e-11)


def test_kinematics_agree_with_differences_of_attitude_and_position():
    mapping = odd_table() | {'latitude': None}
    profile = make_profile('tumbling', table=mapping)
    time, step = np.linspace(6.0, 60.0, 50), 1e-3
    around = [
        move_table(mapping, time + k * step, profile.at(time + k * step), 9.81)
        for k in (-2, -1, 0, 1, 2)
    ]
    here = around[2]
    turns = [
        Rotation.from_matrix(around[b].mat_ns @ around[a].mat_ns.transpose(0, 2, 1)).as_rotvec()
        for a, b in ((1, 3), (0, 4))
    ]
    rate = (8 * turns[0] / 2 - turns[1] / 2) / (6 * step)
    np.testing.assert_allclose(rate, here.rate_n, atol=1e-6 * np.abs(here.rate_n).max())
    alpha = (8 * (around[3].rate_n - around[1].rate_n) - (around[4].rate_n - around[0].rate_n)) / (
        12 * step
    )
    np.testing.assert_allclose(alpha, here.alpha_n, atol=1e-6 * np.abs(here.alpha_n).max())
    points = [position_of(mapping, profile.at(time + k * step).position) for k in (-2, -1, 0, 1, 2)]
    acceleration = (-points[0] + 16 * points[1] - 30 * points[2] + 16 * points[3] - points[4]) / (
        12 * step**2
    )
    up = [0.0, 0.0, 9.81]
    np.testing.assert_allclose(acceleration, here.force_n - up, atol=1e-4)


def position_of(mapping, angles):
    """Return the mount's point in the level frame from positions alone."""
    up = np.asarray(mapping['up']) / np.linalg.norm(mapping['up'])
    axis = np.cross(up, [0, 0, 1.0])
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(up[2]))
    points = np.zeros((len(angles), 3))
    turns = Rotation.concatenate([turn] * len(angles))
    for k, joint in enumerate(mapping['joints']):
        points = points + turns.apply(joint['xyz'])
        axis = np.asarray(joint['axis']) / np.linalg.norm(joint['axis'])
        turns = turns * Rotation.from_rotvec(np.outer(angles[:, k], axis))
    return points + turns.apply(mapping['mount']['xyz'])


def test_tilt_agrees_with_the_package():
    mapping = TABLES['three_axis']
    angles = [0.004, -0.007]
    profile = make_profile('random', seed=1)
    time = np.linspace(0.0, profile.duration, 100)
    world = move_table(mapping, time, profile.at(time), 9.81, tilt=angles)
    ref = reference_motion(
        tilt(Table.from_mapping(mapping | {'gravity': 9.81}), angles), profile.at(time)
    )
    np.testing.assert_allclose(world.to_sensor(world.force_n), ref.force_s, atol=1e-11)
    np.testing.assert_allclose(world.to_sensor(world.rate_n), ref.rate_s, atol=1e-12)


def test_gravity_agrees_with_the_package():
    for latitude, height in ((0.0, 0.0), (48.8, 150.0), (-70.0, 2000.0)):
        # GRS 80 and WGS 84 differ by 1.5e-6 m/s^2; the short formula by about as much.
        assert local_gravity(latitude, height) == pytest.approx(
            normal_gravity(latitude, height), abs=5e-6
        )


@pytest.mark.parametrize('frequency', [0.5, 3.0, 12.0])
def test_low_pass_answers_a_sine_as_theory_says(frequency):
    step, constant = 1.0 / 1600.0, 8e-3
    time = np.arange(0.0, 6.0, step)
    omega = 2.0 * np.pi * frequency
    gain = 1.0 / (1.0 + 1j * omega * constant)
    expected = np.imag(gain * np.exp(1j * omega * time))
    got = low_pass(np.sin(omega * time)[:, None], step, constant)[:, 0]
    late = time > 20 * constant
    # Linear interpolation between grid points: (omega step)^2 / 8.
    np.testing.assert_allclose(got[late], expected[late], atol=(omega * step) ** 2 / 8 + 1e-9)
    twice = low_pass(np.sin(omega * time)[:, None], step, constant, order=2)[:, 0]
    expected = np.imag(np.exp(1j * omega * time) / (1.0 + 1j * omega * constant / 2) ** 2)
    np.testing.assert_allclose(twice[late], expected[late], atol=(omega * step) ** 2 / 4 + 1e-9)


def test_low_pass_leaves_a_constant_alone():
    np.testing.assert_allclose(low_pass(np.full((50, 3), 2.5), 1e-3, 5e-3), 2.5, rtol=1e-14)


@lru_cache(maxsize=1)
def quiet():
    return make_session(7, None, 'none', **SHORT)


def clean(hidden=None, **options):
    return make_session(7, hidden, 'none', **(SHORT | options)) if hidden or options else quiet()


def predicted(session, **changes):
    """Return bias + matrix @ true at the samples, from the package's kinematics."""
    table = Table.from_mapping(session.table | {'gravity': session.truth['gravity']} | changes)
    time = (session.imu.stamp_ns - session.truth['start_ns']) * 1e-9
    ref = reference_motion(table, session.truth['profile'].at(time))
    accel, gyro = session.truth['accelerometer'], session.truth['gyroscope']
    return ref, [accel.bias + ref.force_s @ accel.matrix.T, gyro.bias + ref.rate_s @ gyro.matrix.T]


def test_without_effects_the_readings_are_bias_plus_matrix_times_true():
    session = clean()
    _, (force, rate) = predicted(session)
    # Stamps are rounded to 1 ns.
    np.testing.assert_allclose(session.imu.force_s, force, atol=2e-7)
    np.testing.assert_allclose(session.imu.rate_s, rate, atol=2e-7)


@pytest.mark.parametrize('name', EFFECTS)
def test_each_effect_touches_only_its_own_sensor(name):
    options = options_of(name)  # a machine, for what follows its vibration
    before, after = clean(**options), clean({name: None}, **options)
    change = [
        np.abs(getattr(after.imu, part) - getattr(before.imu, part)).max()
        for part in ('force_s', 'rate_s')
    ]
    # An axis that passes beside the others moves the sensor to another point, not to another
    # attitude.
    expected = (
        (True, False)
        if name.startswith(('accel', 'lever', 'table', 'axis_offset'))
        else (False, True)
        if name.startswith('gyro_')
        else (True, True)
    )
    if name in ('encoder_harmonic', 'time_offset', 'clock_rate', 'earth_rate'):
        assert max(change) == 0.0
        return
    assert (change[0] > 1e-4, change[1] > 1e-5) == expected


@pytest.mark.parametrize(
    'name, part, truth, shape',
    [
        ('accel_quadratic', 0, 'accelerometer', lambda u: u**2),
        ('accel_cubic', 0, 'accelerometer', lambda u: u**3),
        ('accel_scale_asymmetry', 0, 'accelerometer', np.abs),
        ('gyro_quadratic', 1, 'gyroscope', lambda u: u**2),
        ('gyro_scale_asymmetry', 1, 'gyroscope', np.abs),
    ],
)
def test_response_along_the_input_axis(name, part, truth, shape):
    session = clean({name: None})
    ref, linear = predicted(session)
    true = (ref.force_s, ref.rate_s)[part]
    matrix = session.truth[truth].matrix
    along = true @ (matrix / np.linalg.norm(matrix, axis=1)[:, None]).T
    measured = (session.imu.force_s, session.imu.rate_s)[part]
    np.testing.assert_allclose(
        measured - linear[part], shape(along) * session.truth['values'][name], atol=3e-7
    )


def test_products_and_force_sensitivity():
    session = clean({'accel_cross_product': None, 'gyro_g_sensitivity': None})
    ref, (force, rate) = predicted(session)
    x, y, z = ref.force_s.T
    products = np.stack([x * y, y * z, x * z], axis=1)
    np.testing.assert_allclose(
        session.imu.force_s - force,
        products @ session.truth['values']['accel_cross_product'].T,
        atol=3e-7,
    )
    np.testing.assert_allclose(
        session.imu.rate_s - rate,
        ref.force_s @ session.truth['values']['gyro_g_sensitivity'].T,
        atol=3e-7,
    )


def test_arms_add_the_tangential_and_the_centripetal_term():
    session = clean({'accel_size_effect': None})
    ref, (force, _) = predicted(session)
    arms, matrix = (
        session.truth['values']['accel_size_effect'],
        session.truth['accelerometer'].matrix,
    )
    for i in range(3):
        swing = np.cross(ref.alpha_s, arms[i]) + np.cross(ref.rate_s, np.cross(ref.rate_s, arms[i]))
        np.testing.assert_allclose(
            session.imu.force_s[:, i] - force[:, i], swing @ matrix[i], atol=1e-6
        )


def test_thermal_and_drift():
    session = clean(
        {
            'accel_thermal_bias': None,
            'gyro_thermal_scale': None,
            'gyro_bias_drift': np.array([1e-3, 0.0, -1e-3, 30.0]),
        }
    )
    ref, (force, rate) = predicted(session)
    change = session.imu.force_s - force
    warm = (
        change
        @ session.truth['values']['accel_thermal_bias']
        / np.sum(session.truth['values']['accel_thermal_bias'] ** 2)
        + 25.0
    )
    published, start_ns = session.temperature, session.truth['start_ns']
    shown = np.interp(
        session.imu.stamp_ns - start_ns, published.stamp_ns - start_ns, published.temperature_c
    )
    # The thermometer has 0.01 K of noise and resolution, and lags the last second.
    np.testing.assert_allclose(warm[:-100], shown[:-100], atol=0.1)
    assert np.ptp(shown) > 3.0
    gyro = session.truth['gyroscope']
    expected = (rate - gyro.bias) * np.outer(
        warm - 25.0, session.truth['values']['gyro_thermal_scale']
    )
    expected += np.outer(1.0 - np.exp(-ref.time / 30.0), [1e-3, 0.0, -1e-3])
    np.testing.assert_allclose(session.imu.rate_s - rate, expected, atol=1e-6)


def test_saturation_clips_the_asked_fraction():
    session = clean({'gyro_saturation': 0.05})
    level = session.truth['values']['gyro_saturation']
    at_limit = np.any(np.abs(session.imu.rate_s) >= level, axis=1)
    assert np.abs(session.imu.rate_s).max() == level
    assert at_limit.mean() == pytest.approx(0.05, abs=2e-3)


def test_bandwidth_delays_slow_motion_and_keeps_rest():
    session = clean({'gyro_bandwidth': 4e-3})
    ref, (_, rate) = predicted(session)
    still = np.abs(ref.rate_s).max(axis=1) < 1e-4
    # Where a move begins or ends: acceleration there times the time constant, below 0.1 rad/s^2
    # times 4 ms.
    np.testing.assert_allclose(session.imu.rate_s[still], rate[still], atol=4e-4)
    alpha = ref.alpha_s @ session.truth['gyroscope'].matrix.T
    lag = rate - session.imu.rate_s
    # To first order the output lags by the time constant; the next term is constant^2 times jerk.
    assert np.sum(lag * alpha) / np.sum(alpha**2) == pytest.approx(4e-3, rel=0.02)
    fine = clean({'gyro_bandwidth': 4e-3}, oversampling=32)
    np.testing.assert_allclose(session.imu.rate_s, fine.imu.rate_s, atol=2e-4 * np.abs(rate).max())


def test_late_stamps():
    before, after = clean(), clean({'time_offset': np.array([3e-3])})
    assert set(np.unique(after.imu.stamp_ns - before.imu.stamp_ns)) <= {
        3_000_000,
        2_999_999,
        3_000_001,
    }


def test_encoder_harmonics_are_what_must_be_added_to_the_reading():
    session = clean({'encoder_harmonic': None})
    plain = clean()
    reading, value = session.joints.position, session.truth['values']['encoder_harmonic']
    true = reading + sum(
        value[:, k - 1, 0] * np.cos(k * reading) + value[:, k - 1, 1] * np.sin(k * reading)
        for k in (1, 2)
    )
    np.testing.assert_allclose(true, plain.joints.position, atol=1e-12)
    time = (session.joints.stamp_ns - session.joints.stamp_ns[0]) * 1e-9
    slope = np.gradient(reading, time, axis=0)
    assert np.sqrt(np.mean((slope - session.joints.velocity) ** 2)) < 0.02 * np.sqrt(
        np.mean(slope**2)
    )


def test_crooked_axes_and_zeros():
    crooked = (
        clean({'axis_non_orthogonality': np.array([2e-3, 0.0])}).imu.rate_s - clean().imu.rate_s
    )
    assert 1e-4 < np.abs(crooked).max() < 0.02
    axes = physics_table._true_axes(TABLES['three_axis'], [2e-3, -1e-3])
    angles = [
        np.arccos(axes[k] @ TABLES['three_axis']['joints'][k - 1]['axis']) - np.pi / 2
        for k in (1, 2)
    ]
    np.testing.assert_allclose(angles, [2e-3, -1e-3], atol=1e-12)


def test_earth_rate_is_in_the_data_and_can_be_left_out_of_the_description():
    session = clean({'earth_rate': None})
    assert (
        session.table['azimuth_deg'] is None
        and session.table['latitude'] == clean().table['latitude']
    )
    assert np.linalg.norm(session.truth['values']['earth_rate']) == pytest.approx(EARTH_RATE)
    np.testing.assert_array_equal(session.imu.rate_s, clean().imu.rate_s)
    Table.from_mapping(session.table)


@pytest.mark.parametrize('name', OUTSIDE)
def test_outside_causes_are_visible_and_last(name):
    change = clean({name: None}).imu.force_s - clean().imu.force_s
    if name == 'angle_bias_gyro':
        change = clean({name: None}).imu.rate_s - clean().imu.rate_s
    size = np.linalg.norm(change, axis=1)
    largest = {
        'angle_bias_accel': 1.0,
        'angle_bias_gyro': 1.0,
        'second_warm_up': 1.0,
        'knock_step': 1.0,
    }.get(name)
    assert np.mean(size > 0.02 * OUTSIDE[name]) > 0.2
    if largest and name != 'knock_step':
        assert size.max() <= OUTSIDE[name] * (1 + 1e-9)
    if name == 'knock_step':
        assert np.median(size[-1000:]) == pytest.approx(OUTSIDE[name])


def test_same_seed_same_session_and_effects_leave_the_noise_alone():
    first, again, other = (make_session(seed, None, 'realistic', **SHORT) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.imu.force_s, again.imu.force_s)
    assert np.abs(first.imu.force_s - other.imu.force_s).max() > 1.0
    plain, hidden = (
        make_session(1, effect, 'white', **SHORT) for effect in (None, {'gyro_quadratic': None})
    )
    np.testing.assert_array_equal(plain.imu.force_s, hidden.imu.force_s)
    np.testing.assert_array_equal(plain.joints.position, hidden.joints.position)


def test_noise_has_the_size_of_its_grade():
    session = make_session(3, None, 'white', duration=200.0, profile='random_short')
    _, (force, rate) = predicted(session)
    model = session.truth['noise']
    # 20000 samples x 3 axes: 0.3 % sampling error; stamps add nothing.
    assert np.std(session.imu.force_s - force) == pytest.approx(
        model.accel_density * 10.0, rel=0.02
    )
    assert np.std(session.imu.rate_s - rate) == pytest.approx(model.gyro_density * 10.0, rel=0.02)


def test_traps():
    session = make_session(
        4,
        None,
        'realistic',
        imu_rate=400.0,
        joint_rate=50.0,
        duration=180.0,
        dropped='both',
        velocity='none',
        profile='random_short',
        encoder_resolution=np.radians(0.01),
        mount_rpy_deg=(0.0, 45.0, 0.0),
        temperature=None,
        wrong_covariance=True,
        knock=True,
    )
    assert isinstance(session, Session) and session.temperature is None
    assert np.isnan(session.joints.velocity).all()
    for samples, rate in ((session.imu, 400.0), (session.joints, 50.0)):
        gaps = np.diff(samples.stamp_ns) * 1e-9
        assert np.median(gaps) == pytest.approx(1.0 / rate, rel=0.02)
        assert np.sum(gaps > 1.9) == 1 and gaps.max() < 2.1
    steps = session.joints.position / np.radians(0.01)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert session.covariance['force'] < session.truth['noise'].accel_density ** 2 * 400.0
    assert (
        make_session(
            4, None, table='two_axis', **(SHORT | {'duration': 350.0})
        ).joints.position.shape[1]
        == 2
    )
    still = make_session(4, None, 'none', **(SHORT | {'profile': 'static_only', 'duration': 260.0}))
    assert len(still.truth['profile'].find('spin')) == 0


def test_paused_recording_holds_no_motion():
    session = clean(only_at_rest=True)
    assert 0.2 < len(session.imu) / len(clean().imu) < 0.8
    assert np.abs(session.joints.velocity).max() == 0.0
    ref, _ = predicted(session)
    assert np.abs(ref.alpha_s).max() < 1e-12


def test_arm_leaves_one_g():
    session = clean(table='centrifuge', profile='separating_short', duration=None)
    assert np.linalg.norm(session.imu.force_s, axis=1).max() > 1.3 * G


def test_session_can_be_written_into_a_bag(tmp_path):
    bag = pytest.importorskip('msg_adapters.write')
    session = make_session(1, None, 'white', **SHORT)
    physics.write_bag(session, tmp_path / 'bag')
    assert bag and (tmp_path / 'bag' / 'metadata.yaml').is_file()


def test_the_simulator_does_not_know_what_is_searched_for():
    allowed = {
        'imu_calibration',
        'imu_calibration.core.samples',
        'imu_calibration.core.units',
        'imu_calibration.kinematics.joint_motion',
        'imu_calibration.simulation.profiles',
        'imu_calibration.simulation.sensor_noise',
    }
    for name in ('physics.py', 'physics_draw.py', 'physics_table.py', 'physics_sensor.py'):
        tree = ast.parse((Path(__file__).parents[1] / 'worlds' / name).read_text())
        for node in ast.walk(tree):
            modules = (
                [node.module or '']
                if isinstance(node, ast.ImportFrom)
                else [a.name for a in getattr(node, 'names', []) if isinstance(a, ast.alias)]
            )
            for module in modules:
                assert not module.startswith('imu_calibration') or module in allowed


def test_triad_of_a_perfect_unit_is_transparent():
    rng = np.random.default_rng(1)
    field = rng.normal(size=(20, 3))
    out = Triad(np.zeros(3), np.eye(3)).respond(
        [field] * 3, np.arange(20.0), np.full(20, 25.0), field
    )
    np.testing.assert_array_equal(out, field)
