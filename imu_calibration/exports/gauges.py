"""Axes by convention: the turn that makes a matrix triangular, and the frames of other programs."""

import numpy as np

from imu_calibration.errors import InputError
from imu_calibration.exports.affine import AffineImu, Placement

FRD = np.diag([1.0, -1.0, -1.0])
"""From forward-left-up, as in ROS, to forward-right-down, as in autopilots; its own inverse."""
_TURNED_ROUND = np.eye(3)[::-1]


def lower_times_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (L, Q) with ``matrix = L @ Q``: L lower triangular with positive diagonal, Q a rotation.

    Raises
    ------
    InputError
        When the axes of the matrix are left-handed.

    """
    if np.linalg.det(matrix) <= 0:
        raise InputError('the axes of a sensor must be right-handed, the matrix of this calibration turns them into their mirror image; '
                         'check for an exchanged axis', code='left_handed')
    q, r = np.linalg.qr(matrix.T)
    signs = np.sign(np.diag(r))
    return np.tril((r * signs[:, None]).T), (q * signs).T


def upper_times_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (U, Q) with ``matrix = U @ Q``: U upper triangular with positive diagonal, Q a rotation."""
    lower, rotation = lower_times_rotation(_TURNED_ROUND @ matrix @ _TURNED_ROUND)
    return _TURNED_ROUND @ lower @ _TURNED_ROUND, _TURNED_ROUND @ rotation @ _TURNED_ROUND


def as_mounted(_imu: AffineImu) -> Placement:
    """Return the placement of a program with unchanged axes."""
    return Placement()


def accelerometer_lower(imu: AffineImu) -> Placement:
    """Return the placement in which the accelerometer's matrix is lower triangular."""
    return Placement(mat_ts=lower_times_rotation(imu.matrix['accelerometer'])[1])


def accelerometer_lower_at_x(imu: AffineImu) -> Placement:
    """Return the same with the origin in the sensitive point of the x accelerometer."""
    return Placement(mat_ts=lower_times_rotation(imu.matrix['accelerometer'])[1], origin_s=imu.arms[0])


def forward_right_down(_imu: AffineImu) -> Placement:
    """Return the placement of an autopilot: readings and frame forward-right-down."""
    return Placement(mat_ts=FRD, mat_readings=FRD)
