"""Directions, and the sphere on which readings of gravity in many attitudes lie."""

import itertools
from dataclasses import dataclass

import numpy as np

from imu_calibration.kinematics.rotations import unit_rows

DIRECTIONS = np.array(
    [np.array(d) / np.linalg.norm(d) for d in itertools.product((-1, 0, 1), repeat=3) if any(d)]
)
"""Six faces, twelve edges and eight corners turned up, in the sensor frame, shape (26, 3)."""


@dataclass(frozen=True, eq=False)
class Sphere:
    """Readings of a vector of constant length in several attitudes."""

    centre: np.ndarray
    """The bias, in the unit of the readings, shape (3,)."""
    radius: float
    """Length of the vector, in the unit of the readings."""
    spread: float
    """
    Smallest eigenvalue of the scatter of the directions from the centre: 1/3 when they are even, 0
    in a plane, where the readings do not separate bias from length.
    """


def fit_sphere(readings: np.ndarray) -> Sphere:
    """
    Return the sphere that fits readings, shape (n, 3), by linear least squares.

    With centre c and radius r, ``|x - c|^2 = r^2`` is linear in c and ``r^2 - |c|^2``::

        2 x . c + (r^2 - |c|^2) = |x|^2

    so that no starting point is needed, whatever the size of the bias.
    """
    # in units of the usual length, so that all columns have one order of magnitude
    unit = float(np.median(np.linalg.norm(readings, axis=1)))
    scaled = readings / unit
    design = np.column_stack([2 * scaled, np.ones(len(scaled))])
    *centre, constant = np.linalg.lstsq(design, (scaled**2).sum(axis=1), rcond=None)[0]
    centre = np.array(centre)
    radius = float(np.sqrt(max(constant + centre @ centre, 0.0)))
    spread = float(np.linalg.eigvalsh(np.cov(unit_rows(scaled - centre).T))[0])
    return Sphere(centre * unit, radius * unit, spread)
