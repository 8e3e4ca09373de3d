"""sensor_msgs/Temperature: by attribute and by bytes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from imu_calibration.core.samples import TemperatureSamples
from msg_adapters.layout import MessageLayout, Packed
from msg_adapters.stamps import FRAME_OFFSET, MessageError, aligned, header_stamp_ns, open_header

TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'


def find_temperature_layout(data: bytes) -> MessageLayout:
    """Return the MessageLayout of a serialized Temperature message (raises MessageError)."""
    header = open_header(data)
    body = aligned(header.end, 8)
    if len(data) < body + 16:
        raise MessageError(f'a Temperature message with its doubles at byte {body} has {body + 16} bytes, got {len(data)}')
    fixed = ((0, 2), (FRAME_OFFSET, header.end))
    return MessageLayout(header.order, len(data), bytes(data), fixed, {'temperature_c': (body, 1)},
                         (header.frame_id,))


def decode_temperature(layout: MessageLayout, packed: Packed) -> TemperatureSamples:
    """Decode messages of one layout into TemperatureSamples."""
    return TemperatureSamples(layout.stamp_ns(packed), layout.column(packed, 'temperature_c')[:, 0])


def temperature_row(message: Any) -> tuple[int, float]:
    """Return (stamp_ns, temperature) of a message object of rclpy or rosbags."""
    return header_stamp_ns(message), float(message.temperature)


def temperature_from_rows(rows: Sequence[tuple[float, float]]) -> TemperatureSamples:
    """Return TemperatureSamples from rows of `temperature_row`."""
    stamp_ns, temperature_c = zip(*rows, strict=True)
    return TemperatureSamples(np.array(stamp_ns, dtype=np.int64), np.array(temperature_c, dtype=float))
