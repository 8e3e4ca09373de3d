"""Angles between neighbouring axes of a chain: their names, and about which direction an axis turns when one of them is wrong."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from imu_calibration.reference.reference_motion import rotation

if TYPE_CHECKING:
    from imu_calibration.reference.joint import Joint
    from imu_calibration.reference.table import Table

PARALLEL = 0.02
"""Sine of the angle up to which two axes count as parallel: their common perpendicular is undefined there."""


class AxisAngle(NamedTuple):
    """One angular error of an axis relative to the preceding axis."""

    name: str
    """The two joints; with u or v where the axes are parallel."""
    joint: int
    """Index of the joint whose axis turns."""
    direction: np.ndarray
    """Unit vector about which it turns, in the joint's frame, shape (3,)."""


@lru_cache(maxsize=64)
def axis_angles(joints: tuple[Joint, ...]) -> tuple[AxisAngle, ...]:
    """
    Return the angles between each turning axis and the one before it.

    Two axes enclose one angle, about their common perpendicular; the other direction in which the second may stand wrong is the zero
    of the first joint. Parallel axes have no such perpendicular: there are two angles, about `axis_error_directions`, and the zeros
    of their joints are one (Hayati and Mirmirani 1985).
    """
    found, before, name = [], None, ''
    for index, joint in enumerate(joints):
        # The axis of the turning joint before, brought along from frame to frame with all joints at zero.
        before = None if before is None else joint.mat_before.T @ before
        if not joint.turns:
            continue
        axis = np.array(joint.axis)
        if before is not None:
            found += _between(f'{name}_{joint.name}', index, before, axis)
        before, name = axis, joint.name
    return tuple(found)


def _between(name, index, before, axis):
    normal = np.cross(before, axis)
    sine = np.linalg.norm(normal)
    if sine > PARALLEL:
        return [AxisAngle(name, index, normal / sine)]
    return [AxisAngle(f'{name}_{letter}', index, direction) for letter, direction in zip('uv', axis_error_directions(axis), strict=True)]


def axis_error_directions(axis: np.ndarray) -> np.ndarray:
    """
    Return two unit vectors u, v that form a right-handed triad u, v, axis; shape (2, 3).

    u is the coordinate axis that lies farthest from `axis` (the first of equals), made orthogonal to it; v = axis x u.
    """
    axis = np.asarray(axis, float)
    start = np.eye(3)[np.argmin(np.round(np.abs(axis), 6))]
    first = start - axis * (axis @ start)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])


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
