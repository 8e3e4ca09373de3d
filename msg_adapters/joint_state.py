"""JointState and JointTrajectory messages."""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import JointSamples
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters.layout import (
    FRAME_OFFSET,
    NS_PER_S,
    Header,
    MessageError,
    MessageLayout,
    Packed,
    UnusableMessage,
    aligned,
    clean_name,
    open_header,
)

JOINT_STATE_TYPE = 'sensor_msgs/msg/JointState'

MAX_MESSAGE_JOINTS = 1000
"""Joints of a message; the time to compare names grows with their square."""
MAX_NAME_BYTES = 1 << 16
"""Bytes of the names of a message; the time to compare them grows with their square."""
MISSING_JOINT = 'JointState without every joint of the table'
NO_NAMES = 'JointState without names'
NO_POSITION = 'JointState without a position for every name'


def find_joint_layout(data: bytes) -> MessageLayout:
    """
    Return the MessageLayout of a serialized JointState message; `names` are the joint names.

    Raises
    ------
    MessageError
        When the bytes are not a plain CDR JointState.

    """
    header = open_header(data)
    cursor = _Cursor(bytes(data), header)
    try:
        # The number of names may be any one: at most as many as are accepted are read.
        n_names = cursor.count()
        names = tuple(cursor.string() for _ in range(min(n_names, MAX_MESSAGE_JOINTS)))
        if n_names > MAX_MESSAGE_JOINTS or cursor.position > MAX_NAME_BYTES:
            raise MessageError(
                f'a JointState must have at most {MAX_MESSAGE_JOINTS} joints and {MAX_NAME_BYTES}'
                ' bytes of names'
            )
        offsets = {field: cursor.doubles() for field in ('position', 'velocity', 'effort')}
    except struct.error:
        raise MessageError(
            f'a JointState of {len(data)} bytes ends before its last field'
        ) from None
    return MessageLayout(header.order, len(data), bytes(data), tuple(cursor.fixed), offsets, names)


def decode_joints(
    layout: MessageLayout, packed: Packed, joint_names: Sequence[str]
) -> JointSamples:
    """
    Decode messages of one layout, columns in the order of `joint_names`.

    Raises
    ------
    UnusableMessage
        When a joint is missing or the message has no positions.

    """
    names = list(layout.names)
    if any(name not in names for name in joint_names):
        raise UnusableMessage(MISSING_JOINT)
    if layout.offsets['position'][1] != len(names):
        raise UnusableMessage(NO_POSITION)
    columns = [names.index(name) for name in joint_names]
    position = layout.column(packed, 'position')[:, columns]
    if layout.offsets['velocity'][1] == len(names):
        velocity = layout.column(packed, 'velocity')[:, columns]
    else:
        velocity = np.full_like(position, np.nan)
    return JointSamples(layout.stamp_ns(packed), position, velocity, tuple(joint_names))


class _Cursor:
    """Steps through a message; raises struct.error at the end of the data."""

    def __init__(self, data: bytes, header: Header):
        self.data = data
        self.position = header.end
        """Next byte."""
        self.number = struct.Struct(header.order + 'I')
        self.fixed = [(0, 2), (FRAME_OFFSET, header.end)]
        """Ranges (first, last + 1) of bytes that every message of the layout must share."""

    def count(self) -> int:
        """Read a count or the length of a string, which every message of the layout must share."""
        start = aligned(self.position, 4)
        self.position = start + 4
        self.fixed.append((start, self.position))
        return self.number.unpack_from(self.data, start)[0]

    def string(self) -> str:
        """Read a string, which every message of the layout must share."""
        length = self.count()
        start = self._skip(length)
        self.fixed.append((start, self.position))
        return clean_name(self.data[start : start + max(length - 1, 0)])

    def doubles(self) -> tuple[int, int]:
        """Step over a sequence of doubles; return (offset, count)."""
        count = self.count()
        if count:
            self.position = aligned(self.position, 8)
        return self._skip(8 * count), count

    def _skip(self, size: int) -> int:
        """Step over some bytes; return the first of them."""
        start = self.position
        self.position += size
        if self.position > len(self.data):
            raise struct.error
        return start


JOINT_TRAJECTORY_TYPE = 'trajectory_msgs/msg/JointTrajectory'
_FIELDS = {'position': 'positions', 'rate': 'velocities', 'acceleration': 'accelerations'}
"""Column of TrajectoryPoints -> field of a point in the message."""


class CdrWriter:
    """Plain little-endian CDR; numbers are aligned to their size, behind four bytes in front."""

    def __init__(self) -> None:
        self.data = bytearray(b'\x00\x01\x00\x00')

    def integer(self, value: int, signed: bool = False) -> None:
        """Append an integer of four bytes."""
        self.align(4)
        self.data += value.to_bytes(4, 'little', signed=signed)

    def string(self, text: str) -> None:
        """Append a string with its length."""
        encoded = text.encode() + b'\0'
        self.integer(len(encoded))
        self.data += encoded

    def doubles(self, values: np.ndarray) -> None:
        """Append a sequence of doubles, shape (n,)."""
        self.integer(len(values))
        if len(values):
            self.align(8)
            self.data += np.asarray(values, '<f8').tobytes()

    def align(self, size: int) -> None:
        """Append zeros up to a multiple of `size`, counted without the four bytes in front."""
        self.data += bytes(-(len(self.data) - 4) % size)


def encode_trajectory(points: TrajectoryPoints) -> bytes:
    """
    Return TrajectoryPoints as plain little-endian CDR, without a frame, to begin at their arrival.
    """
    columns = points.columns()
    message = CdrWriter()
    # std_msgs/Header: no stamp, no frame.
    message.integer(0)
    message.integer(0)
    message.string('')
    message.integer(len(points.joint_names))
    for name in points.joint_names:
        message.string(name)
    message.integer(len(points.time))
    for k, time in enumerate(points.time):
        for name in _FIELDS:
            message.doubles(columns[name][k] if name in columns else np.zeros(0))
        message.doubles(np.zeros(0))  # effort
        seconds, nanoseconds = divmod(round(time * NS_PER_S), NS_PER_S)
        message.integer(seconds, signed=True)
        message.integer(nanoseconds)
    return bytes(message.data)


def trajectory_from_message(message: Any) -> TrajectoryPoints:
    """
    Return the TrajectoryPoints of a message object of rclpy or rosbags.

    Velocities or accelerations that not every point has count as not given, as in the controller's
    spline.

    Raises
    ------
    InputError
        When a position is missing, or the points are none that a controller would follow.

    """
    names = tuple(message.joint_names)
    points = message.points
    time = np.array(
        [point.time_from_start.sec + point.time_from_start.nanosec * 1e-9 for point in points],
        float,
    )
    complete = {}
    for name, field in _FIELDS.items():
        rows = [list(getattr(point, field)) for point in points]
        has_all_joints = all(len(row) == len(names) for row in rows)
        # Without points only the positions, which are required, are given.
        if has_all_joints and (rows or name == 'position'):
            complete[name] = np.array(rows, float).reshape(len(points), len(names))
    if 'position' not in complete:
        raise InputError(
            f'each point of a trajectory must have {len(names)} positions, one for each joint, some'
            ' have not; give them all',
            code='position_count',
        )
    return TrajectoryPoints(names, time, **complete)
