"""The turntable or arm that carries the sensor: its description, checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.schema import anything, list_of, mapping, maybe, require
from imu_calibration.kinematics.joint import (
    THREE_NUMBERS,
    Joint,
    JointNames,
    direction,
    joint_entry,
    joint_from_mapping,
    joint_to_mapping,
    place_names,
    table_document,
    table_number,
    unit_vector,
)
from imu_calibration.kinematics.rotations import (
    NORMAL_GRAVITY_ACCURACY,
    align,
    earth_rate_n,
    normal_gravity,
    rotation_from_rpy,
)

PARALLEL = 0.02
"""
Sine of the angle up to which two axes count as parallel: their common perpendicular is undefined
there.
"""

MOST_JOINTS = 16
"""
Largest number of joints, for which a plan takes 1.4 GB and 100 s: the memory grows with the square.
"""


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
    Return the angular errors of each turning axis relative to the one before it.

    An error of the second axis has two directions. That about the common perpendicular is an angle;
    the other one is equal to an error of the zero of the first joint. Parallel axes have no such
    perpendicular: there are two angles, about `axis_error_directions`, and the zeros of their
    joints are one (Hayati and Mirmirani 1985).
    """
    angles = []
    axis_before = None
    name_before = ''
    for index, joint in enumerate(joints):
        # The axis of the last turning joint in the frame of this one, with all joints at zero.
        if axis_before is not None:
            axis_before = joint.mat_before.T @ axis_before
        if not joint.turns:
            continue
        axis = np.array(joint.axis)
        if axis_before is not None:
            angles += _angles_between(f'{name_before}_{joint.name}', index, axis_before, axis)
        axis_before = axis
        name_before = joint.name
    return tuple(angles)


def _angles_between(
    name: str, index: int, axis_before: np.ndarray, axis: np.ndarray
) -> list[AxisAngle]:
    """Return the angular errors of an axis relative to another, both in the frame of the joint."""
    normal = np.cross(axis_before, axis)
    sine = np.linalg.norm(normal)
    if sine > PARALLEL:
        return [AxisAngle(name, index, normal / sine)]
    u, v = axis_error_directions(axis)
    return [AxisAngle(f'{name}_u', index, u), AxisAngle(f'{name}_v', index, v)]


def axis_error_directions(axis: np.ndarray) -> np.ndarray:
    """
    Return two unit vectors u, v that form a right-handed triad u, v, axis; shape (2, 3).

    u is the coordinate axis with the smallest component of `axis` (the first of equals), made
    orthogonal to `axis`; v = axis x u.
    """
    axis = np.asarray(axis, float)
    start = np.eye(3)[np.argmin(np.round(np.abs(axis), 6))]
    first = start - axis * (axis @ start)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])


SAME_GRAVITY = 1e-5
"""Difference of a gravity that is stated twice, m/s^2: digits that were rounded."""
_NUMBERS = {
    'gravity': maybe(table_number(1.5, 30.0)),
    'gravity_sd': maybe(table_number(0.0, 1.0)),
    'latitude': maybe(table_number(-90.0, 90.0)),
    'height': maybe(table_number(-12000.0, 1e5)),
    'azimuth_deg': maybe(table_number(-720.0, 720.0)),
    'joint_noise_rad': maybe(table_number(0.0, 0.1)),
    'joint_error_rad': maybe(table_number(0.0, 0.1)),
    'joint_error_m': maybe(table_number(0.0, 0.1)),
}
_MOUNT = {'rpy_deg': maybe(THREE_NUMBERS), 'xyz': maybe(THREE_NUMBERS)}
_SITE = {
    'up': maybe(direction),
    **_NUMBERS,
    'mount': maybe(mapping(optional=_MOUNT, closed=True)),
}
TABLE = table_document(
    mapping({'joints': list_of(joint_entry, code='no_joint')}, _SITE, closed=True)
)
"""A table description."""
SITE = table_document(
    mapping(optional={**_SITE, 'joints': maybe(list_of(anything))}, closed=True), 'site'
)
"""
A table description in addition to a robot description; its entries of joints are limits by name.
"""


@dataclass(frozen=True)
class Table:
    """
    A chain of joints that carries the sensor, and its site.

    The level frame n is the base frame turned by the smallest rotation that makes `up` its z axis
    (half a turn about the base x axis when the base hangs upside down).
    """

    joints: tuple[Joint, ...]
    """Joints from the base outwards."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Up, a unit vector in the base frame (made unit here)."""
    gravity: float | None = None
    """Local gravity, m/s^2; None: WGS 84 normal gravity from latitude and height."""
    gravity_sd: float | None = None
    """Standard deviation of the gravity, m/s^2; None: see `gravity_sd_value`."""
    latitude: float | None = None
    """Geodetic latitude, degrees; None: the Earth's rate is estimated, not known."""
    height: float | None = None
    """Height, m; None counts as zero."""
    azimuth_deg: float | None = None
    """
    Heading of the base x axis in the horizontal, clockwise from true north (of the x axis of n when
    base x is vertical).
    """
    joint_noise_rad: float | None = None
    """Noise or resolution of the encoders, rad; None: estimated from the data."""
    joint_error_rad: float | None = None
    """
    Standard deviation of zeros and axes of the joints, rad; None: exact unless their errors are
    requested.
    """
    joint_error_m: float | None = None
    """Standard deviation of the places of the axes, m; None: exact."""
    mount_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Inner link to sensor frame, roll, pitch, yaw about fixed axes as in URDF, degrees."""
    mount_xyz: tuple[float, float, float] | None = None
    """Reference point in the frame of the inner link, m; None: its origin, where the axes meet."""

    def __post_init__(self) -> None:
        # 1. All fields, as given, must be those of a valid description.
        joints = tuple(self.joints)
        _require_joints(joints)
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        mount = {f'mount_{name}': requirement for name, requirement in _MOUNT.items()}
        require(
            values,
            TABLE,
            mapping({'up': direction, 'mount_rpy_deg': THREE_NUMBERS}, {**_NUMBERS, **mount}),
        )
        # 2. Texts become numbers, lists become tuples, and `up` a unit vector.
        checked: dict[str, Any] = {'joints': joints, 'up': unit_vector(self.up)}
        for name in _NUMBERS:
            checked[name] = None if values[name] is None else float(values[name])
        for name in mount:
            numbers = values[name]
            checked[name] = None if numbers is None else tuple(float(item) for item in numbers)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.gravity is None and self.latitude is None:
            raise InputError(
                'table: gravity or latitude must be given, got neither; '
                'add gravity in m/s^2, or latitude in degrees (and height)',
                code='gravity_missing',
            )

    @classmethod
    def from_mapping(
        cls, mapping: Mapping[str, Any], *, gravity: float | None = None, gravity_sd: float = 0.0
    ) -> 'Table':
        """
        Return the table that a mapping, as read from the table's YAML, describes.

        Parameters
        ----------
        mapping : mapping
        gravity, gravity_sd : float, optional
            As for `at`.

        Raises
        ------
        InputError
            When a key is unknown, a joint is missing or a value does not fit.

        """
        require(mapping, TABLE)
        joints = tuple(joint_from_mapping(item) for item in mapping['joints'])
        return cls.at(gravity, gravity_sd, {'joints': joints, **site_from_mapping(mapping)})

    @classmethod
    def at(
        cls, gravity: float | None, gravity_sd: float, description: Mapping[str, Any]
    ) -> 'Table':
        """
        Return the table of a description, at a local gravity that is given separately.

        A measured gravity replaces that of the latitude, which still gives the Earth's rate.

        Parameters
        ----------
        gravity : float or None
            Local gravity, m/s^2; None: that of the description.
        gravity_sd : float
            Its standard deviation, m/s^2: 0 if it was measured, larger if it follows from a
            latitude.
        description : mapping
            Fields of the table.

        Raises
        ------
        InputError
            When the description states another gravity, or another place than that of the gravity.

        """
        if gravity is None:
            return cls(**description)
        # The gravity is used unless the description states one that is at least as good: a stated
        # one in any case, that of a latitude if this one follows from a latitude too.
        stronger = ('gravity',) if gravity_sd == 0 else ('gravity', 'latitude')
        if all(description.get(name) is None for name in stronger):
            sd = description.get('gravity_sd') or gravity_sd or None
            return cls(**{**description, 'gravity': gravity, 'gravity_sd': sd})
        # Otherwise it is only compared with that of the description.
        table = cls(**description)
        if abs(table.gravity_value - gravity) > SAME_GRAVITY:
            raise InputError(
                'a gravity, or latitude and height, in addition to a table must agree with its'
                f' gravity of {table.gravity_value:.5f} m/s^2, got {gravity:.5f} m/s^2; omit it, or'
                ' correct the description',
                code='gravity_twice',
            )
        return table

    def to_mapping(self) -> dict[str, Any]:
        """Return the description from which `from_mapping` makes an equal table."""
        mapping = {
            f.name: getattr(self, f.name) for f in fields(self) if not f.name.startswith('mount_')
        }
        mapping['joints'] = [joint_to_mapping(joint) for joint in self.joints]
        mapping['up'] = list(self.up)
        mapping['mount'] = {
            'rpy_deg': list(self.mount_rpy_deg),
            'xyz': None if self.mount_xyz is None else list(self.mount_xyz),
        }
        return mapping

    @cached_property
    def joint_names(self) -> JointNames:
        """Names of the joints with readings, from the base outwards, and of their errors."""
        turning = [joint.source for joint in self.joints if joint.turns]
        # A zero that affects only the first or the last axis is the azimuth, or belongs to the
        # mount. A joint that others follow is listed once for each axis that it turns.
        not_separate = [name for name in turning[:1] + turning[-1:] if turning.count(name) == 1]
        # A mimic joint is read from the same source as another one.
        read = tuple(dict.fromkeys(joint.source for joint in self.joints))
        turning = list(dict.fromkeys(turning))
        angles = tuple(angle.name for angle in axis_angles(self.joints))
        places = place_names([joint.name for joint in self.joints if joint.turns])
        return JointNames(
            read=read,
            turning=tuple(turning),
            zeros=tuple(name for name in turning if name not in not_separate),
            angles=angles,
            places=places,
            angle_sd=self.joint_error_rad or None,
            place_sd=self.joint_error_m or None,
        )

    @property
    def gravity_value(self) -> float:
        """Local gravity, m/s^2: as given, otherwise normal gravity."""
        if self.gravity is not None:
            return self.gravity
        # Required by the constructor.
        assert self.latitude is not None
        return normal_gravity(self.latitude, self.height or 0.0)

    @property
    def gravity_sd_value(self) -> float:
        """
        Standard deviation of `gravity_value`, m/s^2.

        As given; otherwise zero for a given gravity, and the accuracy of normal gravity without.
        """
        if self.gravity_sd is not None:
            return self.gravity_sd
        if self.gravity is not None:
            return 0.0
        return NORMAL_GRAVITY_ACCURACY * self.gravity_value

    @property
    def mat_nb(self) -> np.ndarray:
        """Base frame to level frame, shape (3, 3)."""
        return align(np.array(self.up))

    @property
    def mat_sl(self) -> np.ndarray:
        """
        Frame of the last link to sensor frame, shape (3, 3).

        Inverse of ``Rz(yaw) Ry(pitch) Rx(roll)``.
        """
        return rotation_from_rpy(np.radians(self.mount_rpy_deg)).T

    @property
    def azimuth_n_deg(self) -> float | None:
        """Heading of the x axis of n, degrees clockwise from true north, or None."""
        if self.azimuth_deg is None:
            return None
        return self.azimuth_deg + base_heading_deg(self.mat_nb)

    @property
    def earth_rate_n(self) -> np.ndarray | None:
        """Earth's rate in n, rad/s, shape (3,); None without latitude or azimuth."""
        azimuth = self.azimuth_n_deg
        if self.latitude is None or azimuth is None:
            return None
        return earth_rate_n(self.latitude, azimuth)


def site_from_mapping(site: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a valid description except the joints, as arguments of `Table`."""
    values = {}
    for name, value in site.items():
        if value is not None and name not in ('mount', 'joints'):
            values[name] = value
    mount = site.get('mount') or {}
    return values | {f'mount_{name}': value for name, value in mount.items() if value is not None}


def base_heading_deg(mat_nb: np.ndarray) -> float:
    """
    Return the heading of the base x axis in the level frame, degrees.

    Counter-clockwise from the x axis of the level frame; zero when the base x axis is vertical.
    """
    x, y, _ = mat_nb[:, 0]
    return float(np.degrees(np.arctan2(y, x))) if np.hypot(x, y) > 1e-9 else 0.0


def _require_joints(joints: Sequence[Joint]) -> None:
    """Raise an InputError unless there are joints with different names, moved by read joints."""
    if not joints:
        raise InputError(
            'table: joints must list at least one joint, got none; describe them from the base'
            ' outwards',
            code='no_joint',
        )
    if len(joints) > MOST_JOINTS:
        raise InputError(
            f'table: joints must be at most {MOST_JOINTS}, got {len(joints)}; omit those that do'
            ' not move',
            code='joints_many',
        )
    names = [joint.name for joint in joints]
    for name in names:
        if not isinstance(name, str) or not name or names.count(name) > 1:
            raise InputError(
                f'table: joint names must be different and not empty, got {names}; use the names of'
                ' the joint states',
                code='joint_names',
            )
    followers = {joint.name for joint in joints if joint.mimic is not None}
    for joint in joints:
        if joint.source in followers:
            raise InputError(
                f"table: joint '{joint.name}' must follow a joint that moves by itself,"
                f" '{joint.source}' follows another one; name that one"
            )
