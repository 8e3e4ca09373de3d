"""Inputs that were made to exhaust memory or time, with random sizes, as readers of `make fuzz`."""

import io
import json
import re
import sqlite3
import struct
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from fuzz.mutation import mutated

from imu_calibration.cli.fleet_run import csv_text
from imu_calibration.effects.expressions import FUNCTIONS, PLACES
from imu_calibration.references.turntable.collector import SAVED_FORMAT
from msg_adapters.definitions import standard_definition
from msg_adapters.imu import IMU_TYPE
from msg_adapters.mcap_file import MAGIC
from msg_adapters.mcap_writer import prefixed_string, record

from worlds.small_bags import with_effects, write_small_bag

FORMULA = tuple('=+-@')
"""Beginnings of text that spreadsheets calculate."""


def drawn(draw, data, others, rng, text=False):
    """Return an input of the attack `draw`, drawn again; one of five times as changed bytes."""
    return mutated(data, others, rng, text) if rng.random() < 0.2 else draw(rng)


def size_of(rng, most):
    """Return a size up to `most`, small ones as often as large ones."""
    return int(most ** rng.random())


# Bags


@cache
def _one_message(page_size):
    """The storage file of a bag with 20,000 bytes in place of each message, and its page size."""
    with TemporaryDirectory() as folder:
        bag = write_small_bag(Path(folder) / 'bag')
        path = next(bag.glob('*.db3'))
        with closing(sqlite3.connect(path)) as connection:
            connection.execute('DELETE FROM messages')
            connection.execute(f'PRAGMA page_size = {page_size}')
            connection.commit()
            connection.execute('VACUUM')
        return path.read_bytes()


def rows_that_share_pages(n_rows, n_pages, page_size=4096):
    """
    Return an sqlite3 bag in which the rows of all messages continue in one chain of pages.

    Parameters
    ----------
    n_rows : int
    n_pages : int
        Length of the chain of overflow pages.
    page_size : int

    """
    n_small = 20_000
    # Multiples of the content of an overflow page leave the part inside the leaf unchanged.
    n_long = n_small + n_pages * (page_size - 4)
    insert = 'INSERT INTO messages (id, topic_id, timestamp, data) VALUES (?, 1, 1000000, ?)'
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'x.db3'
        path.write_bytes(_one_message(page_size))
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(insert, (1000, b'L' * n_long))
            connection.executemany(insert, ((1001 + k, b'S' * n_small) for k in range(n_rows)))
            connection.commit()
        data = path.read_bytes()
    # A cell: sizes of payload and blob as varints, and after the part inside the number of the
    # first overflow page. Both sizes of the small rows become those of the long one.
    minimum = (page_size - 12) * 32 // 255 - 23
    payload = n_small + 10
    part = minimum + (payload - minimum) % (page_size - 4)
    if part > page_size - 35:
        part = minimum
    (start,) = (match.start() for match in re.finditer(re.escape(_varint(2 * n_long + 12)), data))
    chain_at = data.index(b'L', start) - (payload - n_small) + part
    first_page = data[chain_at : chain_at + 4]
    changed = bytearray(data)
    for match in re.finditer(re.escape(_varint(2 * n_small + 12)), data):
        at = match.start()
        begin = data.index(b'S', at) - (payload - n_small)
        changed[at : at + 3] = _varint(2 * n_long + 12)
        size_at = data.rindex(_varint(payload), 0, at)
        changed[size_at : size_at + 3] = _varint(n_long + payload - n_small)
        changed[begin + part : begin + part + 4] = first_page
    return bytes(changed)


def _varint(value):
    """An SQLite varint of three bytes."""
    assert 1 << 14 <= value < 1 << 21
    return bytes([0x80 | value >> 14, 0x80 | value >> 7 & 0x7F, value & 0x7F])


def draw_shared_pages(rng):
    """A bag of up to 1,000 rows that share a chain of up to 1 MB."""
    return rows_that_share_pages(size_of(rng, 1000), rng.randrange(1, 240))


def ros1_with_entries(n_entries, n_bytes):
    """Return a ROS 1 bag with one Imu message of so many bytes, listed again and again."""

    def header(**fields):
        parts = [name.encode() + b'=' + value for name, value in fields.items()]
        packed = b''.join(struct.pack('<I', len(part)) + part for part in parts)
        return struct.pack('<I', len(packed)) + packed

    def entry(data, **fields):
        return header(**fields) + struct.pack('<I', len(data)) + data

    def number(value, kind='<I'):
        return struct.pack(kind, value)

    definition = standard_definition(IMU_TYPE).text.encode()
    names = header(
        topic=b'/imu/data_raw',
        type=b'sensor_msgs/Imu',
        md5sum=b'6a62c6daae103f4ff57a132d6f95cec2',
        message_definition=definition,
    )[4:]
    connection = entry(names, op=b'\x07', conn=number(0), topic=b'/imu/data_raw')
    time = struct.pack('<II', 1, 0)
    content = connection + entry(bytes(n_bytes), op=b'\x02', conn=number(0), time=time)
    chunk_record = entry(content, op=b'\x05', compression=b'none', size=number(len(content)))
    index = entry(
        (time + number(len(connection))) * n_entries,
        op=b'\x04',
        ver=number(1),
        conn=number(0),
        count=number(n_entries),
    )
    magic, size = b'#ROSBAG V2.0\n', 4096
    start = len(magic) + size
    place = start + len(chunk_record) + len(index)
    fields = {'op': b'\x03', 'conn_count': number(1), 'chunk_count': number(1)}
    plain = header(**fields, index_pos=number(place, '<Q'))
    fill = size - len(plain) - 4
    info = entry(
        number(0) + number(n_entries),
        op=b'\x06',
        ver=number(1),
        chunk_pos=number(start, '<Q'),
        start_time=time,
        end_time=time,
        count=number(1),
    )
    bag_header = plain + number(fill) + b' ' * fill
    return magic + bag_header + chunk_record + index + connection + info


def draw_index_entries(rng):
    """A ROS 1 bag of up to 8 MB with up to 10,000 index entries for its message."""
    return ros1_with_entries(size_of(rng, 10_000), size_of(rng, 8 << 20))


def mcap(data_section, summary=b'', summary_at=0):
    """Return an MCAP file."""
    head = MAGIC + record(0x01, prefixed_string('ros2'), prefixed_string('test')) + data_section
    footer = struct.pack('<QQI', len(head) if summary else summary_at, 0, 0)
    return head + record(0x0F, bytes(4)) * (not summary) + summary + record(0x02, footer) + MAGIC


def overlapping_chunks(n_starts, step, claimed):
    """
    Return an MCAP file whose index has many starts of chunks that overlap.

    Parameters
    ----------
    n_starts : int
    step : int
        Bytes between two starts.
    claimed : int
        Size that each chunk claims to have.

    """
    one = struct.pack('<BQ', 0x06, claimed) + bytes(51)
    starts = b''.join(
        record(0x08, struct.pack('<QQQ', 0, 0, 8 + step * k) + bytes(40)) for k in range(n_starts)
    )
    data = MAGIC + one * n_starts
    return data + starts + record(0x02, struct.pack('<QQI', len(data), 0, 0)) + MAGIC


def draw_overlapping_chunks(rng):
    """Up to 60,000 starts; chunks that end inside or behind the file."""
    claimed = rng.choice((51, 600, 1 << 16, 1 << 40))
    return overlapping_chunks(size_of(rng, 60_000), rng.choice((1, 30, 60, 60, 60)), claimed)


def draw_many_imus(rng):
    """An MCAP file with up to 5,000 Imu channels, or with up to 5,000 frames of one."""
    n_topics, n_frames = size_of(rng, 5000), size_of(rng, 5000)
    if rng.random() < 0.5:
        n_topics = 1
    else:
        n_frames = n_topics
    definition = standard_definition(IMU_TYPE)
    schema = record(
        0x03,
        struct.pack('<H', 1),
        prefixed_string(definition.type),
        prefixed_string('ros2msg'),
        prefixed_string(definition.text),
    )
    parts = [schema]
    for k in range(1, n_topics + 1):
        names = prefixed_string(f'/imu{k}'), prefixed_string('cdr'), prefixed_string(b'')
        parts.append(record(0x04, struct.pack('<HH', k, 1), *names))
    for k in range(n_frames):
        frame = f'frame{k}'.encode() + b'\0'
        fill = bytes(-len(frame) % 8 + 4)
        head = b'\0\1\0\0' + struct.pack('<iII', 1, k, len(frame)) + frame + fill
        stamps = struct.pack('<HIQQ', 1 + k % n_topics, 0, k, k)
        parts.append(record(0x05, stamps, head + struct.pack('<37d', *[1.0] * 37)))
    return mcap(b''.join(parts))


# Saved sessions


def saved_session(content):
    """Return an archive of a saved session with this content in its header, and no numbers."""
    header = json.dumps({'format': SAVED_FORMAT, 'content': content})
    target = io.BytesIO()
    np.savez(target, header=np.frombuffer(header.encode(), np.uint8), numbers=np.zeros(0))
    return target.getvalue()


def draw_empty_arrays(rng):
    """Columns of up to 10^9 empty arrays, empty tuples or empty lists, nested."""

    def column(depth):
        count, kind = size_of(rng, 10**9), rng.randrange(6)
        if kind == 0 or depth == 0:
            return ['array', rng.choice(([count, 0], [count, 0, count], [0, count], [count]))]
        if kind == 1:
            return ['tuple', count, [], ['plain', []]]
        parts = [column(depth - 1) for _ in range(rng.randrange(1, 4))]
        if kind == 2:
            return ['tuple', count, parts, ['plain', []]]
        if kind == 3:
            return ['list', [count] * rng.randrange(1, 9), parts[0]]
        if kind == 4:
            return ['mixed', [rng.randrange(3)] * rng.randrange(1, 9), parts]
        return ['dict', count, parts, ['plain', ['a'] * len(parts)]]

    return saved_session(column(3))


# Text


def draw_long_cells(rng):
    """A log with a cell, a heading or a first line of up to 60,000 equal characters."""
    letter = rng.choice('9(([])/:.-_ +eE\t"\'=*#x;|^{@,T')
    long = letter * size_of(rng, 60_000)
    long = rng.choice(('', '9', 'a', '0x', '1/', '[s')) + long + rng.choice(('', 'x', ']', '1'))
    names = ['time', 'ax', 'ay', 'az', 'gx', 'gy', 'gz']
    rows = [[str(k), '1', '2', '9', '0', '0', '1'] for k in range(9)]
    place = rng.randrange(4)
    if place == 0:
        names[rng.randrange(7)] = long
    elif place == 1:
        rows[rng.randrange(9)][rng.randrange(7)] = long
    elif place == 2:
        for row in rows:
            row[rng.choice((0, 6))] = long
    lines = [names, *rows]
    text = '\n'.join(rng.choice((',', ',', ';', '\t', ' ')).join(line) for line in lines)
    return (f'{long}\n{text}' if place == 3 else text).encode()


def draw_own_effects(rng):
    """A calibration with up to 60 own effects of random columns, with numbers that overflow."""
    numbers = ('1e30', '9e29', '1e-30', '0', '2', '-1', '1e999', '3.5')
    names = sorted(PLACES)

    def column(depth):
        kind = rng.randrange(5)
        if depth == 0 or kind == 0:
            return rng.choice((rng.choice(names), rng.choice(numbers)))
        if kind == 1:
            return f'{rng.choice(FUNCTIONS)}({column(depth - 1)})'
        if kind == 2:
            return f'({column(depth - 1)})**{rng.choice((2, 3, 9, -1, "0.5"))}'
        return f'({column(depth - 1)} {rng.choice("+-*/")} {column(depth - 1)})'

    count = rng.choice((size_of(rng, 60), 50))
    columns = [column(rng.randrange(1, 6)) for _ in range(1 + rng.randrange(3))]
    text = with_effects([columns[k % len(columns)] for k in range(count)])
    value = rng.choice(('0.1', '.inf', '.nan', '1e9', '-1e9', '1e308', '0', '1e-300'))
    return text.replace('value: [0.1, 0.1, 0.1]', f'value: [{value}, 0.1, {value}]').encode()


def draw_formula(rng):
    """A name that a spreadsheet may calculate."""
    blank = ''.join(rng.choice((' ', '\t', '\r', '\xa0', '\u3000', '\v')) for _ in range(3))
    return (
        blank[: rng.randrange(4)] + rng.choice('=+-@a1') + rng.choice(('1+1', 'x', ''))
    ).encode()


def read_name(data, _folder):
    """Write a name into units.csv, where no text may be calculated."""
    import csv

    name = data.decode(errors='replace')
    (_, *rows) = csv.reader(io.StringIO(csv_text([{'name': name}]), newline=''))
    for cell in (cell for row in rows for cell in row):
        assert not cell.strip().startswith(FORMULA), repr(cell)


def seeds_of(draw):
    """Return a function of a folder that returns four inputs of an attack."""
    import random

    return lambda _folder: [draw(random.Random(k)) for k in range(9510, 9514)]


def mutation_of(draw):
    """Return the mutation of an attack."""
    return partial(drawn, draw)
