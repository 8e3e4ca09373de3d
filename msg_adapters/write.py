"""Sessions from arrays into new recordings."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import DEFAULT_TOPICS, standard_definition
from msg_adapters.encode import UNKNOWN, encode_imu, encode_joints, encode_temperature, rows
from msg_adapters.imu import IMU_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE
from msg_adapters.joint_trajectory import JOINT_TRAJECTORY_TYPE, encode_trajectory
from msg_adapters.temperature import TEMPERATURE_TYPE

BATCH = 65536
"""Messages handed to the storage at once; bounds the memory of a long recording."""


def write_session(path: str | PathLike[str], imu: ImuSamples, joints: JointSamples | None = None, *,
                  temperature: TemperatureSamples | None = None, storage: str = 'sqlite3', imu_topic: str = DEFAULT_TOPICS[IMU_TYPE],
                  joint_topic: str = DEFAULT_TOPICS[JOINT_STATE_TYPE], temperature_topic: str = DEFAULT_TOPICS[TEMPERATURE_TYPE],
                  force_cov: ArrayLike = UNKNOWN, rate_cov: ArrayLike = UNKNOWN, **options: Any) -> None:
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
    streams: list[tuple[str, str, Any, Callable]] = [(imu_topic, IMU_TYPE, imu,
                                                      lambda part: encode_imu(part, force_cov=force_cov, rate_cov=rate_cov))]
    if joints is not None:
        keep_velocity = not np.isnan(joints.velocity).all()
        streams.append((joint_topic, JOINT_STATE_TYPE, joints, lambda part: encode_joints(part, with_velocity=keep_velocity)))
    if temperature is not None:
        streams.append((temperature_topic, TEMPERATURE_TYPE, temperature, encode_temperature))
    with BagWriter(path, storage, **options) as bag:
        ids = [bag.add_topic(name, standard_definition(message_type)) for name, message_type, _, _ in streams]
        received = [np.maximum.accumulate(samples.stamp_ns) for _, _, samples, _ in streams]
        for parts in _merged(received):
            _write_batch(bag, ids, received, [(samples, encode) for _, _, samples, encode in streams], parts)


def write_trajectories(path: str | PathLike[str], parts: Sequence[tuple[int, TrajectoryPoints]], *, topic: str = 'joint_trajectory',
                       storage: str = 'sqlite3') -> None:
    """
    Write joint trajectories into a new bag, each at the time (ns) at which it shall begin: played back, it drives the joints.

    Raises
    ------
    InputError
        When `path` exists already or cannot be written.

    """
    with BagWriter(path, storage) as bag:
        number = bag.add_topic(topic, standard_definition(JOINT_TRAJECTORY_TYPE))
        messages = [memoryview(encode_trajectory(points)) for _, points in parts]
        bag.write(np.full(len(parts), number), np.array([stamp for stamp, _ in parts], np.int64), messages)


def _merged(received):
    """Cut the merged streams into batches; yield for each stream its slice of a batch."""
    everything = np.sort(np.concatenate(received), kind='stable')
    limits = [*everything[BATCH::BATCH], None]
    starts = [0] * len(received)
    for limit in limits:
        ends = [len(times) if limit is None else int(np.searchsorted(times, limit)) for times in received]
        yield [slice(start, end) for start, end in zip(starts, ends, strict=True)]
        starts = ends


def _write_batch(bag, ids, received, streams, parts):
    times = np.concatenate([times[part] for times, part in zip(received, parts, strict=True)])
    topic_ids = np.concatenate([np.full(part.stop - part.start, topic) for topic, part in zip(ids, parts, strict=True)])
    messages = []
    for (samples, encode), part in zip(streams, parts, strict=True):
        if part.stop > part.start:
            messages += rows(encode(samples.select(part)))
    order = np.argsort(times, kind='stable')
    bag.write(topic_ids[order], times[order], [messages[k] for k in order.tolist()])
