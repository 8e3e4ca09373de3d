"""The table with three axes that many worlds share."""

from imu_calibration.kinematics.table import Table

Z_Y_X = [
    {'name': 'outer', 'axis': [0, 0, 1]},
    {'name': 'middle', 'axis': [0, 1, 0]},
    {'name': 'inner', 'axis': [1, 0, 0]},
]
"""Joints from the ground to the sensor."""


def three_axis_table(**fields):
    """Return a table with the joints `Z_Y_X`, at a latitude, with further or other fields."""
    usual = {'joints': Z_Y_X, 'up': [0, 0, 1], 'latitude': 48.8, 'azimuth_deg': 0.0}
    return Table.from_mapping(usual | fields)
