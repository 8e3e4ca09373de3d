"""Any arm as a table: the chain of a URDF against Pinocchio, and what is refused."""

import warnings

import numpy as np
import pytest
from refusal import refused
from scipy.spatial.transform import Rotation

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.joint import JointLimits, JointNames
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import table_from_urdf

from worlds.arms import FOLLOWING, GANTRY, ROBOTS, SCARA, SIX_AXES, joint, robot

GRAVITY = 9.81
SITE = {'gravity': GRAVITY}


def random_motion(table, n=40, seed=3):
    rng = np.random.default_rng(seed)
    count = len(table.joint_names)
    return JointMotion(
        np.arange(n) * 0.01,
        *(rng.uniform(-size, size, (n, count)) for size in (2.5, 3.0, 8.0, 0.0)),
    )


def pinocchio_reference(text, table, motion, link='imu_link'):
    """
    Return the motion of the link by Pinocchio, z of the root up.

    The motion is attitude, rate, angular acceleration and specific force.
    """
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        pin = pytest.importorskip(
            'pinocchio',
            reason='Pinocchio is the oracle of this test: pip install -r constraints/oracles.txt',
        )
    model = pin.buildModelFromXML(text.split('?>', 1)[1])
    data, frame = model.createData(), model.getFrameId(link)
    mimics = {j.name: j.mimic for j in table.joints if j.mimic is not None}
    rows = []
    for values in zip(motion.position, motion.rate, motion.acceleration, strict=True):
        read = dict(zip(table.joint_names, np.array(values).T, strict=True))
        q, v, a = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        for name in (j.name for j in table.joints):
            mimic = mimics.get(name)
            at = (
                read[name]
                if mimic is None
                else mimic.multiplier * read[mimic.joint] + [mimic.offset, 0, 0]
            )
            index = model.getJointId(name)
            part = model.joints[index]
            q[part.idx_q : part.idx_q + part.nq] = (
                at[0] if part.nq == 1 else [np.cos(at[0]), np.sin(at[0])]
            )
            v[part.idx_v], a[part.idx_v] = at[1], at[2]
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        turn = data.oMf[frame].rotation.copy()
        speed = pin.getFrameVelocity(model, data, frame, pin.LOCAL).angular
        acceleration = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL)
        rows.append(
            (turn.T, speed, acceleration.angular, acceleration.linear + turn.T @ [0, 0, GRAVITY])
        )
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize('name', ROBOTS)
def test_a_link_of_any_robot_feels_what_pinocchio_says(name):
    table = table_from_urdf(ROBOTS[name], 'imu_link', SITE)
    motion = random_motion(table)
    ref = reference_motion(table, motion)
    attitude, rate, alpha, force = pinocchio_reference(ROBOTS[name], table, motion)
    for ours, its in (
        (ref.mat_sn, attitude),
        (ref.rate_s, rate),
        (ref.alpha_s, alpha),
        (ref.force_s, force),
    ):
        # Largest values: 20 rad/s, 500 rad/s^2, 500 m/s^2.
        np.testing.assert_allclose(ours, its, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('name', ROBOTS)
def test_a_table_file_holds_any_arm(name):
    table = table_from_urdf(ROBOTS[name], 'imu_link', SITE)
    again = Table.from_mapping(table.to_mapping())
    assert again.joint_names == table.joint_names
    motion = random_motion(table)
    for field in ('mat_sn', 'force_s', 'rate_s', 'alpha_s'):
        np.testing.assert_allclose(
            getattr(reference_motion(again, motion), field),
            getattr(reference_motion(table, motion), field),
            rtol=1e-12,
            atol=1e-12,
        )
    assert Table.from_mapping(again.to_mapping()) == again


def test_names_of_what_may_be_wrong_follow_from_the_axes():
    """
    A zero is an error of its own between the first and the last axis.

    Parallel axes have two angles.
    """
    six = table_from_urdf(SIX_AXES, 'imu_link', SITE).joint_names
    assert six.read == ('pan', 'lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3')
    assert six.zeros == ('lift', 'elbow', 'wrist_1', 'wrist_2')
    assert six.angles == (
        'pan_lift',
        'lift_elbow_u',
        'lift_elbow_v',
        'elbow_wrist_1_u',
        'elbow_wrist_1_v',
        'wrist_1_wrist_2',
        'wrist_2_wrist_3',
    )
    scara = table_from_urdf(SCARA, 'imu_link', SITE).joint_names
    assert scara.read == ('first', 'second', 'stroke', 'third')
    assert (scara.turning, scara.zeros) == (('first', 'second', 'third'), ('second',))
    following = table_from_urdf(FOLLOWING, 'imu_link', SITE).joint_names
    assert following.read == ('drive', 'parallel', 'gripper_joint', 'end')
    assert following.zeros == ('parallel', 'gripper_joint')
    assert JointNames.of(following.read, following.errors) == following
    plain = Table.from_mapping(
        {
            'joints': [{'name': 'a', 'axis': [0, 0, 1]}, {'name': 'b', 'axis': [0, 1, 0]}],
            'gravity': 9.81,
        }
    ).joint_names
    assert plain.errors is None and plain == JointNames.of(('a', 'b'))


def test_limits_come_from_the_description_and_the_site():
    site = SITE | {
        'joints': [
            {'name': 'lift', 'acceleration_deg_s2': 180.0, 'range_deg': [-90, 30]},
            {'name': 'wrist_3', 'speed_deg_s': 90.0},
        ]
    }
    limits = {j.name: j.limits for j in table_from_urdf(SIX_AXES, 'imu_link', site).joints}
    assert limits['pan'] == JointLimits(-2.9, 2.9, 3.0)
    assert limits['lift'] == JointLimits(np.radians(-90), np.radians(30), 3.0, np.radians(180.0))
    assert limits['wrist_3'] == JointLimits(speed=np.radians(90.0), endless=True)
    assert table_from_urdf(GANTRY, 'imu_link', SITE).joints[0].limits == JointLimits(-0.1, 0.9, 1.5)


def test_the_place_of_the_link_and_of_the_sensor_in_it_add_up():
    inner = joint('turn', 'base_link', 'arm')
    # At the pole of roll, pitch, yaw.
    fixed = joint(
        'bent', 'arm', 'imu_link', '0.1 0.2 0.3', f'{np.pi / 2} {np.pi / 2} 0.3', kind='fixed'
    )
    table = table_from_urdf(
        robot(inner, fixed),
        'imu_link',
        SITE | {'mount': {'xyz': [0.0, 0.0, 0.5], 'rpy_deg': [0, 0, 90]}},
    )
    folded = Rotation.from_euler('xyz', [np.pi / 2, np.pi / 2, 0.3])
    np.testing.assert_allclose(
        table.mount_xyz, [0.1, 0.2, 0.3] + folded.apply([0, 0, 0.5]), atol=1e-15
    )
    np.testing.assert_allclose(
        table.mat_sl.T,
        (folded * Rotation.from_euler('z', 90, degrees=True)).as_matrix(),
        atol=1e-15,
    )


def test_an_unknown_place_takes_the_standard_gravity_and_its_doubt():
    table = table_from_urdf(SIX_AXES, 'imu_link')
    assert (table.gravity, table.gravity_sd, table.joint_error_rad) == (
        STANDARD_GRAVITY,
        0.02,
        1e-3,
    )
    assert table_from_urdf(SIX_AXES, 'imu_link', {'latitude': 45.0}).gravity is None


@pytest.mark.parametrize(
    'text, link, values',
    [
        ('<robot', 'imu_link', ['URDF', 'line 1']),
        ('<sdf/>', 'imu_link', ['URDF', '<sdf>']),
        ('', 'imu_link', ['URDF']),
        (SIX_AXES, 'imu', ["'imu'", 'base_link, camera_link']),
        (SIX_AXES, 'camera_link', ["'camera_link'", "'base_link'"]),
        (SIX_AXES, 'base_link', ["'base_link'"]),
        (
            robot(joint('free', 'base_link', 'imu_link', kind='floating')),
            'imu_link',
            ["'free'", 'floating'],
        ),
        (
            robot(joint('a', 'base_link', 'imu_link', extra='<mimic joint="nobody"/>')),
            'imu_link',
            ["'a'", "'nobody'"],
        ),
        (
            robot(joint('a', 'base_link', 'imu_link', axis='0 0 0')),
            'imu_link',
            ["'a'", [0.0, 0.0, 0.0]],
        ),
        (robot(joint('a', 'base_link', 'imu_link', xyz='0 0')), 'imu_link', ['URDF', "'a'"]),
        (robot(joint('a', 'imu_link', 'b'), joint('c', 'b', 'imu_link')), 'imu_link', ["'b'"]),
    ],
)
def test_what_is_no_chain_is_refused_in_one_line(text, link, values):
    with pytest.raises(InputError) as caught:
        table_from_urdf(text, link, SITE)
    assert all(str(value) in str(caught.value) for value in values) and '\n' not in str(
        caught.value
    )


def test_a_site_may_only_name_joints_on_the_way():
    with refused(InputError, 'joint_unknown', 'imu_link', 'gripper_joint'):
        table_from_urdf(
            SIX_AXES, 'imu_link', SITE | {'joints': [{'name': 'gripper_joint', 'speed_deg_s': 3}]}
        )
    with refused(InputError, 'key_unknown', 'range_m'):
        table_from_urdf(
            SIX_AXES, 'imu_link', SITE | {'joints': [{'name': 'lift', 'range_m': [0, 1]}]}
        )


@pytest.mark.parametrize(
    'changes, values',
    [
        ({'type': 'planar'}, ['(a).type', "'planar'"]),
        ({'range_deg': [10, -10]}, ["'a'", 0.1745, -0.1745]),
        ({'range_deg': 10}, ['(a).range_deg', 10]),
        ({'speed_deg_s': 0}, ['(a).speed_deg_s', 'got 0']),
        ({'type': 'prismatic', 'range_deg': [0, 1]}, ["'range_deg'", 'range_m']),
        ({'mimic': {'joint': 'b'}}, ["'a'", "'b'"]),
        ({'mimic': 'b'}, ['(a).mimic', "'b'"]),
        ({'mimic': {'multiplier': 2}}, ['(a).mimic', "{'multiplier': 2}"]),
    ],
)
def test_joints_that_cannot_be_are_refused(changes, values):
    joints = [
        {'name': 'a', 'axis': [0, 0, 1]} | changes,
        {'name': 'b', 'axis': [0, 1, 0], 'mimic': {'joint': 'c'}},
    ]
    with pytest.raises(InputError) as caught:
        Table.from_mapping({'joints': joints, 'gravity': 9.81})
    assert all(str(value) in str(caught.value) for value in values), str(caught.value)
