"""One joint of a chain: motion, place and limits; and the names of the joints of a chain."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.rotations import rotation_from_rpy

MAX_TABLE_NUMBER = 1e6
"""
Largest number of a table (axis, place, angle, speed); products of larger numbers would overflow.
"""


def require_keys(mapping: Any, known: Sequence[str], what: str) -> None:
    """Refuse values that are not a mapping, and keys that are not `known`."""
    if not isinstance(mapping, Mapping):
        raise InputError(
            f'{what} must be a mapping with the keys {", ".join(known)}, got {mapping!r}; see the'
            ' table description',
            code='not_a_mapping',
        )
    for key in mapping:
        if key not in known:
            raise InputError(
                f"{what}: key '{key}' is unknown; the keys here are {', '.join(known)}",
                code='key_unknown',
            )


def unit_vector(value: Any, what: str) -> tuple[float, float, float]:
    """
    Return the direction of three numbers as a unit vector; a unit vector is returned unchanged.
    """
    vector = np.array(several_numbers(value, what))
    norm = np.linalg.norm(vector)
    if norm < 1e-9:
        raise InputError(
            f'table: {what} must not be zero, got {list(value)}; give a direction of three numbers',
            code='zero_vector',
        )
    # Idempotent, so that a table written and read again is equal.
    return tuple((vector / norm if abs(norm - 1) > 4e-16 else vector).tolist())


def several_numbers(value: Any, what: str, count: int = 3) -> tuple[float, ...]:
    """Return `count` finite numbers."""
    words = {2: 'two', 3: 'three'}[count]
    if isinstance(value, (str, bytes)) or not hasattr(value, '__len__') or len(value) != count:
        raise InputError(
            f'table: {what} must be {words} numbers, got {value!r}; correct it',
            code='three_numbers',
        )
    return tuple(finite_number(item, what, advice=f'give {words} numbers') for item in value)


def finite_number(
    value: Any,
    what: str,
    *,
    low: float = -MAX_TABLE_NUMBER,
    high: float = MAX_TABLE_NUMBER,
    advice: str = 'give a number',
) -> float:
    """
    Return one finite number within [low, high], by default the limits of any number of a table.
    """
    # YAML 1.1 reads 1e-5, without a point, as text.
    try:
        number = float('nan') if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = float('nan')
    if not np.isfinite(number):
        raise InputError(
            f'table: {what} must be a finite number, got {value!r}; {advice}', code='not_finite'
        )
    if not low <= number <= high:
        raise InputError(
            f'table: {what} must lie in [{low:g}, {high:g}], got {value!r}; {advice}',
            code='out_of_range',
        )
    return number


TYPES = ('revolute', 'prismatic')


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
    """
    Names of the fields that come from a robot description (URDF); the remaining fields are from a
    table file.
    """


@dataclass(frozen=True)
class Mimic:
    """
    A joint that follows another one: ``position = multiplier * position of the other + offset``.
    """

    joint: str
    """Name of the other."""
    multiplier: float = 1.0
    """Motion per unit of the followed joint."""
    offset: float = 0.0
    """Where it is when the other is at zero, rad or m."""


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
    Angle by which it hangs towards the ground where its axis lies level, rad (`axis_sag`):
    estimated, no description holds it.
    """
    wobble: tuple[tuple[int, complex], ...] = ()
    """
    How it leans as it turns: (turns of the lean for one of the joint, amplitude, rad), an estimate
    too.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, 'axis', unit_vector(self.axis, f"axis of joint '{self.name}'"))
        object.__setattr__(self, 'xyz', several_numbers(self.xyz, f"xyz of joint '{self.name}'"))
        object.__setattr__(
            self, 'rpy_deg', several_numbers(self.rpy_deg, f"rpy_deg of joint '{self.name}'")
        )
        if self.type not in TYPES:
            raise InputError(
                f"table: the type of joint '{self.name}' must be {' or '.join(TYPES)}, got"
                f' {self.type!r}; correct it'
            )
        _require_limits(self.limits, f"joint '{self.name}'")

    @property
    def turns(self) -> bool:
        """Whether it rotates; otherwise it slides."""
        return self.type == 'revolute'

    @property
    def leans(self) -> bool:
        """Whether its axis does not keep its direction."""
        return bool(self.sag or self.wobble)

    @property
    def source(self) -> str:
        """
        Name of the joint whose readings give its position: its own, or that of the followed joint.
        """
        return self.name if self.mimic is None else self.mimic.joint

    @property
    def mat_before(self) -> np.ndarray:
        """Joint's frame to the frame of the link before it, at joint zero, shape (3, 3)."""
        return rotation_from_rpy(np.radians(self.rpy_deg))


@dataclass(frozen=True)
class JointNames(Sequence):
    """
    Names in the readings of a chain and in the parameters of its errors.

    As a sequence: the joints with readings.
    """

    read: tuple[str, ...]
    """Joints that are read, in the order of the columns of a `JointMotion`."""
    turning: tuple[str, ...]
    """The rotating joints of them."""
    zeros: tuple[str, ...]
    """
    Joints whose zero is a separate error: the zero of the first is the azimuth, that of the last
    belongs to the mount.
    """
    angles: tuple[str, ...]
    """Angles between neighbouring axes."""
    places: tuple[str, ...] = ()
    """
    Directions of the displacement of an axis from its nominal place; those of the first axis have
    no effect.
    """
    angle_sd: float | None = None
    """Standard deviation of zeros and angles, rad; None: not given."""
    place_sd: float | None = None
    """Standard deviation of places, m; None: they are exact."""

    @classmethod
    def of(cls, names: Sequence[str], errors: Mapping[str, Any] | None = None) -> 'JointNames':
        """
        Return `names`, or if None the rotating joints without parallel neighbours.

        The second only if `errors` is not given.
        """
        if isinstance(names, cls):
            return names
        names = tuple(names)
        if errors is not None:
            known: dict[str, Any] = {
                key: tuple(value) if isinstance(value, list) else value
                for key, value in errors.items()
            }
            return cls(names, **known)
        return cls(
            names,
            names,
            names[1:-1],
            tuple(f'{a}_{b}' for a, b in zip(names, names[1:], strict=False)),
            place_names(names),
        )

    @property
    def errors(self) -> dict[str, Any] | None:
        """
        Return the arguments that `of` needs in addition to the names with readings.

        Or None if these suffice.
        """
        if self == self.of(self.read):
            return None
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != 'read'}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()
        }

    @property
    def taken_as_described(self) -> tuple[str, ...]:
        """Joints whose zero is collinear with the azimuth or with the mount."""
        return tuple(name for name in self.turning if name not in self.zeros)

    def __getitem__(self, index: int | slice) -> Any:
        return self.read[index]

    def __len__(self) -> int:
        return len(self.read)


def place_names(turning: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the places of all axes but the first: two directions across each."""
    return tuple(f'{name}_{letter}' for name, letter in product(turning[1:], 'uv'))


LIMIT_KEYS = {
    'revolute': ('range_deg', 'speed_deg_s', 'acceleration_deg_s2', 'endless'),
    'prismatic': ('range_m', 'speed_m_s', 'acceleration_m_s2'),
}
"""Keys of the limits in a table description, by type."""
_KEYS = ('name', 'axis', 'xyz', 'rpy_deg', 'type', 'mimic')


def joint_from_mapping(item: Any) -> Joint:
    """Return the joint that an entry of a table description describes."""
    kind = item.get('type') or 'revolute' if isinstance(item, Mapping) else 'revolute'
    require_keys(item, (*_KEYS, *LIMIT_KEYS.get(kind, ())), 'table joint')
    for key in ('name', 'axis'):
        if item.get(key) is None:
            raise InputError(
                f'table: every joint must have name and axis, got {item!r}; add {key}',
                code='keys_missing',
            )
    values = {key: item[key] for key in _KEYS if item.get(key) is not None}
    if 'mimic' in values:
        values['mimic'] = _mimic(values['mimic'], item['name'])
    return Joint(**values, limits=limits_from_mapping(item, kind))


def limits_from_mapping(item: Mapping, kind: str) -> JointLimits:
    """Return the limits in an entry of a table description."""
    what = f"of joint '{item.get('name')}'"
    range_key, *others = LIMIT_KEYS.get(kind, LIMIT_KEYS['revolute'])[:3]
    unit = np.radians(1.0) if range_key.endswith('_deg') else 1.0
    lower, upper = (
        (None, None)
        if item.get(range_key) is None
        else (unit * end for end in several_numbers(item[range_key], f'{range_key} {what}', 2))
    )
    endless = item.get('endless') or False
    if not isinstance(endless, bool):
        raise InputError(
            f'table: endless {what} must be true or false, got {endless!r}; correct it',
            code='not_true_or_false',
        )
    speed, acceleration = (
        None if item.get(key) is None else unit * finite_number(item[key], f'{key} {what}')
        for key in others
    )
    return JointLimits(lower, upper, speed, acceleration, endless)


def _require_limits(limits: JointLimits, what: str) -> None:
    lower, upper = limits.lower, limits.upper
    if (lower is None) != (upper is None) or (
        lower is not None and upper is not None and lower > upper
    ):
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


def _mimic(item: Any, name: str) -> Mimic:
    require_keys(item, ('joint', 'multiplier', 'offset'), f"mimic of joint '{name}'")
    numbers = {
        key: finite_number(item[key], f"mimic {key} of joint '{name}'")
        for key in ('multiplier', 'offset')
        if item.get(key) is not None
    }
    if not isinstance(item.get('joint'), str):
        raise InputError(
            f"table: mimic of joint '{name}' must name a joint, got {item.get('joint')!r}; add"
            ' joint: NAME'
        )
    return Mimic(item['joint'], **numbers)


def joint_to_mapping(joint: Joint) -> dict[str, Any]:
    """
    Return the entry that `joint_from_mapping` turns into an equal joint.

    Values at their default are omitted, except the place.
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
    limits, unit = joint.limits, np.radians(1.0) if joint.turns else 1.0
    ends = None if limits.lower is None else [limits.lower, limits.upper]
    if limits.endless:
        item['endless'] = True
    for key, value in zip(
        LIMIT_KEYS[joint.type][:3], (ends, limits.speed, limits.acceleration), strict=True
    ):
        if value is not None:
            # Twelve decimals of a degree, so that values survive reading and writing.
            item[key] = np.round(np.asarray(value) / unit, 10).tolist()
    return item
