"""
Exact kinematics of a serial chain of joints that turn or slide, also with errors.

Tilt, wrong axes, sag with load, wobble.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from imu_calibration.kinematics.rotations import Reference, align, cross, rotation
from imu_calibration.kinematics.table import (
    Table,
    axis_angles,
    axis_error_directions,
    base_heading_deg,
)

if TYPE_CHECKING:
    from imu_calibration.kinematics.joint import Joint
    from imu_calibration.kinematics.joint_motion import JointMotion


def with_axis_places(table: Table, errors: np.ndarray) -> Table:
    """
    Return the table with its turning axes, except the first, shifted perpendicular to the axis.

    Parameters
    ----------
    table : Table
        The nominal table.
    errors : array, shape (2 (n_turning - 1),)
        For each of these axes its displacement along its `axis_error_directions`, m; the following
        chain moves with it.

    """
    displacements = iter(np.reshape(errors, (-1, 2)))
    joints = []
    is_first_turning = True
    for joint in table.joints:
        if joint.turns and not is_first_turning:
            # In the frame of the joint, then in the frame of the link before.
            shift = next(displacements) @ axis_error_directions(np.array(joint.axis))
            xyz = np.array(joint.xyz) + joint.mat_before @ shift
            joint = replace(joint, xyz=tuple(xyz.tolist()))
        if joint.turns:
            is_first_turning = False
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
    joints = []
    for joint, vector in zip(table.joints, vectors, strict=True):
        if vector.any():
            axis = rotation(vector) @ np.array(joint.axis)
            joint = replace(joint, axis=tuple(axis.tolist()))
        joints.append(joint)
    return replace(table, joints=tuple(joints))


def tilt(table: Table, angles: np.ndarray) -> Table:
    """
    Return the table with a levelling error of its base.

    The level frame n, with up and north, is rotated relative to the base b by (tx, ty, 0) rad::

        mat_bn_tilted = mat_bn exp((tx, ty, 0) x),   up_b = mat_bn_tilted e_z

    The direction of north in b is rotated with it.
    """
    mat_bn = table.mat_nb.T @ rotation(np.array([angles[0], angles[1], 0.0]))
    tilted = replace(table, up=tuple(mat_bn[:, 2].tolist()))
    if table.azimuth_deg is None:
        return tilted

    # The level frame of a table is that with the shortest rotation to `up`, which may have another
    # heading than that of mat_bn: north is expressed in the frame of the tilted table.
    azimuth = np.radians(table.azimuth_n_deg)  # type: ignore[arg-type]
    mat_nn = tilted.mat_nb @ mat_bn
    north_n = mat_nn @ np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    azimuth_n_deg = np.degrees(np.arctan2(north_n[1], north_n[0]))
    azimuth_deg = (azimuth_n_deg - base_heading_deg(tilted.mat_nb)) % 360.0
    return replace(tilted, azimuth_deg=float(azimuth_deg))


WOBBLES = (-1, 2)
"""
Turns of the lean for one turn of the joint: once in the opposite direction, twice in the same one.

A lean that rotates once with the joint is equal to an error of the next axis or the mount, and a
constant one to an error of this axis.
"""


def with_sag(table: Table, angles: np.ndarray) -> Table:
    """
    Return the table with a sag of its turning axes, except the first, towards the ground.

    The links after a joint rotate by the rotation vector ``angle (up x axis)``: by the full angle
    if the axis is level.

    Parameters
    ----------
    table : Table
    angles : array, shape (n_turning - 1,)
        One for each turning joint that is read, except the first, rad.

    """
    sag_of_joint = dict(zip(table.joint_names.turning[1:], angles, strict=True))
    joints = []
    for joint in table.joints:
        if joint.turns and sag_of_joint.get(joint.source):
            joint = replace(joint, sag=sag_of_joint[joint.source])
        joints.append(joint)
    return replace(table, joints=tuple(joints))


def with_wobble(table: Table, amplitudes: np.ndarray) -> Table:
    """
    Return the table with axes that wobble as they turn.

    The links after a joint rotate by the rotation vector ``Re(z) u + Im(z) v`` with u, v its
    `axis_error_directions` and ``z = sum over m of (c + i s) exp(i m q)`` at the joint angle q.

    Parameters
    ----------
    table : Table
    amplitudes : array, shape (n_turning n_wobbles 2,)
        c and s for each of `WOBBLES` of each turning joint that is read, rad.

    """
    parts = np.reshape(amplitudes, (len(table.joint_names.turning), len(WOBBLES), 2))
    wobble_of_joint = {}
    for name, amplitudes_of_joint in zip(table.joint_names.turning, parts, strict=True):
        wobble = []
        for order, (cosine, sine) in zip(WOBBLES, amplitudes_of_joint, strict=True):
            if cosine or sine:
                wobble.append((order, complex(cosine, sine)))
        wobble_of_joint[name] = tuple(wobble)
    joints = []
    for joint in table.joints:
        if joint.turns:
            joint = replace(joint, wobble=wobble_of_joint[joint.source])
        joints.append(joint)
    return replace(table, joints=tuple(joints))


def wobble_at(
    wobble: tuple[tuple[int, complex], ...],
    angle: np.ndarray,
    rate: np.ndarray,
    *,
    acceleration: np.ndarray,
) -> np.ndarray:
    """
    Return z of `with_wobble` and its first two derivatives in time, complex, shape (3, n).

    For each term ``z = A exp(i m q)``::

        z' = i m q' z,   z'' = (i m q'' - (m q')^2) z

    """
    total = np.zeros((3, len(angle)), complex)
    for order, amplitude in wobble:
        z = amplitude * np.exp(1j * order * angle)
        first_derivative = 1j * order * rate * z
        second_derivative = (1j * order * acceleration - (order * rate) ** 2) * z
        total += np.stack([z, first_derivative, second_derivative])
    return total


_IDENTITY = np.eye(3)
_CHAIN_BLOCK_SAMPLES = 1024
"""Samples per block, so that intermediate arrays fit in the processor's cache."""
UP, RATE, ALPHA, FORCE = -4, -3, -2, -1
"""Columns of the recursion (`_base_columns`): direction up, rate, angular acceleration, force."""


class _Link(NamedTuple):
    """A joint with its constants as arrays."""

    joint: Joint
    """The joint."""
    axis: np.ndarray
    """Unit vector in the joint's frame, shape (3,)."""
    xyz: np.ndarray
    """Origin of the joint's frame in the frame of the link before, m, shape (3,)."""
    mat_in: np.ndarray
    """From the frame of the link before to the joint's frame, shape (3, 3)."""
    column: int
    """Column of the readings in the motion."""
    to_coordinate_axis: np.ndarray
    """
    From the joint's frame to one in which a turn is about a coordinate axis, shape (3, 3); the
    identity if the joint slides.
    """
    sense: float
    """+1 or -1: the joint turns about ``sense`` times the coordinate axis `third`."""
    third: int
    """Index of the coordinate axis that the joint turns about."""
    across: np.ndarray
    """`axis_error_directions` in the frame of the coordinate axis, shape (2, 3)."""


class _Displacement(NamedTuple):
    """A constant offset, then a constant rotation, of the frame in which vectors are expressed."""

    offset: np.ndarray
    """In the frame before the rotation, m, shape (3,)."""
    matrix: np.ndarray
    """Turns vectors from the frame before into that after it, shape (3, 3)."""


class _Step(NamedTuple):
    """One step of the outward transformation: a constant displacement, then a moving joint."""

    before: _Displacement
    """From the joint before to this one."""
    link: _Link
    """The joint, which turns about a coordinate axis after the displacement."""


class _Path(NamedTuple):
    """The transformation from the base to the sensor."""

    steps: list[_Step]
    """One for each moving joint."""
    to_sensor: _Displacement
    """From the last moving joint to the sensor."""


def reference_motion(
    table: Table,
    motion: JointMotion,
    temperature_c: np.ndarray | None = None,
    *,
    attitude: bool = True,
) -> Reference:
    """
    Return the readings of an ideal sensor at the reference point of the mount.

    From link to link, with C the inverse of the joint's turn, a its axis, r the step to its origin
    and q its angle::

        force' = C (force + alpha x r + omega x (omega x r)),   omega' = C omega + a q',
        alpha' = C alpha + a q'' + (C omega) x a q'

    and for a joint that has slid by q, after the step r::

        force' = force + alpha x a q + omega x (omega x a q) + 2 omega x a q' + a q''

    starting at the base with gravity (upwards) and, when latitude and azimuth are known, the
    Earth's rate.

    Parameters
    ----------
    table : Table
        The chain.
    motion : JointMotion
        Joints at the instants wanted, columns in the order of ``table.joint_names``.
    temperature_c : array, shape (n,), optional
        Temperature of the result, degrees Celsius.
    attitude : bool
        Whether the attitude is computed, a third of the time; without it `mat_sn` is NaN.

    Returns
    -------
    Reference

    """
    n_samples = len(motion.time)
    mat_sn = np.empty((n_samples, 3, 3)) if attitude else np.broadcast_to(np.nan, (n_samples, 3, 3))
    force_s = np.empty((n_samples, 3))
    rate_s = np.empty((n_samples, 3))
    alpha_s = np.empty((n_samples, 3))
    constants = _constants(table)
    path = _path_to_sensor(constants, motion)
    # Rate, angular acceleration and force are the last columns. Up, which a sag needs, is before
    # them: the last column of the attitude.
    has_sag = any(link.joint.sag for link in constants.links)
    n_columns = 6 if attitude else 3 + has_sag
    base = constants.base[:, -n_columns:]
    for start in range(0, n_samples, _CHAIN_BLOCK_SAMPLES):
        part = slice(start, min(start + _CHAIN_BLOCK_SAMPLES, n_samples))
        columns = _run_chain(base, motion, path, part)
        if attitude:
            mat_sn[part] = columns[:, :3].transpose(2, 0, 1)
        rate_s[part] = columns[:, RATE].T
        alpha_s[part] = columns[:, ALPHA].T
        force_s[part] = columns[:, FORCE].T
    return Reference(
        time=motion.time,
        mat_sn=mat_sn,
        force_s=force_s,
        rate_s=rate_s,
        alpha_s=alpha_s,
        gravity=constants.gravity,
        temperature_c=temperature_c,
        branch=motion.thermal_branch,
        shaking=motion.vibration,
        motion=motion,
        warming=motion.temperature_rate,
    )


def _path_to_sensor(constants: _Constants, motion: JointMotion) -> _Path:
    """
    Return the steps from the base to the sensor, one for each moving joint.

    A joint at rest is part of the displacement to the next moving joint, or to the sensor.
    """
    steps = []
    # Constant displacement since the last moving joint: rotation, and offset in the frame before
    # that rotation.
    matrix = np.eye(3)
    offset = np.zeros(3)
    moves = _moving_columns(motion)
    for link in constants.links:
        offset = offset + matrix.T @ link.xyz
        matrix = link.mat_in @ matrix

        # A joint at rest is a constant rotation or offset.
        if not link.joint.leans and not moves[link.column]:
            position = link.joint.offset
            if len(motion.time):
                position += link.joint.multiplier * motion.position[0, link.column]
            if link.joint.turns:
                matrix = _turn_at_rest(link.joint.axis, float(position)) @ matrix
            else:
                offset = offset + matrix.T @ (position * link.axis)
            continue

        # Turns are computed about a coordinate axis; the next step begins with the inverse of the
        # rotation to it.
        steps.append(_Step(_Displacement(offset, link.to_coordinate_axis @ matrix), link))
        matrix = link.to_coordinate_axis.T
        offset = np.zeros(3)

    offset = offset + matrix.T @ constants.mount_xyz
    return _Path(steps, _Displacement(offset, constants.mat_sl @ matrix))


def _moving_columns(motion: JointMotion) -> np.ndarray:
    """Return which joints change their position or have a rate, shape (n_joints,)."""
    changes = np.any(motion.position != motion.position[:1], axis=0)
    return changes | motion.rate.any(axis=0) | motion.acceleration.any(axis=0)


@lru_cache(maxsize=512)
def _turn_at_rest(axis: tuple[float, float, float], position: float) -> np.ndarray:
    """
    Return the rotation to the frame of the link after a joint at rest, shape (3, 3).

    The joints at rest in a window have one position for all differences of the kinematics.
    """
    matrix = rotation(-position * np.array(axis))
    matrix.flags.writeable = False
    return matrix


def _to_coordinate_axis(axis: np.ndarray) -> tuple[np.ndarray, float, int]:
    """
    Return (rotation, sense, index) with ``rotation @ axis = sense * e_index``.

    The rotation is the identity if the axis is a coordinate axis, otherwise that to z.
    """
    third = int(np.argmax(np.abs(axis)))
    if np.abs(axis[third]) == 1.0:
        return np.eye(3), float(np.sign(axis[third])), third
    return align(axis), 1.0, 2


class _Constants(NamedTuple):
    """Constants of a table for the recursion."""

    base: np.ndarray
    """`_base_columns`."""
    links: tuple[_Link, ...]
    """From the base outwards."""
    mount_xyz: np.ndarray
    """Reference point in the frame of the last link, m, shape (3,)."""
    mat_sl: np.ndarray
    """Frame of the last link to sensor frame, shape (3, 3)."""
    gravity: float
    """m/s^2."""


@lru_cache(maxsize=512)
def _constants(table: Table) -> _Constants:
    """Return the constants of a table; they are cached for thousands of short windows."""
    columns = {name: column for column, name in enumerate(table.joint_names)}
    links = []
    for joint in table.joints:
        axis = np.array(joint.axis)
        to_coordinate_axis, sense, third = np.eye(3), 1.0, 2
        if joint.turns:
            to_coordinate_axis, sense, third = _to_coordinate_axis(axis)
        links.append(
            _Link(
                joint,
                axis=axis,
                xyz=np.array(joint.xyz),
                mat_in=joint.mat_before.T,
                column=columns[joint.source],
                to_coordinate_axis=to_coordinate_axis,
                sense=sense,
                third=third,
                across=axis_error_directions(axis) @ to_coordinate_axis.T,
            )
        )
    mount_xyz = np.zeros(3) if table.mount_xyz is None else np.array(table.mount_xyz)
    constants = _Constants(
        base=_base_columns(table),
        links=tuple(links),
        mount_xyz=mount_xyz,
        mat_sl=table.mat_sl,
        gravity=table.gravity_value,
    )
    # The constants are shared by all motions of the table: no motion may change them.
    shared = [constants.base, constants.mount_xyz, constants.mat_sl]
    for link in links:
        shared += [link.axis, link.xyz, link.mat_in, link.to_coordinate_axis, link.across]
    for array in shared:
        array.flags.writeable = False
    return constants


def _base_columns(table: Table) -> np.ndarray:
    """
    Return attitude and motion of the base in the base frame, shape (3, 6, 1).

    Its columns are the three of mat_bn, rate, angular acceleration and specific force.
    """
    columns = np.zeros((3, 6, 1))
    mat_bn = table.mat_nb.T
    columns[:, :3, 0] = mat_bn
    earth_rate = table.earth_rate_n
    if earth_rate is not None:
        columns[:, 3, 0] = mat_bn @ earth_rate
    columns[:, 5, 0] = table.gravity_value * mat_bn[:, 2]
    return columns


def _run_chain(columns: np.ndarray, motion: JointMotion, path: _Path, part: slice) -> np.ndarray:
    """
    Return the k columns of `_base_columns` at the sensor, in its frame, shape (3, k, n).

    `columns`: all of the base or the last ones, shape (3, k, 1); `part`: the n samples.
    """
    for step in path.steps:
        columns = _displace(columns, step.before)
        columns = _move(columns, step, motion, part)
    columns = _displace(columns, path.to_sensor)
    return np.broadcast_to(columns, (*columns.shape[:2], part.stop - part.start))


def _displace(columns: np.ndarray, displacement: _Displacement) -> np.ndarray:
    """
    Return `columns` after a constant displacement.

    ``force += alpha x r + omega x (omega x r)`` with the offset r, then the rotation.
    """
    if displacement.offset.any():
        columns = columns.copy()
        arm = displacement.offset[:, None]
        columns[:, FORCE] += _arm_force(columns[:, RATE], columns[:, ALPHA], arm)
    if np.any(displacement.matrix != _IDENTITY):
        # As tensordot, without its preparation, which takes longer than a short window.
        columns = np.dot(displacement.matrix, columns.reshape(3, -1)).reshape(columns.shape)
    return columns


def _move(columns: np.ndarray, step: _Step, motion: JointMotion, part: slice) -> np.ndarray:
    """Return `columns` in the frame of the link after a moving joint, with its motion added."""
    # The motion about the coordinate axis of the step is `sense` times that of the joint.
    link = step.link
    factor = link.sense * link.joint.multiplier
    position = factor * motion.position[part, link.column]
    position += link.sense * link.joint.offset
    rate = factor * motion.rate[part, link.column]
    acceleration = factor * motion.acceleration[part, link.column]
    if not link.joint.turns:
        return _slide(columns, link.axis[:, None], position, rate, acceleration)
    if link.joint.leans:
        columns = _lean(
            columns, link, link.sense * position, link.sense * rate, link.sense * acceleration
        )
    return _turn(columns, link.third, position, rate, acceleration)


def _lean(
    columns: np.ndarray,
    link: _Link,
    angle: np.ndarray,
    rate: np.ndarray,
    acceleration: np.ndarray,
) -> np.ndarray:
    """
    Return `columns` in the frame of a joint with an axis that sags and wobbles.

    The lean is the small rotation vector v, across the axis a. With z of `with_wobble` at the
    angle of the joint, the direction up u in the frame of the link, and the link's rate omega::

        v = Re(z) across_1 + Im(z) across_2 + sag (u x a)
        u' = u x omega,   u'' = u' x omega + u x alpha

    The derivatives of u hold because up is fixed in space; the rotation of the Earth is negligible
    relative to the sag.
    """
    joint = link.joint
    lean = np.zeros((3, 3, len(angle)))  # v, v', v''; coordinate; sample
    if joint.wobble:
        z = wobble_at(joint.wobble, angle, rate, acceleration=acceleration)
        about_first = np.einsum('dn,k->dkn', z.real, link.across[0])
        about_second = np.einsum('dn,k->dkn', z.imag, link.across[1])
        lean += about_first + about_second
    if joint.sag:
        up = columns[:, UP]
        omega = columns[:, RATE]
        up_rate = cross(up, omega)
        up_acceleration = cross(up_rate, omega) + cross(up, columns[:, ALPHA])
        sag = np.zeros((3, 1))
        sag[link.third] = link.sense * joint.sag
        lean += np.stack([cross(up, sag), cross(up_rate, sag), cross(up_acceleration, sag)])

    # Two small turns about the coordinate axes across the joint: the components of v, v', v''.
    for across in ((link.third + 1) % 3, (link.third + 2) % 3):
        columns = _turn(columns, across, *lean[:, across])
    return columns


def _arm_force(rate: np.ndarray, alpha: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Return ``alpha x arm + rate x (rate x arm)``, all shape (3, n) or (3, 1)."""
    return cross(alpha, arm) + rate * (rate * arm).sum(axis=0) - arm * (rate * rate).sum(axis=0)


def _slide(
    columns: np.ndarray,
    axis: np.ndarray,
    position: np.ndarray,
    rate: np.ndarray,
    acceleration: np.ndarray,
) -> np.ndarray:
    """
    Return `columns` in the link that slides along `axis`, shape (3, 1).

    The equation is that of `reference_motion`.
    """
    slid = np.array(np.broadcast_to(columns, columns.shape[:2] + (len(position),)))
    omega = slid[:, RATE]
    slid[:, FORCE] += (
        _arm_force(omega, slid[:, ALPHA], axis * position)
        + 2 * rate * cross(omega, axis)
        + axis * acceleration
    )
    return slid


def _turn(
    columns: np.ndarray,
    third: int,
    angle: np.ndarray,
    rate: np.ndarray,
    acceleration: np.ndarray,
) -> np.ndarray:
    """
    Return `columns` in the link of a joint, with the motion of the joint added.

    The link turns about coordinate axis `third`, with the unit vector e. With C of the turn::

        column -> C column,   omega += q' e,   alpha += q'' e + (C omega) x q' e

    """
    first = (third + 1) % 3
    second = (third + 2) % 3
    cos = np.cos(angle)
    sin = np.sin(angle)
    turned = np.empty(columns.shape[:2] + (len(angle),))
    turned[first] = cos * columns[first]
    turned[first] += sin * columns[second]
    turned[second] = cos * columns[second]
    turned[second] -= sin * columns[first]
    turned[third] = columns[third]

    # The cross product before the rate of the joint is added to omega.
    turned[first, ALPHA] += turned[second, RATE] * rate
    turned[second, ALPHA] -= turned[first, RATE] * rate
    turned[third, RATE] += rate
    turned[third, ALPHA] += acceleration
    return turned
