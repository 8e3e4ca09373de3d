"""sensor_msgs/Temperature: by attribute and by bytes."""

import struct

import numpy as np

from imu_calibration.samples import TemperatureSamples
from msg_adapters.layout import Layout
from msg_adapters.stamps import ENCAPSULATION_SIZE, MessageError, align, byte_order, header_stamp_ns

TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'

_FRAME = ENCAPSULATION_SIZE + 8


def find_temperature_layout(data):
    """Return the Layout of a serialized Temperature message (raises MessageError)."""
    order = byte_order(data)
    if len(data) < _FRAME + 4:
        raise MessageError(f'a Temperature message has at least {_FRAME + 4} bytes, got {len(data)}')
    length, = struct.unpack_from(order + 'I', data, _FRAME)
    body = ENCAPSULATION_SIZE + align(_FRAME + length, 8)
    if len(data) < body + 16:
        raise MessageError(f'a Temperature message with a frame_id of {length} bytes has {body + 16} bytes, got {len(data)}')
    frame = bytes(data[_FRAME + 4:_FRAME + 4 + max(length - 1, 0)]).decode(errors='replace')
    return Layout(order, len(data), bytes(data), ((0, 2), (_FRAME, _FRAME + 4 + length)), {'temperature_c': (body, 1)}, (frame,))


def decode_temperature(layout, packed):
    """Decode messages of one layout into TemperatureSamples."""
    return TemperatureSamples(layout.stamp_ns(packed), layout.column(packed, 'temperature_c')[:, 0])


def temperature_row(message):
    """Return (stamp_ns, temperature) of a message object of rclpy or rosbags."""
    return header_stamp_ns(message), message.temperature


def temperature_from_rows(rows):
    """Return TemperatureSamples from what `temperature_row` gave."""
    stamp_ns, temperature_c = zip(*rows, strict=True)
    return TemperatureSamples(np.array(stamp_ns, dtype=np.int64), np.array(temperature_c, dtype=float))
