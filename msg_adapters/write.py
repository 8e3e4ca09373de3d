"""Messages from samples, and bags of a session."""

import struct
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import DEFAULT_TOPICS, standard_definition
from msg_adapters.imu import FIELDS, IMU_TYPE, N_DOUBLES, TEMPERATURE_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE, JOINT_TRAJECTORY_TYPE, encode_trajectory
from msg_adapters.layout import NS_PER_S, Packed, frame_head

NO_ORIENTATION = (0.0, 0.0, 0.0, 1.0)
UNKNOWN_COVARIANCE = (0.0,) * 9
ABSENT_COVARIANCE = (-1.0,) + (0.0,) * 8
"""
Covariances: all zeros means unknown, -1 first means that the message does not hold the quantity.
"""


def encode_imu(
    imu: ImuSamples,
    *,
    force_cov: ArrayLike = UNKNOWN_COVARIANCE,
    rate_cov: ArrayLike = UNKNOWN_COVARIANCE,
) -> np.ndarray:
    """
    Serialize ImuSamples; the orientation is declared absent.

    Returns
    -------
    table : ndarray
        uint8, shape (n, n_bytes): one plain little-endian CDR message per row.

    """
    doubles = np.zeros((len(imu), N_DOUBLES), dtype='<f8')
    columns = {
        'orientation': NO_ORIENTATION,
        'orientation_cov': ABSENT_COVARIANCE,
        'rate_s': imu.rate_s,
        'force_s': imu.force_s,
        'rate_cov': np.ravel(rate_cov),
        'force_cov': np.ravel(force_cov),
    }
    for name, value in columns.items():
        doubles[:, FIELDS[name]] = value
    for quantity, values in (('rate', imu.rate_s), ('force', imu.force_s)):
        if len(values) and np.isnan(values).all():  # absent by the definition of the message
            doubles[:, FIELDS[f'{quantity}_s']] = 0.0
            doubles[:, FIELDS[f'{quantity}_cov']] = ABSENT_COVARIANCE
    return _table(imu.stamp_ns, frame_head(imu.frame_id), [doubles])


def encode_joints(joints: JointSamples, with_velocity: bool = True) -> np.ndarray:
    """
    Serialize JointSamples (see `encode_imu`).

    With an empty sequence of velocities when these are left out.
    """
    count = struct.pack('<I', len(joints.names))
    # Joined once: a sum that grows by each of many names needs quadratic time.
    names = [_padded(_string(name), 4) for name in joints.names]
    head = b''.join([_padded(_string(''), 4), count, *names])
    velocity = [count + bytes(4), joints.velocity] if with_velocity and joints.names else [bytes(4)]
    return _table(
        joints.stamp_ns,
        _padded(head + count, 8 if joints.names else 4),
        [joints.position, *velocity, bytes(4)],
    )


def encode_temperature(temperature: TemperatureSamples) -> np.ndarray:
    """Serialize TemperatureSamples (see `encode_imu`); the variance is unknown, 0."""
    doubles = np.zeros((len(temperature), 2), dtype='<f8')
    doubles[:, 0] = temperature.temperature_c
    return _table(temperature.stamp_ns, frame_head(''), [doubles])


def _string(text):
    data = text.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def _padded(data, size):
    """Pad bytes that follow the 8 bytes of a stamp, so that their end is aligned."""
    return data + bytes(-len(data) % size)


def _table(stamp_ns, head, pieces):
    """
    Lay encapsulation, stamp, `head` and the pieces side by side.

    The pieces are constant bytes, or doubles per row.
    """
    n = len(stamp_ns)
    stamps = np.empty((n, 2), dtype='<i4')
    stamps[:, 0], stamps[:, 1] = np.divmod(np.asarray(stamp_ns, dtype=np.int64), NS_PER_S)
    columns = [_constant(b'\0\x01\0\0', n), stamps.view(np.uint8), _constant(head, n)]
    for piece in pieces:
        columns.append(
            _constant(piece, n)
            if isinstance(piece, bytes)
            else np.ascontiguousarray(piece, dtype='<f8').view(np.uint8)
        )
    return np.concatenate(columns, axis=1)


def _constant(data, n):
    return np.broadcast_to(np.frombuffer(data, dtype=np.uint8), (n, len(data)))


WRITE_BATCH = 65536
"""Messages handed to the storage at once; bounds the memory of a long recording."""


def write_session(
    path: str | PathLike[str],
    imu: ImuSamples,
    joints: JointSamples | None = None,
    *,
    temperature: TemperatureSamples | None = None,
    storage: str = 'sqlite3',
    imu_topic: str = DEFAULT_TOPICS[IMU_TYPE],
    joint_topic: str = DEFAULT_TOPICS[JOINT_STATE_TYPE],
    temperature_topic: str = DEFAULT_TOPICS[TEMPERATURE_TYPE],
    force_cov: ArrayLike = UNKNOWN_COVARIANCE,
    rate_cov: ArrayLike = UNKNOWN_COVARIANCE,
    **options: Any,
) -> None:
    """
    Write a session into a new bag; receive times are the header stamps, made monotone per topic.

    Parameters
    ----------
    path : path-like
        The rosbag2 folder to make.
    imu : ImuSamples
        Readings; NaN is written as NaN.
    joints : JointSamples, optional
        Joints; velocities that are all NaN are left out of the messages.
    temperature : TemperatureSamples, optional
        Temperatures.
    storage : str
        'sqlite3' or 'mcap'.
    force_cov, rate_cov : array_like
        Covariances for every message, shape (3, 3); zeros mean unknown.
    options : dict
        `compression` of the chunks of an mcap: '', 'zstd' or 'lz4'.

    Raises
    ------
    InputError
        When `path` exists already or cannot be written.

    """
    streams: list[tuple[str, str, Any, Callable]] = [
        (
            imu_topic,
            IMU_TYPE,
            imu,
            lambda part: encode_imu(part, force_cov=force_cov, rate_cov=rate_cov),
        )
    ]
    if joints is not None:
        keep_velocity = not np.isnan(joints.velocity).all()
        streams.append(
            (
                joint_topic,
                JOINT_STATE_TYPE,
                joints,
                lambda part: encode_joints(part, with_velocity=keep_velocity),
            )
        )
    if temperature is not None:
        streams.append((temperature_topic, TEMPERATURE_TYPE, temperature, encode_temperature))
    with BagWriter(path, storage, **options) as bag:
        ids = [
            bag.add_topic(name, standard_definition(message_type))
            for name, message_type, _, _ in streams
        ]
        received = [np.maximum.accumulate(samples.stamp_ns) for _, _, samples, _ in streams]
        for parts in _merged(received):
            _write_batch(
                bag, ids, received, [(samples, encode) for _, _, samples, encode in streams], parts
            )


def write_trajectories(
    path: str | PathLike[str],
    parts: Sequence[tuple[int, TrajectoryPoints]],
    *,
    storage: str = 'sqlite3',
) -> None:
    """
    Write joint trajectories into a new bag, each at the time (ns) at which it shall begin.

    Played back, it drives the joints.

    Raises
    ------
    InputError
        When `path` exists already or cannot be written.

    """
    with BagWriter(path, storage) as bag:
        number = bag.add_topic('joint_trajectory', standard_definition(JOINT_TRAJECTORY_TYPE))
        messages = Packed.join([encode_trajectory(points) for _, points in parts])
        bag.write(
            np.full(len(parts), number), np.array([stamp for stamp, _ in parts], np.int64), messages
        )


def _merged(received):
    """Cut the merged streams into batches; yield for each stream its slice of a batch."""
    everything = np.sort(np.concatenate(received), kind='stable')
    limits = [*everything[WRITE_BATCH::WRITE_BATCH], None]
    starts = [0] * len(received)
    for limit in limits:
        ends = [
            len(times) if limit is None else int(np.searchsorted(times, limit))
            for times in received
        ]
        yield [slice(start, end) for start, end in zip(starts, ends, strict=True)]
        starts = ends


def _write_batch(bag, ids, received, streams, parts):
    times = np.concatenate([times[part] for times, part in zip(received, parts, strict=True)])
    topic_ids = np.concatenate(
        [np.full(part.stop - part.start, topic) for topic, part in zip(ids, parts, strict=True)]
    )
    tables = [
        encode(samples.select(part)) for (samples, encode), part in zip(streams, parts, strict=True)
    ]
    order = np.argsort(times, kind='stable')
    bag.write(
        topic_ids[order],
        times[order],
        Packed.chain([Packed.of_rows(table) for table in tables]).select(order),
    )
