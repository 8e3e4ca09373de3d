"""Header stamps and the four bytes in front of every CDR message."""

NS_PER_S = 1_000_000_000

ENCAPSULATION_SIZE = 4
"""CDR aligns relative to the byte after the encapsulation header."""

_BYTE_ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}


class MessageError(ValueError):
    """A serialized message does not have the layout that its type asks for."""


class UnusableMessage(MessageError):
    """A well-formed message that gives no sample; its text is the reason to count it under."""


def byte_order(data):
    """
    Return '<' or '>' from the encapsulation header of a serialized message.

    Raises
    ------
    MessageError
        When the message is not plain CDR (XCDR1), the only representation that ROS 2 uses for these types.

    """
    try:
        return _BYTE_ORDERS[bytes(data[:2])]
    except KeyError:
        raise MessageError(f'encapsulation must be plain CDR (0x0000 or 0x0001), got 0x{bytes(data[:2]).hex()}') from None


def align(position, size):
    """Return the first position from `position` on that is a multiple of `size`; both count from the encapsulation header's end."""
    return -(-position // size) * size


def to_ns(sec, nanosec):
    """Return the stamp as integer nanoseconds; works on numbers and on int64 arrays."""
    return sec * NS_PER_S + nanosec


def from_ns(stamp_ns):
    """Return (sec, nanosec) of an integer stamp; works on numbers and on int64 arrays."""
    return stamp_ns // NS_PER_S, stamp_ns % NS_PER_S


def header_stamp_ns(message):
    """Return the header stamp of a message object, from rclpy or from rosbags (ROS 1 messages say nsec)."""
    stamp = message.header.stamp
    return to_ns(int(stamp.sec), int(stamp.nanosec))
