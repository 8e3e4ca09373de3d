"""Messages from samples, and bags of a session."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import DEFAULT_TOPICS, standard_definition
from msg_adapters.imu import FIELDS, IMU_TYPE, N_DOUBLES, TEMPERATURE_TYPE
from msg_adapters.joint_state import (
    JOINT_STATE_TYPE,
    JOINT_TRAJECTORY_TYPE,
    CdrWriter,
    encode_trajectory,
)
from msg_adapters.layout import ENCAPSULATION_SIZE, FRAME_OFFSET, NS_PER_S, Packed, frame_head

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
    n_joints = len(joints.names)
    # The same in all messages: frame_id, names and number of positions, up to the first double.
    message = CdrWriter()
    message.data += bytes(FRAME_OFFSET - ENCAPSULATION_SIZE)  # a stamp, which `_table` has
    message.string('')
    message.integer(n_joints)
    for name in joints.names:
        message.string(name)
    message.integer(n_joints)
    if n_joints:
        message.align(8)
    # The count of the velocities needs four more bytes, because doubles are aligned to eight.
    no_items = bytes(4)  # count of an empty sequence
    velocity = [no_items]
    if with_velocity and n_joints:
        velocity = [n_joints.to_bytes(8, 'little'), joints.velocity]
    return _table(
        joints.stamp_ns,
        bytes(message.data[FRAME_OFFSET:]),
        [joints.position, *velocity, no_items],
    )


def encode_temperature(temperature: TemperatureSamples) -> np.ndarray:
    """Serialize TemperatureSamples (see `encode_imu`); the variance is unknown, 0."""
    doubles = np.zeros((len(temperature), 2), dtype='<f8')
    doubles[:, 0] = temperature.temperature_c
    return _table(temperature.stamp_ns, frame_head(''), [doubles])


def _table(stamp_ns: np.ndarray, head: bytes, pieces: Sequence[bytes | np.ndarray]) -> np.ndarray:
    """
    Return one message per row, uint8: encapsulation, stamp, `head` and the pieces.

    A piece is the same bytes for all rows, or the doubles of each row, shape (n, count).
    """
    n = len(stamp_ns)
    stamps = np.empty((n, 2), dtype='<i4')
    stamps[:, 0], stamps[:, 1] = np.divmod(np.asarray(stamp_ns, dtype=np.int64), NS_PER_S)
    columns = [_constant(b'\0\x01\0\0', n), stamps.view(np.uint8), _constant(head, n)]
    for piece in pieces:
        if isinstance(piece, bytes):
            columns.append(_constant(piece, n))
        else:
            columns.append(np.ascontiguousarray(piece, dtype='<f8').view(np.uint8))
    return np.concatenate(columns, axis=1)


def _constant(data: bytes, n: int) -> np.ndarray:
    """Return the same bytes in each of n rows, uint8, shape (n, n_bytes)."""
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
    encode = partial(encode_imu, force_cov=force_cov, rate_cov=rate_cov)
    streams = [_Stream(imu_topic, IMU_TYPE, imu, encode)]
    if joints is not None:
        has_velocity = not np.isnan(joints.velocity).all()
        encode = partial(encode_joints, with_velocity=has_velocity)
        streams.append(_Stream(joint_topic, JOINT_STATE_TYPE, joints, encode))
    if temperature is not None:
        streams.append(
            _Stream(temperature_topic, TEMPERATURE_TYPE, temperature, encode_temperature)
        )
    with BagWriter(path, storage, **options) as bag:
        topic_ids = []
        for stream in streams:
            topic_ids.append(bag.add_topic(stream.topic, standard_definition(stream.message_type)))
        for parts in _batches([stream.received_ns for stream in streams]):
            _write_batch(bag, streams, topic_ids, parts)


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


@dataclass(frozen=True, eq=False)
class _Stream:
    """Samples of one topic of a session."""

    topic: str
    message_type: str
    samples: Any
    encode: Callable[[Any], np.ndarray]
    """Samples -> one message per row, uint8."""

    @cached_property
    def received_ns(self) -> np.ndarray:
        """Receive times, ascending, int64, shape (n,)."""
        return np.maximum.accumulate(self.samples.stamp_ns)


def _batches(received_ns: Sequence[np.ndarray]) -> Iterator[list[slice]]:
    """
    Yield the slice of each stream for consecutive intervals of time.

    An interval has about `WRITE_BATCH` messages of all streams. `received_ns`: ascending times of
    each stream.
    """
    all_times = np.sort(np.concatenate(received_ns), kind='stable')
    starts = [0] * len(received_ns)
    for limit in all_times[WRITE_BATCH::WRITE_BATCH]:
        ends = [int(np.searchsorted(times, limit)) for times in received_ns]
        yield [slice(start, end) for start, end in zip(starts, ends, strict=True)]
        starts = ends
    yield [slice(start, len(times)) for start, times in zip(starts, received_ns, strict=True)]


def _write_batch(
    bag: BagWriter,
    streams: Sequence[_Stream],
    topic_ids: Sequence[int],
    parts: Sequence[slice],
) -> None:
    """Write one slice of each stream, in the order of the receive times."""
    times = []
    ids = []
    messages = []
    for stream, topic_id, part in zip(streams, topic_ids, parts, strict=True):
        times.append(stream.received_ns[part])
        ids.append(np.full(part.stop - part.start, topic_id))
        messages.append(Packed.of_rows(stream.encode(stream.samples.select(part))))
    received_ns = np.concatenate(times)
    order = np.argsort(received_ns, kind='stable')
    bag.write(np.concatenate(ids)[order], received_ns[order], Packed.chain(messages).select(order))
