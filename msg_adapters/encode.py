"""Samples to serialized messages of one size each: numpy fills a byte table, one row per message."""

import struct
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from msg_adapters.imu import FIELDS, N_DOUBLES
from msg_adapters.stamps import from_ns

NO_ORIENTATION = (0.0, 0.0, 0.0, 1.0)
UNKNOWN = (0.0,) * 9
ABSENT = (-1.0,) + (0.0,) * 8
"""Covariances: all zeros means unknown, -1 first means that the message does not hold the quantity."""


def encode_imu(imu: ImuSamples, frame_id: str | None = None, force_cov: ArrayLike = UNKNOWN, *,
               rate_cov: ArrayLike = UNKNOWN) -> np.ndarray:
    """
    Serialize ImuSamples; the orientation is declared absent.

    Returns
    -------
    table : ndarray
        uint8, shape (n, n_bytes): one plain little-endian CDR message per row.

    """
    doubles = np.zeros((len(imu), N_DOUBLES), dtype='<f8')
    columns = {'orientation': NO_ORIENTATION, 'orientation_cov': ABSENT, 'rate_s': imu.rate_s, 'force_s': imu.force_s,
               'rate_cov': np.ravel(rate_cov), 'force_cov': np.ravel(force_cov)}
    for name, value in columns.items():
        doubles[:, FIELDS[name]] = value
    return _table(imu.stamp_ns, _head(imu.frame_id if frame_id is None else frame_id, 8), [doubles])


def encode_joints(joints: JointSamples, frame_id: str = '', with_velocity: bool = True) -> np.ndarray:
    """Serialize JointSamples (see `encode_imu`), with an empty sequence of velocities when these are left out."""
    names = b''
    for name in joints.names:
        names = _padded(names, 4) + _string(name)
    head = _head(frame_id, 4) + struct.pack('<I', len(joints.names)) + names
    count = struct.pack('<I', len(joints.names))
    pieces: list[Any] = [joints.position]
    if with_velocity and joints.names:
        pieces += [count + bytes(4), joints.velocity]
    else:
        pieces += [bytes(4)]
    return _table(joints.stamp_ns, _padded(_padded(head, 4) + count, 8 if joints.names else 4), [*pieces, bytes(4)])


def encode_temperature(temperature: TemperatureSamples, frame_id: str = '') -> np.ndarray:
    """Serialize TemperatureSamples (see `encode_imu`); the variance is unknown, 0."""
    doubles = np.zeros((len(temperature), 2), dtype='<f8')
    doubles[:, 0] = temperature.temperature_c
    return _table(temperature.stamp_ns, _head(frame_id, 8), [doubles])


def rows(table: np.ndarray) -> list[memoryview]:
    """Return one memoryview per row of a contiguous byte table."""
    view, size = table.data.cast('B'), table.shape[1]
    return [view[start:start + size] for start in range(0, table.size, size)]


def _head(frame_id, alignment):
    """Bytes of the frame_id after the stamp, padded for the field that follows."""
    return _padded(_string(frame_id), alignment)


def _string(text):
    data = text.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def _padded(data, size):
    """Pad bytes that follow the 8 bytes of a stamp, so that their end is aligned."""
    return data + bytes(-len(data) % size)


def _table(stamp_ns, head, pieces):
    """Lay encapsulation, stamp, `head` and the pieces (constant bytes, or doubles per row) side by side."""
    n = len(stamp_ns)
    stamps = np.empty((n, 2), dtype='<i4')
    sec, nanosec = from_ns(np.asarray(stamp_ns, dtype=np.int64))
    stamps[:, 0], stamps[:, 1] = sec, nanosec
    columns = [_constant(b'\0\x01\0\0', n), stamps.view(np.uint8), _constant(head, n)]
    for piece in pieces:
        columns.append(_constant(piece, n) if isinstance(piece, bytes) else np.ascontiguousarray(piece, dtype='<f8').view(np.uint8))
    return np.concatenate(columns, axis=1)


def _constant(data, n):
    return np.broadcast_to(np.frombuffer(data, dtype=np.uint8), (n, len(data)))
