"""Data of the robot in a recording: its description, the frame of the IMU, the attitude of the robot's root."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np

from imu_calibration.core.errors import InputError
from msg_adapters.bag import open_recording
from msg_adapters.stamps import clean_name

DESCRIPTION_TOPIC = '/robot_description'
STRING_TYPE = 'std_msgs/msg/String'
STATIC_TOPIC = '/tf_static'
TF_TYPE = 'tf2_msgs/msg/TFMessage'
T = TypeVar('T')


def frame_of(path: str, imu_topic: str | None = None) -> str:
    """Return the frame_id of the first Imu message."""
    with open_recording(path, imu_topic, want_joints=False, want_temperature=False) as recording:
        for block in recording.blocks(block_samples=1):
            if block.imu is not None and len(block.imu):
                return block.imu.frame_id
    return ''


def description_in(path: str, imu_topic: str | None = None) -> str:
    """
    Return the last robot description of a recording that can be decoded.

    Raises
    ------
    InputError
        When it holds none.

    """
    texts = list(_messages(path, imu_topic, DESCRIPTION_TOPIC, STRING_TYPE, lambda message: str(message.data)))
    if not texts:
        raise InputError(f'{path} must hold the robot description on {DESCRIPTION_TOPIC} ({STRING_TYPE}), it holds none; record that '
                         'topic, or give the file', key='urdf', code='description_missing')
    return texts[-1]


def static_transforms(path: str, imu_topic: str | None = None) -> list[tuple[str, str, np.ndarray]]:
    """Return (parent, child, quaternion x y z w of the child in the parent) of every static transform of a recording."""
    return [row for rows in _messages(path, imu_topic, STATIC_TOPIC, TF_TYPE, transform_rows) for row in rows]


def transform_rows(message: Any) -> list[tuple[str, str, np.ndarray]]:
    """Return (parent, child, quaternion) of each transform of a TFMessage, as an object of rclpy or rosbags."""
    return [(clean_name(t.header.frame_id).lstrip('/'), clean_name(t.child_frame_id).lstrip('/'),
             np.array([float(getattr(t.transform.rotation, a)) for a in 'xyzw'])) for t in message.transforms]


def _messages(path, imu_topic, topic, message_type, read: Callable[[Any], T]) -> Iterator[T]:
    """Yield the result of `read` for each decodable message of a topic; no results when the recording lacks it."""
    with open_recording(path, imu_topic, want_joints=False, want_temperature=False) as recording:
        if recording.source.types.get(topic) == message_type:
            deserialize = recording.deserializer(message_type)
            for found in recording.source.stretches([topic]):
                packed = found[topic].packed
                for k in range(len(packed)):
                    with suppress(Exception):   # rosbags raises many kinds on broken bytes
                        yield read(deserialize(packed.message(k)))
