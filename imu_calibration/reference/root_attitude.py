"""Attitude of the root of a robot, from static transforms."""

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.errors import InputError


def up_of(root: str, transforms: Iterable[tuple[str, str, np.ndarray]]) -> tuple[float, float, float]:
    """
    Return the z axis of the outermost frame in the frame `root`: up, where that frame is the world or a map.

    Parameters
    ----------
    root : str
        Frame of the robot's root.
    transforms : iterable of (parent, child, quaternion)
        The quaternion x, y, z, w turns vectors of the child into the parent.

    Raises
    ------
    InputError
        When the frames form a circle.

    """
    parents = {child: (parent, quaternion) for parent, child, quaternion in transforms}
    up, frame, passed = np.array([0.0, 0.0, 1.0]), root, []
    mats = []
    while frame in parents:
        passed.append(frame)
        frame, quaternion = parents[frame]
        if frame in passed:
            raise InputError(f"static transforms must form a tree, those around '{frame}' form a circle; correct them, or give `up`",
                             key='up', code='frame_circle')
        mats.append(_matrix(quaternion))
    for matrix in reversed(mats):
        up = matrix.T @ up
    return tuple(up.tolist())


def _matrix(quaternion):
    """Return the rotation matrix of a quaternion x, y, z, w of any length, shape (3, 3)."""
    return Rotation.from_quat(quaternion).as_matrix()
