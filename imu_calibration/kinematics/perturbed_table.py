"""The table with errors: not level, axes at wrong angles or places, axes that sag with their load and wobble as they turn."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imu_calibration.kinematics.reference_motion import rotation
from imu_calibration.kinematics.table import Table, axis_angles, axis_error_directions, base_heading_deg

if TYPE_CHECKING:
    from imu_calibration.kinematics.table import Table


def with_axis_places(table: Table, errors: np.ndarray) -> Table:
    """
    Return the table with its turning axes, but the first, shifted sideways.

    Parameters
    ----------
    table : Table
        The nominal table.
    errors : array, shape (2 (n_turning - 1),)
        For each of these axes its displacement along its `axis_error_directions`, m; the following chain moves with it.

    """
    shifts, joints, first = iter(np.reshape(errors, (-1, 2))), [], True
    for joint in table.joints:
        if joint.turns and not first:
            step = joint.mat_before @ (next(shifts) @ axis_error_directions(np.array(joint.axis)))
            joint = replace(joint, xyz=tuple((np.array(joint.xyz) + step).tolist()))
        first &= not joint.turns
        joints.append(joint)
    return replace(table, joints=tuple(joints))


def with_axis_angles(table: Table, errors: np.ndarray) -> Table:
    """
    Return the table with its axes turned by small angles.

    Parameters
    ----------
    table : Table
        The nominal table.
    errors : array, shape (n_angles,)
        One angle for each of `axis_angles`, rad; the rotation vectors of one axis add up.

    """
    vectors = np.zeros((len(table.joints), 3))
    for angle, error in zip(axis_angles(table.joints), errors, strict=True):
        vectors[angle.joint] += error * angle.direction
    joints = [joint if not vector.any() else replace(joint, axis=tuple((rotation(vector) @ np.array(joint.axis)).tolist()))
              for joint, vector in zip(table.joints, vectors, strict=True)]
    return replace(table, joints=tuple(joints))


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


WOBBLES = (-1, 2)
"""
Turns of the lean for one turn of the joint: once against it, twice with it.

A component that rotates once with the joint is the direction of the next axis or the mount, a constant one that of this axis.
"""


def with_sag(table: Table, angles: np.ndarray) -> Table:
    """
    Return the table whose turning axes, but the first, hang towards the ground.

    The load of a joint rotates by the rotation vector ``angle (up x axis)``: by the full angle if the axis is level.

    Parameters
    ----------
    table : Table
    angles : array, shape (n_turning - 1,)
        rad, by name of the joints that are read.

    """
    of_joint = dict(zip(table.joint_names.turning[1:], angles, strict=True))
    return replace(table, joints=tuple(replace(joint, sag=of_joint[joint.source]) if joint.turns and of_joint.get(joint.source) else joint
                                       for joint in table.joints))


def with_wobble(table: Table, amplitudes: np.ndarray) -> Table:
    """
    Return the table whose axes lean as they turn.

    The load of a joint rotates by the rotation vector ``Re(z) u + Im(z) v`` with u, v its `axis_error_directions` and
    ``z = sum over m of (c + i s) exp(i m q)`` at the joint angle q.

    Parameters
    ----------
    table : Table
    amplitudes : array, shape (n_turning n_wobbles 2,)
        c and s for each of `WOBBLES` of each turning joint that is read, rad.

    """
    parts = np.reshape(amplitudes, (len(table.joint_names.turning), len(WOBBLES), 2))
    of_joint = {name: tuple((order, complex(*each)) for order, each in zip(WOBBLES, part, strict=True) if each.any())
                for name, part in zip(table.joint_names.turning, parts, strict=True)}
    return replace(table, joints=tuple(replace(joint, wobble=of_joint[joint.source]) if joint.turns else joint for joint in table.joints))


def wobble_at(wobble: tuple[tuple[int, complex], ...], angle: np.ndarray, rate: np.ndarray, *, acceleration: np.ndarray) -> np.ndarray:
    """Return z of `with_wobble` and its first two derivatives in time, complex, shape (3, n)."""
    found = np.zeros((3, len(angle)), complex)
    for order, amplitude in wobble:
        turn = amplitude * np.exp(1j * order * angle)
        found += np.stack([turn, 1j * order * rate * turn, (1j * order * acceleration - (order * rate) ** 2) * turn])
    return found
