"""
Recordings that were made to exhaust memory or time, or to deceive.

One line and exit code 1, or a warning and what is usable.
"""

import os
import sqlite3
import struct
from contextlib import closing
from functools import cache
from types import SimpleNamespace

import lz4.frame
import numpy as np
import pytest
import yaml
from fuzz.attacks import overlapping_chunks, ros1_with_entries, rows_that_share_pages
from test_mcap_file import chunk, message, prefixed_string, record, write_file

from imu_calibration.cli.main import main
from imu_calibration.core.documents import parsed
from imu_calibration.core.errors import InputError
from msg_adapters.bag import Ros1File, list_topics
from msg_adapters.compression import (
    LARGEST_CHUNK,
    MOST_FRAMES,
    decompress,
    decompress_message,
    largest_content,
    zstd,
)
from msg_adapters.definitions import is_standard
from msg_adapters.imu import IMU_TYPE
from msg_adapters.mcap_file import MAGIC, McapFile
from msg_adapters.rosbag2 import spelled_out

from worlds.hostile_messages import decode_long_names, refusal_of
from worlds.limited import limited, refused, survived
from worlds.small_bags import write_small_bag

pytestmark = pytest.mark.live  # each input is read in a process with limits
SEPARATOR = '=' * 80 + '\n'


@pytest.fixture
def bag(tmp_path):
    """A recording of a second."""
    return write_small_bag(tmp_path / 'bag')


def rewrite_metadata(bag, change):
    """Change the mapping in metadata.yaml."""
    document = yaml.safe_load((bag / 'metadata.yaml').read_text())
    change(document['rosbag2_bagfile_information'])
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(document))


def change_database(bag, *statements):
    """Execute SQL in the storage file."""
    connection = sqlite3.connect(next(bag.glob('*.db3')))
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


@cache
def zeros():
    """A zstd stream of 320 MiB of zeros, made piece by piece."""
    compressor = zstd().ZstdCompressor(level=1)
    piece = bytes(1 << 24)
    return b''.join(compressor.compress(piece) for _ in range(20)) + compressor.flush()


@cache
def zeros_in_lz4():
    """An lz4 stream of 128 MiB of zeros."""
    return lz4.frame.compress(bytes(1 << 27), store_size=True)


# Decompression


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'lz4 that claims 2^45 bytes'])
@pytest.mark.parametrize('declared', [1000, LARGEST_CHUNK, 5 << 30, 2**63])
def test_a_chunk_expands_to_its_declared_size_at_most(tmp_path, compression, declared):
    """0.6 MB of zstd filled 5 GB; an lz4 header that claims 2^45 bytes gave a traceback."""
    if compression == 'zstd':
        packed = zeros()
    else:
        packed = zeros_in_lz4()
        if 'claims' in compression:
            packed = packed[:6] + struct.pack('<Q', 2**45) + packed[14:]
    content = (
        struct.pack('<QQQI', 0, 1, declared, 0)
        + prefixed_string(compression[:4])
        + struct.pack('<Q', len(packed))
        + packed
    )
    write_file(tmp_path / 'x.mcap', record(0x06, content) * 3)
    refused('inspect', tmp_path / 'x.mcap')


@pytest.mark.parametrize('name', ['x.db3.zstd', 'x.mcap.zstd', 'x.mcap.zst'])
def test_a_compressed_file_is_not_written_out_without_end(tmp_path, name):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / name).write_bytes(zeros())
    printed = refused('inspect', tmp_path / 'bag').err
    assert name in printed and f'beyond the {largest_content(len(zeros()))} bytes' in printed


def test_frames_without_content_do_not_take_quadratic_time(tmp_path):
    """Each frame costs a copy of what follows it: what comes after `MOST_FRAMES` is not read."""
    empty = zstd().compress(b'')
    (tmp_path / 'x.mcap.zstd').write_bytes(empty * (2 * MOST_FRAMES))
    ended = refused('inspect', tmp_path / 'x.mcap.zstd')
    assert f' {MOST_FRAMES} ' in ended.err
    last = zstd().compress(b'x')
    assert decompress('zstd', empty * (MOST_FRAMES - 1) + last, 1000) == b'x'
    assert decompress('zstd', empty * MOST_FRAMES + last, 1000) == b''
    packed = empty * (2 * MOST_FRAMES)
    content = (
        struct.pack('<QQQI', 0, 1, 1000, 0)
        + prefixed_string('zstd')
        + struct.pack('<Q', len(packed))
        + packed
    )
    write_file(tmp_path / 'x.mcap', record(0x06, content))
    refused('inspect', tmp_path / 'x.mcap')


def test_messages_that_expand_far_are_lost_and_counted(bag):
    rewrite_metadata(
        bag, lambda metadata: metadata.update(compression_mode='message', compression_format='zstd')
    )
    data = zstd().compress(bytes(60 << 20))
    connection = sqlite3.connect(next(bag.glob('*.db3')))
    connection.execute('UPDATE messages SET data = ? WHERE id % 20 = 0', (data,))
    connection.commit()
    connection.close()
    survived('inspect', bag)
    with pytest.raises(ValueError, match='limit'):
        decompress_message(zstd().compress(bytes(5 << 20)))
    assert decompress_message(zstd().compress(bytes(3 << 20))) == bytes(3 << 20)


# Storage


def test_a_page_that_lists_itself_is_read_once(bag):
    """1000 pointers of a page to itself were followed to the 20th power."""
    path = next(bag.glob('*.db3'))
    connection = sqlite3.connect(path)
    (root,) = connection.execute(
        "SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
    ).fetchone()
    (size,) = connection.execute('PRAGMA page_size').fetchone()
    connection.close()
    page = bytearray(path.read_bytes()[(root - 1) * size : root * size])
    n_cells = (size - 100) // 2
    cells = np.full(n_cells, size - 8, '>u2').tobytes()
    page[: 12 + len(cells)] = struct.pack('>BHHHBI', 0x05, 0, n_cells, size - 8, 0, root) + cells
    page[size - 8 : size - 4] = struct.pack('>I', root)
    data = bytearray(path.read_bytes())
    data[(root - 1) * size : root * size] = page
    path.write_bytes(data)
    survived('inspect', bag)


ENDLESS = 'WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n)'


@pytest.mark.parametrize(
    'statements',
    [
        (
            'ALTER TABLE topics RENAME TO t',
            (
                f"CREATE VIEW topics AS {ENDLESS} SELECT k AS id, 'x' || k AS name,"
                " 'std_msgs/msg/String' AS type, 'cdr' AS serialization_format, '' AS"
                ' offered_qos_profiles FROM n'
            ),
        ),
        (
            'ALTER TABLE messages RENAME TO m',
            (
                f'CREATE VIEW messages AS {ENDLESS} SELECT k AS id, 1 AS topic_id, 0 AS timestamp,'
                ' zeroblob(1000) AS data FROM n'
            ),
        ),
        (
            'ALTER TABLE messages RENAME TO m',
            (
                'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,'
                ' data AS (zeroblob(900000000)))'
            ),
            'INSERT INTO messages(id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM m',
        ),
        (
            'DROP TABLE message_definitions',
            (
                f"CREATE VIEW message_definitions AS {ENDLESS} SELECT 'a' || k AS topic_type,"
                " 'ros2msg' AS encoding, hex(zeroblob(1000)) AS encoded_message_definition FROM n"
            ),
        ),
    ],
    ids=['topics', 'messages', 'generated column', 'definitions'],
)
def test_views_and_generated_columns_in_place_of_tables_are_refused(bag, statements):
    os.remove(bag / 'metadata.yaml')
    change_database(bag, *statements)
    printed = refused('inspect', bag).err
    assert (
        any(f"'{name}'" in printed for name in ('topics', 'messages', 'message_definitions'))
        and 'columns' in printed
    )


@pytest.mark.parametrize(
    'change',
    [
        'UPDATE topics SET name = NULL',
        "UPDATE topics SET name = x'ff00'",
        "UPDATE topics SET type = x'00'",
        'UPDATE topics SET serialization_format = NULL',
        'UPDATE message_definitions SET topic_type = NULL',
        'UPDATE messages SET data = NULL',
        'UPDATE messages SET data = 7',
        "UPDATE messages SET timestamp = 'noon'",
        "UPDATE messages SET topic_id = 'x'",
        "UPDATE messages SET data = 'text'",
        'DROP TABLE messages',
    ],
)
@pytest.mark.parametrize('columns', [False, True])
def test_values_of_other_kinds_are_one_line(bag, change, columns):
    if columns:  # then rows are read by SQL
        change_database(bag, 'ALTER TABLE messages ADD COLUMN more INTEGER')
    else:
        os.remove(bag / 'metadata.yaml')
    table = next(
        name for name in ('topics', 'messages', 'message_definitions') if f' {name}' in change
    )
    if 'UPDATE' in change:  # a copy has no constraints
        change_database(
            bag,
            f'CREATE TABLE t AS SELECT * FROM {table}',
            f'DROP TABLE {table}',
            f'ALTER TABLE t RENAME TO {table}',
        )
    change_database(bag, change)
    survived('inspect', bag)


@pytest.mark.parametrize(
    'content',
    [
        overlapping_chunks(3_000, 60, 2**40),
        MAGIC + (message(1, 0, b'') + chunk(b'')) * 2_000 + MAGIC,
    ],
    ids=['overlapping chunks', 'messages between chunks'],
)
def test_overlapping_chunks_and_messages_between_chunks_are_not_read_again_and_again(
    tmp_path, monkeypatch, content
):
    """
    Chunk starts that overlap, each of a chunk that claims to end behind the file.

    All the rest was read for each: 60,000 of them took minutes.
    """
    path, read, n_bytes = tmp_path / 'x.mcap', McapFile._read, []

    def counted(file, position, length):
        part = read(file, position, length)
        n_bytes.append(len(part))
        return part

    path.write_bytes(content)
    refused('inspect', path)
    monkeypatch.setattr(McapFile, '_read', counted)
    assert main(['inspect', str(path)]) == 1
    assert len(content) < sum(n_bytes) < 20 * len(content)


# Definitions


@pytest.mark.parametrize(
    'text',
    [
        '9' * 60_000 + 'x',
        'a' + '(' * 25_000,
        'E' * 20_000,
        'ax:' + '9' * 60_000 + 'x',
        '\t' * 60_000,
        'a ' * 10_000,
        'a:' * 30_000,
    ],
)
def test_long_cells_and_headers_of_a_log_take_linear_time(tmp_path, text):
    """
    Regular expressions that backtrack needed 195 s for a cell of 60,000 digits.

    Later ones, of labelled cells, needed minutes for 60,000 letters.
    """
    rows = [f'{k},1,2,9,0,0,{text}\n' for k in range(9)]
    for name, lines in (('x.csv', [f'time,ax,ay,az,gx,gy,{text}\n', *rows]), ('y.csv', rows)):
        (tmp_path / name).write_text(''.join(lines))
        refused('inspect', tmp_path / name)


def doubling(n_levels, last):
    """A definition with 2^n fields."""
    levels = [f'MSG: sensor_msgs/T{k}\nT{k + 1} a\nT{k + 1} b\n' for k in range(1, n_levels)] + [
        f'MSG: sensor_msgs/T{n_levels}\n{last}\n'
    ]
    return 'T1 a\nT1 b\n' + ''.join(SEPARATOR + level for level in levels)


@pytest.mark.parametrize('last', ['float64 x', 'int32 X=3'])
def test_a_definition_with_far_too_many_fields_is_neither_standard_nor_used(last):
    definition = doubling(61, last)
    assert limited(is_standard, IMU_TYPE, 'ros2msg', definition).code is False
    ended = limited(refusal_of, definition)
    assert ('10000' in ended.code) == (last == 'float64 x') and ended.code, ended


@pytest.mark.parametrize(
    'definition, reason',
    [
        ('string[2000000000] x', '10000 '),
        ('float64[2000000000] x', '10000 '),
        ('Header[99999] x\n' + SEPARATOR + 'MSG: std_msgs/Header\nuint32 seq\n', '10000 '),
        ('E[] x\n' + SEPARATOR + 'MSG: sensor_msgs/E\nint32 X=3\n', IMU_TYPE),
        ('E[4] x\n' + SEPARATOR + 'MSG: sensor_msgs/E\nint32 X=3\n', IMU_TYPE),
        ('E x\n' + SEPARATOR + 'MSG: sensor_msgs/E\nE x\n', 'sensor_msgs/msg/E'),
        ('int32 x\n' * 200_000, '100000'),
    ],
)
def test_definitions_of_endless_messages_are_refused(definition, reason):
    told = limited(refusal_of, definition).code
    assert reason in told and ('10000 ' in told) == (reason == '10000 ')


# Metadata


@pytest.mark.parametrize(
    'value',
    [
        '{<<: [&a {x: 1}, *a]}',
        '&a [*a]',
        '[' * 100 + ']' * 100,
        '1' + ':59' * 100_000,
        '!!int "1' + ':59' * 100_000 + '"',
        '9' * 5000,
        '[' + '[],' * 70_000 + ']',
        '2000-99-99',
        '.inf',
    ],
)
def test_metadata_that_cost_more_than_they_say_are_left_out(bag, value):
    (bag / 'metadata.yaml').write_text(
        (bag / 'metadata.yaml').read_text().replace('custom_data: null', f'custom_data: {value}')
        + f'hostile: {value}\n'
    )
    assert survived('inspect', bag).code != 1
    assert spelled_out(value) == []
    if value != '.inf':  # a number like others
        with pytest.raises(InputError):
            parsed(value, 'metadata', aliases=True)


def test_nested_aliases_in_metadata_are_not_expanded(bag):
    lines = ['custom_data: &a0 [x, x]'] + [
        f'  c{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]' for k in range(1, 20)
    ]
    (bag / 'metadata.yaml').write_text(
        (bag / 'metadata.yaml').read_text().replace('custom_data: null', '\n'.join(lines))
    )
    assert survived('inspect', bag).code != 1
    with pytest.raises(InputError):
        parsed('\n'.join(line.strip() for line in lines), 'metadata', aliases=True)


def test_members_that_never_end_or_come_again_are_left_out(bag, tmp_path):
    os.remove(bag / 'metadata.yaml')
    os.symlink('/dev/zero', bag / 'metadata.yaml')
    assert survived('inspect', bag).code != 1
    os.remove(bag / 'metadata.yaml')
    os.mkfifo(bag / 'metadata.yaml')
    os.mkfifo(bag / 'more.mcap')
    os.mkfifo(bag / 'more.db3')
    os.symlink('/dev/zero', bag / 'more.db3.zstd')
    ended = survived('inspect', bag)
    assert all(name in ended.out + ended.err for name in ('more.mcap', 'more.db3'))
    for name in ('fifo.mcap', 'fifo.bag', 'fifo.csv'):
        os.mkfifo(tmp_path / name)
        refused('inspect', tmp_path / name)


def test_a_file_that_is_listed_again_and_again_is_read_once(bag):
    before = sum(topic.count for topic in list_topics(bag))
    rewrite_metadata(
        bag,
        lambda metadata: metadata.update(
            relative_file_paths=metadata['relative_file_paths'] * 2000, topics_with_message_count=[]
        ),
    )
    assert sum(topic.count for topic in list_topics(bag)) == before
    survived('inspect', bag)


# Messages


def test_long_names_take_no_quadratic_time():
    """A frame_id of 4 MiB took 50 s to compare; four live messages blocked a node for 31 s."""
    imu = SimpleNamespace(
        stamp_ns=np.arange(4), force_s=np.ones((4, 3)), rate_s=np.ones((4, 3)), frame_id=''
    )
    ended = limited(decode_long_names, imu)
    assert ended.code == 0 and ended.seconds < 10 and ended.megabytes < 500, ended


def test_a_name_cannot_pose_as_markup_or_as_a_line(tmp_path):
    bag = write_small_bag(
        tmp_path / 'bag', frame_id='imu\n[/nope]\x1b[2J', imu_topic='/[/nope]', storage='mcap'
    )
    ended = survived('inspect', bag)
    assert ended.code != 1 and '\x1b[2J' not in ended.out and '/[/nope]' in ended.out
    refused('inspect', tmp_path / 'x\x1b[2J\n')


def test_index_entries_of_one_message_read_it_once(tmp_path):
    """A ROS 1 bag of 8 MB with 1,000 index entries for one message needed 7.9 GB."""
    path = tmp_path / 'x.bag'
    path.write_bytes(ros1_with_entries(1000, 4 << 20))
    source = Ros1File(path)
    sizes = [len(raw.packed) for raw in source.stretches(['/imu/data_raw'])]
    assert sum(sizes) == 1 and source.lost == {'index entries that repeat a message': 999}
    source.close()
    survived('inspect', path)


def test_rows_that_share_overflow_pages_take_little_memory(tmp_path):
    """8.5 MB with 1000 rows on one chain of overflow pages took 7.1 GB."""
    path = tmp_path / 'x.db3'
    path.write_bytes(rows_that_share_pages(400, 239))
    with closing(sqlite3.connect(path)) as connection:
        (n_rows,) = connection.execute(
            'SELECT count(*) FROM messages WHERE length(data) = ?', (20_000 + 239 * 4092,)
        ).fetchone()
    assert n_rows == 401
    assert survived('inspect', path).megabytes < 150
