"""Writing and reading back: both storages, checked against rosbags."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from imu_calibration.samples import ImuSamples, JointSamples, TemperatureSamples
from msg_adapters.bag import open_recording
from msg_adapters.write import write_session

START_NS = 1_700_000_000_000_000_000


def make_session(n=2000, seed=0, names=('outer', 'middle', 'inner')):
    """IMU at 1 kHz, joints at 200 Hz, temperature at 1 Hz."""
    rng = np.random.default_rng(seed)
    stamp_ns = START_NS + 1_000_000 * np.arange(n)
    imu = ImuSamples(stamp_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), 'imu_link')
    joints = JointSamples(stamp_ns[::5] + 321, rng.normal(size=(len(stamp_ns[::5]), len(names))),
                          rng.normal(size=(len(stamp_ns[::5]), len(names))), names)
    return imu, joints, TemperatureSamples(stamp_ns[::1000], rng.normal(size=len(stamp_ns[::1000])))


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_session_comes_back_to_the_last_bit(tmp_path, storage):
    imu, joints, temperature = make_session()
    write_session(tmp_path / 'bag', imu, joints, temperature, storage=storage)
    with open_recording(tmp_path / 'bag') as recording:
        blocks = list(recording.blocks(('inner', 'outer', 'middle'), block_samples=700))
    assert not recording.lost and all(block.dropped is None for block in blocks)
    read = ImuSamples.concatenate(block.imu for block in blocks)
    for name in ('stamp_ns', 'force_s', 'rate_s'):
        np.testing.assert_array_equal(getattr(read, name), getattr(imu, name))
    read = JointSamples.concatenate(block.joints for block in blocks if block.joints)
    np.testing.assert_array_equal(read.position, joints.position[:, [2, 0, 1]])
    np.testing.assert_array_equal(read.velocity, joints.velocity[:, [2, 0, 1]])
    read = TemperatureSamples.concatenate(block.temperature for block in blocks if block.temperature)
    np.testing.assert_array_equal(read.temperature_c, temperature.temperature_c)


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_rosbags_reads_what_is_written(tmp_path, storage):
    imu, joints, _ = make_session(300)
    write_session(tmp_path / 'bag', imu, joints, storage=storage)
    with AnyReader([tmp_path / 'bag']) as reader:
        messages = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(reader.topics['/imu/data_raw'].connections)]
        assert reader.topics['/joint_states'].msgcount == 60
        assert reader.duration == joints.stamp_ns[-1] - imu.stamp_ns[0] + 1 or reader.duration == imu.stamp_ns[-1] - imu.stamp_ns[0] + 1
    np.testing.assert_array_equal([[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z] for m in messages], imu.force_s)
    assert {m.orientation_covariance[0] for m in messages} == {-1.0}
