"""Header stamps and the four bytes in front of every CDR message."""

import struct
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.errors import printable

NS_PER_S = 1_000_000_000

ENCAPSULATION_SIZE = 4
"""CDR aligns relative to the byte after the encapsulation header."""

FRAME_OFFSET = ENCAPSULATION_SIZE + 8
"""Position of the length of the frame_id, after the stamp."""

LONGEST_NAME = 256
"""Bytes of a name; ROS 2 itself allows 255 for a topic."""
LONGEST_FRAME = 4096
"""Bytes of a frame_id in a message that is used; the time to compare frames grows with the square of their length."""

_STARTS = {order: struct.Struct(order + 'iII') for order in '<>'}
_BYTE_ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}


class MessageError(ValueError):
    """A serialized message does not have the layout of its type."""


class UnusableMessage(MessageError):
    """A well-formed message that gives no sample; its text is the reason to count it under."""


def byte_order(data: bytes) -> str:
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


def clean_name(name: str | bytes) -> str:
    """Return a frame, topic, type or joint name without control characters, at most `LONGEST_NAME` bytes; a recording may contain any."""
    raw = name.encode(errors='replace') if isinstance(name, str) else bytes(name)
    return printable(raw[:LONGEST_NAME].decode(errors='replace'))


class Header(NamedTuple):
    """Header of every stamped message."""

    order: str
    """Byte order of the message, '<' or '>'."""
    stamp_ns: int
    """Header stamp."""
    frame: bytes
    """frame_id without its closing zero."""
    end: int
    """First byte after the frame_id, not yet aligned."""

    @property
    def frame_id(self) -> str:
        """The frame_id as text."""
        return clean_name(self.frame)


def open_header(data: bytes) -> Header:
    """Return the Header of a serialized message (raises MessageError)."""
    order = byte_order(data)
    if len(data) < FRAME_OFFSET + 4:
        raise MessageError(f'a stamped message has at least {FRAME_OFFSET + 4} bytes, got {len(data)}')
    sec, nanosec, length = _STARTS[order].unpack_from(data, ENCAPSULATION_SIZE)
    if length > LONGEST_FRAME:
        raise MessageError(f'a frame_id must have at most {LONGEST_FRAME} bytes, got {length}')
    end = FRAME_OFFSET + 4 + length
    if end > len(data):
        raise MessageError(f'a frame_id of {length} bytes ends at byte {end}, the message has {len(data)}')
    return Header(order, to_ns(sec, nanosec), bytes(data[FRAME_OFFSET + 4:end - 1 if length else end]), end)


def aligned(position: int, size: int) -> int:
    """Return the first position from `position` on that CDR aligns to `size`; positions count from the start of the message."""
    return position + (ENCAPSULATION_SIZE - position) % size


def to_ns(sec: int, nanosec: int) -> int:
    """Return the stamp as integer nanoseconds; works on numbers and on int64 arrays."""
    return sec * NS_PER_S + nanosec


def from_ns(stamp_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (sec, nanosec) of an integer stamp; works on numbers and on int64 arrays."""
    return stamp_ns // NS_PER_S, stamp_ns % NS_PER_S


def header_stamp_ns(message: Any) -> int:
    """Return the header stamp of a message object, from rclpy or from rosbags (ROS 1 messages have nsec)."""
    stamp = message.header.stamp
    stamp_ns = to_ns(int(stamp.sec), int(stamp.nanosec))
    if abs(stamp_ns) >= 2**63:
        raise MessageError(f'a stamp must fit into 64 bits, got {stamp_ns} ns')
    return stamp_ns
