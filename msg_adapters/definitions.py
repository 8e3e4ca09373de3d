"""
Message definitions: the standard ones, and whether a bag's own definition is the standard one.
"""

import re
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.errors import InputError
from msg_adapters.imu import IMU_TYPE, TEMPERATURE_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE, JOINT_TRAJECTORY_TYPE

SEPARATOR = '=' * 80
MAX_DEFINITION_CHARACTERS = 100_000
"""Largest number of characters of a definition."""
MAX_ELEMENTS = 10_000
"""Largest number of elements of a message; an array counts its elements, a sequence one of them."""
DEFAULT_TOPICS = {
    IMU_TYPE: '/imu/data_raw',
    JOINT_STATE_TYPE: '/joint_states',
    TEMPERATURE_TYPE: '/imu/temperature',
}

FIELDS_OF_TYPE = {
    IMU_TYPE: """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
""",
    JOINT_STATE_TYPE: """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
""",
    JOINT_TRAJECTORY_TYPE: """\
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
""",
    TEMPERATURE_TYPE: """\
std_msgs/Header header
float64 temperature
float64 variance
""",
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
    'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec\n',
    'builtin_interfaces/msg/Duration': 'int32 sec\nuint32 nanosec\n',
    'geometry_msgs/msg/Quaternion': 'float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n',
    'geometry_msgs/msg/Vector3': 'float64 x\nfloat64 y\nfloat64 z\n',
    'trajectory_msgs/msg/JointTrajectoryPoint': """\
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
""",
}
"""
Message type -> its fields, equal in Humble and Jazzy; a test compares them with those of rosbags.

They are here because rosbags may be absent, and because it needs a third of a second for them.
"""
DIGESTS = {
    IMU_TYPE: 'RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b',
    JOINT_STATE_TYPE: 'RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e',
    JOINT_TRAJECTORY_TYPE: (
        'RIHS01_179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e'
    ),
    TEMPERATURE_TYPE: 'RIHS01_72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8',
}
"""Message type -> hash of its description in ROS 2 Jazzy (REP 2016)."""
STANDARD_TYPES = tuple(DIGESTS)


class TypeDefinition(NamedTuple):
    """A bag's entry for a message type."""

    type: str
    """Name, as in sensor_msgs/msg/Imu."""
    encoding: str
    """'ros2msg' or 'ros2idl'."""
    text: str
    """The definition with all nested types; may be empty."""
    digest: str
    """RIHS01 hash; may be empty."""


@cache
def standard_definition(message_type: str) -> TypeDefinition:
    """Return the TypeDefinition of a type that this package supports, as in ROS 2 Jazzy."""
    text = FIELDS_OF_TYPE[message_type]
    for nested in _nested_types(message_type):
        text += f'{SEPARATOR}\nMSG: {nested.replace("/msg/", "/")}\n{FIELDS_OF_TYPE[nested]}'
    return TypeDefinition(message_type, 'ros2msg', text, DIGESTS[message_type])


def _nested_types(message_type: str) -> list[str]:
    """Return the types of the fields and of their fields, each once, in the order of the fields."""
    nested = {}
    for kind, _ in _fields(FIELDS_OF_TYPE[message_type], message_type)[message_type]:
        name = kind.partition('[')[0]
        if name in FIELDS_OF_TYPE:
            nested[name] = None
            nested.update(dict.fromkeys(_nested_types(name)))
    return list(nested)


def rosbags_missing(subject: str) -> InputError:
    """Return the error for input that only rosbags reads, where it is not installed."""
    return InputError(
        f'{subject} needs the Python package rosbags, which is not installed; run'
        " 'pip install rosbags'",
        code='rosbags_missing',
    )


def is_standard(message_type: str, encoding: str, text: str) -> bool:
    """
    Return whether a definition has the fields of the standard one.

    Without a text the standard is assumed.
    """
    if not text:
        return True
    if encoding != 'ros2msg' or len(text) > MAX_DEFINITION_CHARACTERS:
        return False
    try:
        return _fields(text, message_type) == _fields(
            standard_definition(message_type).text, message_type
        )
    except ValueError:
        return False


LINE_COMMENT = re.compile(r'#.*')
FIELD = re.compile(r'(\S+)\s+(\w+)(?!\w)\s*(=?)')
"""A line of a definition: type, name, and '=' for a constant."""


def _fields(text: str, message_type: str) -> dict[str, tuple[tuple[str, str], ...]]:
    """
    Return {type: ((type, name) of each field)} of a ros2msg definition with its nested types.

    The text is the fields of `message_type`, then per nested type a line of ``=``, a line ``MSG:
    NAME`` and its fields. Comments, constants and default values are left out. ValueError for
    another text.
    """
    fields_of = {}
    for section in re.split(r'^={10,}$', text, flags=re.MULTILINE):
        lines = [LINE_COMMENT.sub('', line).strip() for line in section.splitlines()]
        lines = [line for line in lines if line]
        name = message_type
        is_nested = bool(fields_of)
        if is_nested:
            if not lines or not lines[0].startswith('MSG: '):
                raise ValueError('a part of a definition must begin with MSG')
            name = _full_name(lines.pop(0).removeprefix('MSG: ').strip(), message_type)
        fields = []
        for line in lines:
            match = FIELD.match(line)
            if match is None:
                raise ValueError(f'not a field: {line}')
            is_constant = bool(match[3])
            if not is_constant:
                fields.append((_full_name(match[1], name), match[2]))
        fields_of[name] = tuple(fields)
    return fields_of


def _full_name(kind: str, owner: str) -> str:
    """
    Return the type of a field as package/msg/Name, with its array size.

    A name without a package is basic, if in lower case, or of the package of `owner`:
    ``Vector3[3]`` in geometry_msgs/msg/Accel is ``geometry_msgs/msg/Vector3[3]``.
    """
    name, bracket, size = kind.partition('[')
    if '/' in name:
        package, _, short = name.rpartition('/')
        name = f'{package.removesuffix("/msg")}/msg/{short}'
    elif name == 'Header':
        name = 'std_msgs/msg/Header'
    elif name[:1].isupper():
        name = f'{owner.partition("/")[0]}/msg/{name}'
    return name + bracket + size


@cache
def standard_store() -> Any:
    """Return rosbags' standard types; the first call takes a third of a second."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def deserializer(
    message_type: str, definitions: dict[str, tuple[str, str]], ros1: bool = False
) -> Callable:
    """
    Return a function from message bytes to a message object, by rosbags.

    Parameters
    ----------
    message_type : str
        Type of the messages.
    definitions : dict
        Message type -> (encoding, text) of the bag; the current ROS 2 definitions are the default.
    ros1 : bool
        Whether the bytes are of ROS 1.

    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    types = dict(get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY).fielddefs)
    encoding, text = definitions.get(message_type, ('', ''))
    if len(text) > MAX_DEFINITION_CHARACTERS:
        raise ValueError(
            f'a definition of {len(text)} characters, at most {MAX_DEFINITION_CHARACTERS} are'
            ' accepted'
        )
    if text and encoding == 'ros2msg':
        types.update(get_types_from_msg(text, message_type))
    elif text:
        # One IDL text, or several, each after a separator and a line with its name.
        idl_texts = [text]
        if text.startswith(SEPARATOR):
            sections = text.split(SEPARATOR + '\n')[1:]
            idl_texts = [section.split('\n', 1)[1] for section in sections]
        for idl in idl_texts:
            types.update(get_types_from_idl(idl))
    # A message of few bytes could otherwise fill the memory.
    _ElementCounter(types, message_type).count_in_type(message_type)
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
    return lambda data: deserialize(data, message_type)


def standard_bytes(message: Any, message_type: str) -> bytes:
    """
    Return a message object of any definition as plain CDR of the standard one.

    Fields are found by their names.
    """
    return bytes(standard_store().serialize_cdr(_standard(message, message_type), message_type))


def _standard(message: Any, message_type: str) -> Any:
    """
    Return a message object of any definition as the object of the standard definition.

    rosbags describes a field as (kind, content). The content is a message type for the kind NAME,
    (basic type, size limit) for BASE, and (description of an item, size) for ARRAY and SEQUENCE.
    """
    store = standard_store()
    fields = []
    for name, (kind, content) in store.fielddefs[message_type][1]:
        value = getattr(message, name)
        if kind.name == 'NAME':
            value = _standard(value, content)
        elif kind.name in ('ARRAY', 'SEQUENCE'):
            item_kind, item_type = content[0]
            if item_kind.name == 'BASE' and item_type[0] == 'float64':
                value = np.asarray(value, np.float64)
        fields.append(value)
    return store.types[message_type](*fields)


class _ElementCounter:
    """
    Counts the elements of a message type, with one item of each sequence.

    Raises ValueError for too many elements, recursion, or sequences of an empty type. `types`:
    message type -> its entry of rosbags, which ends in the list of (name, description) of its
    fields; for descriptions see `_standard`.
    """

    def __init__(self, types: dict[str, Any], message_type: str):
        self.types = types
        self.message_type = message_type
        """The outermost type, for errors."""
        self.n_elements: dict[str, int | None] = {}
        """Type -> its elements; None while its fields are counted."""

    def count_in_type(self, name: str) -> int:
        """Return the sum of the elements of the fields of a type."""
        if name in self.n_elements:
            n_elements = self.n_elements[name]
            if n_elements is None:
                raise ValueError(f'{name} contains itself')
            return n_elements
        self.n_elements[name] = None
        fields = self.types[name][1]
        n_elements = sum(self._count_in_field(description) for _, description in fields)
        if n_elements > MAX_ELEMENTS:
            raise ValueError(f'{name} has more than {MAX_ELEMENTS} elements')
        self.n_elements[name] = n_elements
        return n_elements

    def _count_in_field(self, description: Any) -> int:
        """Return the elements of a field: of an array all, of a sequence those of one item."""
        kind, content = description
        if kind.name == 'NAME':
            return self.count_in_type(content)
        if kind.name == 'BASE':
            return 1
        item, size = content
        n_per_item = self._count_in_field(item)
        # Elements without fields need no bytes: a short message could state billions of them.
        if n_per_item == 0:
            raise ValueError(f'{self.message_type} has a sequence of elements without fields')
        if kind.name == 'ARRAY':
            return n_per_item * size
        return n_per_item
