"""Axes that do not keep their direction: they sag with the weight that they carry, and wobble as they turn."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from imu_calibration.reference.table import Table

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
