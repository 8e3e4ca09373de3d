"""The real recordings, against rosbags; and ROS 1 bags."""

from itertools import islice

import numpy as np
import pytest
from refusal import refused
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_typestore
from test_bag import make_session

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples
from msg_adapters.bag import open_recording
from msg_adapters.copying import copy_with_corrected
from msg_adapters.write import encode_imu, encode_joints


def by_rosbags(path, topic, limit=None):
    """Return the message objects of a topic."""
    with AnyReader([path]) as reader:
        messages = reader.messages(reader.topics[topic].connections)
        return [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in islice(messages, limit)
        ]


@pytest.mark.real_data
@pytest.mark.parametrize('name', ['ferraris', 'mpu9150_3'])
def test_imu_recordings_are_equal_to_the_last_bit(recordings, name):
    with open_recording(recordings / name, want_joints=False) as recording:
        imu = ImuSamples.concatenate(block.imu for block in recording.blocks())
        assert not recording.lost
    messages = by_rosbags(recordings / name, '/imu/data_raw')
    np.testing.assert_array_equal(
        imu.stamp_ns, [10**9 * m.header.stamp.sec + m.header.stamp.nanosec for m in messages]
    )
    for vectors, field in ((imu.force_s, 'linear_acceleration'), (imu.rate_s, 'angular_velocity')):
        np.testing.assert_array_equal(
            vectors, [[getattr(getattr(m, field), axis) for axis in 'xyz'] for m in messages]
        )
    assert imu.frame_id == messages[0].header.frame_id


@pytest.mark.real_data
def test_a_shaft_recording_is_read_whole(recordings):
    limit = 3000
    with open_recording(recordings / 'shaft_pitch_slow') as recording:
        assert recording.imu_topic == '/imu/data_raw'  # the default name, though there are two
        assert recording.duration == pytest.approx(480, abs=1)
        blocks = list(recording.blocks(['shaft']))
        counts = recording.message_counts
    imu = ImuSamples.concatenate(block.imu for block in blocks)
    joints = JointSamples.concatenate(block.joints for block in blocks)
    assert len(imu) == counts['/imu/data_raw'] and len(joints) == counts['/joint_states']
    assert np.isnan(joints.velocity).all()
    messages = by_rosbags(recordings / 'shaft_pitch_slow', '/joint_states', limit)
    np.testing.assert_array_equal(
        joints.position[:limit, 0],
        [message.position[message.name.index('shaft')] for message in messages],
    )


@pytest.mark.real_data
def test_several_imus_without_the_default_name_are_refused_with_a_list(recordings):
    with refused(InputError, 'topic_ambiguous', '/imu_1/data_raw', '/imu_3/data_raw'):
        open_recording(recordings / 'array_2', want_joints=False)
    with open_recording(
        recordings / 'array_2', imu_topic='imu_3/data_raw', want_joints=False
    ) as recording:
        assert recording.imu_topic == '/imu_3/data_raw'


def test_ros1_bags_take_the_general_path(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    ros2 = get_typestore(Stores.ROS2_JAZZY)
    imu, joints, _ = make_session(60)
    path = tmp_path / 'old.bag'
    with Writer1(path) as writer:
        for topic, kind, table in (
            ('/imu/data_raw', 'sensor_msgs/msg/Imu', encode_imu(imu)),
            ('/joint_states', 'sensor_msgs/msg/JointState', encode_joints(joints)),
        ):
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, row in enumerate(table):
                message = ros2.deserialize_cdr(row.tobytes(), kind)
                header = store.types['std_msgs/msg/Header'](
                    k, message.header.stamp, message.header.frame_id
                )
                fields = [
                    value
                    for name, value in vars(message).items()
                    if name != 'header' and name[0] != '_'
                ]
                message = store.types[kind](header, *fields)
                writer.write(connection, 10**18 + k, store.serialize_ros1(message, kind))
    with open_recording(path) as recording:
        blocks = list(recording.blocks(('inner', 'outer', 'middle')))
    np.testing.assert_array_equal(
        np.concatenate([block.imu.force_s for block in blocks]), imu.force_s
    )
    np.testing.assert_array_equal(blocks[0].imu.stamp_ns, imu.stamp_ns)
    np.testing.assert_array_equal(blocks[0].joints.velocity, joints.velocity[:, [2, 0, 1]])
    with refused(InputError, 'ros1_bag'):
        copy_with_corrected(
            path, tmp_path / 'new', '/imu/data_raw', corrected_topic='/c', correct=None
        )
