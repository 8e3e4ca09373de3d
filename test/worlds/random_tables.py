"""Random tables and arms: how many joints, how they stand, how far and how fast they go."""

import numpy as np

from imu_calibration.core.units import DEG
from imu_calibration.kinematics.joint import Joint, JointLimits
from imu_calibration.kinematics.table import Table


def random_axes(rng, count):
    """
    Return axes of which no two neighbours are closer than 60 degrees to parallel, shape (count, 3).
    """
    axes = [rng.normal(size=3)]
    while len(axes) < count:
        axis = rng.normal(size=3)
        if abs(axis @ axes[-1]) < 0.5 * np.linalg.norm(axis) * np.linalg.norm(axes[-1]):
            axes.append(axis)
    return [axis / np.linalg.norm(axis) for axis in axes]


def random_table(rng, count=3, ends=0.0, speeds_deg=(60, 300)):
    """
    Return a table with so many joints, each with ends with the chance `ends`.

    With speeds between these.
    """
    joints = []
    for number, axis in enumerate(random_axes(rng, count)):
        lower, upper = (
            (-rng.uniform(40, 170) * DEG, rng.uniform(40, 170) * DEG)
            if rng.random() < ends
            else (None, None)
        )
        limits = JointLimits(
            lower, upper, rng.uniform(*speeds_deg) * DEG, rng.uniform(150, 900) * DEG
        )
        joints.append(Joint(f'joint_{number}', tuple(axis), limits=limits))
    return Table(tuple(joints), gravity=9.81, mount_rpy_deg=tuple(rng.uniform(-180, 180, 3)))
