"""Rotation matrices: from a rotation vector, from roll, pitch and yaw, and the smallest one that turns a direction upwards."""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.reference.reference_motion import skew


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return ``exp(vector x)``, shape (3, 3): the turn by a rotation vector, rad."""
    return Rotation.from_rotvec(vector).as_matrix()


def rotation_from_rpy(rpy: np.ndarray) -> np.ndarray:
    """Return ``Rz(yaw) Ry(pitch) Rx(roll)``, shape (3, 3): turns about fixed axes as in URDF, rad."""
    return Rotation.from_euler('xyz', rpy).as_matrix()


def rpy_from_rotation(matrix: np.ndarray) -> np.ndarray:
    """
    Return roll, pitch and yaw of a rotation matrix, rad, shape (3,): ``rotation_from_rpy`` gives the matrix back to rounding.

    At a pitch of a quarter turn only one combination of roll and yaw is defined; yaw follows from the remainder (Shoemake), so
    that their errors cancel there.
    """
    roll = np.arctan2(matrix[2, 1], matrix[2, 2])
    pitch = np.arctan2(-matrix[2, 0], np.hypot(matrix[2, 1], matrix[2, 2]))
    sin, cos = np.sin(roll), np.cos(roll)
    return np.array([roll, pitch, np.arctan2(sin * matrix[0, 2] - cos * matrix[0, 1], cos * matrix[1, 1] - sin * matrix[1, 2])])


def align(direction: np.ndarray) -> np.ndarray:
    """Return the smallest rotation from the unit vector `direction` to z, shape (3, 3); half a turn about x from -z."""
    x, y, z = direction
    across = x * x + y * y
    if z < 0 and across < 1e-24:
        return np.diag([1.0, -1.0, -1.0])
    cross = skew([y, -x, 0.0])
    # 1 + z cancels when z is near -1.
    return np.eye(3) + cross + cross @ cross / (1 + z if z > 0 else across / (1 - z))
