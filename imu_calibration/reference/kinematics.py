"""Exact kinematics of a chain of revolute joints."""

from functools import lru_cache

import numpy as np

from imu_calibration.reference.earth import earth_rate_n
from imu_calibration.reference.reference_motion import Reference, skew

_BLOCK = 8192  # samples whose intermediates fit in the processor's cache


def rotation(vector):
    """Return ``exp(vector x)``, shape (3, 3): the turn by a rotation vector, rad (Rodrigues)."""
    vector = np.asarray(vector, float)
    cross = skew(vector)
    angle = np.linalg.norm(vector)
    # numpy's sinc is sin(pi x) / (pi x); it has no trouble at zero.
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (cross @ cross)


def align(direction):
    """Return the smallest rotation that takes the unit vector `direction` to z, shape (3, 3); half a turn about x from -z."""
    x, y, z = direction
    across = x * x + y * y
    if z < 0 and across < 1e-24:
        return np.diag([1.0, -1.0, -1.0])
    cross = skew([y, -x, 0.0])
    # 1 + z cancels when z is near -1.
    return np.eye(3) + cross + cross @ cross / (1 + z if z > 0 else across / (1 - z))


def reference_motion(table, motion, temperature_c=None):
    """
    Return what a perfect sensor at the reference point of the mount feels.

    From link to link, with C the inverse of the joint's turn, a its axis and r the step to its origin::

        force' = C (force + alpha x r + omega x (omega x r)),   omega' = C omega + a q',
        alpha' = C alpha + a q'' + (C omega) x a q'

    starting at the base with gravity (upwards) and, when latitude and azimuth are known, the Earth's rate.

    Parameters
    ----------
    table : Table
        The chain.
    motion : JointMotion
        Joints at the instants wanted, columns in the table's order.
    temperature_c : array, shape (n,), optional
        Passed on.

    Returns
    -------
    Reference

    """
    n_samples = len(motion.time)
    mat_sn, force_s = np.empty((n_samples, 3, 3)), np.empty((n_samples, 3))
    rate_s, alpha_s = np.empty((n_samples, 3)), np.empty((n_samples, 3))
    base, mat_sl, gravity = _constants(table)
    steps = _chain_steps(table, motion, mat_sl)
    for start in range(0, n_samples, _BLOCK):
        part = slice(start, min(start + _BLOCK, n_samples))
        columns = _run_chain(base, motion, steps, part)
        mat_sn[part] = columns[:, :3].transpose(2, 0, 1)
        rate_s[part], alpha_s[part], force_s[part] = columns[:, 3].T, columns[:, 4].T, columns[:, 5].T
    return Reference(time=motion.time, mat_sn=mat_sn, force_s=force_s, rate_s=rate_s, alpha_s=alpha_s, gravity=gravity,
                     temperature_c=temperature_c, motion=motion)


def _chain_steps(table, motion, mat_sl):
    """Return what happens to vectors on the way out: (constant matrix, offset before it, moving joint or None, plane)."""
    steps, fixed = [], np.eye(3)
    offset = np.zeros(3)
    for column, joint in enumerate(table.joints):
        axis, offset = np.array(joint.axis), offset + fixed.T @ np.array(joint.xyz)
        if not _moves(motion, column):
            angle = motion.position[0, column] if len(motion.time) else 0.0
            fixed = rotation(-angle * axis) @ fixed
            continue
        before, sense, third = _to_coordinate_axis(axis)
        steps.append((before @ fixed, offset, column, sense, third))
        fixed, offset = before.T, np.zeros(3)
    if table.mount_xyz is not None:
        offset = offset + fixed.T @ np.array(table.mount_xyz)
    steps.append((mat_sl @ fixed, offset, None, 1.0, 2))
    return steps


def _moves(motion, column):
    position = motion.position[:, column]
    still = len(position) == 0 or (np.all(position == position[0]) and not motion.rate[:, column].any()
                                   and not motion.acceleration[:, column].any())
    return not still


def _to_coordinate_axis(axis):
    """Return (matrix, sense, index) with ``matrix @ axis = sense * e_index``; the identity where the axis is one already."""
    third = int(np.argmax(np.abs(axis)))
    if np.abs(axis[third]) == 1.0:
        return np.eye(3), float(np.sign(axis[third])), third
    return align(axis), 1.0, 2


@lru_cache(maxsize=64)
def _constants(table):
    """Return `_base_columns`, the mount's matrix and gravity: thousands of short windows share one table."""
    constants = _base_columns(table), table.mat_sl
    for array in constants:
        array.flags.writeable = False
    return *constants, table.gravity_value


def _base_columns(table):
    """Return mat_bn (three columns), rate, angular acceleration and specific force of the base, in the base frame, shape (3, 6, 1)."""
    columns = np.zeros((3, 6, 1))
    mat_bn = table.mat_nb.T
    columns[:, :3, 0] = mat_bn
    if table.latitude is not None and table.azimuth_deg is not None:
        columns[:, 3, 0] = mat_bn @ earth_rate_n(table.latitude, table.azimuth_n_deg)
    columns[:, 5, 0] = table.gravity_value * mat_bn[:, 2]
    return columns


def _run_chain(columns, motion, steps, part):
    """Return the columns of `_base_columns` at the sensor, in its frame, shape (3, 6, n)."""
    for matrix, offset, column, sense, third in steps:
        if offset.any():
            columns = columns.copy()
            columns[:, 5] += _arm_force(columns[:, 3], columns[:, 4], offset)
        if not np.array_equal(matrix, np.eye(3)):
            columns = np.tensordot(matrix, columns, 1)
        if column is not None:
            values = (motion.position, motion.rate, motion.acceleration)
            columns = _turn(columns, third, *(sense * value[part, column] for value in values))
    return np.broadcast_to(columns, (3, 6, part.stop - part.start))


def _arm_force(rate, alpha, arm):
    """Return ``alpha x arm + rate x (rate x arm)``, all (3, n) but `arm` (3,)."""
    along = np.tensordot(arm, rate, 1)
    squared = (rate * rate).sum(axis=0)
    return skew(-arm) @ alpha + rate * along - arm[:, None] * squared


def _turn(columns, third, angle, rate, acceleration):
    """Bring `columns` into the link that turns about coordinate axis `third` and add the joint's own motion."""
    first, second = (third + 1) % 3, (third + 2) % 3
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.empty(columns.shape[:2] + (len(angle),))
    turned[first] = cos * columns[first]
    turned[first] += sin * columns[second]
    turned[second] = cos * columns[second]
    turned[second] -= sin * columns[first]
    turned[third] = columns[third]
    turned[first, 4] += turned[second, 3] * rate
    turned[second, 4] -= turned[first, 3] * rate
    turned[third, 3] += rate
    turned[third, 4] += acceleration
    return turned
