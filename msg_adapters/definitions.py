"""
Message definitions: the standard ones, and whether a bag's own definition is the standard one.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from msg_adapters.imu import IMU_TYPE, TEMPERATURE_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE, JOINT_TRAJECTORY_TYPE, standard_store

SEPARATOR = '=' * 80
MAX_DEFINITION_CHARACTERS, MAX_ELEMENTS = 100_000, 10_000
"""
Characters of a definition and elements of a message at most, an array counted by its elements.
"""
DEFAULT_TOPICS = {
    IMU_TYPE: '/imu/data_raw',
    JOINT_STATE_TYPE: '/joint_states',
    TEMPERATURE_TYPE: '/imu/temperature',
}

STANDARD_TYPES = (IMU_TYPE, JOINT_STATE_TYPE, JOINT_TRAJECTORY_TYPE, TEMPERATURE_TYPE)


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
    store = standard_store()
    return TypeDefinition(
        message_type,
        'ros2msg',
        store.generate_msgdef(message_type, ros_version=2)[0],
        store.hash_rihs01(message_type),
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
    except Exception:  # rosbags' parser raises many kinds
        return False


def _fields(text, message_type):
    """
    Return the types of a ros2msg definition with their fields.

    Without constants and default values.
    """
    from rosbags.typesys import get_types_from_msg

    return {name: fields for name, (_, fields) in get_types_from_msg(text, message_type).items()}


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
        parts = (
            [part.split('\n', 1)[1] for part in text.split(SEPARATOR + '\n')[1:]]
            if text.startswith(SEPARATOR)
            else [text]
        )
        for part in parts:
            types.update(get_types_from_idl(part))
    _require_size(types, message_type)
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


def _standard(message, message_type):
    store, fields = standard_store(), []
    for name, (kind, content) in store.fielddefs[message_type][1]:
        value = getattr(message, name)
        if kind.name == 'NAME':
            value = _standard(value, content)
        elif kind.name in ('ARRAY', 'SEQUENCE') and content[0][1][0] == 'float64':
            value = np.asarray(value, np.float64)
        fields.append(value)
    return store.types[message_type](*fields)


def _require_size(types, message_type):
    """
    Refuse a type with too many elements, recursion, or sequences of an empty type.

    A message of few bytes would fill the memory.
    """
    known = {}

    def elements(name):
        if known.setdefault(name, -1) >= 0:
            return known[name]
        known[name] = sum(_of(description) for _, description in types[name][1])
        if known[name] > MAX_ELEMENTS:
            raise ValueError(f'{name} has more than {MAX_ELEMENTS} elements')
        return known[name]

    def _of(description):
        kind, content = description
        if kind.name == 'NAME':
            if known.get(content) == -1:
                raise ValueError(f'{content} contains itself')
            return elements(content)
        if kind.name == 'BASE':
            return 1
        one = _of(content[0])
        if one == 0:
            raise ValueError(f'{message_type} has a sequence of elements without fields')
        return one * content[1] if kind.name == 'ARRAY' else one

    elements(message_type)
