"""Single serialized Imu messages: parsed, and copied with other fields; for checks and tests."""

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msg_adapters.imu import FIELDS, N_DOUBLES, find_imu_layout
from msg_adapters.layout import FRAME_OFFSET, aligned, open_header


class ImuMessage(NamedTuple):
    """One parsed message."""

    stamp_ns: int
    """Header stamp."""
    frame_id: str
    """Frame of the readings."""
    doubles: tuple
    """All 37 numbers in the order of the message; `FIELDS` gives their positions."""


def parse_imu(data: bytes) -> ImuMessage:
    """
    Parse a serialized Imu message.

    Raises
    ------
    MessageError
        When the bytes are not a plain CDR Imu message.

    """
    header, body = open_header(data), find_imu_layout(data).offsets['orientation'][0]
    return ImuMessage(
        header.stamp_ns,
        header.frame_id,
        struct.unpack_from(f'{header.order}{N_DOUBLES}d', data, body),
    )


def patch_imu(data: bytes, frame_id: str | None = None, **fields: Sequence[float]) -> bytes:
    """
    Return a copy of a serialized Imu message with some fields replaced.

    Parameters
    ----------
    data : bytes
        The message; its stamp and every field that is not named are copied bit by bit.
    frame_id : str, optional
        New frame.
    fields : array_like
        Values by the names of `FIELDS`; covariances as 3 x 3 or as nine numbers.

    """
    header, body = open_header(data), find_imu_layout(data).offsets['orientation'][0]
    order = header.order
    if frame_id is not None and frame_id.encode() != header.frame:
        frame = frame_id.encode() + b'\0'
        new_body = aligned(FRAME_OFFSET + 4 + len(frame), 8)
        data = (data[:FRAME_OFFSET] + struct.pack(order + 'I', len(frame)) + frame).ljust(
            new_body, b'\0'
        ) + data[body:]
        body = new_body
    patched = bytearray(data)
    for name, value in fields.items():
        value = np.asarray(value, dtype=float).ravel()
        place = FIELDS[name]
        struct.pack_into(
            f'{order}{place.stop - place.start}d', patched, body + 8 * place.start, *value
        )
    return bytes(patched)
