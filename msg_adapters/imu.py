"""Imu and Temperature messages."""

import numpy as np

from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from msg_adapters.layout import (
    FRAME_OFFSET,
    MessageError,
    MessageLayout,
    Packed,
    aligned,
    frame_head,
    open_header,
)

IMU_TYPE = 'sensor_msgs/msg/Imu'

N_DOUBLES = 37
FIELDS = {
    'orientation': slice(0, 4),
    'orientation_cov': slice(4, 13),
    'rate_s': slice(13, 16),
    'rate_cov': slice(16, 25),
    'force_s': slice(25, 28),
    'force_cov': slice(28, 37),
}
"""Positions in the 37 doubles after the header: x, y, z, w and row-major 3 x 3 covariances."""


def find_imu_layout(data: bytes) -> MessageLayout:
    """Return the MessageLayout of a serialized Imu message (raises MessageError)."""
    return _layout(data, 'Imu', N_DOUBLES, FIELDS)


def _layout(data: bytes, kind: str, n_doubles: int, fields: dict[str, slice]) -> MessageLayout:
    """
    Return the MessageLayout of a message with `n_doubles` doubles after its header.

    `kind`: type for errors; `fields`: name -> its doubles.
    """
    header = open_header(data)
    body = aligned(header.end, 8)
    if len(data) < body + 8 * n_doubles:
        raise MessageError(
            f'a message of type {kind} with its doubles at byte {body} has {body + 8 * n_doubles}'
            f' bytes, got {len(data)}'
        )
    offsets = {
        name: (body + 8 * place.start, place.stop - place.start) for name, place in fields.items()
    }
    return MessageLayout(
        header.order,
        len(data),
        bytes(data),
        ((0, 2), (FRAME_OFFSET, header.end)),
        offsets,
        (header.frame_id,),
    )


def decode_imu(layout: MessageLayout, packed: Packed) -> ImuSamples:
    """
    Return the ImuSamples of messages of one layout.

    A quantity declared absent (covariance -1) is NaN.
    """
    readings = {}
    for name, cov_name in (('force_s', 'force_cov'), ('rate_s', 'rate_cov')):
        values = layout.column(packed, name)
        absent = layout.column(packed, cov_name, 1)[:, 0] == -1.0
        if absent.any():
            values[absent] = np.nan
        readings[name] = values
    return ImuSamples(
        layout.stamp_ns(packed),
        force_s=readings['force_s'],
        rate_s=readings['rate_s'],
        frame_id=layout.names[0],
    )


def patch_imu_group(
    layout: MessageLayout,
    packed: Packed,
    fields: dict[str, np.ndarray],
    *,
    frame_id: str | None = None,
) -> np.ndarray:
    """
    Return copies of messages of one layout with some fields replaced.

    Parameters
    ----------
    layout, packed : MessageLayout, Packed
        The messages.
    fields : dict
        Field name -> values, shape (n, count).
    frame_id : str, optional
        New frame.

    Returns
    -------
    table : ndarray
        uint8, shape (n, n_bytes): one message per row.

    """
    rows = np.array(packed.items_at(0, f'V{layout.size}'))
    table = rows.view(np.uint8).reshape(-1, layout.size)
    for name, values in fields.items():
        offset, count = layout.offsets[name]
        table[:, offset : offset + 8 * count] = np.ascontiguousarray(
            values, dtype=layout.order + 'f8'
        ).view(np.uint8)
    if frame_id is None or frame_id == layout.names[0]:
        return table
    # The stamp, the new frame_id with its padding, and the doubles.
    head = np.frombuffer(frame_head(frame_id, layout.order), np.uint8)
    heads = np.broadcast_to(head, (len(table), len(head)))
    return np.concatenate(
        [table[:, :FRAME_OFFSET], heads, table[:, layout.offsets['orientation'][0] :]], axis=1
    )


TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'


def find_temperature_layout(data: bytes) -> MessageLayout:
    """Return the MessageLayout of a serialized Temperature message (raises MessageError)."""
    return _layout(data, 'Temperature', 2, {'temperature_c': slice(0, 1)})


def decode_temperature(layout: MessageLayout, packed: Packed) -> TemperatureSamples:
    """Decode messages of one layout into TemperatureSamples."""
    return TemperatureSamples(layout.stamp_ns(packed), layout.column(packed, 'temperature_c')[:, 0])
