"""Recordings where rosbags, zstd or both are not installed, as after an installation by apt."""

import sys
import types
from contextlib import closing

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples
from imu_calibration.kinematics.motion_limits import TrajectoryPoints
from msg_adapters import compression
from msg_adapters.bag import open_recording
from msg_adapters.definitions import STANDARD_TYPES, _fields, is_standard, standard_definition
from msg_adapters.joint_state import JOINT_TRAJECTORY_TYPE, encode_trajectory
from msg_adapters.write import write_session

N = 500
RATE_HZ = 200


@pytest.fixture
def session():
    """One sensor for 2.5 s."""
    rng = np.random.default_rng(630)
    stamp_ns = 10**18 + (10**9 // RATE_HZ) * np.arange(N)
    force, rate = rng.normal(0, 3, (N, 3)), rng.normal(0, 1, (N, 3))
    return ImuSamples(stamp_ns, force, rate, 'imu_link')


def hide(monkeypatch, *modules):
    """Make the import of modules fail."""
    for name in modules:
        monkeypatch.setitem(sys.modules, name, None)
    compression.zstd.cache_clear()


@pytest.fixture(autouse=True)
def search_again():
    """Look for zstd again after each test."""
    yield
    compression.zstd.cache_clear()


HIDDEN = ('rosbags', 'rosbags.typesys', 'rosbags.rosbag1', 'backports.zstd', 'compression.zstd')


def samples_of(path):
    """All Imu samples of a recording."""
    with open_recording(path, want_joints=False) as bag:
        return ImuSamples.concatenate([block.imu for block in bag.blocks()])


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_a_bag_is_written_and_read_without_rosbags(session, storage, tmp_path, monkeypatch):
    hide(monkeypatch, *HIDDEN)
    write_session(tmp_path / 'bag', session, storage=storage)
    found = samples_of(tmp_path / 'bag')
    np.testing.assert_array_equal(found.force_s, session.force_s)
    np.testing.assert_array_equal(found.stamp_ns, session.stamp_ns)


def test_a_ros1_bag_is_refused_in_one_line(tmp_path, monkeypatch):
    hide(monkeypatch, *HIDDEN)
    (tmp_path / 'old.bag').write_bytes(b'#ROSBAG V2.0\n')
    with refused(InputError, 'rosbags_missing', 'old.bag'):
        open_recording(tmp_path / 'old.bag')


def test_a_packed_bag_is_refused_without_a_way_to_unpack_it(session, tmp_path, monkeypatch):
    write_session(tmp_path / 'bag', session, storage='mcap', compression='zstd')
    hide(monkeypatch, *HIDDEN, 'rosbag2_py')
    with refused(InputError, 'compression_missing', 'backports.zstd'):
        samples_of(tmp_path / 'bag')


def stand_in_for_rosbag2_py(path):
    """A module with the names of rosbag2_py that are used; it reads a copy without compression."""
    opened = []

    class SequentialReader:
        def open(self, storage, converter):
            opened.append((storage.uri, storage.storage_id))
            self.messages = iter(stored_messages(path))
            self.waiting = next(self.messages, None)

        def get_all_topics_and_types(self):
            return [types.SimpleNamespace(name='/imu/data_raw', type='sensor_msgs/msg/Imu')]

        def get_metadata(self):
            topic = self.get_all_topics_and_types()[0]
            entry = types.SimpleNamespace(topic_metadata=topic, message_count=N)
            return types.SimpleNamespace(
                topics_with_message_count=[entry],
                starting_time=types.SimpleNamespace(nanoseconds=10**18),
                duration=types.SimpleNamespace(nanoseconds=10**9),
            )

        def set_filter(self, storage_filter):
            assert storage_filter.topics == ['/imu/data_raw']

        def has_next(self):
            return self.waiting is not None

        def read_next(self):
            message, self.waiting = self.waiting, next(self.messages, None)
            return message

    return types.SimpleNamespace(
        SequentialReader=SequentialReader,
        SequentialCompressionReader=SequentialReader,
        StorageOptions=types.SimpleNamespace,
        ConverterOptions=lambda *formats: formats,
        StorageFilter=types.SimpleNamespace,
        opened=opened,
    )


def stored_messages(path):
    """Yield (topic, data, receive time) of a plain recording."""
    from msg_adapters.rosbag2 import Rosbag2

    with closing(Rosbag2(path)) as source:
        for raw in source.stretches(['/imu/data_raw']):
            packed, received_ns = raw.of(0)
            for k, time in enumerate(received_ns()):
                yield '/imu/data_raw', bytes(packed.message(k)), int(time)


def test_a_packed_bag_is_read_through_rosbag2_py(session, tmp_path, monkeypatch):
    write_session(tmp_path / 'plain', session)
    write_session(tmp_path / 'packed', session, storage='mcap', compression='zstd')
    module = stand_in_for_rosbag2_py(tmp_path / 'plain')
    hide(monkeypatch, *HIDDEN)
    monkeypatch.setitem(sys.modules, 'rosbag2_py', module)
    found = samples_of(tmp_path / 'packed')
    np.testing.assert_array_equal(found.rate_s, session.rate_s)
    np.testing.assert_array_equal(found.stamp_ns, session.stamp_ns)
    assert set(module.opened) == {(str(tmp_path / 'packed'), 'mcap')}


def test_a_plain_bag_is_read_without_rosbag2_py_although_it_is_there(
    session, tmp_path, monkeypatch
):
    write_session(tmp_path / 'plain', session)
    module = stand_in_for_rosbag2_py(tmp_path / 'plain')
    hide(monkeypatch, *HIDDEN)
    monkeypatch.setitem(sys.modules, 'rosbag2_py', module)
    assert len(samples_of(tmp_path / 'plain')) == N
    assert module.opened == []


@pytest.mark.parametrize('message_type', STANDARD_TYPES)
@pytest.mark.parametrize('distribution', ['ROS2_HUMBLE', 'ROS2_JAZZY'])
def test_definitions_are_those_of_humble_and_jazzy(message_type, distribution):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(getattr(Stores, distribution))
    text, digest = standard_definition(message_type)[2:]
    assert text == store.generate_msgdef(message_type, ros_version=2)[0]
    assert digest == store.hash_rihs01(message_type)


DECORATED = """\
# a comment = with a sign
uint8 LEVEL=3
std_msgs/msg/Header header  # stamp
float64 temperature 20.0
string NAME = "x"
float64 variance
"""


def test_comments_constants_and_defaults_do_not_make_another_definition():
    kind = 'sensor_msgs/msg/Temperature'
    nested = standard_definition(kind).text.partition('=' * 80)[2]
    assert is_standard(kind, 'ros2msg', f'{DECORATED}{"=" * 80}{nested}')
    changed = DECORATED.replace('float64 variance', 'float32 variance')
    assert not is_standard(kind, 'ros2msg', f'{changed}{"=" * 80}{nested}')
    assert not is_standard(kind, 'ros2msg', 'float64')


def test_bounded_and_local_types_have_full_names():
    text = 'string<=10[<=3] names\nPoint32[2] corners\ngeometry_msgs/Vector3 size\n'
    assert _fields(text, 'my_msgs/msg/Box')['my_msgs/msg/Box'] == (
        ('string<=10[<=3]', 'names'),
        ('my_msgs/msg/Point32[2]', 'corners'),
        ('geometry_msgs/msg/Vector3', 'size'),
    )


@pytest.mark.parametrize('with_rates', [False, True])
def test_a_trajectory_has_the_bytes_of_rosbags(with_rates):
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    position = np.array([[0.1, -2.0], [0.5, 3.0]])
    rate = position * [[2], [0]] if with_rates else None
    points = TrajectoryPoints(('yaw', 'pitch1'), np.array([0.25, 1.5]), position, rate)
    data = encode_trajectory(points)
    message = store.deserialize_cdr(data, JOINT_TRAJECTORY_TYPE)
    assert bytes(store.serialize_cdr(message, JOINT_TRAJECTORY_TYPE)) == data
    assert message.joint_names == ['yaw', 'pitch1']
    assert message.points[1].time_from_start.nanosec == 500_000_000
    np.testing.assert_array_equal(message.points[1].positions, position[1])
    assert len(message.points[0].velocities) == 2 * with_rates
