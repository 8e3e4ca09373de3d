"""
The six stands of the planner's targets.

Two tables, a table with ends, a gantry, arms with six and seven joints.
"""

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import table_from_urdf
from imu_calibration.references.turntable.requested_model import choose_model

from worlds.arms import GANTRY, SEVEN_AXES, SIX_AXES
from worlds.random_tables import random_table

LIMITS = {'speed_deg_s': 150.0, 'acceleration_deg_s2': 300.0}
STANDS = ('two axes', 'three axes', 'three axes with ends', 'gantry', 'six joints', 'seven joints')
ROBOTS = {'gantry': GANTRY, 'six joints': SIX_AXES, 'seven joints': SEVEN_AXES}


def stand(name):
    """Return the table of a stand."""
    if name in ROBOTS:
        return table_from_urdf(ROBOTS[name], 'imu_link', {'gravity': 9.81})
    if name == 'three axes with ends':
        return random_table(np.random.default_rng(11), 3, 1.0)
    axes = (
        {'outer': [0, 0, 1], 'middle': [0, 1, 0], 'inner': [1, 0, 0]}
        if name == 'three axes'
        else {'tilt': [0, 1, 0], 'plate': [0, 0, 1]}
    )
    return Table.from_mapping(
        {
            'joints': [{'name': joint, 'axis': axis, **LIMITS} for joint, axis in axes.items()],
            'gravity': 9.81,
            'mount': {'rpy_deg': [0, 0, 0]},
        }
    )


def quarter_tolerances(table):
    """Return {section: {effect: a quarter of its default tolerance}}."""
    found = {}
    for effect in choose_model(CalibrationOptions(), table).effects:
        found.setdefault(effect.sensor, {})[effect.name] = 0.25 * effect.tolerance
    return found
