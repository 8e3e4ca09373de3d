"""sensor_msgs/JointState: names in any order, velocities that may be missing, more joints than the table has."""

import struct

import numpy as np

from imu_calibration.samples import JointSamples
from msg_adapters.layout import Layout
from msg_adapters.stamps import ENCAPSULATION_SIZE, MessageError, UnusableMessage, align, byte_order, header_stamp_ns

JOINT_STATE_TYPE = 'sensor_msgs/msg/JointState'

MISSING_JOINT = 'JointState without every joint of the table'
NO_POSITION = 'JointState without a position for every name'


def find_joint_layout(data):
    """
    Return the Layout of a serialized JointState message; `names` are the joint names.

    Raises
    ------
    MessageError
        When the bytes are not a plain CDR JointState.

    """
    order = byte_order(data)
    try:
        return _walk(bytes(data), order)
    except (struct.error, IndexError):
        raise MessageError(f'a JointState of {len(data)} bytes ends before its last field') from None


def decode_joints(layout, packed, joint_names):
    """
    Decode messages of one layout, columns in the order of `joint_names`.

    Raises
    ------
    UnusableMessage
        When a joint is missing or the message has no positions.

    """
    columns = joint_columns(layout.names, layout.offsets['position'][1], joint_names)
    position = layout.column(packed, 'position')[:, columns]
    if layout.offsets['velocity'][1] == len(layout.names):
        velocity = layout.column(packed, 'velocity')[:, columns]
    else:
        velocity = np.full_like(position, np.nan)
    return JointSamples(layout.stamp_ns(packed), position, velocity, tuple(joint_names))


def joint_row(message, joint_names):
    """Return (stamp_ns, positions, velocities) of a message object of rclpy or rosbags (raises UnusableMessage)."""
    columns = joint_columns(message.name, len(message.position), joint_names)
    has_velocity = len(message.velocity) == len(message.name)
    velocity = [message.velocity[k] for k in columns] if has_velocity else [np.nan] * len(columns)
    return header_stamp_ns(message), [message.position[k] for k in columns], velocity


def joints_from_rows(rows, joint_names):
    """Return JointSamples from what `joint_row` gave."""
    stamp_ns, position, velocity = zip(*rows, strict=True)
    return JointSamples(np.array(stamp_ns, dtype=np.int64), np.array(position, dtype=float), np.array(velocity, dtype=float),
                        tuple(joint_names))


def joint_columns(names, n_positions, joint_names):
    """Return where in a message that names `names` the joints stand (raises UnusableMessage)."""
    names = list(names)
    if any(name not in names for name in joint_names):
        raise UnusableMessage(MISSING_JOINT)
    if n_positions != len(names):
        raise UnusableMessage(NO_POSITION)
    return [names.index(name) for name in joint_names]


def _walk(data, order):
    """Step through header, names and the three sequences; raises struct.error or IndexError at the end of the data."""
    count_at = struct.Struct(order + 'I')
    start = position = ENCAPSULATION_SIZE + 8
    fixed = [(0, 2)]

    def skip_string(position):
        length, = count_at.unpack_from(data, position)
        fixed.append((position, position + 4 + length))
        if position + 4 + length > len(data):
            raise IndexError
        return data[position + 4:position + 4 + max(length - 1, 0)].decode(errors='replace'), position + 4 + length

    def aligned(position, size):
        return ENCAPSULATION_SIZE + align(position - ENCAPSULATION_SIZE, size)

    _, position = skip_string(start)
    position = aligned(position, 4)
    n_names, = count_at.unpack_from(data, position)
    fixed.append((position, position + 4))
    position, names = position + 4, []
    for _ in range(n_names):
        name, position = skip_string(aligned(position, 4))
        names.append(name)
    offsets = {}
    for field in ('position', 'velocity', 'effort'):
        position = aligned(position, 4)
        count, = count_at.unpack_from(data, position)
        fixed.append((position, position + 4))
        position = aligned(position + 4, 8) if count else position + 4
        offsets[field] = (position, count)
        position += 8 * count
        if position > len(data):
            raise IndexError
    return Layout(order, len(data), data, tuple(fixed), offsets, tuple(names))
