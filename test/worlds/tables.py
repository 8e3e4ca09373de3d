"""The table with three axes that many worlds share."""

from imu_calibration.kinematics.table import Table

NAMES = ('outer', 'middle', 'inner')
"""Joints from the ground to the sensor."""


def joints_about(axes, names=NAMES):
    """Return the description of joints about coordinate axes, such as 'zyx'."""
    vectors = {'x': [1, 0, 0], 'y': [0, 1, 0], 'z': [0, 0, 1]}
    return [{'name': name, 'axis': vectors[axis]} for name, axis in zip(names, axes, strict=True)]


Z_Y_X = joints_about('zyx')


def three_axis_table(**fields):
    """Return a table with the joints `Z_Y_X`, at a latitude, with further or other fields."""
    usual = {'joints': Z_Y_X, 'up': [0, 0, 1], 'latitude': 48.8, 'azimuth_deg': 0.0}
    return Table.from_mapping(usual | fields)
