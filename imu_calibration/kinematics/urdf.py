"""
The chain of joints that carries the sensor, from a robot description (URDF).

Also the tree of static transforms, and poses of its frames in each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.core.documents import MAX_DOCUMENT_CHARACTERS
from imu_calibration.core.errors import InputError, printable, shortened
from imu_calibration.core.schema import mapping, require, text
from imu_calibration.core.units import STANDARD_GRAVITY, STANDARD_GRAVITY_SD
from imu_calibration.kinematics.joint import (
    LIMITS,
    Joint,
    JointLimits,
    Mimic,
    limits_from_mapping,
    three_numbers,
)
from imu_calibration.kinematics.rotations import (
    rotation_from_rpy,
    rotations_from_quaternions,
    rpy_from_rotation,
)
from imu_calibration.kinematics.table import SITE, Table, site_from_mapping

NAMED = 6
"""Largest number of frames in one line."""


@dataclass(frozen=True, eq=False)
class _Placement:
    """A frame relative to an outer frame."""

    xyz: np.ndarray
    """Origin in the outer frame, m, shape (3,)."""
    matrix: np.ndarray
    """Turns vectors into the outer frame, shape (3, 3)."""

    def then(self, xyz: np.ndarray, matrix: np.ndarray) -> '_Placement':
        """Return the placement, in the outer frame, of a frame that is placed in this one."""
        return _Placement(self.xyz + self.matrix @ xyz, self.matrix @ matrix)

    @property
    def fields(self) -> dict[str, Any]:
        """The fields `xyz` and `rpy_deg` of a `Joint`."""
        return {
            'xyz': tuple(self.xyz.tolist()),
            'rpy_deg': tuple(np.degrees(rpy_from_rotation(self.matrix)).tolist()),
        }


class StaticTransforms:
    """Transforms from parent to child frames; the newest of each child counts, as in tf2."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, _Placement]] = {}
        """Child -> (parent, placement of the child in it)."""

    def add(
        self,
        parent: str,
        child: str,
        *,
        xyz: Sequence[float],
        quaternion: Sequence[float] | np.ndarray,
    ) -> bool:
        """
        Add the pose of a child frame in its parent: translation in m, quaternion (x, y, z, w).

        Returns
        -------
        bool
            Whether it was usable: finite, a quaternion of a length above 0.5, two frames.

        """
        xyz = np.array(xyz, float)
        quaternion = np.array(quaternion, float)
        if parent == child:
            return False
        if not np.isfinite(xyz).all() or not np.isfinite(quaternion).all():
            return False
        if np.linalg.norm(quaternion) <= 0.5:
            return False
        self._parents[child] = parent, _Placement(xyz, rotations_from_quaternions(quaternion))
        return True

    def pose(self, target: str, source: str) -> tuple[np.ndarray, np.ndarray] | None:
        """
        Return the pose of `source` in `target`, or None if they are not connected.

        Returns
        -------
        xyz_t : ndarray
            Origin of the source in the target frame, m, shape (3,).
        mat_ts : ndarray
            Turns source vectors into target vectors, shape (3, 3).

        """
        source_root, source_frame = self._in_root(source)
        target_root, target_frame = self._in_root(target)
        if source_root != target_root:
            return None
        mat_tr = target_frame.matrix.T
        return mat_tr @ (source_frame.xyz - target_frame.xyz), mat_tr @ source_frame.matrix

    def why_not(self, target: str, source: str) -> str:
        """Return the missing connection of two frames as text."""
        known = {*self._parents, *(parent for parent, _ in self._parents.values())}
        if not known:
            return 'no static transform has come'
        absent = [f"'{name}'" for name in (target, source) if name not in known]
        names = ', '.join(sorted(known)[:NAMED]) + (', ...' if len(known) > NAMED else '')
        if absent:
            return (
                f'{" and ".join(absent)} {"is" if len(absent) == 1 else "are"} in none that came'
                f' (frames: {names})'
            )
        return (
            f"'{target}' and '{source}' are in trees without a static connection (roots:"
            f' {self._in_root(target)[0]}, {self._in_root(source)[0]})'
        )

    def _in_root(self, frame: str) -> tuple[str, _Placement]:
        """
        Return (root, placement of `frame` in it).

        In a circle of frames the root is the last one before the circle closes.
        """
        ancestor = frame
        placement = _Placement(np.zeros(3), np.eye(3))
        seen = {frame}
        while ancestor in self._parents:
            parent, ancestor_in_parent = self._parents[ancestor]
            if parent in seen:
                break
            ancestor = parent
            placement = ancestor_in_parent.then(placement.xyz, placement.matrix)
            seen.add(parent)
        return ancestor, placement


def up_of(
    root: str, transforms: Iterable[tuple[str, str, np.ndarray]]
) -> tuple[float, float, float]:
    """
    Return the z axis of the outermost frame, a unit vector in the frame `root`.

    It is up where the outermost frame is the world or a map.

    Parameters
    ----------
    root : str
        Frame of the robot's root.
    transforms : iterable of (parent, child, quaternion)
        The quaternion x, y, z, w turns vectors of the child into the parent.

    Raises
    ------
    InputError
        When the frames form a circle.

    """
    tree = StaticTransforms()
    for parent, child, quaternion in transforms:
        tree.add(parent, child, xyz=(0.0, 0.0, 0.0), quaternion=quaternion)
    frame, placement = tree._in_root(root)
    if frame in tree._parents:
        raise InputError(
            f"static transforms must form a tree, those around '{frame}' form a circle; correct"
            ' them, or give `up`',
            key='up',
            code='frame_circle',
        )
    return tuple(placement.matrix[2].tolist())


JOINT_ERRORS = {'joint_error_rad': 1e-3, 'joint_error_m': 1e-3}
"""Default standard deviations of an arm's joints: arms have 0.1 to 1 mrad and 0.1 to 1 mm."""

_MOVING = {'revolute': 'revolute', 'continuous': 'revolute', 'prismatic': 'prismatic'}
"""Type of a moving joint in a URDF -> `Joint.type`."""
_READ = {'link': (), 'joint': ('origin', 'parent', 'child', 'axis', 'limit', 'mimic')}
"""
Elements that describe the kinematics, with their children; meshes, materials, controllers and
simulators' tags are ignored.
"""


def table_from_urdf(
    text: str | bytes,
    link: str,
    site: Mapping[str, Any] | None = None,
    *,
    gravity: float | None = None,
    gravity_sd: float = 0.0,
) -> Table:
    """
    Return the chain of joints from the root of a robot to one of its links.

    Fixed joints are folded into their neighbours; a joint that mimics another one is moved by the
    readings of that one. The root's z axis points up unless the site differs.

    Parameters
    ----------
    text : str or bytes
        The URDF.
    link : str
        Link whose frame is the sensor's: the frame_id of its messages.
    site : mapping, optional
        Entries of a table description except the joints (up, gravity, latitude, mount, ...); its
        joints may give limits, by name.
    gravity, gravity_sd : float, optional
        Local gravity and its standard deviation, m/s^2, as for `Table.at`. Without any gravity and
        latitude: the standard gravity, with the sd of an unknown site.

    Raises
    ------
    InputError
        When the text is no robot description, the link is not in it or does not move, a joint on
        the way has several degrees of freedom, or the site names a joint that is not on the way.

    """
    robot = _read(text)
    site = site or {}
    require(site, SITE)
    values = site_from_mapping(site)
    if gravity is None and values.keys().isdisjoint(('gravity', 'latitude')):
        gravity = STANDARD_GRAVITY
        gravity_sd = STANDARD_GRAVITY_SD
    joints, link_placement = _chain(robot, link)
    xyz = np.array(values.get('mount_xyz', (0.0, 0.0, 0.0)), float)
    rpy_deg = np.array(values.get('mount_rpy_deg', (0.0, 0.0, 0.0)), float)
    mount = link_placement.then(xyz, rotation_from_rpy(np.radians(rpy_deg)))
    values |= {f'mount_{name}': value for name, value in mount.fields.items()}
    joints = _with_limits(joints, site.get('joints') or (), link)
    return Table.at(gravity, gravity_sd, JOINT_ERRORS | values | {'joints': joints})


def root_of(text: str | bytes) -> str:
    """Return the name of the root link."""
    robot = _read(text)
    roots = [link for link in robot.link_map if link not in robot.parent_map]
    if len(roots) != 1:
        raise InputError(
            f'a robot description must have one root link, it has {_listed(roots) or "none"};'
            ' correct it'
        )
    return roots[0]


def _read(text: str | bytes) -> Any:
    """Return the links and joints of a URDF as a `Robot` of urdf_parser_py."""
    from xml.etree import ElementTree

    try:
        from urdf_parser_py.urdf import Robot
    except ImportError as error:
        raise InputError(
            'a robot description needs the package urdfdom-py, it is not installed; install'
            " 'imu_calibration[arm]'",
            code='package_missing',
        ) from error
    try:
        if len(text) > MAX_DOCUMENT_CHARACTERS:
            raise ValueError(
                f'it has {len(text)} characters, at most {MAX_DOCUMENT_CHARACTERS} are accepted'
            )
        # Names are printed: without control characters.
        root = ElementTree.fromstring(text)
        for element in root.iter():
            element.attrib.update((key, printable(value)) for key, value in element.items())
        if root.tag != 'robot':
            raise ValueError(f'its outermost element is <{root.tag}>')
        # Only the elements that describe the kinematics.
        kinematics = ElementTree.Element('robot', root.attrib)
        for element in root:
            if element.tag in _READ:
                copied = ElementTree.SubElement(kinematics, element.tag, element.attrib)
                copied.extend(child for child in element if child.tag in _READ[element.tag])
        return Robot.from_xml_string(ElementTree.tostring(kinematics))
    except Exception as error:  # the parsers raise many kinds
        raise InputError(
            f'a robot description must be a URDF, this is not: {shortened(str(error), 200)}; give'
            ' the .urdf or .xacro of the robot'
        ) from error


def _chain(robot: Any, link: str) -> tuple[list[Joint], _Placement]:
    """
    Return the moving joints from the root to `link`, and the placement of the link.

    Fixed joints are part of the placement of the next frame. The placement of the link is relative
    to the frame of the last moving joint.
    """
    if link not in robot.link_map:
        raise InputError(
            f"the robot description must hold the link '{link}' that carries the IMU, it holds"
            f' {_listed(robot.link_map)}; name one of these',
            key='imu_link',
            code='link_unknown',
        )
    # From the link inwards; the root has no parent.
    joints_to_root = []
    while link in robot.parent_map:
        name, link = robot.parent_map[link]
        joints_to_root.append(robot.joint_map[name])
        if len(joints_to_root) > len(robot.joint_map):
            raise InputError(
                f"the links of a robot description must form a tree, those around '{link}' form a"
                ' circle; correct it'
            )
    # Outwards again.
    joints = []
    placement = _Placement(np.zeros(3), np.eye(3))  # since the last moving joint
    for joint in reversed(joints_to_root):
        placement = placement.then(*_origin(joint))
        if joint.type == 'fixed':
            continue
        if joint.type not in _MOVING:
            raise InputError(
                'joints on the way to the IMU must be revolute, continuous, prismatic or fixed,'
                f" '{joint.name}' is {joint.type}; use a description that begins after it"
            )
        joints.append(
            Joint(
                joint.name,
                tuple(joint.axis or (1.0, 0.0, 0.0)),
                type=_MOVING[joint.type],
                mimic=_mimic(robot, joint),
                limits=_limits(joint),
                **placement.fields,
            )
        )
        placement = _Placement(np.zeros(3), np.eye(3))
    if not joints:
        raise InputError(
            f"the link '{joints_to_root[0].child if joints_to_root else link}' must be moved by at"
            f" least one joint, it is fixed to the root '{link}'; name the link that carries the"
            ' IMU, or calibrate by hand'
        )
    return joints, placement


def _origin(joint: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return origin, m, and rotation matrix of a joint's frame in the frame of its parent link."""
    numbers = {}
    for name in ('xyz', 'rpy'):
        value = joint.origin and getattr(joint.origin, name)
        place = f'origin {name} of joint {joint.name}'
        numbers[name] = np.array(three_numbers(value or (0, 0, 0), place))
    return numbers['xyz'], rotation_from_rpy(numbers['rpy'])


def _mimic(robot: Any, joint: Any) -> Mimic | None:
    """
    Return how a joint follows a joint that follows no other, or None if it follows none.

    Several steps, each ``position = multiplier * followed + offset``, are joined into one.
    """
    multiplier = 1.0
    offset = 0.0
    name = joint.name
    seen = []
    while robot.joint_map[name].mimic is not None:
        mimic = robot.joint_map[name].mimic
        offset += multiplier * (mimic.offset or 0.0)
        multiplier *= 1.0 if mimic.multiplier is None else mimic.multiplier
        seen.append(name)
        name = mimic.joint
        if name not in robot.joint_map or name in seen:
            raise InputError(
                f"joint '{joint.name}' must mimic another joint of the robot, it mimics '{name}';"
                ' correct the description'
            )
    return None if name == joint.name else Mimic(name, multiplier, offset)


def _limits(joint: Any) -> JointLimits:
    """
    Return the limits of a joint in the robot description.

    A continuous joint is endless. Placeholders, zero or infinite, count as not given.
    """
    limit = joint.limit
    endless = joint.type == 'continuous'
    lower = None
    upper = None
    speed = None
    if limit is not None:
        ends = (limit.lower or 0.0, limit.upper or 0.0)
        if not endless and ends != (0.0, 0.0) and all(map(math.isfinite, ends)):
            lower, upper = ends
        if limit.velocity and math.isfinite(limit.velocity):
            speed = limit.velocity
    return JointLimits(
        lower,
        upper,
        speed,
        endless=endless,
        described=frozenset(('lower', 'upper', 'speed', 'endless')),
    )


def _with_limits(joints: Sequence[Joint], entries: Iterable[Any], link: str) -> tuple[Joint, ...]:
    """Return the joints with the limits that the entries of a site give for them by name."""
    by_name = {joint.name: joint for joint in joints}
    for entry in entries:
        name = entry.get('name') if isinstance(entry, Mapping) else None
        if name not in by_name:
            raise InputError(
                f"joints of the site must be on the way to '{link}': {_listed(by_name)}; got"
                f' {name!r}',
                code='joint_unknown',
            )
        joint = by_name[name]
        limits = mapping({'name': text()}, LIMITS[joint.type], closed=True)
        require(entry, replace(SITE, name=f"limits of joint '{name}'"), limits)
        # Limits that the entry gives replace those of the robot description. A range and endless
        # exclude each other, so that either one removes the other.
        given = limits_from_mapping(entry, joint.type)
        changes: dict[str, Any] = {}
        for key, value in vars(given).items():
            if key != 'described' and value is not None and value is not False:
                changes[key] = value
        if given.endless or given.lower is not None:
            changes = {'lower': None, 'upper': None, 'endless': False} | changes
        changes['described'] = joint.limits.described - set(changes)
        by_name[name] = replace(joint, limits=replace(joint.limits, **changes))
    return tuple(by_name.values())


def _listed(names: Iterable[str]) -> str:
    """Return the first names in alphabetical order, and the number of further ones."""
    names = sorted(names)
    return ', '.join(names[:12]) + (f' and {len(names) - 12} more' if len(names) > 12 else '')
