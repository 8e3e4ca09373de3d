"""Writing and reading back: both storages, checked against rosbags."""

import numpy as np
import pytest
from refusal import refused
from rosbags.highlevel import AnyReader

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session

START_NS = 1_700_000_000_000_000_000


def make_session(n=2000, seed=0, names=('outer', 'middle', 'inner')):
    """IMU at 1 kHz, joints at 200 Hz, temperature at 1 Hz."""
    rng = np.random.default_rng(seed)
    stamp_ns = START_NS + 1_000_000 * np.arange(n)
    imu = ImuSamples(stamp_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), 'imu_link')
    joints = JointSamples(
        stamp_ns[::5] + 321,
        rng.normal(size=(len(stamp_ns[::5]), len(names))),
        rng.normal(size=(len(stamp_ns[::5]), len(names))),
        names,
    )
    return imu, joints, TemperatureSamples(stamp_ns[::1000], rng.normal(size=len(stamp_ns[::1000])))


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_session_comes_back_to_the_last_bit(tmp_path, storage):
    imu, joints, temperature = make_session()
    write_session(tmp_path / 'bag', imu, joints, temperature=temperature, storage=storage)
    with open_recording(tmp_path / 'bag') as recording:
        blocks = list(recording.blocks(('inner', 'outer', 'middle'), block_samples=700))
    assert not recording.lost and all(block.dropped is None for block in blocks)
    read = ImuSamples.concatenate(block.imu for block in blocks)
    for name in ('stamp_ns', 'force_s', 'rate_s'):
        np.testing.assert_array_equal(getattr(read, name), getattr(imu, name))
    read = JointSamples.concatenate(block.joints for block in blocks if block.joints)
    np.testing.assert_array_equal(read.position, joints.position[:, [2, 0, 1]])
    np.testing.assert_array_equal(read.velocity, joints.velocity[:, [2, 0, 1]])
    read = TemperatureSamples.concatenate(
        block.temperature for block in blocks if block.temperature
    )
    np.testing.assert_array_equal(read.temperature_c, temperature.temperature_c)


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_rosbags_reads_what_is_written(tmp_path, storage):
    imu, joints, _ = make_session(300)
    write_session(tmp_path / 'bag', imu, joints, storage=storage)
    with AnyReader([tmp_path / 'bag']) as reader:
        messages = [
            reader.deserialize(data, c.msgtype)
            for c, _, data in reader.messages(reader.topics['/imu/data_raw'].connections)
        ]
        assert reader.topics['/joint_states'].msgcount == 60
        assert (
            reader.duration == joints.stamp_ns[-1] - imu.stamp_ns[0] + 1
            or reader.duration == imu.stamp_ns[-1] - imu.stamp_ns[0] + 1
        )
    force_s = [
        [m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z]
        for m in messages
    ]
    np.testing.assert_array_equal(force_s, imu.force_s)
    assert {m.orientation_covariance[0] for m in messages} == {-1.0}


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_the_same_session_gives_the_same_bytes(tmp_path, storage):
    session = make_session()
    for folder in ('a', 'b'):
        write_session(
            tmp_path / folder / 'bag', *session[:2], temperature=session[2], storage=storage
        )
    for path in sorted((tmp_path / 'a' / 'bag').iterdir()):
        assert path.read_bytes() == (tmp_path / 'b' / 'bag' / path.name).read_bytes()


def test_stamps_come_from_the_header_and_keep_their_disorder(tmp_path):
    imu, joints, _ = make_session(400)
    stamp_ns = imu.stamp_ns.copy()
    stamp_ns[100:110] = stamp_ns[50]  # repeated
    stamp_ns[200:210] -= 5_000_000_000  # backward
    imu = ImuSamples(stamp_ns, imu.force_s, imu.rate_s, imu.frame_id)
    write_session(tmp_path / 'bag', imu, joints)
    with open_recording(tmp_path / 'bag') as recording:
        (block,) = recording.blocks()
    np.testing.assert_array_equal(block.imu.stamp_ns, stamp_ns)
    np.testing.assert_array_equal(block.imu.force_s, imu.force_s)


def test_blocks_hold_the_same_stretch_of_every_topic(tmp_path):
    imu, joints, temperature = make_session(40000)
    write_session(tmp_path / 'bag', imu, joints, temperature=temperature, storage='mcap')
    with open_recording(tmp_path / 'bag') as recording:
        blocks = list(recording.blocks(block_samples=5000))
    assert len(blocks) > 2
    for block in blocks:
        assert abs(block.imu.stamp_ns[0] - block.joints.stamp_ns[0]) < 10_000_000
        assert abs(block.imu.stamp_ns[-1] - block.joints.stamp_ns[-1]) < 10_000_000


def test_topics_are_chosen_by_name_then_default_then_type(tmp_path):
    imu, joints, temperature = make_session(20)
    write_session(
        tmp_path / 'bag',
        imu,
        joints,
        temperature=temperature,
        imu_topic='/my/imu',
        joint_topic='/my/joints',
    )
    with open_recording(tmp_path / 'bag') as recording:
        assert (recording.imu_topic, recording.joint_topic, recording.temperature_topic) == (
            '/my/imu',
            '/my/joints',
            '/imu/temperature',
        )
        assert [(topic.name, topic.count) for topic in recording.topics] == [
            ('/imu/temperature', 1),
            ('/my/imu', 20),
            ('/my/joints', 4),
        ]
    with refused(InputError, 'topic_unknown', 'sensor_msgs/msg/Imu', '/imu', '/my/imu'):
        open_recording(tmp_path / 'bag', imu_topic='/imu')
    with refused(
        InputError, 'topic_unknown', 'sensor_msgs/msg/JointState', '/my/imu', '/my/joints'
    ):
        open_recording(tmp_path / 'bag', joint_topic='/my/imu')
    write_session(tmp_path / 'alone', imu)
    with refused(InputError, 'no_topic_of_type', 'sensor_msgs/msg/JointState', '/imu/data_raw'):
        open_recording(tmp_path / 'alone')
    with open_recording(tmp_path / 'alone', want_joints='optional') as recording:
        assert recording.joint_topic is None and recording.temperature_topic is None


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_an_empty_topic_is_a_recording_without_blocks(tmp_path, storage):
    imu, joints, _ = make_session(5)
    write_session(tmp_path / 'bag', imu.select(slice(0)), joints.select(slice(0)), storage=storage)
    with open_recording(tmp_path / 'bag') as recording:
        assert list(recording.blocks()) == [] and recording.duration == 0 and not recording.lost


@pytest.mark.parametrize(
    'make', [lambda path: None, lambda path: path.mkdir(), lambda path: path.write_text('no bag')]
)
def test_what_is_no_bag_is_refused_in_one_line(tmp_path, make):
    for name in ('x', 'x.db3', 'x.mcap', 'x.bag'):
        make(tmp_path / name)
        with pytest.raises(InputError) as error:
            open_recording(tmp_path / name)
        assert '\n' not in str(error.value) and name in str(error.value)


def test_reading_may_stop_early_and_start_again(tmp_path):
    session = make_session(5000)
    write_session(tmp_path / 'bag', *session[:2], temperature=session[2])
    with open_recording(tmp_path / 'bag') as recording:
        for _ in range(3):
            assert next(iter(recording.blocks(block_samples=1))).imu is not None
        assert sum(len(block.imu) for block in recording.blocks()) == 5000
