"""
The table's description, and its kinematics against differences in time.

The differences are of an independent chain of rotations.
"""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from refusal import refused
from scipy.spatial.transform import Rotation

from imu_calibration.api.resources import config_file
from imu_calibration.core.errors import InputError
from imu_calibration.document.files import read_table
from imu_calibration.kinematics.chain import reference_motion, tilt, with_axis_angles
from imu_calibration.kinematics.joint import TYPES, Joint, Mimic
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import earth_rate_n, normal_gravity, skew
from imu_calibration.kinematics.table import Table, axis_error_directions

THREE_AXES = {
    'joints': [
        {'name': 'outer', 'axis': [0, 0, 1]},
        {'name': 'middle', 'axis': [0, 1, 0]},
        {'name': 'inner', 'axis': [1, 0, 0]},
    ],
    'gravity': 9.81,
}
number = st.floats(-1.0, 1.0, allow_subnormal=False).map(lambda x: round(x, 6))
vectors = st.tuples(number, number, number)
coordinate_axes = st.sampled_from([(1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
directions = coordinate_axes | vectors.filter(lambda v: np.linalg.norm(v) > 0.1)


@st.composite
def chain_joints(draw, number_):
    """A joint that turns or slides, with its frame turned or not; some follow the first one."""
    mimic = (
        Mimic('joint0', 2 * draw(number), draw(number))
        if number_ and draw(st.integers(0, 3)) == 0
        else None
    )
    degrees = draw(st.just((0.0, 0.0, 0.0)) | vectors.map(lambda v: tuple(180 * x for x in v)))
    return Joint(
        f'joint{number_}',
        draw(directions),
        draw(vectors),
        degrees,
        draw(st.sampled_from(TYPES)),
        mimic,
    )


@st.composite
def tables(draw):
    joints = [draw(chain_joints(k)) for k in range(draw(st.integers(1, 4)))]
    degrees = tuple(180 * x for x in draw(vectors))
    return Table(
        joints,
        up=draw(directions),
        gravity=9.81,
        latitude=draw(st.none() | st.floats(-90, 90)),
        azimuth_deg=draw(st.none() | number),
        mount_rpy_deg=degrees,
        mount_xyz=draw(st.none() | vectors),
    )


def joint_motion(table, seed, time):
    """Sines about a ramp; every second joint of an odd seed stands still."""
    rng = np.random.default_rng(seed)
    angle, rate, amplitude, pulsation, phase = rng.uniform(
        -1.0, 1.0, (5, len(table.joint_names))
    ) * [[3.0], [2.0], [0.5], [3.0], [3.0]]
    moving = np.arange(len(table.joint_names)) % 2 < 2 - seed % 2
    rate, amplitude = rate * moving, amplitude * moving
    argument = pulsation * time[:, None] + phase
    return JointMotion(
        time,
        angle + rate * time[:, None] + amplitude * np.sin(argument),
        rate + amplitude * pulsation * np.cos(argument),
        -amplitude * pulsation**2 * np.sin(argument),
        -amplitude * pulsation**3 * np.cos(argument),
    )


def pose(table, position):
    """
    Return attitude (sensor to level) and place of the reference point.

    They are found by products of rotations, one link after the other.
    """
    turn = Rotation.from_matrix(table.mat_nb)
    place = np.zeros(3)
    at = dict(zip(table.joint_names, position, strict=True))
    for joint in table.joints:
        place = place + turn.apply(joint.xyz)
        turn = turn * Rotation.from_euler('xyz', joint.rpy_deg, degrees=True)
        moved = (
            at[joint.source]
            if joint.mimic is None
            else joint.mimic.multiplier * at[joint.source] + joint.mimic.offset
        )
        if joint.turns:
            turn = turn * Rotation.from_rotvec(moved * np.array(joint.axis))
        else:
            place = place + turn.apply(moved * np.array(joint.axis))
    place = place + turn.apply(table.mount_xyz or (0.0, 0.0, 0.0))
    return turn * Rotation.from_euler('xyz', table.mount_rpy_deg, degrees=True), place


STEP = 2e-3
OFFSETS = STEP * np.arange(-3, 4)
FIRST = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * STEP)  # sixth-order differences
SECOND = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * STEP**2)


@given(table=tables(), seed=st.integers(0, 1000))
def test_rate_is_the_derivative_of_the_attitude(table, seed):
    table = replace(table, azimuth_deg=None)
    motion = joint_motion(table, seed, 0.7 + OFFSETS)
    ref = reference_motion(table, motion)
    attitudes = np.array([pose(table, position)[0].as_matrix() for position in motion.position])
    np.testing.assert_allclose(ref.mat_sn, attitudes.transpose(0, 2, 1), atol=1e-14)
    np.testing.assert_allclose(
        ref.mat_sn @ attitudes, np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-14
    )
    # Rounding 1e-15 / STEP; truncation STEP^6 rate^7 / 140 for rates up to 14 rad/s (four joints in
    # line).
    np.testing.assert_allclose(
        -np.tensordot(FIRST, ref.mat_sn, 1) @ attitudes[3], skew(ref.rate_s[3]), atol=1e-7
    )


@given(table=tables(), seed=st.integers(0, 1000))
def test_angular_acceleration_is_the_derivative_of_the_rate(table, seed):
    """Against inertial space, in the turning frame: the Earth's rate is included."""
    ref = reference_motion(table, joint_motion(table, seed, 0.7 + OFFSETS))
    np.testing.assert_allclose(FIRST @ ref.rate_s, ref.alpha_s[3], atol=1e-6)


@given(table=tables(), seed=st.integers(0, 1000))
def test_force_is_gravity_and_the_acceleration_of_the_reference_point(table, seed):
    table = replace(table, azimuth_deg=None)
    motion = joint_motion(table, seed, 0.7 + OFFSETS)
    ref = reference_motion(table, motion)
    acceleration = SECOND @ np.array([pose(table, position)[1] for position in motion.position])
    scale = 1 + np.abs(ref.force_s[3]).max()
    np.testing.assert_allclose(
        ref.mat_sn[3] @ (acceleration + [0, 0, 9.81]), ref.force_s[3], atol=1e-7 * scale
    )


@settings(max_examples=20, deadline=None)
@given(table=tables(), seed=st.integers(0, 1000))
def test_static_table_feels_gravity_and_the_earth(table, seed):
    moving = joint_motion(table, seed, np.array([0.0, 1.0]))
    zero = np.zeros_like(moving.rate)
    ref = reference_motion(table, JointMotion(moving.time, moving.position, zero, zero, zero))
    known = table.latitude is not None and table.azimuth_deg is not None
    rate_n = earth_rate_n(table.latitude, table.azimuth_n_deg) if known else np.zeros(3)
    np.testing.assert_allclose(ref.rate_s, ref.mat_sn @ rate_n, atol=1e-18)
    # The turn of the Earth moves the reference point: 5e-9 rad^2/s^2 times its arm.
    np.testing.assert_allclose(ref.force_s, 9.81 * ref.mat_sn[:, :, 2], atol=1e-7)
    # Each row by itself, which takes the path of joints that stand still.
    for row in range(2):
        single = reference_motion(
            table,
            JointMotion(moving.time, moving.position, zero, zero, zero).select(slice(row, row + 1)),
        )
        np.testing.assert_allclose(single.mat_sn[0], ref.mat_sn[row], atol=1e-15)


def test_joints_that_stand_still_are_not_special():
    table = Table.from_mapping(
        THREE_AXES | {'mount': {'rpy_deg': [10, 20, 30], 'xyz': [0.1, 0.2, 0.3]}}
    )
    time = np.linspace(0, 1, 50)
    motion = joint_motion(table, 1, time)
    assert np.ptp(motion.position[:, 1]) == 0
    nudged = motion.position.copy()
    nudged[-1, 1] += 1e-3
    still, moved = (
        reference_motion(table, motion),
        reference_motion(table, replace(motion, position=nudged)),
    )
    for name in ('mat_sn', 'force_s', 'rate_s', 'alpha_s'):
        np.testing.assert_allclose(getattr(still, name)[:-1], getattr(moved, name)[:-1], atol=1e-13)


def test_long_records_are_the_same_as_their_pieces():
    table = with_axis_angles(Table.from_mapping(THREE_AXES), [1e-3, 2e-3])
    motion = joint_motion(table, 0, np.linspace(0, 20, 20001))
    whole, part = (
        reference_motion(table, motion),
        reference_motion(table, motion.select(slice(9000, 9010))),
    )
    np.testing.assert_array_equal(whole.mat_sn[9000:9010], part.mat_sn)
    np.testing.assert_array_equal(whole.alpha_s[9000:9010], part.alpha_s)
    assert len(reference_motion(table, motion.select(slice(0, 0)))) == 0


def test_gimbal_rates_are_not_body_rates():
    """
    The middle joint at a right angle lines up outer and inner axis.

    Equal and opposite rates cancel.
    """
    table = Table.from_mapping(THREE_AXES)
    rate = np.array([[1.0, 0.0, 1.0]])
    zero = np.zeros((1, 3))
    ref = reference_motion(
        table, JointMotion(np.zeros(1), np.array([[0.3, np.pi / 2, 0.7]]), rate, zero, zero)
    )
    np.testing.assert_allclose(ref.rate_s, np.zeros((1, 3)), atol=1e-15)


def test_centrifuge_arm_feels_its_centripetal_acceleration():
    table = Table([Joint('arm', (0, 0, 1))], gravity=9.81, mount_xyz=(2.0, 0.0, 0.0))
    motion = JointMotion(
        np.zeros(1), np.zeros((1, 1)), np.full((1, 1), 3.0), np.full((1, 1), 0.5), np.zeros((1, 1))
    )
    np.testing.assert_allclose(
        reference_motion(table, motion).force_s, [[-18.0, 1.0, 9.81]], atol=1e-14
    )


@given(up=directions)
def test_level_frame_is_the_smallest_turn(up):
    table = Table([Joint('a', (0, 0, 1))], up=up, gravity=9.81)
    np.testing.assert_allclose(table.mat_nb @ table.up, [0, 0, 1], atol=1e-9)
    angle = Rotation.from_matrix(table.mat_nb).magnitude()
    assert angle == pytest.approx(np.arctan2(np.hypot(*table.up[:2]), table.up[2]), abs=1e-7)


def test_mount_follows_urdf():
    table = Table([Joint('a', (0, 0, 1))], gravity=9.81, mount_rpy_deg=(0, 0, 90))
    np.testing.assert_allclose(table.mat_sl @ [0, 1, 0], [1, 0, 0], atol=1e-15)
    rpy = (20.0, -50.0, 110.0)
    expected = Rotation.from_euler('xyz', rpy, degrees=True).as_matrix().T
    np.testing.assert_allclose(replace(table, mount_rpy_deg=rpy).mat_sl, expected, atol=1e-15)


def test_azimuth_is_that_of_the_base_x_axis():
    table = Table([Joint('a', (0, 0, 1))], up=(0.4, 0.5, 0.6), latitude=40.0, azimuth_deg=30.0)
    x_n = table.mat_nb[:, 0]
    north_n = earth_rate_n(40.0, table.azimuth_n_deg)
    east_n = np.cross(north_n, [0, 0, 1])
    heading = np.degrees(
        np.arctan2(
            x_n @ east_n / np.linalg.norm(east_n),
            x_n[:2] @ north_n[:2] / np.linalg.norm(north_n[:2]),
        )
    )
    assert heading == pytest.approx(30.0)


@given(table=tables(), angles=st.tuples(number, number))
def test_tilt_turns_up_and_north_together(table, angles):
    table = replace(table, latitude=30.0, azimuth_deg=20.0)
    tilted = tilt(table, 0.1 * np.array(angles))
    turn_n = Rotation.from_rotvec([0.1 * angles[0], 0.1 * angles[1], 0.0]).as_matrix()
    mat_bn = table.mat_nb.T
    np.testing.assert_allclose(tilted.up, mat_bn @ turn_n[:, 2], atol=1e-9)
    before, after = (earth_rate_n(30.0, one.azimuth_n_deg) for one in (table, tilted))
    np.testing.assert_allclose(tilted.mat_nb.T @ after, mat_bn @ turn_n @ before, atol=1e-12)


@given(axis=directions, error=st.tuples(number, number))
def test_axes_that_should_be_parallel_turn_about_the_declared_directions(axis, error):
    table = Table(
        [Joint('a', axis), Joint('rail', (1, 0, 0), type='prismatic'), Joint('b', axis)],
        gravity=9.81,
    )
    assert table.joint_names.angles == ('a_b_u', 'a_b_v')
    axis = np.array(table.joints[0].axis)
    triad = np.vstack([axis_error_directions(axis), axis])
    np.testing.assert_allclose(triad @ triad.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(triad) > 0
    turned = with_axis_angles(table, error).joints[2].axis
    np.testing.assert_allclose(
        turned, Rotation.from_rotvec(np.array(error) @ triad[:2]).apply(axis), atol=1e-12
    )


@given(table=tables())
def test_mapping_gives_the_table_back(table):
    assert Table.from_mapping(table.to_mapping()) == table
    assert Table.from_mapping(yaml.safe_load(yaml.safe_dump(table.to_mapping()))) == table


def test_yaml_of_the_contract_is_read():
    text = """
joints:
  - {name: outer, axis: [0, 0, 2]}
  - {name: inner, axis: [1, 0, 0], xyz: [0.1, 0, 0]}
up: [0, 0, 1]
gravity: null
latitude: 48.0
height: 500
joint_noise_rad: 5e-6
mount: {rpy_deg: [0, 0, 90], xyz: null}
"""
    table = Table.from_mapping(yaml.safe_load(text))
    assert table.joint_names.read == ('outer', 'inner')
    assert table.joints[0].axis == (0.0, 0.0, 1.0)
    assert table.joint_noise_rad == 5e-6
    assert table.gravity_value == pytest.approx(9.8089 - 3.086e-6 * 500, abs=2e-4)
    assert table.mount_xyz is None


@pytest.mark.parametrize(
    ('change', 'code', 'values'),
    [
        ({'gravity': None}, 'gravity_missing', []),
        ({'gravity': 1.0}, 'out_of_range', ['gravity', '[1.5, 30]', 1.0]),
        ({'gravity': 'nine'}, 'not_finite', ['gravity', 'nine']),
        ({'latitude': 91.0}, 'out_of_range', ['latitude', '[-90, 90]', 91.0]),
        ({'joint': []}, 'key_unknown', ["'joint'", 'joints, up']),
        ({'joints': None}, 'no_joint', ['joints']),
        ({'joints': []}, 'no_joint', ['joints']),
        (
            {'joints': [{'name': f'j{k}', 'axis': [0, 0, 1]} for k in range(17)]},
            'joints_many',
            [16, 17],
        ),
        ({'joints': [{'name': 'a'}]}, 'keys_missing', ["{'name': 'a'}", 'axis']),
        (
            {'joints': [{'name': 'a', 'axis': [0, 0, 0]}]},
            'zero_vector',
            ['joints[0] (a).axis', '[0, 0, 0]'],
        ),
        (
            {'joints': [{'name': 'a', 'axis': [0, 1]}]},
            'three_numbers',
            ['joints[0] (a).axis', '[0, 1]'],
        ),
        (
            {'joints': [{'name': 'a', 'axis': [0, 0, 1], 'angle': 3}]},
            'key_unknown',
            ['angle', 'name, axis, xyz'],
        ),
        ({'joints': 2 * [{'name': 'a', 'axis': [0, 0, 1]}]}, 'joint_names', ["['a', 'a']"]),
        ({'joints': ['outer']}, 'not_a_mapping', ['joint']),
        ({'up': [0, 0, 0]}, 'zero_vector', ['up', '[0, 0, 0]']),
        ({'up': 'z'}, 'three_numbers', ['up', "'z'"]),
        ({'mount': {'rpy': [0, 0, 0]}}, 'key_unknown', ["'rpy'", 'rpy_deg, xyz']),
        ({'mount': {'rpy_deg': [0, float('nan'), 0]}}, 'not_finite', ['rpy_deg', 'nan']),
    ],
)
def test_wrong_descriptions_are_refused_in_one_line(change, code, values):
    with refused(InputError, code, *values) as caught:
        Table.from_mapping(THREE_AXES | change)
    assert '\n' not in str(caught.value)


def test_something_else_than_a_mapping_is_refused():
    with refused(InputError, 'not_a_mapping'):
        Table.from_mapping(['outer'])


@pytest.mark.parametrize(
    'name',
    sorted(path.name for path in config_file('table_template.yaml').parent.glob('table_*.yaml')),
)
def test_the_files_that_users_copy_have_no_place(name):
    """
    A copied latitude of 48.8 degrees made scale factors wrong by more than 100 sd at 13 degrees.
    """
    if name == 'table_simulated.yaml':
        assert read_table(config_file(name)).latitude == 48.8
        return
    mapping = yaml.safe_load(config_file(name).read_text(encoding='utf-8'))
    assert [
        mapping[key] for key in ('gravity', 'gravity_sd', 'latitude', 'height', 'azimuth_deg')
    ] == [None] * 5
    # Limits of another table would move joints.
    assert all(set(joint) == {'name', 'axis'} for joint in mapping['joints'])
    with refused(InputError, 'gravity_missing'):
        Table.from_mapping(mapping)
    assert Table.from_mapping(mapping | {'gravity': 9.78}).gravity_value == 9.78


@pytest.mark.parametrize(
    ('given_values', 'expected'),
    [
        ({'latitude': 13.0}, 1e-4 * normal_gravity(13.0)),
        ({'latitude': 13.0, 'gravity': 9.78}, 0.0),
        ({'gravity': 9.78}, 0.0),
        ({'latitude': 13.0, 'gravity_sd': 0.0}, 0.0),
        ({'latitude': 13.0, 'gravity_sd': 3e-3}, 3e-3),
    ],
)
def test_sd_of_gravity_is_that_of_the_formula_unless_gravity_is_given(given_values, expected):
    assert Table.from_mapping(
        THREE_AXES | {'gravity': None} | given_values
    ).gravity_sd_value == pytest.approx(expected)


MEASURED = (9.80123, 0.0)
OF_LATITUDE = (normal_gravity(48.0), 1e-4 * normal_gravity(48.0))


@pytest.mark.parametrize(
    ('description', 'apart', 'expected'),
    [
        ({}, MEASURED, MEASURED),
        ({}, OF_LATITUDE, OF_LATITUDE),
        ({'gravity_sd': 1e-5}, MEASURED, (9.80123, 1e-5)),
        # a measured gravity is closer than that of the latitude, which the Earth's rate still needs
        ({'latitude': 13.0}, MEASURED, MEASURED),
        # stated twice
        ({'latitude': 48.0}, OF_LATITUDE, OF_LATITUDE),
        ({'gravity': 9.80123, 'gravity_sd': 1e-5}, MEASURED, (9.80123, 1e-5)),
        ({'latitude': 13.0}, OF_LATITUDE, None),
        ({'gravity': 9.81}, MEASURED, None),
        ({'gravity': 9.81}, OF_LATITUDE, None),
        ({'gravity': 9.81, 'latitude': 48.0}, OF_LATITUDE, None),
    ],
)
def test_a_gravity_given_apart_is_used_or_refused(description, apart, expected):
    mapping = THREE_AXES | {'gravity': None} | description
    gravity, spread = apart
    if expected is None:
        with refused(InputError, 'gravity_twice', f'{gravity:.5f}'):
            Table.from_mapping(mapping, gravity=gravity, gravity_sd=spread)
        return
    table = Table.from_mapping(mapping, gravity=gravity, gravity_sd=spread)
    assert (table.gravity_value, table.gravity_sd_value) == pytest.approx(expected)
    assert table.latitude == description.get('latitude')
