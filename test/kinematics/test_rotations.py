"""Quaternions and matrices of rotation vectors, compared with those of SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calibration.kinematics.rotations import (
    quaternions_from_vectors,
    rotation,
    rotation_from_rpy,
    rotations_from_quaternions,
)


@pytest.mark.parametrize('length', [0.0, 1e-9, 0.3, np.pi, 7.0])
def test_rotation_vectors(length):
    directions = np.random.default_rng(3).standard_normal((20, 3))
    vectors = length * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    expected = Rotation.from_rotvec(vectors)
    # SciPy takes the shorter way: its quaternion has the other sign above half a turn.
    aligned = np.abs(np.sum(quaternions_from_vectors(vectors) * expected.as_quat(), axis=1))
    np.testing.assert_allclose(aligned, 1.0, atol=1e-14)
    np.testing.assert_allclose(rotation(vectors), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotation(vectors[0]), expected[0].as_matrix(), atol=1e-14)


def test_quaternions_of_any_length_and_angles_about_fixed_axes():
    generator = np.random.default_rng(4)
    quaternions = generator.standard_normal((20, 4))
    expected = Rotation.from_quat(quaternions).as_matrix()
    np.testing.assert_allclose(rotations_from_quaternions(quaternions), expected, atol=1e-14)
    rpy = generator.uniform(-3.0, 3.0, 3)
    expected = Rotation.from_euler('xyz', rpy).as_matrix()
    np.testing.assert_allclose(rotation_from_rpy(rpy), expected, atol=1e-14)
