"""A table that is not level."""

from dataclasses import replace

import numpy as np

from imu_calibration.reference.reference_motion import rotation
from imu_calibration.reference.table import Table, base_heading_deg


def tilt(table: Table, angles: np.ndarray) -> Table:
    """
    Return the table with its true `up` turned by the rotation vector (tx, ty, 0) of the level frame.

    A levelling error: ``up_true = exp((tx, ty, 0) x) up``, rad. North turns with it, so that the Earth's rate is the same
    vector of n turned alike; `azimuth_deg` changes where the convention of n requires it.
    """
    mat_bn = table.mat_nb.T @ rotation(np.array([angles[0], angles[1], 0.0]))
    tilted = replace(table, up=tuple(mat_bn[:, 2].tolist()))
    if table.azimuth_deg is None:
        return tilted
    azimuth = np.radians(table.azimuth_n_deg)  # type: ignore[arg-type]
    north = tilted.mat_nb @ mat_bn @ np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    azimuth_n_deg = np.degrees(np.arctan2(north[1], north[0]))
    return replace(tilted, azimuth_deg=float((azimuth_n_deg - base_heading_deg(tilted.mat_nb)) % 360.0))
