"""
Poses through a tree of static transforms.

Products of rigid motions, whatever the order in which they came; what is missing is named.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calibration.kinematics.urdf import StaticTransforms

GENERATOR = np.random.default_rng(5)
STEPS = {('base', 'tower'): 0, ('tower', 'plate'): 1, ('plate', 'imu'): 2, ('base', 'camera'): 3}
POSES = [(GENERATOR.normal(size=3), Rotation.random(random_state=k)) for k in range(4)]


def matrix(xyz, turn):
    """Homogeneous matrix of a pose."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn.as_matrix() if isinstance(turn, Rotation) else turn, xyz
    return result


@pytest.fixture
def tree():
    """base -> tower -> plate -> imu and base -> camera, leaves first."""
    made = StaticTransforms()
    for (parent, child), k in reversed(STEPS.items()):
        assert made.add(parent, child, xyz=POSES[k][0], quaternion=POSES[k][1].as_quat())
    return made


def test_a_pose_is_the_product_of_the_steps(tree):
    in_base = matrix(*POSES[0]) @ matrix(*POSES[1]) @ matrix(*POSES[2])
    np.testing.assert_allclose(matrix(*tree.pose('base', 'imu')), in_base, atol=1e-12)
    np.testing.assert_allclose(
        matrix(*tree.pose('imu', 'base')), np.linalg.inv(in_base), atol=1e-12
    )
    np.testing.assert_allclose(
        matrix(*tree.pose('camera', 'imu')), np.linalg.inv(matrix(*POSES[3])) @ in_base, atol=1e-12
    )
    np.testing.assert_allclose(matrix(*tree.pose('imu', 'imu')), np.eye(4), atol=1e-12)


def test_the_newest_transform_of_a_child_counts(tree):
    tree.add('base', 'tower', xyz=[9.0, 0.0, 0.0], quaternion=[0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(tree.pose('base', 'tower')[0], [9.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ('xyz', 'turn'),
    [([np.nan, 0, 0], [0, 0, 0, 1]), ([0, 0, 0], [0, 0, 0, 0]), ([0, 0, 0], [np.inf, 0, 0, 1])],
)
def test_what_is_no_pose_is_left_out(tree, xyz, turn):
    assert not tree.add('base', 'tower', xyz=xyz, quaternion=turn) and tree.pose('base', 'tower')[
        0
    ] == pytest.approx(POSES[0][0])
    assert not tree.add('base', 'base', xyz=[0, 0, 0], quaternion=[0, 0, 0, 1])


def test_what_is_missing_is_named(tree):
    assert StaticTransforms().why_not('base', 'imu') == 'no static transform has come'
    assert tree.pose('base_link', 'imu') is None
    assert (
        tree.why_not('base_link', 'imu')
        == "'base_link' is in none that came (frames: base, camera, imu, plate, tower)"
    )
    assert "'a' and 'b' are in none that came" in tree.why_not('a', 'b')
    tree.add('map', 'odom', xyz=[0, 0, 0], quaternion=[0, 0, 0, 1])
    assert tree.pose('odom', 'imu') is None
    assert (
        tree.why_not('odom', 'imu')
        == "'odom' and 'imu' are in trees without a static connection (roots: map, base)"
    )


def test_a_ring_of_transforms_ends():
    ring = StaticTransforms()
    for parent, child in (('a', 'b'), ('b', 'c'), ('c', 'a')):
        ring.add(parent, child, xyz=[1.0, 0.0, 0.0], quaternion=[0.0, 0.0, 0.0, 1.0])
    ring.pose('a', 'x')
    assert ring.why_not('a', 'x')
