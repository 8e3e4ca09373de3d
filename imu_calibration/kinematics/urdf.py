"""
A robot description (URDF) becomes the chain of joints that carries the sensor.

The tree of static transforms, and poses through it.
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


class StaticTransforms:
    """Transforms from parent to child frames; the newest of each child counts, as in tf2."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}

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
            Whether it was usable: finite, a quaternion that turns, two frames.

        """
        xyz = np.array(xyz, float)
        quaternion = np.array(quaternion, float)
        if (
            not (
                np.isfinite(xyz).all()
                and np.isfinite(quaternion).all()
                and np.linalg.norm(quaternion) > 0.5
            )
            or parent == child
        ):
            return False
        self._parents[child] = (parent, xyz, rotations_from_quaternions(quaternion))
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
        ups = self._to_root(source)
        downs = self._to_root(target)
        if ups[-1][0] != downs[-1][0]:
            return None
        (_, xyz_s, mat_rs), (_, xyz_t, mat_rt) = ups[-1], downs[-1]
        return mat_rt.T @ (xyz_s - xyz_t), mat_rt.T @ mat_rs

    def why_not(self, target: str, source: str) -> str:
        """Return the missing connection of two frames as text."""
        known = {*self._parents, *(parent for parent, _, _ in self._parents.values())}
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
            f' {self._to_root(target)[-1][0]}, {self._to_root(source)[-1][0]})'
        )

    def _to_root(self, frame):
        """
        Return (ancestor, origin of `frame` in it, matrix from `frame` to it).

        The ancestors run from the frame up to its root. A ring ends once closed.
        """
        steps = [(frame, np.zeros(3), np.eye(3))]
        seen = {frame}
        while (step := self._parents.get(steps[-1][0])) is not None and step[0] not in seen:
            parent, xyz, mat = step
            _, origin, turned = steps[-1]
            steps.append((parent, xyz + mat @ origin, mat @ turned))
            seen.add(parent)
        return steps


def up_of(
    root: str, transforms: Iterable[tuple[str, str, np.ndarray]]
) -> tuple[float, float, float]:
    """
    Return the z axis of the outermost frame in the frame `root`.

    Up, where that frame is the world or a map.

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
    frame, _, mat = tree._to_root(root)[-1]
    if frame in tree._parents:
        raise InputError(
            f"static transforms must form a tree, those around '{frame}' form a circle; correct"
            ' them, or give `up`',
            key='up',
            code='frame_circle',
        )
    return tuple(mat[2].tolist())


JOINT_ERRORS = {'joint_error_rad': 1e-3, 'joint_error_m': 1e-3}
"""Default standard deviations of an arm's joints: arms have 0.1 to 1 mrad and 0.1 to 1 mm."""

_MOVING = {'revolute': 'revolute', 'continuous': 'revolute', 'prismatic': 'prismatic'}
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
        gravity, gravity_sd = STANDARD_GRAVITY, STANDARD_GRAVITY_SD
    joints, rest = _chain(robot, link)
    xyz = np.array(values.get('mount_xyz', (0.0, 0.0, 0.0)), float)
    rpy_deg = np.array(values.get('mount_rpy_deg', (0.0, 0.0, 0.0)), float)
    mount = rest.then(xyz, rotation_from_rpy(np.radians(rpy_deg)))
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


@dataclass(frozen=True, eq=False)
class _Placement:
    """A frame in another one: where its origin is, and how it is turned."""

    xyz: np.ndarray
    matrix: np.ndarray

    def then(self, xyz, matrix):
        """Return the placement of a frame that is placed in this one."""
        return _Placement(self.xyz + self.matrix @ xyz, self.matrix @ matrix)

    @property
    def fields(self):
        """As fields of a `Joint`."""
        return {
            'xyz': tuple(self.xyz.tolist()),
            'rpy_deg': tuple(np.degrees(rpy_from_rotation(self.matrix)).tolist()),
        }


def _read(text):
    """Return the parser's robot from the links and joints of the text."""
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
        root = ElementTree.fromstring(text)
        for element in root.iter():
            element.attrib.update((key, printable(value)) for key, value in element.items())
        if root.tag != 'robot':
            raise ValueError(f'its outermost element is <{root.tag}>')
        bare = ElementTree.Element('robot', root.attrib)
        for element in (child for child in root if child.tag in _READ):
            ElementTree.SubElement(bare, element.tag, element.attrib).extend(
                child for child in element if child.tag in _READ[element.tag]
            )
        return Robot.from_xml_string(ElementTree.tostring(bare))
    except Exception as error:  # the parsers raise many kinds
        raise InputError(
            f'a robot description must be a URDF, this is not: {shortened(str(error), 200)}; give'
            ' the .urdf or .xacro of the robot'
        ) from error


def _chain(robot, link):
    """
    Return the moving joints from the root to `link`, and the link's placement.

    The placement of the link is after the last of these joints.
    """
    if link not in robot.link_map:
        raise InputError(
            f"the robot description must hold the link '{link}' that carries the IMU, it holds"
            f' {_listed(robot.link_map)}; name one of these',
            key='imu_link',
            code='link_unknown',
        )
    on_the_way = []
    while link in robot.parent_map:
        name, link = robot.parent_map[link]
        on_the_way.append(robot.joint_map[name])
        if len(on_the_way) > len(robot.joint_map):
            raise InputError(
                f"the links of a robot description must form a tree, those around '{link}' form a"
                ' circle; correct it'
            )
    joints = []
    placement = _Placement(np.zeros(3), np.eye(3))
    for joint in reversed(on_the_way):
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
            f"the link '{on_the_way[0].child if on_the_way else link}' must be moved by at least"
            f" one joint, it is fixed to the root '{link}'; name the link that carries the IMU, or"
            ' calibrate by hand'
        )
    return joints, placement


def _origin(joint):
    xyz, rpy = (
        three_numbers(
            (joint.origin and getattr(joint.origin, name)) or (0, 0, 0),
            f'origin {name} of joint {joint.name}',
        )
        for name in ('xyz', 'rpy')
    )
    return np.array(xyz), rotation_from_rpy(np.array(rpy))


def _mimic(robot, joint):
    """Return the joint at the end of the chain of followed joints, or None."""
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


def _limits(joint):
    """
    Return the limits in the description.

    A continuous joint is endless, placeholders (zero, infinite) count as not given.
    """
    limit = joint.limit
    endless = joint.type == 'continuous'
    ends = (0.0, 0.0) if limit is None else (limit.lower or 0.0, limit.upper or 0.0)
    ends = (
        (None, None) if endless or ends == (0.0, 0.0) or not all(map(math.isfinite, ends)) else ends
    )
    speed = (
        limit.velocity
        if limit is not None and limit.velocity and math.isfinite(limit.velocity)
        else None
    )
    lower, upper = ends
    return JointLimits(
        lower,
        upper,
        speed,
        endless=endless,
        described=frozenset(('lower', 'upper', 'speed', 'endless')),
    )


def _with_limits(joints, entries, link):
    """Return the joints with the limits that the site gives, by name."""
    by_name = {joint.name: joint for joint in joints}
    for entry in entries:
        name = entry.get('name') if isinstance(entry, Mapping) else None
        if name not in by_name:
            raise InputError(
                f"joints of the site must be on the way to '{link}': {_listed(by_name)}; got"
                f' {name!r}',
                code='joint_unknown',
            )
        known = by_name[name]
        limits = mapping({'name': text()}, LIMITS[known.type], closed=True)
        require(entry, replace(SITE, name=f"limits of joint '{name}'"), limits)
        given = limits_from_mapping(entry, known.type)
        better = {}
        for key, value in vars(given).items():
            if key != 'described' and value is not None and value is not False:
                better[key] = value
        if given.endless or given.lower is not None:  # a range and endless exclude each other
            better = {'lower': None, 'upper': None, 'endless': False} | better
        better['described'] = known.limits.described - set(better)
        by_name[name] = replace(known, limits=replace(known.limits, **better))
    return tuple(by_name.values())


def _listed(names):
    names = sorted(names)
    return ', '.join(names[:12]) + (f' and {len(names) - 12} more' if len(names) > 12 else '')
