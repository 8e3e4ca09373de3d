"""A robot that can only turn about its vertical, as a table with one joint."""

from imu_calibration.constants import DEG, STANDARD_GRAVITY
from imu_calibration.reference.joint import Joint, JointLimits
from imu_calibration.reference.table import Table

SPEED, ACCELERATION = 60.0 * DEG, 90.0 * DEG
"""Rotation of a mobile base on the spot, rad/s and rad/s^2."""


def yaw_table(gravity: float | None = None) -> Table:
    """Return the table: one vertical joint without end, whose angle is known from odometry or marks on the floor."""
    joint = Joint('yaw', (0.0, 0.0, 1.0), limits=JointLimits(None, None, SPEED, ACCELERATION, endless=True))
    return Table((joint,), gravity=STANDARD_GRAVITY if gravity is None else gravity, mount_xyz=(0.0, 0.0, 0.0))
