"""Bags that are cut off, overwritten in places, compressed, or without their metadata."""

import shutil
import sqlite3
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusal import refused
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_bag import make_session

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, JointSamples
from msg_adapters.bag import open_recording
from msg_adapters.compression import zstd
from msg_adapters.definitions import standard_definition
from msg_adapters.rosbag2 import read_metadata
from msg_adapters.sqlite_file import PAGE_SIZE, STEP_IDS, SqliteFile
from msg_adapters.write import encode_imu, encode_joints, write_session

N = 9000
KINDS = {
    'sqlite3': {'storage': 'sqlite3'},
    'mcap': {'storage': 'mcap'},
    'mcap_zstd': {'storage': 'mcap', 'compression': 'zstd'},
    'mcap_lz4': {'storage': 'mcap', 'compression': 'lz4'},
}
quick = settings(
    max_examples=12,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(scope='module')
def session():
    return make_session(N)


@pytest.fixture(scope='module')
def bags(session, tmp_path_factory):
    """One bag of each kind, and a sqlite3 one compressed as a file."""
    folder = tmp_path_factory.mktemp('bags')
    for kind, options in KINDS.items():
        write_session(folder / kind, *session[:2], temperature=session[2], **options)
    shutil.copytree(folder / 'sqlite3', folder / 'sqlite3_zstd')
    plain = folder / 'sqlite3_zstd' / 'sqlite3_0.db3'
    plain.with_suffix('.db3.zstd').write_bytes(zstd().compress(plain.read_bytes()))
    plain.unlink()
    metadata = folder / 'sqlite3_zstd' / 'metadata.yaml'
    metadata.write_text(
        metadata.read_text()
        .replace("compression_format: ''", 'compression_format: zstd')
        .replace("compression_mode: ''", 'compression_mode: FILE')
        .replace('sqlite3_0.db3', 'sqlite3_0.db3.zstd')
    )
    return folder


def read(path, **options):
    """Return (ImuSamples, JointSamples, lost) of a bag; samples may be None."""
    with open_recording(path, want_joints='optional', **options) as recording:
        blocks = list(recording.blocks())
        lost = recording.lost
    imu = [block.imu for block in blocks if block.imu is not None]
    joints = [block.joints for block in blocks if block.joints is not None]
    return (
        ImuSamples.concatenate(imu) if imu else None,
        JointSamples.concatenate(joints) if joints else None,
        lost,
    )


def storage_file(folder):
    return next(path for path in folder.iterdir() if '.db3' in path.name or '.mcap' in path.name)


def damaged_copy(bags, kind, target, change):
    """Copy a bag and change the bytes of its storage file."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(bags / kind, target)
    file = storage_file(target)
    file.write_bytes(change(file.read_bytes()))
    return target


def assert_true_samples(samples, original, names):
    """Every sample is one of the originals, to the last bit, in the right order."""
    place = np.searchsorted(original.stamp_ns, samples.stamp_ns)
    assert (np.diff(place) > 0).all()
    for name in names:
        np.testing.assert_array_equal(getattr(samples, name), getattr(original, name)[place])


@pytest.mark.parametrize('kind', [*KINDS, 'sqlite3_zstd'])
def test_every_kind_is_read_whole(bags, session, kind):
    imu, joints, lost = read(bags / kind)
    assert not lost
    for name in ('stamp_ns', 'force_s', 'rate_s'):
        np.testing.assert_array_equal(getattr(imu, name), getattr(session[0], name))
    np.testing.assert_array_equal(joints.position, session[1].position)


@pytest.mark.parametrize('kind', [*KINDS, 'sqlite3_zstd'])
@pytest.mark.parametrize('with_metadata', [True, False])
def test_a_bag_cut_off_anywhere_gives_what_came_before(
    bags, session, tmp_path, kind, with_metadata
):
    @quick
    @given(st.floats(0, 0.999))
    def check(share):
        path = damaged_copy(
            bags, kind, tmp_path / 'cut', lambda data: data[: int(share * len(data))]
        )
        if not with_metadata:
            (path / 'metadata.yaml').unlink()
        try:
            imu, joints, lost = read(path)
        except InputError as error:
            assert share < 0.1, error
            return
        # A cut in the index, behind the last message, loses nothing.
        assert lost or (len(imu), len(joints)) == (N, N // 5)
        assert all(count > 0 for count in lost.values())
        if imu is not None:
            assert_true_samples(imu, session[0], ('stamp_ns', 'force_s', 'rate_s'))
        if joints is not None:
            assert_true_samples(joints, session[1], ('stamp_ns', 'position', 'velocity'))
        # A chunk of an mcap holds a third of this session; what is compressed comes in blocks of
        # 128 KiB.
        found = 0 if imu is None else len(imu)
        slack = 0.45 if kind in ('mcap_lz4', 'mcap_zstd') else 0.12
        assert found >= (share - slack) * N, (share, found)
        announced = 'messages that the metadata announce and the files do not hold'
        if with_metadata and announced in lost:
            n_read = found + (0 if joints is None else len(joints))
            assert abs(lost[announced] + n_read - (N + N // 5)) <= 9  # the temperatures

    check()


@pytest.mark.parametrize('kind', KINDS)
def test_bytes_overwritten_anywhere_never_crash(bags, session, tmp_path, kind):
    @quick
    @given(st.floats(0, 0.999), st.binary(min_size=1, max_size=5000))
    def check(share, noise):
        def overwrite(data):
            start = int(share * len(data))
            return data[:start] + noise[: len(data) - start] + data[start + len(noise) :]

        path = damaged_copy(bags, kind, tmp_path / 'noise', overwrite)
        try:
            imu, _, _ = read(path)
        except InputError:
            return
        assert imu is None or len(imu) <= N

    check()


def test_a_damaged_page_costs_its_own_rows_and_few_more(bags, session, tmp_path):
    def overwrite(data):
        page = len(data) // PAGE_SIZE // 2
        while data[PAGE_SIZE * page] != 0x0D:  # a table leaf
            page += 1
        return data[: PAGE_SIZE * page] + bytes(PAGE_SIZE) + data[PAGE_SIZE * (page + 1) :]

    imu, _, lost = read(damaged_copy(bags, 'sqlite3', tmp_path / 'bag', overwrite))
    most = PAGE_SIZE // 300 + 2 * STEP_IDS  # bytes of an Imu message; both ends of the damage
    assert N - most < len(imu) < N
    assert_true_samples(imu, session[0], ('stamp_ns', 'force_s'))
    assert N - len(imu) <= lost['unreadable rows of sqlite3_0.db3'] <= most
    assert lost['messages that the metadata announce and the files do not hold'] <= most


@pytest.mark.parametrize('kind', ['mcap', 'mcap_zstd', 'mcap_lz4'])
def test_a_chunk_whose_checksum_fails_is_left_out(bags, session, tmp_path, kind):
    def flip(data):
        middle = len(data) // 2
        return data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]

    imu, _, lost = read(damaged_copy(bags, kind, tmp_path / 'bag', flip))
    assert N / 2 < len(imu) < N
    assert_true_samples(imu, session[0], ('stamp_ns', 'force_s', 'rate_s'))
    assert any('chunk' in reason and count > 1000 for reason, count in lost.items())


@pytest.mark.parametrize('kind', KINDS)
def test_a_bare_file_and_a_folder_without_metadata(bags, session, tmp_path, kind):
    with open_recording(storage_file(bags / kind)) as recording:
        assert recording.message_counts == {
            '/imu/data_raw': N,
            '/joint_states': N // 5,
            '/imu/temperature': 9,
        }
        assert recording.duration == pytest.approx(
            (session[0].stamp_ns[-1] - session[0].stamp_ns[0]) * 1e-9
        )
        assert sum(len(block.imu) for block in recording.blocks()) == N and not recording.lost
    folder = tmp_path / 'folder'
    folder.mkdir()
    for number in (10, 9):
        shutil.copy(
            storage_file(bags / kind), folder / f'x_{number}{storage_file(bags / kind).suffix}'
        )
    imu, _, lost = read(folder)
    assert len(imu) == 2 * N and not lost


def test_a_file_that_is_no_database_is_closed(tmp_path, monkeypatch):
    (tmp_path / 'text.db3').write_bytes(b'no database ' * 100)
    opened = []

    class Recorded(sqlite3.Connection):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            opened.append(self)

    monkeypatch.setattr(sqlite3, 'connect', partial(sqlite3.connect, factory=Recorded))
    with pytest.raises(sqlite3.DatabaseError, match='not a database'):
        SqliteFile(tmp_path / 'text.db3')
    with pytest.raises(sqlite3.ProgrammingError, match='closed'):
        opened[0].execute('SELECT 1')


def test_a_missing_or_broken_part_of_a_split_bag_costs_only_itself(bags, session, tmp_path):
    folder = tmp_path / 'split'
    shutil.copytree(bags / 'sqlite3', folder)
    text = (folder / 'metadata.yaml').read_text()
    (folder / 'metadata.yaml').write_text(
        text.replace(
            '- sqlite3_0.db3\n', '- missing_0.db3\n  - broken_1.db3\n  - sqlite3_0.db3\n', 1
        )
    )
    (folder / 'broken_1.db3').write_bytes(b'SQLite format 3\0' + bytes(5000))
    imu, _, lost = read(folder)
    assert len(imu) == N
    assert sorted(reason.split(' that')[0] for reason in lost) == [
        'file broken_1.db3',
        'file missing_0.db3',
    ]


def test_a_receive_time_that_is_no_number_leaves_the_duration_unknown(bags, tmp_path):
    shutil.copy(bags / 'sqlite3' / 'sqlite3_0.db3', tmp_path / 'bag.db3')
    with sqlite3.connect(tmp_path / 'bag.db3') as connection:
        connection.execute("UPDATE messages SET timestamp = 'x' WHERE id = 7")
    connection.close()
    with open_recording(tmp_path / 'bag.db3', want_joints='optional') as recording:
        assert recording.duration == 0.0


def test_rows_of_a_write_ahead_log_are_read(bags, session, tmp_path):
    """A recorder that was killed in its resilient mode leaves such a file."""
    folder = tmp_path / 'wal'
    shutil.copytree(bags / 'sqlite3', folder)
    connection = sqlite3.connect(storage_file(folder))
    connection.execute('PRAGMA journal_mode = WAL')
    connection.execute('PRAGMA wal_autocheckpoint = 0')
    row = encode_imu(session[0].select(slice(0, 1)))[0].tobytes()
    connection.execute('INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 5, ?)', (row,))
    connection.commit()
    copy = tmp_path / 'killed'
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns('*-shm'))
    connection.close()
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    imu, _, lost = read(copy)
    assert len(imu) == N + 1 and not lost
    # SQLite wrote the index of the log (-shm) next to the recording.
    assert {path.name: path.read_bytes() for path in copy.iterdir()} == before


@pytest.mark.parametrize('want_joints', [False, 'optional'])
def test_rows_of_other_types_and_sizes_are_read_or_counted(bags, session, tmp_path, want_joints):
    """One frame_id of another length, one message that is text, one of an unknown topic."""
    folder = tmp_path / 'mixed'
    shutil.copytree(bags / 'sqlite3', folder)
    renamed = encode_imu(replace(session[0].select(slice(5000, 5001)), frame_id='a_longer_frame'))
    statements = [
        (
            'UPDATE messages SET data = ? WHERE data = ?',
            (renamed[0].tobytes(), encode_imu(session[0].select(slice(5000, 5001)))[0].tobytes()),
        ),
        (
            "UPDATE messages SET data = 'text' WHERE data = ?",
            (encode_imu(session[0].select(slice(6000, 6001)))[0].tobytes(),),
        ),
    ]
    connection = sqlite3.connect(storage_file(folder))
    for statement in statements:
        assert connection.execute(*statement).rowcount == 1
    connection.commit()
    connection.close()
    with open_recording(folder, want_joints=want_joints, want_temperature=False) as recording:
        imu = ImuSamples.concatenate([block.imu for block in recording.blocks()])
        lost = recording.lost
    assert_true_samples(imu, session[0], ('stamp_ns', 'force_s', 'rate_s'))
    assert len(imu) == N - 1
    assert lost['rows with values of other types of sqlite3_0.db3'] == 1


@pytest.mark.parametrize(
    'change',
    [
        'id = id + 1000000000000 WHERE id > 6000',
        'id = id * 1000000',
        'id = id - 9223372036854775807',
    ],
)
def test_rows_with_distant_ids_are_read(bags, session, tmp_path, change):
    """Rows that were deleted between them, or ids that another program chose."""
    folder = tmp_path / 'distant'
    shutil.copytree(bags / 'sqlite3', folder)
    connection = sqlite3.connect(storage_file(folder))
    connection.execute(f'UPDATE messages SET {change}')
    connection.commit()
    connection.close()
    with open_recording(folder, want_joints=False, want_temperature=False) as recording:
        imu = ImuSamples.concatenate([block.imu for block in recording.blocks()])
        assert not recording.lost
    assert_true_samples(imu, session[0], ('stamp_ns', 'force_s', 'rate_s'))
    assert len(imu) == N


def test_messages_in_overflow_pages_and_of_other_types(tmp_path, session):
    """Long names make JointState larger than a page; other topics hold anything."""
    names = tuple('joint_' + 200 * c for c in 'abcdefghijklmnopqrstuvwx')
    rng = np.random.default_rng(5)
    joints = JointSamples(
        session[1].stamp_ns[:40], rng.normal(size=(40, 24)), rng.normal(size=(40, 24)), names
    )
    write_session(tmp_path / 'bag', session[0].select(slice(0, 200)), joints)
    connection = sqlite3.connect(storage_file(tmp_path / 'bag'))
    connection.execute(
        "INSERT INTO topics VALUES (77, '/text', 'std_msgs/msg/String', 'cdr', '', '')"
    )
    for k in range(300):
        connection.execute(
            'INSERT INTO messages (topic_id, timestamp, data) VALUES (77, ?, ?)',
            (-k, rng.bytes(37 * k)),
        )
    connection.commit()
    connection.close()
    with open_recording(tmp_path / 'bag') as recording:
        blocks = list(recording.blocks(names[::-1]))
        assert not recording.lost
    np.testing.assert_array_equal(
        np.concatenate([block.joints.position for block in blocks]), joints.position[:, ::-1]
    )
    assert sum(len(block.imu) for block in blocks) == 200


@pytest.mark.parametrize('storage', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize(
    'mode',
    [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE, CompressionMode.STORAGE],
)
def test_bags_of_another_writer(tmp_path, session, storage, mode):
    """
    Compressed in every way.

    A few frames and the joint order change, byte order too, and types are mixed in the middle.
    """
    if storage is StoragePlugin.SQLITE3 and mode is CompressionMode.STORAGE:
        pytest.skip('sqlite3 has no compression of its own')
    store = get_typestore(Stores.ROS2_HUMBLE)
    imu, joints, _ = session
    imu, joints = imu.select(slice(0, 600)), joints.select(slice(0, 120))
    swapped = JointSamples(
        joints.stamp_ns, joints.position[:, ::-1], joints.velocity[:, ::-1], joints.names[::-1]
    )
    plain = [encode_imu(replace(imu, frame_id=frame)) for frame in ('a', 'another_frame')]
    joint_rows = encode_joints(joints), encode_joints(swapped, with_velocity=False)
    writer = Writer(tmp_path / 'bag', version=8, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = [
            writer.add_connection(name, kind, typestore=store)
            for name, kind in (
                ('/imu/data_raw', 'sensor_msgs/msg/Imu'),
                ('/joint_states', 'sensor_msgs/msg/JointState'),
                ('/other', 'sensor_msgs/msg/Imu'),
            )
        ]
        for k in range(600):
            data = plain[250 <= k < 265][k].tobytes()
            if 400 <= k < 420:
                message = store.deserialize_cdr(data, 'sensor_msgs/msg/Imu')
                data = bytes(
                    store.serialize_cdr(message, 'sensor_msgs/msg/Imu', little_endian=False)
                )
            writer.write(topics[0], int(imu.stamp_ns[k]), data)
            if k % 5 == 0:
                writer.write(
                    topics[1], int(imu.stamp_ns[k]), joint_rows[k >= 333][k // 5].tobytes()
                )
            if k % 7 == 0:
                writer.write(topics[2], int(imu.stamp_ns[k]), plain[0][k].tobytes())
    found, found_joints, lost = read(tmp_path / 'bag')
    assert not lost and found.frame_id == 'a'
    for name in ('stamp_ns', 'force_s', 'rate_s'):
        np.testing.assert_array_equal(getattr(found, name), getattr(imu, name))
    np.testing.assert_array_equal(found_joints.position, joints.position)
    np.testing.assert_array_equal(found_joints.velocity[:67], joints.velocity[:67])
    assert np.isnan(found_joints.velocity[67:]).all()


@pytest.mark.parametrize('text, usable', [('float32', True), ('complicated', False)])
def test_another_definition_of_a_type_takes_the_general_path(tmp_path, session, text, usable):
    """
    A bag says itself what its messages hold.

    Here covariances of single precision, and no definition that makes sense.
    """
    store = get_typestore(Stores.EMPTY)
    definition = standard_definition('sensor_msgs/msg/Imu').text.replace('float64[9]', 'float32[9]')
    store.register(get_types_from_msg(definition, 'sensor_msgs/msg/Imu'))
    full = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / 'bag', version=9) as writer:
        topic = writer.add_connection(
            '/imu/data_raw',
            'sensor_msgs/msg/Imu',
            msgdef=definition if usable else text,
            rihs01='x',
        )
        for row in encode_imu(session[0].select(slice(0, 30))):
            message = full.deserialize_cdr(row.tobytes(), 'sensor_msgs/msg/Imu')
            for name in ('orientation', 'angular_velocity', 'linear_acceleration'):
                setattr(
                    message,
                    f'{name}_covariance',
                    getattr(message, f'{name}_covariance').astype(np.float32),
                )
            writer.write(topic, 0, bytes(store.serialize_cdr(message, 'sensor_msgs/msg/Imu')))
    if usable:
        np.testing.assert_array_equal(read(tmp_path / 'bag')[0].rate_s, session[0].rate_s[:30])
    else:
        with refused(InputError, 'definition_damaged', 'sensor_msgs/msg/Imu'):
            read(tmp_path / 'bag')


@pytest.mark.parametrize(
    ('good', 'damaged'),
    [
        ("compression_mode: ''", 'compression_mode: [1]'),
        ('message_count: 9000', 'message_count: 9000.5'),
        ('nanoseconds: ', 'nanoseconds: x'),
        ('type_description_hash: ', 'type_description_hash: 5 # '),
        ('- sqlite3_0.db3', '- 7'),
    ],
)
def test_metadata_with_a_part_of_another_type_count_as_none(bags, tmp_path, good, damaged):
    folder = tmp_path / 'damaged'
    shutil.copytree(bags / 'sqlite3', folder)
    assert read_metadata(folder)
    content = (folder / 'metadata.yaml').read_text()
    assert good in content
    (folder / 'metadata.yaml').write_text(content.replace(good, damaged))
    assert read_metadata(folder) == {}
    imu, _, lost = read(folder)
    assert len(imu) == N and not lost
