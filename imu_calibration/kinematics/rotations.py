"""
Readings of a perfect sensor, rotation matrices, gravity and the Earth's rate.

The rotation matrices are from vectors and angles. The gravity is normal gravity.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import AlignedArrays


@dataclass(frozen=True, eq=False)
class Reference(AlignedArrays):
    """Motion of the mount's reference point at the IMU's stamps."""

    time: np.ndarray
    """Seconds since the session's first sample, shape (n,)."""
    mat_sn: np.ndarray
    """Attitude, level frame to sensor frame, shape (n, 3, 3)."""
    force_s: np.ndarray
    """Specific force at the reference point, m/s^2, shape (n, 3)."""
    rate_s: np.ndarray
    """
    Angular rate against inertial space, rad/s, shape (n, 3); without Earth rate when latitude or
    azimuth is unknown.
    """
    alpha_s: np.ndarray
    """Angular acceleration, rad/s^2, shape (n, 3)."""
    gravity: float
    """Local gravity, m/s^2."""
    temperature_c: np.ndarray | None = None
    """Temperature at the samples, degrees Celsius, shape (n,)."""
    branch: np.ndarray | None = None
    """Thermal branch at the samples (`kinematics.signal_history`), shape (n,); None: unknown."""
    shaking: np.ndarray | None = None
    """
    Variance of vibration at the samples (`kinematics.signal_history`), (m/s^2)^2, shape (n, 3);
    None: unknown.
    """
    motion: Any = None
    """The joints' motion (`JointMotion`), when there is a table."""
    warming: np.ndarray | None = None
    """Slope of the temperature at the samples, K/s, shape (n,); None: unknown."""

    @property
    def thermal_branch(self) -> np.ndarray:
        """Thermal branch in [-1, 1], shape (n,); zero, between the branches, if unknown."""
        return np.zeros(len(self)) if self.branch is None else self.branch

    @property
    def vibration(self) -> np.ndarray:
        """Variance of vibration, (m/s^2)^2, shape (n, 3); zero if unknown."""
        return np.zeros((len(self), 3)) if self.shaking is None else self.shaking

    @property
    def temperature_rate(self) -> np.ndarray:
        """Slope of the temperature, K/s, shape (n,); zero if unknown."""
        return np.zeros(len(self)) if self.warming is None else self.warming

    @property
    def joint_angle(self) -> np.ndarray:
        """Angles of the joints from the base outwards, rad, shape (n, n_joints)."""
        return self._joints.position

    @property
    def joint_rate(self) -> np.ndarray:
        """Rates of the joints, rad/s, shape (n, n_joints)."""
        return self._joints.rate

    @property
    def _joints(self) -> Any:
        """The `JointMotion` of the joints; raises an InputError without one."""
        if self.motion is None:
            raise InputError(
                'an effect that depends on joints needs a table or an arm, there is none; omit the'
                ' effect'
            )
        return self.motion


def skew(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the cross-product matrices of vectors, shape (..., 3) to (..., 3, 3)."""
    vector = np.asarray(vector, float)
    matrix = np.zeros(vector.shape + (3,))
    matrix[..., 0, 1], matrix[..., 0, 2] = -vector[..., 2], vector[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = vector[..., 2], -vector[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -vector[..., 1], vector[..., 0]
    return matrix


def unit_rows(vectors: np.ndarray) -> np.ndarray:
    """Return the directions of vectors, shape (n, 3); zero for a vector of length zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """
    Return the rotation closest to a matrix, shape (3, 3).

    For pairs of vectors as rows, that of ``vectors_a.T @ vectors_b`` is the mat_ab of least squares
    with ``vector_a = mat_ab @ vector_b`` (Kabsch).
    """
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def cross(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """
    Return the cross products of vectors along the last axis but one.

    Shapes (..., 3, n) and (3, n) or (3, 1).
    """
    a = left[..., 0, :]
    b = left[..., 1, :]
    c = left[..., 2, :]
    x, y, z = right
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-2)


def lever_matrix(rate_s: np.ndarray, alpha_s: np.ndarray) -> np.ndarray:
    """
    Return W with ``f_point = f_ref + W @ r``: ``W = [alpha x] + [omega x]^2``, shape (n, 3, 3).

    Zhang 2017, eq. 11, with the dot on the tangential term that the print lost.
    """
    across = skew(rate_s)
    return skew(alpha_s) + across @ across


def quaternions_from_vectors(vectors: np.ndarray) -> np.ndarray:
    """
    Return the unit quaternions (x, y, z, w) of rotation vectors, rad, shape (..., 3) to (..., 4).

    ``(v sin(a / 2) / a, cos(a / 2))`` with the angle ``a = |v|``. SciPy has the same function, but
    its import needs more time than a short recording.
    """
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    # np.sinc(x) is sin(pi x) / (pi x), and 1 at zero.
    return np.concatenate(
        [0.5 * np.sinc(0.5 * angle / np.pi) * vectors, np.cos(0.5 * angle)], axis=-1
    )


def rotations_from_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """
    Return the rotation matrices of quaternions (x, y, z, w), shape (..., 4) to (..., 3, 3).

    ``1 + 2 w [u x] + 2 [u x]^2`` with the vector part u; the length of a quaternion is made 1.
    """
    unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    across = skew(unit[..., :3])
    return np.eye(3) + 2.0 * unit[..., 3, None, None] * across + 2.0 * across @ across


def rotation(vector: np.ndarray) -> np.ndarray:
    """Return ``exp(vector x)``, shape (..., 3, 3): turns by rotation vectors, rad."""
    return rotations_from_quaternions(quaternions_from_vectors(np.asarray(vector, float)))


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Return the vector of a rotation by less than half a turn, rad, shape (3,)."""
    # The antisymmetric part is sin(angle) times the axis, the trace 1 + 2 cos(angle).
    across = 0.5 * (matrix - matrix.T)
    sine = np.array([across[2, 1], across[0, 2], across[1, 0]])
    size = np.linalg.norm(sine)
    angle = np.arctan2(size, 0.5 * (np.trace(matrix) - 1.0))
    return sine * (angle / max(size, 1e-300))


def rotation_from_rpy(rpy: np.ndarray) -> np.ndarray:
    """
    Return ``Rz(yaw) Ry(pitch) Rx(roll)``, shape (3, 3): turns about fixed axes as in URDF, rad.
    """
    roll, pitch, yaw = np.diag(np.asarray(rpy, float))
    return rotation(yaw) @ rotation(pitch) @ rotation(roll)


def rpy_from_rotation(matrix: np.ndarray) -> np.ndarray:
    """
    Return roll, pitch and yaw of a rotation matrix, rad, shape (3,).

    ``rotation_from_rpy`` gives the matrix back to rounding.

    At a pitch of a quarter turn only one combination of roll and yaw is defined. Yaw is therefore
    that of the remainder ``matrix Rx(roll)' = Rz(yaw) Ry(pitch)``, whose second column is
    ``(-sin yaw, cos yaw, 0)`` (Shoemake): errors of roll and yaw cancel there.
    """
    roll = np.arctan2(matrix[2, 1], matrix[2, 2])
    pitch = np.arctan2(-matrix[2, 0], np.hypot(matrix[2, 1], matrix[2, 2]))
    sin = np.sin(roll)
    cos = np.cos(roll)
    sin_yaw = sin * matrix[0, 2] - cos * matrix[0, 1]
    cos_yaw = cos * matrix[1, 1] - sin * matrix[1, 2]
    yaw = np.arctan2(sin_yaw, cos_yaw)
    return np.array([roll, pitch, yaw])


def align(direction: np.ndarray) -> np.ndarray:
    """
    Return the smallest rotation from the unit vector `direction` to z, shape (3, 3).

    Half a turn about x from -z.
    """
    x, y, z = direction
    across = x * x + y * y
    if z < 0 and across < 1e-24:
        return np.diag([1.0, -1.0, -1.0])
    turn = skew([y, -x, 0.0])
    # The same number, as 1 + z cancels when z is near -1.
    one_plus_z = 1 + z if z > 0 else across / (1 - z)
    return np.eye(3) + turn + turn @ turn / one_plus_z


EARTH_RATE = 7.292115e-5
"""Rate of the Earth against inertial space, rad/s (WGS 84)."""

NORMAL_GRAVITY_ACCURACY = 1e-4
"""
Relative standard deviation of the normal gravity of a place: gravity anomalies and an inexact
height.
"""

_SEMI_MAJOR_AXIS = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)
_GRAVITY_EQUATOR = 9.7803253359
_SOMIGLIANA = 0.00193185265241
_ROTATION_RATIO = 0.00344978650684  # m = omega^2 a^2 b / GM


def attitudes_with_vertical(up_s: np.ndarray) -> np.ndarray:
    """
    Return attitudes mat_sn with a given vertical as third column, shape (n, 3, 3).

    The heading is arbitrary. `up_s`: unit vectors in the sensor frame, shape (n, 3).
    """
    other = np.eye(3)[np.argmin(np.abs(up_s), axis=1)]
    first = np.cross(other, up_s)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(up_s, first), up_s], axis=2)


def normal_gravity(latitude_deg: float, height: float = 0.0) -> float:
    """
    Return the normal gravity of the WGS 84 ellipsoid, m/s^2.

    Somigliana's closed form on the ellipsoid, ``g_e (1 + k sin^2) / sqrt(1 - e^2 sin^2)``, with the
    height correction of second order (NIMA TR8350.2, eq. 4-1 and 4-3). The local anomaly, up to
    5e-4 m/s^2 in mountains, is not in it.

    Parameters
    ----------
    latitude_deg : float or array
        Geodetic latitude, degrees.
    height : float or array
        Height above the ellipsoid, m.

    """
    sin2 = np.sin(np.radians(latitude_deg)) ** 2
    surface = (
        _GRAVITY_EQUATOR * (1 + _SOMIGLIANA * sin2) / np.sqrt(1 - _ECCENTRICITY_SQUARED * sin2)
    )
    ratio = np.asarray(height, float) / _SEMI_MAJOR_AXIS
    value = surface * (
        1 - 2 * (1 + _FLATTENING + _ROTATION_RATIO - 2 * _FLATTENING * sin2) * ratio + 3 * ratio**2
    )
    return value if np.ndim(value) else float(value)


def local_gravity(
    gravity: float | None, latitude_deg: float | None = None, height: float | None = None
) -> tuple[float | None, float]:
    """
    Return (gravity, its standard deviation), m/s^2, as given or of a place.

    The normal gravity of the place; (None, 0.0) without gravity and latitude.

    Parameters
    ----------
    gravity : float or None
        Measured gravity, m/s^2, with a standard deviation of zero.
    latitude_deg : float or None
        Geodetic latitude, degrees.
    height : float or None
        Height above the ellipsoid, m; 0 if not given.

    Raises
    ------
    InputError
        If gravity and latitude are both given, a height has no latitude, or the place is not on the
        Earth.

    """
    if latitude_deg is None:
        if height is not None:
            raise InputError(
                f'height must come with a latitude, got height {height:g} m alone; give both, or'
                ' gravity in m/s^2',
                key='latitude',
                code='latitude_missing',
            )
        return gravity, 0.0
    if gravity is not None:
        raise InputError(
            f'the place or gravity must be given, got latitude {latitude_deg:g} deg and gravity'
            f' {gravity:g} m/s^2; omit one',
            key='latitude',
            code='gravity_twice',
        )
    if not (abs(latitude_deg) <= 90 and -500 <= (height or 0.0) <= 9000):
        raise InputError(
            'the place must have a latitude of -90 to 90 deg and a height of -500 to 9000 m, got'
            f' {latitude_deg:g} deg and {height or 0.0:g} m; correct them',
            key='latitude',
            code='place_impossible',
        )
    value = normal_gravity(latitude_deg, height or 0.0)
    return value, NORMAL_GRAVITY_ACCURACY * value


def gravity_of_settings(gravity: float, latitude_deg: float, height: float) -> tuple[float, float]:
    """
    Return (gravity, its standard deviation), m/s^2, of parameters of a node; (0.0, 0.0) without.

    Parameters
    ----------
    gravity : float
        m/s^2; 0: unknown.
    latitude_deg : float
        Used if the gravity is unknown; above 90: unknown.
    height : float
        Above the ellipsoid, m, used with the latitude.

    """
    # A known gravity excludes the place, as `local_gravity` refuses both together.
    place = () if gravity or latitude_deg > 90 else (latitude_deg, height)
    value, sd = local_gravity(gravity or None, *place)
    return value or 0.0, sd


def earth_rate_n(latitude_deg: float, azimuth_deg: float) -> np.ndarray:
    """
    Return the Earth's rate in the level frame n, rad/s, shape (3,).

    North lies `azimuth_deg` counter-clockwise of x: ``omega_e (cos(lat) cos(az), cos(lat) sin(az),
    sin(lat))``.

    Parameters
    ----------
    latitude_deg : float
        Geodetic latitude, degrees.
    azimuth_deg : float
        Heading of the x axis of n, degrees clockwise from true north.

    """
    latitude = np.radians(latitude_deg)
    azimuth = np.radians(azimuth_deg)
    return EARTH_RATE * np.array(
        [np.cos(latitude) * np.cos(azimuth), np.cos(latitude) * np.sin(azimuth), np.sin(latitude)]
    )
