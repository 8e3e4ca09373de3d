"""The static transform from our sensor frame to that of a target, as a line of a file: written, and found again."""

import re
import shlex

import numpy as np
from scipy.spatial.transform import Rotation

from imu_calibration.exports.affine import Placement

PUBLISHER = 'static_transform_publisher'
NUMBERS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
PARENT, CHILD = 'frame-id', 'child-frame-id'
UNNAMED = 'sensor_frame'
"""Name of the sensor frame where the calibration has none."""


def pose_line(placement: Placement, parent: str, child: str) -> str:
    """Return the transform with the arguments of the program of tf2_ros, with all digits."""
    values = [*placement.origin_s, *Rotation.from_matrix(placement.mat_ts.T).as_quat()]
    pose: dict[str, str] = {name: repr(float(value)) for name, value in zip(NUMBERS, values)}
    return ' '.join([PUBLISHER, *(f'--{name} {shlex.quote(value)}' for name, value in (pose | {PARENT: parent, CHILD: child}).items())])


def find_pose(content: bytes) -> tuple[Placement, str] | None:
    """Return (placement, our frame) of the first such line in a file, None where there is none: in files of other programs."""
    line = re.search(rf'{PUBLISHER} (.*)', content.decode(errors='replace'))
    try:
        words = shlex.split(line.group(1).partition('"')[0]) if line else []
        options = {name.removeprefix('--'): value for name, value in zip(words, words[1:], strict=False) if name.startswith('--')}
        values = np.array([float(options[name]) for name in NUMBERS])
        parent = options[PARENT]
    except (KeyError, ValueError):
        return None
    if not np.all(np.isfinite(values)) or not 0.99 < np.linalg.norm(values[3:]) < 1.01:
        return None
    return Placement(mat_ts=Rotation.from_quat(values[3:]).as_matrix().T, origin_s=values[:3]), '' if parent == UNNAMED else parent
