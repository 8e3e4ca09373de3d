"""Message definitions: the standard ones, their hashes, and whether a bag's own definition is the standard one."""

from functools import cache
from typing import NamedTuple


class TypeDefinition(NamedTuple):
    """What a bag stores about a message type."""

    type: str
    """Name, as in sensor_msgs/msg/Imu."""
    encoding: str
    """'ros2msg' or 'ros2idl'."""
    text: str
    """The definition with everything it uses; may be empty."""
    digest: str
    """RIHS01 hash; may be empty."""


@cache
def standard_typestore():
    """Return rosbags' typestore of the current ROS 2 definitions."""
    from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores.ROS2_JAZZY)


@cache
def standard_definition(message_type):
    """Return the TypeDefinition of a standard type."""
    store = standard_typestore()
    text, _ = store.generate_msgdef(message_type, ros_version=2)
    return TypeDefinition(message_type, 'ros2msg', text, store.hash_rihs01(message_type))


def typestore_for(definitions):
    """
    Return a typestore that knows the standard types, overridden by a bag's own definitions.

    Parameters
    ----------
    definitions : dict
        Message type -> (encoding 'ros2msg' or 'ros2idl', text); empty texts are passed over.

    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    types = dict(standard_typestore().fielddefs)
    for name, (encoding, text) in definitions.items():
        if text:
            types.update(get_types_from_msg(text, name) if encoding == 'ros2msg' else get_types_from_idl(text))
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def is_standard(typestore, message_type):
    """Return whether a type and everything inside it has the fields of the standard definition."""
    standard = standard_typestore()
    return message_type in standard.fielddefs and typestore.hash_rihs01(message_type) == standard.hash_rihs01(message_type)
