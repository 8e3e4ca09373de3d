"""The mount of the table description against a turn that both sensors have in common."""

import numpy as np

from imu_calibration.core.units import DEG
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.rotations import nearest_rotation, rotation_vector
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.joint_geometry import mount_rpy_deg
from imu_calibration.preprocessing.recording_evidence import WARNING, CheckFinding

CHECK = 'mount'
LEAST_TURN = 1.5 * DEG
"""Smallest common turn that is reported, rad; the axes of a sensor are off by less."""
LARGEST_DIFFERENCE = 0.5
"""Largest difference between the turns of two sensors, as a share of their mean."""
ALONG = np.cos(10 * DEG)
"""Cosine of the angle between a turn and an axis from which the turn is about that axis."""


def mount_findings(solution: Solution, table: Table) -> tuple[CheckFinding, ...]:
    """
    Return the finding of a turn of the IMU against the mount of the table, if there is one.

    The matrix of a sensor is that of its axes times the turn R of the IMU against its stated mount,
    ``M = E R``. E differs from sensor to sensor and is nearly the identity, R is common to both. A
    wrong zero of the last joint is such a turn, about its axis: no recording separates them.

    Parameters
    ----------
    solution : Solution
        With the matrices of the sensors.
    table : Table

    """
    matrices = []
    for sensor in SENSORS:
        part = solution.model.part(sensor, Role.LINEAR)
        if part.stop > part.start and not solution.held[part].any():
            matrices.append(solution.values[part].reshape(3, 3))
    if not matrices:
        return ()
    turns = [nearest_rotation(matrix) for matrix in matrices]
    common = nearest_rotation(np.sum(turns, axis=0))
    turn = rotation_vector(common)
    angle = float(np.linalg.norm(turn))
    if angle < LEAST_TURN:
        return ()
    for one in turns:
        if np.linalg.norm(rotation_vector(one @ common.T)) > LARGEST_DIFFERENCE * angle / 2:
            return ()
    # The axis of the last joint is the same in both links that it connects.
    last_axis = table.mat_sl @ np.array(table.joints[-1].axis)
    zero = ''
    if table.joints[-1].turns and abs(last_axis @ turn) > ALONG * angle:
        zero = f' (or the zero of {table.joint_names[-1]}, which has the same effect)'
    fits = ', '.join(f'{value + 0.0:.2f}' for value in np.round(mount_rpy_deg(common, table), 2))
    text = (
        'the IMU must be mounted as in the table description, its readings are turned by'
        f' {angle / DEG:.2f} deg against it: mount.rpy_deg [{fits}] would fit; correct it{zero}, or'
        ' the matrices contain this turn'
    )
    return (CheckFinding(CHECK, WARNING, text, key='table'),)
