"""
Rigid-body motion of a turntable, written apart from the package so that the two check each other.

Everything is done in the level frame n, link by link: rate, angular acceleration and the
acceleration of the mount's point.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

EARTH_RATE = 7.292115e-5


@dataclass(frozen=True, eq=False)
class World:
    """Where the mount's reference point goes, in the level frame of the nominal table."""

    time: np.ndarray
    """True time since the start of the session, s, shape (n,)."""
    joints: np.ndarray
    """True joint angles, rad, shape (n, n_joints)."""
    mat_ns: np.ndarray
    """Sensor frame to level frame, shape (n, 3, 3)."""
    rate_n: np.ndarray
    """Rate against inertial space, rad/s, shape (n, 3)."""
    alpha_n: np.ndarray
    """Its derivative seen from inertial space, rad/s^2, shape (n, 3)."""
    force_n: np.ndarray
    """Specific force at the reference point, m/s^2, shape (n, 3)."""
    earth_n: np.ndarray
    """Earth rate, rad/s, shape (3,)."""

    def to_sensor(self, vector_n):
        """Return vectors of the level frame in the sensor frame."""
        return np.einsum('nji,nj->ni', self.mat_ns, vector_n)

    def force_at(self, arm_s):
        """Return the specific force (in s) at a point `arm_s` from the reference point."""
        if not np.any(arm_s):
            return self.to_sensor(self.force_n)
        arm_n = self.mat_ns @ np.asarray(arm_s, float)
        swing = np.cross(self.alpha_n, arm_n) + np.cross(self.rate_n, np.cross(self.rate_n, arm_n))
        return self.to_sensor(self.force_n + swing)


def move_table(
    mapping,
    time,
    motion,
    gravity,
    tilt=(0.0, 0.0),
    axis_errors=None,
    slip=None,
    *,
    sag=None,
    wobble=None,
    beside=None,
):
    """
    Return the `World` of a table description under a joint motion.

    Parameters
    ----------
    mapping : dict
        Table description, as in the table's YAML.
    motion : JointMotion
        True joint motion at `time`.
    gravity : float
        m/s^2.
    tilt : (2,)
        The true vertical is the nominal one turned by the rotation vector (x, y, 0), rad; the
        Earth's axis turns with it.
    axis_errors : (n_joints - 1,)
        How much each axis but the first is turned away from the one before it, rad.
    slip : array (n, 3), optional
        Turn of the sensor in its fixture against the nominal mount, rotation vector in s.
    sag : (n_joints - 1,)
        By how much the end of each axis but the first would hang down if it lay level, rad: a shaft
        that bends with its load.
    wobble : (n_joints, 2, 2)
        Two circles on which the tip of each axis moves, rad: (cosine, sine) of one against the
        turn, and of one at twice the turn.
    beside : (n_joints - 1, 2)
        By how much each axis but the first passes beside the point where it should meet the others,
        m, in the two directions across it.

    """
    axes = _true_axes(mapping, axis_errors)
    mount = mapping.get('mount') or {}
    count = len(time)
    attitude = stand_up(mapping['up'])
    mats = np.broadcast_to(attitude, (count, 3, 3))
    lean = Rotation.from_rotvec([tilt[0], tilt[1], 0.0])
    earth_n = lean.apply(earth_vector(mapping))
    rate, alpha, acceleration = (
        np.tile(earth_n, (count, 1)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )
    for k, joint in enumerate(mapping['joints']):
        if np.any(joint.get('xyz') or 0.0):
            acceleration = acceleration + _swing(
                rate, alpha, mats @ np.asarray(joint['xyz'], float)
            )
        if beside is not None and k:
            acceleration = acceleration + _swing(
                rate, alpha, mats @ (np.asarray(beside[k - 1]) @ _across(axes[k]))
            )
        leans = []
        if sag is not None and k:
            leans.append(sag[k - 1] * np.cross(np.swapaxes(mats, 1, 2) @ [0.0, 0.0, 1.0], axes[k]))
        if wobble is not None:
            leans.append(_circles(wobble[k], motion.position[:, k]) @ _across(axes[k]))
        for lean_b in leans:
            swing_b = np.gradient(lean_b, time, axis=0, edge_order=2)
            swing_n = np.einsum('nij,nj->ni', mats, swing_b)
            alpha = (
                alpha
                + np.einsum('nij,nj->ni', mats, np.gradient(swing_b, time, axis=0, edge_order=2))
                + np.cross(rate, swing_n)
            )
            rate, mats = rate + swing_n, mats @ Rotation.from_rotvec(lean_b).as_matrix()
        axis_n = mats @ axes[k]
        own = motion.rate[:, k, None] * axis_n
        alpha = alpha + motion.acceleration[:, k, None] * axis_n + np.cross(rate, own)
        rate = rate + own
        mats = mats @ Rotation.from_rotvec(motion.position[:, k, None] * axes[k]).as_matrix()
    if np.any(mount.get('xyz') or 0.0):
        acceleration = acceleration + _swing(rate, alpha, mats @ np.asarray(mount['xyz'], float))
    mats = (
        mats
        @ Rotation.from_euler('xyz', mount.get('rpy_deg') or [0, 0, 0], degrees=True).as_matrix()
    )
    if slip is not None:
        mats = mats @ Rotation.from_rotvec(slip).as_matrix()
    force = acceleration + gravity * lean.apply([0.0, 0.0, 1.0])
    return World(time, motion.position, mats, rate, alpha, force, earth_n)


def _across(axis):
    """
    Return two directions across an axis along x, y or z, and right-handed with it, shape (2, 3).

    The first of x, y, z comes first.
    """
    first = np.eye(3)[0 if abs(axis[0]) < 0.5 else 1]
    return np.array([first, np.cross(axis, first)])


def _circles(amplitudes, angle):
    """
    Return where the tip of an axis is across it, shape (n, 2), that runs on two circles.

    Backwards, and forwards at twice the turn.
    """
    (c1, s1), (c2, s2) = amplitudes
    one, two = angle, 2 * angle
    return np.stack(
        [
            c1 * np.cos(one) + s1 * np.sin(one) + c2 * np.cos(two) - s2 * np.sin(two),
            s1 * np.cos(one) - c1 * np.sin(one) + c2 * np.sin(two) + s2 * np.cos(two),
        ],
        axis=1,
    )


def earth_vector(mapping):
    """
    Return the Earth's rate in the level frame (zero when latitude or azimuth is not given).

    North cos(lat) + up sin(lat).
    """
    if mapping.get('latitude') is None or mapping.get('azimuth_deg') is None:
        return np.zeros(3)
    latitude, azimuth = np.radians(mapping['latitude']), np.radians(mapping['azimuth_deg'])
    x, y, _ = stand_up(mapping['up'])[:, 0]
    azimuth = azimuth + np.arctan2(y, x)
    north = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return EARTH_RATE * (np.cos(latitude) * north + np.sin(latitude) * np.array([0.0, 0.0, 1.0]))


def local_gravity(latitude_deg, height):
    """
    Return gravity by the 1980 formula (Moritz 2000) with the free-air reduction.

    Within 2e-6 m/s^2 of WGS 84.
    """
    square = np.sin(np.radians(latitude_deg)) ** 2
    double = np.sin(2 * np.radians(latitude_deg)) ** 2
    surface = 9.780327 * (1 + 0.0053024 * square - 0.0000058 * double)
    return surface - (3.0877e-6 - 4.3e-9 * square) * height + 0.72e-12 * height**2


def _swing(rate, alpha, arm):
    return np.cross(alpha, arm) + np.cross(rate, np.cross(rate, arm))


def stand_up(up):
    """Return the smallest rotation that makes `up` the z axis."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    if np.linalg.norm(axis) < 1e-12:
        return np.eye(3) if up[2] > 0 else Rotation.from_rotvec([np.pi, 0, 0]).as_matrix()
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(up[2])).as_matrix()


def _true_axes(mapping, axis_errors):
    axes = [
        np.asarray(joint['axis'], float) / np.linalg.norm(joint['axis'])
        for joint in mapping['joints']
    ]
    true = list(axes)
    for k in range(1, len(axes)):
        if axis_errors is not None:
            normal = np.cross(axes[k - 1], axes[k])
            true[k] = Rotation.from_rotvec(
                axis_errors[k - 1] * normal / np.linalg.norm(normal)
            ).apply(axes[k])
    return true
