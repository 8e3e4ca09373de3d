"""Rows written as pages, read by SQLite itself: `PRAGMA integrity_check` compares every page with the file format."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest

from msg_adapters import sqlite_rows
from msg_adapters.bag_writer import BagWriter
from msg_adapters.definitions import standard_definition
from msg_adapters.layout import Packed
from msg_adapters.sqlite_rows import LEAST_LOCAL, LOCK_PAGE, MOST_LOCAL, PAGE_SIZE, RowWriter

OVERFLOW = PAGE_SIZE - 4
"""Bytes of a message in one overflow page."""
SIZES = {
    'none': [], 'one': [330], 'empty': [0, 1, 0], 'one leaf': [100] * 20, 'two levels': [330] * 2000, 'three levels': [4000] * 8000,
    'various': np.random.default_rng(0).integers(0, 900, 3000).tolist(),
    'long': [*range(MOST_LOCAL - 40, MOST_LOCAL + 5), *range(LEAST_LOCAL + OVERFLOW - 30, LEAST_LOCAL + OVERFLOW + 10), 3 * OVERFLOW, 2**20, 7]}


@pytest.mark.parametrize('case', SIZES)
@pytest.mark.parametrize('batch', [50, 4000])
def test_sqlite_reads_the_rows_that_were_written(tmp_path, case, batch):
    rng, sizes = np.random.default_rng(1), SIZES[case]
    messages = [rng.bytes(size) for size in sizes]
    stamps = 10**18 + rng.integers(-10**9, 10**9, len(messages))
    with BagWriter(tmp_path / 'bag') as writer:
        topics = [writer.add_topic(name, standard_definition('sensor_msgs/msg/Imu')) for name in ('/a', '/b')]
        which = rng.choice(topics, len(messages))
        for first in range(0, len(messages), batch):
            some = slice(first, first + batch)
            writer.write(which[some], stamps[some], Packed.join(messages[some]))
    with closing(sqlite3.connect(tmp_path / 'bag' / 'bag_0.db3')) as connection:
        assert connection.execute('PRAGMA integrity_check').fetchall() == [('ok',)]
        rows = connection.execute('SELECT id, topic_id, timestamp, data FROM messages ORDER BY id').fetchall()
        assert rows == list(zip(range(1, len(sizes) + 1), which.tolist(), stamps.tolist(), messages, strict=True))
        assert connection.execute('SELECT count(*) FROM message_definitions').fetchone() == (1,)   # both topics are of one type
        by_time = connection.execute('SELECT timestamp FROM messages ORDER BY timestamp').fetchall()
        assert [stamp for stamp, in by_time] == sorted(stamps.tolist())


def test_page_of_the_lock_bytes_is_not_used(tmp_path):
    """SQLite never uses the page with the byte 2^30 (section 1.4): a file beyond 1 GiB would be damaged."""
    assert LOCK_PAGE == 65537 and (LOCK_PAGE - 1) * PAGE_SIZE == 2**30
    (tmp_path / 'file').write_bytes(bytes(2 * PAGE_SIZE))
    writer = RowWriter(tmp_path / 'file', 2)
    writer._next = LOCK_PAGE - 2
    assert writer._take(3).tolist() == [LOCK_PAGE - 2, LOCK_PAGE - 1, LOCK_PAGE + 1]
    assert writer._take(2).tolist() == [LOCK_PAGE + 2, LOCK_PAGE + 3]
    writer._next = LOCK_PAGE
    assert writer._take(1).tolist() == [LOCK_PAGE + 1]
    writer.abort()


def test_numbers_of_any_size_are_decoded():
    """One to eight bytes, by the definition of a varint: seven bits per byte, the most significant first."""
    for largest in (0, 127, 128, 2**14, 2**35, 2**55):
        table = sqlite_rows._varint(np.array([0, 5, largest]))
        value = 0
        for column in table.T:
            value = value << 7 | (column & 0x7F).astype(np.int64)
        assert value.tolist() == [0, 5, largest] and (table[:, -1] < 0x80).all() and (table[:, :-1] >= 0x80).all()
