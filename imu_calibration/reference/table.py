"""The turntable: its description, checked, and small errors of it (levelling, axes)."""

from dataclasses import dataclass, fields, replace

import numpy as np

from imu_calibration.errors import InputError
from imu_calibration.reference.earth import normal_gravity
from imu_calibration.reference.encoder import with_encoder_harmonics
from imu_calibration.reference.joint_delay import shifted
from imu_calibration.reference.kinematics import align, reference_motion, rotation

__all__ = ['Joint', 'Table', 'axis_error_directions', 'reference_motion', 'shifted', 'tilt', 'with_axis_errors', 'with_encoder_harmonics']

_MOUNT_KEYS = ('rpy_deg', 'xyz')


@dataclass(frozen=True)
class Joint:
    """One revolute joint."""

    name: str
    """Name in the joint states."""
    axis: tuple
    """Unit vector in the frame of the link before it, at joint zero (made unit here)."""
    xyz: tuple = (0.0, 0.0, 0.0)
    """A point of the axis, from the origin of the link before it, m; the origin of the link that the joint turns."""

    def __post_init__(self):
        object.__setattr__(self, 'axis', _unit(self.axis, f"axis of joint '{self.name}'"))
        object.__setattr__(self, 'xyz', _vector(self.xyz, f"xyz of joint '{self.name}'"))


@dataclass(frozen=True)
class Table:
    """
    A chain of revolute joints that carries the sensor.

    The level frame n is the base frame turned by the smallest rotation that makes `up` its z axis (half a turn about
    the base x axis when the base hangs upside down).
    """

    joints: tuple
    """Joints from the base outwards."""
    up: tuple = (0.0, 0.0, 1.0)
    """Up, a unit vector in the base frame (made unit here)."""
    gravity: float | None = None
    """Local gravity, m/s^2; None: WGS 84 normal gravity from latitude and height."""
    gravity_sd: float | None = None
    """Standard deviation of the gravity, m/s^2."""
    latitude: float | None = None
    """Geodetic latitude, degrees; None: Earth rate is not modelled."""
    height: float | None = None
    """Height, m; None counts as zero."""
    azimuth_deg: float | None = None
    """Heading of the base x axis in the horizontal, clockwise from true north (of the x axis of n when base x is vertical)."""
    joint_noise_rad: float | None = None
    """Noise or resolution of the encoders, rad; None: estimated from the data."""
    mount_rpy_deg: tuple = (0.0, 0.0, 0.0)
    """Inner link to sensor frame, roll, pitch, yaw about fixed axes as in URDF, degrees."""
    mount_xyz: tuple | None = None
    """Reference point in the frame of the inner link, m; None: its origin, where the axes meet."""

    def __post_init__(self):
        joints = tuple(self.joints)
        _require_joints(joints)
        checked = {'joints': joints, 'up': _unit(self.up, 'up'), 'mount_rpy_deg': _vector(self.mount_rpy_deg, 'mount rpy_deg')}
        if self.mount_xyz is not None:
            checked['mount_xyz'] = _vector(self.mount_xyz, 'mount xyz')
        for name, (low, high, advice) in _NUMBERS.items():
            value = getattr(self, name)
            checked[name] = None if value is None else _number(value, name, low, high, advice)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.gravity is None and self.latitude is None:
            raise InputError('table: gravity or latitude must be given, got neither; '
                             'add gravity in m/s^2, or latitude in degrees (and height)')

    @classmethod
    def from_mapping(cls, mapping):
        """
        Return the table that a mapping, as read from the table's YAML, describes.

        Raises
        ------
        InputError
            When a key is unknown, a joint is missing or a value does not fit.

        """
        _require_keys(mapping, [f.name for f in fields(cls) if not f.name.startswith('mount_')] + ['mount'], 'table')
        values = {name: value for name, value in mapping.items() if value is not None and name != 'mount'}
        values['joints'] = [_joint(item) for item in _sequence(mapping.get('joints'))]
        mount = mapping.get('mount') or {}
        _require_keys(mount, _MOUNT_KEYS, 'table mount')
        values.update({f'mount_{name}': value for name, value in mount.items() if value is not None})
        return cls(**values)

    def to_mapping(self):
        """Return the mapping that `from_mapping` turns into an equal table."""
        mapping = {f.name: getattr(self, f.name) for f in fields(self) if not f.name.startswith('mount_')}
        mapping['joints'] = [{'name': joint.name, 'axis': list(joint.axis), 'xyz': list(joint.xyz)} for joint in self.joints]
        mapping['up'] = list(self.up)
        mapping['mount'] = {'rpy_deg': list(self.mount_rpy_deg), 'xyz': None if self.mount_xyz is None else list(self.mount_xyz)}
        return mapping

    @property
    def joint_names(self):
        """Names of the joints from the base outwards."""
        return tuple(joint.name for joint in self.joints)

    @property
    def gravity_value(self):
        """Local gravity, m/s^2: as given, else normal gravity."""
        return self.gravity if self.gravity is not None else normal_gravity(self.latitude, self.height or 0.0)

    @property
    def mat_nb(self):
        """Base frame to level frame, shape (3, 3)."""
        return align(np.array(self.up))

    @property
    def mat_sl(self):
        """Frame of the inner link to sensor frame, shape (3, 3): inverse of ``Rz(yaw) Ry(pitch) Rx(roll)``."""
        roll, pitch, yaw = np.radians(self.mount_rpy_deg)
        return (rotation([0, 0, yaw]) @ rotation([0, pitch, 0]) @ rotation([roll, 0, 0])).T

    @property
    def azimuth_n_deg(self):
        """Heading of the x axis of n, degrees clockwise from true north, or None."""
        return None if self.azimuth_deg is None else self.azimuth_deg + _base_heading_deg(self.mat_nb)


_NUMBERS = {
    'gravity': (1.5, 30.0, 'give it in m/s^2, about 9.8'),
    'gravity_sd': (0.0, 1.0, 'give it in m/s^2'),
    'latitude': (-90.0, 90.0, 'give it in degrees'),
    'height': (-12000.0, 1e5, 'give it in m'),
    'azimuth_deg': (-720.0, 720.0, 'give it in degrees clockwise from true north'),
    'joint_noise_rad': (0.0, 0.1, 'give it in rad'),
}


def tilt(table, angles):
    """
    Return the table with its true `up` turned by the rotation vector (tx, ty, 0) of the level frame.

    A levelling error: ``up_true = exp((tx, ty, 0) x) up``, rad. North turns with it, so that the Earth's rate is the same
    vector of n turned alike; `azimuth_deg` changes where the convention of n asks for it.
    """
    mat_bn = table.mat_nb.T @ rotation([angles[0], angles[1], 0.0])
    tilted = replace(table, up=tuple(mat_bn[:, 2].tolist()))
    if table.azimuth_deg is None:
        return tilted
    azimuth = np.radians(table.azimuth_n_deg)
    north = tilted.mat_nb @ mat_bn @ np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    azimuth_n_deg = np.degrees(np.arctan2(north[1], north[0]))
    return replace(tilted, azimuth_deg=float((azimuth_n_deg - _base_heading_deg(tilted.mat_nb)) % 360.0))


def with_axis_errors(table, errors):
    """
    Return the table with each joint axis turned by small angles.

    ``axis_true = exp((errors[j] @ axis_error_directions(axis)) x) axis``.

    Parameters
    ----------
    table : Table
        The nominal table.
    errors : array, shape (n_joints, 2)
        Rotation about the two directions of `axis_error_directions`, rad.

    """
    joints = []
    for joint, error in zip(table.joints, np.asarray(errors, float), strict=True):
        turned = rotation(error @ axis_error_directions(joint.axis)) @ np.array(joint.axis)
        joints.append(replace(joint, axis=tuple(turned.tolist())))
    return replace(table, joints=tuple(joints))


def axis_error_directions(axis):
    """
    Return two unit vectors u, v that form a right-handed triad u, v, axis; shape (2, 3).

    u is the coordinate axis that lies farthest from `axis` (the first of equals), made orthogonal to it; v = axis x u.
    """
    axis = np.asarray(axis, float)
    start = np.eye(3)[np.argmin(np.round(np.abs(axis), 6))]
    first = start - axis * (axis @ start)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])


def _base_heading_deg(mat_nb):
    x, y, _ = mat_nb[:, 0]
    return float(np.degrees(np.arctan2(y, x))) if np.hypot(x, y) > 1e-9 else 0.0


def _joint(item):
    _require_keys(item, [f.name for f in fields(Joint)], 'table joint')
    for key in ('name', 'axis'):
        if item.get(key) is None:
            raise InputError(f'table: every joint must have name and axis, got {item!r}; add {key}')
    return Joint(**{key: value for key, value in item.items() if value is not None})


def _sequence(value):
    return value if isinstance(value, (list, tuple)) else ()


def _require_joints(joints):
    if not joints:
        raise InputError('table: joints must list at least one joint, got none; describe them from the base outwards')
    names = [joint.name for joint in joints]
    for name in names:
        if not isinstance(name, str) or not name or names.count(name) > 1:
            raise InputError(f'table: joint names must be different and not empty, got {names}; use the names of the joint states')


def _require_keys(mapping, known, what):
    if not hasattr(mapping, 'items'):
        raise InputError(f'{what} must be a mapping with the keys {", ".join(known)}, got {mapping!r}; see the table description')
    for key in mapping:
        if key not in known:
            raise InputError(f"{what}: key '{key}' is unknown; the keys here are {', '.join(known)}")


def _unit(value, what):
    vector = np.array(_vector(value, what))
    norm = np.linalg.norm(vector)
    if norm < 1e-9:
        raise InputError(f'table: {what} must not be zero, got {list(value)}; give a direction of three numbers')
    # Idempotent, so that a table written and read again is equal.
    return tuple((vector / norm if abs(norm - 1) > 4e-16 else vector).tolist())


def _vector(value, what):
    if isinstance(value, (str, bytes)) or not hasattr(value, '__len__') or len(value) != 3:
        raise InputError(f'table: {what} must be three numbers, got {value!r}; correct it')
    return tuple(_number(item, what, None, None, 'give three numbers') for item in value)


def _number(value, what, low, high, advice):
    # YAML 1.1 reads 1e-5, without a point, as text.
    try:
        number = float('nan') if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = float('nan')
    if not np.isfinite(number):
        raise InputError(f'table: {what} must be a finite number, got {value!r}; {advice}')
    if low is not None and not low <= number <= high:
        raise InputError(f'table: {what} must lie in [{low:g}, {high:g}], got {value!r}; {advice}')
    return number
