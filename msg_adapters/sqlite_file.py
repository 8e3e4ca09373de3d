"""
rosbag2 sqlite3 storage, read and written (schema version 4).

Topics are read by SQL, and messages from the pages or row by row.
"""

import os
import sqlite3
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from itertools import chain, islice
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from imu_calibration.core.exit_codes import UNKNOWN_EXTENT
from msg_adapters.definitions import TypeDefinition
from msg_adapters.layout import Packed, clean_name
from msg_adapters.sqlite_pages import PageReader
from msg_adapters.storage import StorageFile, Stretch, read_ahead

MESSAGE_COLUMNS = ['id', 'topic_id', 'timestamp', 'data']
STRETCH_ROWS = 8192
TABLES = ('topics', 'messages', 'message_definitions')
MOST_TABLES, MOST_TOPICS = 1000, 100_000
"""Entries of the schema and of the table of topics that are read."""


class SqliteFile(StorageFile):
    """
    One .db3 file.

    Parameters
    ----------
    path : path-like
        The file.
    unpack : callable, optional
        Bytes -> bytes for each message (compression by message).

    """

    def __init__(self, path: str | PathLike[str], unpack: Callable[[bytes], bytes] | None = None):
        self.path, self.unpack = Path(path), unpack
        self.lost = {}
        log = Path(f'{path}-wal')
        self.logged = log.exists() and log.stat().st_size > 0
        self.connection = _connect(self.path, self.logged)
        try:
            self._read_topics()
        except sqlite3.OperationalError as error:
            self.connection.close()
            if not self.logged:
                raise
            self.lost[f'write-ahead log {log.name} that cannot be read ({error})'] = 1
            self.logged, self.connection = False, _connect(self.path, False)
            self._read_topics()
        except BaseException:
            self.connection.close()
            raise

    def _read_topics(self):
        self._require_tables()
        self.topic_ids, self.types, self.definitions = defaultdict(list), {}, {}
        for topic_id, name, message_type, encoding in self.connection.execute(
            'SELECT id, name, type, serialization_format FROM topics'
        ).fetchmany(MOST_TOPICS):
            if not (
                isinstance(topic_id, int)
                and isinstance(name, str)
                and isinstance(message_type, str)
            ):
                self._lose('topics without a name or type', 1)
                continue
            topic = clean_name(name)
            self.topic_ids[topic].append(topic_id)
            self.types[topic] = clean_name(
                message_type if encoding == 'cdr' else f'{message_type} ({encoding})'
            )
        with suppress(sqlite3.Error):  # before schema version 4 there are no definitions
            rows = self.connection.execute(
                'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
            ).fetchmany(MOST_TOPICS)
            self.definitions = {
                clean_name(str(name)): (str(encoding), str(text)) for name, encoding, text in rows
            }

    def _require_tables(self):
        """
        Refuse views, virtual tables and generated columns.

        They are programs that can give rows without end.
        """
        for kind, name, text in self.connection.execute(
            'SELECT type, name, sql FROM sqlite_master'
        ).fetchmany(MOST_TABLES):
            if str(name).lower() not in TABLES or kind == 'index':
                continue
            columns = self.connection.execute(f'PRAGMA table_xinfo({str(name).lower()})').fetchall()
            if (
                kind != 'table'
                or 'VIRTUAL' in str(text).upper().split()[:2]
                or any(column[6] for column in columns)
            ):
                raise ValueError(
                    f"'{name}' must be a plain table, got a {kind} with {len(columns)} columns"
                )

    def count(self) -> dict[str, int]:
        """Return topic -> messages by counting them."""
        by_id = defaultdict(int)
        for stretch in self._stretches(list(self.topic_ids)):
            for topic_id, count in zip(
                *np.unique(stretch.topic_ids, return_counts=True), strict=True
            ):
                by_id[int(topic_id)] += int(count)
        return {name: sum(by_id[k] for k in ids) for name, ids in self.topic_ids.items()}

    def time_range(self) -> tuple[int, int] | None:
        """
        Return (first, last) receive time in ns.

        Or None when there are no messages or they cannot be read.
        """
        with suppress(sqlite3.Error):
            (first,) = self.connection.execute('SELECT min(timestamp) FROM messages').fetchone()
            (last,) = self.connection.execute('SELECT max(timestamp) FROM messages').fetchone()
            return (
                (first, last) if isinstance(first, int) and isinstance(last, int) else None
            )  # a damaged index has other values
        return None

    def close(self) -> None:
        """Close the file."""
        self.connection.close()

    def _stretches(self, _topics):
        root = self._root()
        if root is None:
            yield from self._rows_by_sql()
            return
        reader = PageReader(self.path, root)
        try:
            with closing(read_ahead(reader.stretches())) as pieces:
                for buffer, starts in pieces:
                    rows = reader.rows(buffer, starts)
                    yield Stretch(rows.topic_id, partial(self._pack, rows), rows.received_ns)
        finally:
            reader.close()
            if reader.damaged_pages:
                # A page that cannot be read has an unknown number of rows.
                self._lose(f'unreadable pages {UNKNOWN_EXTENT}', reader.damaged_pages)
            if reader.damaged_rows:
                self._lose('unreadable rows', reader.damaged_rows)

    def _root(self):
        """
        Return the root page of the table of messages.

        Or None when only SQL can read it (write-ahead log, other columns).
        """
        columns = [row[1] for row in self.connection.execute('PRAGMA table_info(messages)')]
        found = self.connection.execute(
            "SELECT rootpage, sql FROM sqlite_master WHERE type = 'table' AND name = 'messages'"
        ).fetchone()
        if (
            self.logged
            or columns != MESSAGE_COLUMNS
            or not found
            or 'INTEGER PRIMARY KEY' not in found[1].upper()
        ):
            return None
        return found[0]

    def _pack(self, rows, index):
        """
        Return the data of some rows.

        Data that continue in overflow pages are read by SQL and appended to the pages.
        """
        start, size = rows.start[index], rows.size[index]
        outside = np.flatnonzero(~rows.inside[index])
        if not len(outside):
            return index, Packed(rows.buffer, start, size)
        found = [self._by_id(int(rows.row_id[index[k]])) for k in outside]
        tail = Packed.join([data or b'' for data in found])
        start[outside], size[outside] = len(rows.buffer) + tail.start, tail.size
        kept = np.ones(len(index), dtype=bool)
        kept[outside] = [data is not None for data in found]
        return index[kept], Packed(
            np.concatenate([rows.buffer, tail.buffer]), start[kept], size[kept]
        )

    def _by_id(self, row_id):
        try:
            return memoryview(
                self.connection.execute(
                    'SELECT data FROM messages WHERE id = ?', (row_id,)
                ).fetchone()[0]
            ).tobytes()
        except (sqlite3.Error, TypeError):
            self._lose('unreadable rows', 1)
            return None

    def _rows_by_sql(self):
        cursor = iter(
            self.connection.execute('SELECT topic_id, timestamp, data FROM messages ORDER BY id')
        )
        while True:
            rows: list[Any] = []
            try:
                rows.extend(islice(cursor, STRETCH_ROWS))
            except sqlite3.Error as error:
                self._lose(f'rest {UNKNOWN_EXTENT} after damage ({error})', 1)
            usable = [row for row in rows if tuple(map(type, row)) == (int, int, bytes)]
            if len(usable) < len(rows):
                self._lose('rows with values of other types', len(rows) - len(usable))
            if usable:
                ids, received, messages = zip(*usable, strict=True)
                packed, received = Packed.join(messages), np.array(received, dtype=np.int64)
                yield Stretch(
                    np.array(ids),
                    lambda index, packed=packed: (index, packed.select(index)),
                    received.__getitem__,
                )
            if len(rows) < STRETCH_ROWS:  # the end, or damage
                return


def _connect(path, logged):
    """
    Open read-only; ``immutable`` keeps SQLite from looking for locks, but hides a write-ahead log.
    """
    if os.path.getsize(path) < 512:
        raise sqlite3.DatabaseError('the file is shorter than one page')
    address = f'file:{quote(str(path))}?mode=ro' + ('' if logged else '&immutable=1')
    connection = sqlite3.connect(address, uri=True, check_same_thread=False)
    # Without this SQLite refuses a truncated file; with it the remaining rows can be read.
    connection.execute('PRAGMA writable_schema = ON')
    connection.text_factory = partial(str, encoding='utf-8', errors='replace')
    return connection


SCHEMA_STATEMENTS = (
    'CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)',
    (
        'CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata'
        ' TEXT NOT NULL)'
    ),
    (
        'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,'
        ' serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,'
        ' type_description_hash TEXT NOT NULL)'
    ),
    (
        'CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,'
        ' encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, type_description_hash'
        ' TEXT NOT NULL)'
    ),
    (
        'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER'
        ' NOT NULL, data BLOB NOT NULL)'
    ),
)


PAGE_SIZE = 16384
"""Bytes; SQLite writes and balances fewer pages than with its default of 4096."""
INSERTED_ROWS = 256
"""
Rows per statement; SQLite finds the end of the table once for all of them. Older versions allow 999
values.
"""


class SqliteWriter:
    """Writes one new file, which must not be opened elsewhere before `close`."""

    def __init__(self, path: Path, ros_distro: str):
        self.connection = sqlite3.connect(path, isolation_level=None)
        # The file is made under another name and deleted on failure: a journal would have no
        # benefit.
        for pragma in (
            f'page_size = {PAGE_SIZE}',
            'journal_mode = OFF',
            'synchronous = OFF',
            'locking_mode = EXCLUSIVE',
            'cache_size = -16000',
        ):
            self.connection.execute('PRAGMA ' + pragma)
        self.connection.execute('BEGIN')
        for statement in SCHEMA_STATEMENTS:
            self.connection.execute(statement)
        self.connection.execute('INSERT INTO schema VALUES (4, ?)', (ros_distro,))

    def add_topic(self, topic_id: int, name: str, definition: TypeDefinition, *, qos: str) -> None:
        """Declare a topic; `definition` is a TypeDefinition."""
        self.connection.execute(
            'INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)',
            (topic_id, name, definition.type, 'cdr', qos, definition.digest),
        )
        known = self.connection.execute(
            'SELECT 1 FROM message_definitions WHERE topic_type = ?', (definition.type,)
        ).fetchone()
        if not known and definition.text:
            self.connection.execute(
                'INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition,'
                ' type_description_hash) VALUES (?, ?, ?, ?)',
                (definition.type, definition.encoding, definition.text, definition.digest),
            )

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Packed) -> None:
        """Append messages: arrays of topic ids and receive times, and the messages."""
        values = chain.from_iterable(
            zip(topic_ids.tolist(), received_ns.tolist(), messages.copies(), strict=True)
        )
        whole = len(messages) // INSERTED_ROWS * INSERTED_ROWS
        for count, rows in ((whole, INSERTED_ROWS), (len(messages) - whole, 1)):
            self.connection.executemany(
                'INSERT INTO messages (topic_id, timestamp, data) VALUES '
                + ', '.join(['(?, ?, ?)'] * rows),
                zip(*[islice(values, 3 * count)] * (3 * rows), strict=True),
            )

    def close(self, information: dict[str, Any], metadata: str) -> None:
        """Add the index by time and the metadata as text, and close."""
        self.connection.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
        self.connection.execute(
            'INSERT INTO metadata (metadata_version, metadata) VALUES (?, ?)',
            (information['version'], metadata),
        )
        self.connection.execute('COMMIT')
        self.connection.close()

    def abort(self) -> None:
        """Close without finishing."""
        self.connection.close()
