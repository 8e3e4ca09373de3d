"""One joint of a chain: motion, place and limits; and the names of the joints of a chain."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.schema import (
    Document,
    Requirement,
    Unmet,
    flag,
    list_of,
    mapping,
    maybe,
    number,
    require,
    text,
)
from imu_calibration.kinematics.rotations import rotation_from_rpy

MAX_TABLE_NUMBER = 1e6
"""
Largest number of a table (axis, place, angle, speed); products of larger numbers would overflow.
"""


def table_number(
    low: float = -MAX_TABLE_NUMBER, high: float = MAX_TABLE_NUMBER, *, above: bool = False
) -> Requirement:
    """
    Return the requirement of a number or its text, as YAML 1.1 reads 1e-5 as text.

    Arguments as for `schema.number`.
    """
    within = number(low, high, above=above)

    def check(value: Any, place: str) -> None:
        """Convert a text to a number, if possible, and require the number."""
        if isinstance(value, str):
            try:
                value = float(value)
            except ValueError:
                pass
        within(value, place)

    return check


THREE_NUMBERS = list_of(table_number(), 3)


def direction(value: Any, place: str) -> None:
    """Require three numbers that are not all zero."""
    THREE_NUMBERS(value, place)
    if np.linalg.norm(np.array(value, float)) < 1e-9:
        raise Unmet('range', place, 'not be zero', received=list(value), code='zero_vector')


def table_document(parts: Requirement, name: str = 'table') -> Document:
    """Return the declaration of a table or of a part of it."""
    return Document(
        name,
        parts,
        'correct the description (m, m/s^2; angles in the unit of their name, latitude in degrees)',
        {'type': 'not_finite', 'range': 'out_of_range', 'length': 'three_numbers'},
        InputError,
    )


def three_numbers(value: Any, what: str) -> tuple[float, ...]:
    """Return three finite numbers, required of a value that is not a part of a document."""
    require({what: value}, table_document(mapping(each=THREE_NUMBERS)))
    return tuple(float(item) for item in value)


def unit_vector(value: Any) -> tuple[float, float, float]:
    """Return a `direction` as a unit vector; a unit vector is returned unchanged."""
    vector = np.array(value, float)
    norm = np.linalg.norm(vector)
    # Idempotent, so that a table written and read again is equal.
    return tuple((vector / norm if abs(norm - 1) > 4e-16 else vector).tolist())


TYPES = ('revolute', 'prismatic')
"""Joints that turn, and joints that slide."""
_PLACE = {
    'axis': direction,
    'xyz': THREE_NUMBERS,
    'rpy_deg': THREE_NUMBERS,
    'type': text(*TYPES),
}
"""Field of a `Joint` for its motion and place -> requirement."""


@dataclass(frozen=True)
class JointLimits:
    """
    Range, speed and acceleration of a joint.

    Rad, rad/s, rad/s^2, or m, m/s, m/s^2 of a sliding joint; None: not given.
    """

    lower: float | None = None
    """Smallest position."""
    upper: float | None = None
    """Largest position."""
    speed: float | None = None
    """Largest speed."""
    acceleration: float | None = None
    """Largest acceleration."""
    endless: bool = False
    """Whether the joint is declared to turn without end."""
    described: frozenset[str] = field(default=frozenset(), compare=False)
    """Names of fields from a robot description (URDF); the remaining ones are from a table file."""


@dataclass(frozen=True)
class Mimic:
    """
    A joint that follows another one: ``position = multiplier * position of the other + offset``.
    """

    joint: str
    """Name of the followed joint."""
    multiplier: float = 1.0
    """Motion per unit of the followed joint."""
    offset: float = 0.0
    """Position when the followed joint is at zero, rad or m."""


@dataclass(frozen=True)
class Joint:
    """One joint that turns about its axis or slides along it."""

    name: str
    """Name in the joint states."""
    axis: tuple[float, float, float]
    """
    Unit vector in the joint's frame, that of the link it moves at joint zero (made unit here).
    """
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the joint's frame, a point of the axis, in the frame of the link before it, m."""
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """
    Joint's frame in the frame of the link before it: roll, pitch, yaw about fixed axes as in URDF,
    degrees.
    """
    type: str = 'revolute'
    """'revolute' (with or without an end) or 'prismatic'."""
    mimic: Mimic | None = None
    """Set when the joint follows another one."""
    limits: JointLimits = field(default=JointLimits())
    """Range, speed and acceleration."""
    sag: float = 0.0
    """
    Angle of the following links towards the ground where the axis is level, rad (`chain.with_sag`):
    an estimate, which no description has.
    """
    wobble: tuple[tuple[int, complex], ...] = ()
    """
    Lean of the axis as the joint turns: (turns of the lean for one turn of the joint, amplitude in
    rad) of each term (`chain.with_wobble`); an estimate too.
    """

    def __post_init__(self) -> None:
        fields_of_place = {name: getattr(self, name) for name in _PLACE}
        require(fields_of_place, table_document(mapping(_PLACE), f"table: joint '{self.name}'"))
        object.__setattr__(self, 'axis', unit_vector(self.axis))
        object.__setattr__(self, 'xyz', tuple(float(number) for number in self.xyz))
        object.__setattr__(self, 'rpy_deg', tuple(float(number) for number in self.rpy_deg))
        _require_limits(self.limits, f"joint '{self.name}'")

    @property
    def turns(self) -> bool:
        """Whether it rotates; otherwise it slides."""
        return self.type == 'revolute'

    @property
    def leans(self) -> bool:
        """Whether its axis changes its direction."""
        return bool(self.sag or self.wobble)

    @property
    def source(self) -> str:
        """Name of the joint that is read for its position: this one, or the followed one."""
        return self.name if self.mimic is None else self.mimic.joint

    @property
    def multiplier(self) -> float:
        """Its motion per unit of the joint `source`."""
        return 1.0 if self.mimic is None else self.mimic.multiplier

    @property
    def offset(self) -> float:
        """Its position where the joint `source` is at zero, rad or m."""
        return 0.0 if self.mimic is None else self.mimic.offset

    @property
    def mat_before(self) -> np.ndarray:
        """Joint's frame at joint zero to the frame of the link before, shape (3, 3)."""
        return rotation_from_rpy(np.radians(self.rpy_deg))


@dataclass(frozen=True)
class JointNames(Sequence):
    """
    Names of the joints of a chain that are read, and of the parameters of its errors.

    As a sequence it has the names of the joints that are read.
    """

    read: tuple[str, ...]
    """Joints that are read, in the order of the columns of a `JointMotion`."""
    turning: tuple[str, ...]
    """Rotating joints that are read."""
    zeros: tuple[str, ...]
    """
    Joints with a separate error of the zero. The zero of the first joint is collinear with the
    azimuth, that of the last with the mount.
    """
    angles: tuple[str, ...]
    """Errors of angles between neighbouring axes."""
    places: tuple[str, ...] = ()
    """
    Errors of the place of each axis except the first, in two directions perpendicular to the axis.
    """
    angle_sd: float | None = None
    """Standard deviation of zeros and angles, rad; None: not given."""
    place_sd: float | None = None
    """Standard deviation of places, m; None: they are exact."""

    @classmethod
    def of(cls, names: Sequence[str], errors: Mapping[str, Any] | None = None) -> 'JointNames':
        """
        Return the names for joints that are read.

        Parameters
        ----------
        names : sequence of str
            The joints that are read; `JointNames` are returned unchanged.
        errors : mapping, optional
            The remaining fields. Default: all joints turn, and no neighbouring axes are parallel.

        """
        if isinstance(names, cls):
            return names
        names = tuple(names)
        if errors is not None:
            values: dict[str, Any] = {}
            for key, value in errors.items():
                values[key] = tuple(value) if isinstance(value, list) else value
            return cls(names, **values)
        pairs = zip(names, names[1:], strict=False)
        return cls(
            read=names,
            turning=names,
            zeros=names[1:-1],
            angles=tuple(f'{first}_{second}' for first, second in pairs),
            places=place_names(names),
        )

    @property
    def errors(self) -> dict[str, Any] | None:
        """Return the argument `errors` that `of` needs for these names; None: it needs none."""
        if self == self.of(self.read):
            return None
        errors = {}
        for item in fields(self):
            if item.name != 'read':
                value = getattr(self, item.name)
                errors[item.name] = list(value) if isinstance(value, tuple) else value
        return errors

    @property
    def taken_as_described(self) -> tuple[str, ...]:
        """Turning joints without a separate error of the zero (`zeros`)."""
        return tuple(name for name in self.turning if name not in self.zeros)

    def __getitem__(self, index: int | slice) -> Any:
        return self.read[index]

    def __len__(self) -> int:
        return len(self.read)


def place_names(turning: Sequence[str]) -> tuple[str, ...]:
    """Return names of two directions, u and v, for each turning axis except the first."""
    return tuple(f'{name}_{letter}' for name, letter in product(turning[1:], 'uv'))


_RANGE = maybe(list_of(table_number(), 2))
_LARGEST = maybe(table_number(0.0, above=True))
LIMITS: dict[str, dict[str, Requirement]] = {
    'revolute': {
        'range_deg': _RANGE,
        'speed_deg_s': _LARGEST,
        'acceleration_deg_s2': _LARGEST,
        'endless': maybe(flag('not_true_or_false')),
    },
    'prismatic': {'range_m': _RANGE, 'speed_m_s': _LARGEST, 'acceleration_m_s2': _LARGEST},
}
"""Type -> requirements of the limits in a table description."""
_MIMIC = mapping(
    {'joint': text()},
    {'multiplier': maybe(table_number()), 'offset': maybe(table_number())},
    closed=True,
)


def joint_entry(value: Any, place: str) -> None:
    """Require an entry of the joints in a table description."""
    kind = None
    if isinstance(value, Mapping):
        place = f'{place} ({value.get("name")})'
        kind = value.get('type')
    mapping(
        {'name': text(), 'axis': direction},
        {
            **{name: maybe(_PLACE[name]) for name in ('xyz', 'rpy_deg', 'type')},
            'mimic': maybe(_MIMIC),
            **(LIMITS['prismatic'] if kind == 'prismatic' else LIMITS['revolute']),
        },
        closed=True,
    )(value, place)


def joint_from_mapping(item: Mapping[str, Any]) -> Joint:
    """Return the joint that a valid `joint_entry` describes."""
    values = {key: item[key] for key in ('name', *_PLACE) if item.get(key) is not None}
    mimic = item.get('mimic')
    if mimic is not None:
        numbers = {
            key: float(mimic[key]) for key in ('multiplier', 'offset') if mimic.get(key) is not None
        }
        values['mimic'] = Mimic(mimic['joint'], **numbers)
    return Joint(**values, limits=limits_from_mapping(item, values.get('type', 'revolute')))


def limits_from_mapping(item: Mapping[str, Any], kind: str) -> JointLimits:
    """Return the limits in a valid entry of a table description."""
    unit = np.radians(1.0) if kind == 'revolute' else 1.0
    range_key, speed_key, acceleration_key = list(LIMITS[kind])[:3]

    def in_si(value: Any) -> float | None:
        """Return a number in rad or m and s, or None."""
        return None if value is None else unit * float(value)

    lower, upper = item.get(range_key) or (None, None)
    return JointLimits(
        lower=in_si(lower),
        upper=in_si(upper),
        speed=in_si(item.get(speed_key)),
        acceleration=in_si(item.get(acceleration_key)),
        endless=bool(item.get('endless')),
    )


def _require_limits(limits: JointLimits, what: str) -> None:
    """Raise an InputError unless the limits of a joint are possible; `what`: the joint."""
    lower = limits.lower
    upper = limits.upper
    has_one_end = (lower is None) != (upper is None)
    if has_one_end or (lower is not None and upper is not None and lower > upper):
        raise InputError(
            f'table: the range of {what} must be a smaller and a larger number, got [{lower},'
            f' {upper}]; correct it'
        )
    if limits.endless and lower is not None:
        raise InputError(
            f'table: {what} must have a range or be endless, got both; omit one',
            code='range_and_endless',
        )
    for name in ('speed', 'acceleration'):
        value = getattr(limits, name)
        if value is not None and not value > 0:
            raise InputError(
                f'table: the largest {name} of {what} must be above zero, got {value:g}; correct or'
                ' omit it'
            )


def joint_to_mapping(joint: Joint) -> dict[str, Any]:
    """
    Return the entry of a joint in a table description, from which `joint_from_mapping` makes it.

    Values at their default are omitted, except `xyz`.
    """
    item: dict[str, Any] = {'name': joint.name, 'axis': list(joint.axis), 'xyz': list(joint.xyz)}
    if any(joint.rpy_deg):
        item['rpy_deg'] = list(joint.rpy_deg)
    if not joint.turns:
        item['type'] = joint.type
    if joint.mimic is not None:
        item['mimic'] = {
            'joint': joint.mimic.joint,
            'multiplier': joint.mimic.multiplier,
            'offset': joint.mimic.offset,
        }
    limits = joint.limits
    unit = np.radians(1.0) if joint.turns else 1.0
    ends = None if limits.lower is None else [limits.lower, limits.upper]
    if limits.endless:
        item['endless'] = True
    for key, value in zip(
        list(LIMITS[joint.type])[:3], (ends, limits.speed, limits.acceleration), strict=True
    ):
        if value is not None:
            # Ten decimals, so that values survive reading and writing.
            item[key] = np.round(np.asarray(value) / unit, 10).tolist()
    return item
