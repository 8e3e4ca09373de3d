"""
rosbag2 sqlite3 storage, read and written (schema version 4).

The standard module ``sqlite3`` reads the rows. A file can declare more rows than it contains, so
two limits hold that an undamaged file does not reach: the messages of a scan have fewer bytes than
the file, and the instructions of SQLite are proportional to the size of the file.
"""

import os
import sqlite3
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from imu_calibration.core.documents import open_regular
from imu_calibration.core.exit_codes import UNKNOWN_EXTENT
from msg_adapters.definitions import TypeDefinition
from msg_adapters.layout import Packed, clean_name
from msg_adapters.storage import StorageFile, Stretch, batches, type_with_encoding

BATCH_ROWS = 256
"""Rows per ``fetchmany``; the objects of more rows do not fit into the cache of the processor."""
SMALL_BYTES = 16384
"""Larger messages are read one by one, so that a batch has at most 4 MB."""
STRETCH_ROWS = 8192
"""Rows that complete a stretch."""
STRETCH_BYTES = 16 << 20
"""Bytes of messages that complete a stretch."""
RANGE_IDS = 4096
"""
Ids whose messages SQLite appends to each other. Half as many rows of one topic complete a stretch:
they are not copied again, and they fit into the cache of the processor.
"""
FEWEST_ROWS = 64
"""Messages in such a range; where it has fewer, rows are read one by one."""
CAN_LIMIT = sys.version_info >= (3, 11)
"""Whether the bytes of one result can be limited; without it all rows are read one by one."""
FIRST_ID, LAST_ID = -(2**63), 2**63 - 1
STEP_IDS = 16
"""Ids of one step behind damage."""
MOST_STEPS = 2000
"""Steps in a scan until the remainder of the file is given up."""
INSTRUCTIONS_PER_BYTE = 8
"""
Instructions of SQLite in a scan, per byte of the file. A row has at least 11 bytes and costs about
40 instructions in all; a page that is listed again and again needs more.
"""
INSTRUCTIONS_PER_CALL = 1_000_000
"""Instructions between two tests of this limit."""
TABLES = ('topics', 'messages', 'message_definitions')
"""Tables that are read."""
MOST_TABLES = 1000
"""Entries of the schema that are read."""
MOST_TOPICS = 100_000
"""Rows of the tables of topics and of definitions that are read."""


class SqliteFile(StorageFile):
    """One .db3 file."""

    def __init__(self, path: str | PathLike[str], unpack: Callable[[bytes], bytes] | None = None):
        super().__init__(path, unpack)
        log = Path(f'{path}-wal')
        self.logged = log.exists() and log.stat().st_size > 0
        """Whether rows of a write-ahead log are read too."""
        self.size = self.path.stat().st_size
        """Bytes of the file and of its log."""
        if self.logged:
            self.size += log.stat().st_size
        self._n_calls = 0
        """Millions of instructions of SQLite (`INSTRUCTIONS_PER_CALL`) in the present scan."""
        self.connection = self._open()
        try:
            self._read_topics()
        except sqlite3.OperationalError as error:
            self.connection.close()
            if not self.logged:
                raise
            self.lost[f'write-ahead log {log.name} that cannot be read ({error})'] = 1
            self.logged = False
            self.connection = self._open()
            self._read_topics()
        except BaseException:
            self.connection.close()
            raise
        self._cut_page = None if self.logged else _incomplete_page(self.path)
        """Bytes of an incomplete last page; None without one."""
        if self._cut_page is not None:
            self._lose(f'incomplete last page {UNKNOWN_EXTENT}', 1)

    def _open(self) -> sqlite3.Connection:
        """Return a connection that stops beyond the limit; raises sqlite3.Error for no database."""
        connection = _connect(self.path, self.logged)
        connection.set_progress_handler(self._count_call, INSTRUCTIONS_PER_CALL)
        try:
            # This reads the header, and fails at a file that is no database.
            encoding = connection.execute('PRAGMA encoding').fetchone()
        except sqlite3.Error:
            connection.close()
            raise
        self._is_utf8 = encoding == ('UTF-8',)
        return connection

    def _count_call(self) -> bool:
        """Count `INSTRUCTIONS_PER_CALL`; SQLite stops where this returns True."""
        self._n_calls += 1
        return self._is_beyond_limit()

    def _is_beyond_limit(self) -> bool:
        """Return whether a scan has executed more instructions than an undamaged file needs."""
        limit = INSTRUCTIONS_PER_BYTE * self.size + 20 * INSTRUCTIONS_PER_CALL
        return self._n_calls * INSTRUCTIONS_PER_CALL > limit

    def _read_topics(self) -> None:
        """Read ids, types and definitions of the topics."""
        self._require_tables()
        self.topic_ids = defaultdict(list)
        self.types: dict[str, str] = {}
        """Topic -> message type (`type_with_encoding`)."""
        self.definitions: dict[str, tuple[str, str]] = {}
        """Message type -> (language, text)."""
        rows = self.connection.execute(
            'SELECT id, name, type, serialization_format FROM topics'
        ).fetchmany(MOST_TOPICS)
        for topic_id, name, message_type, encoding in rows:
            has_text = isinstance(name, str) and isinstance(message_type, str)
            if not has_text or not isinstance(topic_id, int):
                self._lose('topics without a name or type', 1)
                continue
            topic = clean_name(name)
            self.topic_ids[topic].append(topic_id)
            self.types[topic] = clean_name(type_with_encoding(message_type, encoding))
        with suppress(sqlite3.Error):  # before schema version 4 there are no definitions
            rows = self.connection.execute(
                'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
            ).fetchmany(MOST_TOPICS)
            self.definitions = {
                clean_name(str(name)): (str(encoding), str(text)) for name, encoding, text in rows
            }

    def _require_tables(self) -> None:
        """
        Refuse views, virtual tables and generated columns.

        They are programs that can give rows without end.
        """
        entries = self.connection.execute('SELECT type, name, sql FROM sqlite_master')
        for kind, name, text in entries.fetchmany(MOST_TABLES):
            table = str(name).lower()
            if table not in TABLES or kind == 'index':
                continue
            columns = self.connection.execute(f'PRAGMA table_xinfo({table})').fetchall()
            is_virtual = 'VIRTUAL' in str(text).upper().split()[:2]
            # Column 6 of table_xinfo: nonzero for hidden and generated columns.
            is_generated = any(column[6] for column in columns)
            if kind != 'table' or is_virtual or is_generated:
                raise ValueError(
                    f"'{name}' must be a plain table, got a {kind} with {len(columns)} columns"
                )

    def count(self) -> dict[str, int]:
        """Return topic -> messages by counting them."""
        self._n_calls = 0
        by_id: Counter = Counter()
        try:
            rows = self.connection.execute('SELECT topic_id FROM messages NOT INDEXED')
            by_id.update(chain.from_iterable(rows))
        except sqlite3.Error:
            # Damage: the readable rows are counted, and the loss is reported when they are read.
            by_id = Counter()
            lost = dict(self.lost)
            for stretch in self._stretches(list(self.topic_ids)):
                by_id.update(stretch.topic_ids.tolist())
            self.lost = lost
        return {name: sum(by_id[k] for k in ids) for name, ids in self.topic_ids.items()}

    def time_range(self) -> tuple[int, int] | None:
        """
        Return (first, last) receive time in ns.

        Or None when there are no messages or they cannot be read.
        """
        self._n_calls = 0
        with suppress(sqlite3.Error):
            (first,) = self.connection.execute('SELECT min(timestamp) FROM messages').fetchone()
            (last,) = self.connection.execute('SELECT max(timestamp) FROM messages').fetchone()
            # A damaged index has other values.
            return (first, last) if isinstance(first, int) and isinstance(last, int) else None
        return None

    def close(self) -> None:
        """Close the file."""
        self.connection.close()

    def _stretches(self, topics: Sequence[str]) -> Iterator[Stretch]:
        """Yield the messages of some topics in Stretches of many rows, in the order of the ids."""
        wanted: set[int] = set()
        for topic in topics:
            wanted.update(self.topic_ids.get(topic, ()))
        # A scan begins: instructions of SQLite, steps behind damage, and bytes of its messages.
        self._n_calls = 0
        self._n_steps = 0
        scanned_bytes = 0
        rows_of_stretch = RANGE_IDS // 2 if len(wanted) == 1 else STRETCH_ROWS
        # Parts of the present stretch, their rows and bytes.
        parts: list[Part] = []
        n_rows = 0
        n_bytes = 0
        for part in self._parts(wanted):
            part_bytes = len(part.packed.buffer)
            scanned_bytes += part_bytes
            # More messages than the file can hold: damaged rows refer to the same pages.
            if scanned_bytes > self.size:
                self._lose(f'rest {UNKNOWN_EXTENT} after rows that share their pages', 1)
                break
            parts.append(part)
            n_rows += len(part.packed)
            n_bytes += part_bytes
            if n_rows >= rows_of_stretch or n_bytes >= STRETCH_BYTES:
                yield _stretch(parts)
                parts = []
                n_rows = 0
                n_bytes = 0
        if parts:
            yield _stretch(parts)

    def _parts(self, wanted: set[int]) -> Iterator['Part']:
        """Yield the Parts of the rows with the topic ids `wanted`, in the order of the row ids."""
        if not wanted:
            return
        # Rows up to the id `after` are done; None where no further row can be read.
        after: int | None = FIRST_ID
        # 1. Messages of one topic and of one size at once. SQLite treats them as text in UTF-8, its
        #    result must be limited, and messages of an incomplete page need a test of each.
        if len(wanted) == 1 and self._is_utf8 and self._cut_page is None and CAN_LIMIT:
            after = yield from self._equal_messages(min(wanted))
        # 2. The remaining rows in batches. After an error the search continues behind the damage.
        unwanted = set(chain.from_iterable(self.topic_ids.values())) - wanted
        statement = _statement(wanted, unwanted)
        while after is not None:
            last_rows = []
            try:
                cursor = self.connection.execute(statement, (after, LAST_ID))
                while batch := cursor.fetchmany(BATCH_ROWS):
                    last_rows = batch
                    yield from self._usable(batch, wanted)
                return
            except sqlite3.Error as error:
                damage = error
            # The last good row: where a row has an undeclared topic, its id is damaged as well.
            ids = [row_id for row_id, topic_id, *_ in last_rows if topic_id in wanted]
            last_id = max([after, *ids[-1:]])
            after = yield from self._behind_damage(last_id, wanted, unwanted)
            if after is None:
                self._lose(f'rest {UNKNOWN_EXTENT} after damage ({damage})', 1)

    def _equal_messages(self, topic_id: int) -> Generator['Part', None, int]:
        """
        Yield the Parts of one topic while its messages have one size and its ids are dense.

        SQLite appends the messages of a range of ids to each other, which needs half the time of
        one object per row. It treats the bytes as text, which changes nothing in a database with
        UTF-8. The sizes are equal where their sum is the number of messages times the largest one.
        Return the id behind which other rows may follow.
        """
        rows_of_range = (
            f'FROM messages NOT INDEXED WHERE topic_id = {topic_id} AND _rowid_ > ?'
            ' AND _rowid_ <= ?'
        )
        statement = (
            "SELECT count(*), max(length(data)), CAST(group_concat(data, '') AS BLOB) "
            + rows_of_range
        )
        # A range has the ids above `after` up to `until`. The first one begins with the first row.
        after = FIRST_ID
        limit_before = self._limit_length(STRETCH_BYTES)
        try:
            (first,) = self.connection.execute('SELECT min(_rowid_) FROM messages').fetchone()
            until = FIRST_ID if first is None else max(first - 1, FIRST_ID)
            count = RANGE_IDS
            while count >= FEWEST_ROWS:
                after = until
                until = min(until + RANGE_IDS, LAST_ID)
                ids = (after, until)
                count, longest, messages = self.connection.execute(statement, ids).fetchone()
                # No row, or sizes that differ: these rows are read one by one.
                if longest is None or len(messages) != count * longest:
                    return after
                packed = Packed.of_sizes(messages, np.full(count, longest))
                times = partial(self._times, f'SELECT timestamp {rows_of_range}', ids)
                yield Part(packed, np.full(count, topic_id), times)
            return until
        except sqlite3.Error:  # damage, or more bytes than the limit
            return after
        finally:
            self._limit_length(limit_before)

    def _limit_length(self, n_bytes: int) -> int:
        """Limit the bytes of one result of SQLite; return the limit before."""
        if sys.version_info >= (3, 11):  # CAN_LIMIT, in the form of type checkers
            return self.connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, n_bytes)
        return n_bytes

    def _times(self, statement: str, ids: tuple[int, int]) -> list:
        """Return the receive times of the rows in a range of ids."""
        return [value for (value,) in self.connection.execute(statement, ids)]

    def _behind_damage(
        self, after: int, wanted: set[int], unwanted: set[int]
    ) -> Generator['Part', None, int | None]:
        """
        Yield the Parts of ranges of a few ids, to the first readable one behind damage.

        `after`: id of the last good row. Ids that a range lacks count as lost, because a damaged id
        ends a search without an error. Return the last id of the range, None where nothing behind
        the damage can be read.
        """
        statement = _statement(wanted, set())
        after = max(after, 0)  # the first id of a recorder is 1
        n_lost = 0
        n_readable = 0
        while self._n_steps < MOST_STEPS and not self._is_beyond_limit():
            self._n_steps += 1
            until = min(after + STEP_IDS, LAST_ID)
            readable = []
            with suppress(sqlite3.Error):
                readable = self.connection.execute(statement, (after, until)).fetchmany(STEP_IDS)
            after = until
            n_readable += len(readable)
            n_lost += STEP_IDS - len(readable)
            rows = [row for row in readable if row[1] not in unwanted]
            if rows:
                yield from self._usable(rows, wanted)
            # Rows again, after lost ones: the damage is passed.
            if readable and n_lost:
                self._lose('unreadable rows', n_lost)
                return after
            # No id is lost, but the damage was in the batch after the first id: it is passed after
            # as many rows.
            if n_readable > BATCH_ROWS:
                return after
        return None

    def _usable(self, rows: list[tuple], wanted: set[int]) -> Iterator['Part']:
        """
        Yield the Parts of rows (id, topic id, receive time, message).

        Rows that cannot be used are counted in `lost` and left out.
        """
        _, topic_ids, times, messages = zip(*rows, strict=True)
        # Usual rows at once, without a test of each; else those of `_usable_rows`.
        packed = None
        if self._cut_page is None:
            with suppress(TypeError):  # of a message that is None, text or a number
                packed = Packed.join(messages)
        if packed is not None:
            yield Part(packed, np.array(topic_ids), lambda: times)
            return
        usable = self._usable_rows(rows, wanted)
        for batch in batches(usable, lambda row: len(row[-1]), STRETCH_BYTES):
            topic_ids, times, messages = zip(*batch, strict=True)
            yield Part(Packed.join(messages), np.array(topic_ids), partial(list, times))

    def _usable_rows(self, rows: list[tuple], wanted: set[int]) -> Iterator[tuple[int, Any, bytes]]:
        """Yield (topic id, receive time, message) of the rows that can be used."""
        for row_id, topic_id, received_ns, message in rows:
            # The statement gives no large messages.
            if message is None and topic_id in wanted:
                message = self._large(row_id)
            if topic_id not in wanted or not isinstance(message, bytes):
                self._lose('rows with values of other types', 1)
                continue
            if self._is_cut(message):
                self._lose('rows of the incomplete last page', 1)
                continue
            yield topic_id, received_ns, message

    def _large(self, row_id: int) -> Any:
        """Return a message above `SMALL_BYTES`, None where it cannot be read."""
        with suppress(sqlite3.Error):
            (size,) = self.connection.execute(
                'SELECT length(data) FROM messages WHERE _rowid_ = ?', (row_id,)
            ).fetchone()
            if size <= self.size:
                (message,) = self.connection.execute(
                    'SELECT data FROM messages WHERE _rowid_ = ?', (row_id,)
                ).fetchone()
                return message
        return None

    def _is_cut(self, message: bytes) -> bool:
        """
        Return whether a message may end in the missing part of an incomplete page.

        SQLite returns zeros for the missing part. The present part of the message is then at the
        end of the file. Of a message that continues in an overflow page, the present part ends
        with this page without its first four bytes, which are the number of the next one.
        """
        if self._cut_page is None:
            return False
        present = message.rstrip(b'\0')
        if self._cut_page.endswith(present):
            return True
        overflow = self._cut_page[4:]
        return bool(overflow) and present.endswith(overflow)


@dataclass(frozen=True, eq=False)
class Part:
    """Usable messages of consecutive rows."""

    packed: Packed
    """The messages, one after the other."""
    topic_ids: np.ndarray
    """The file's number of the topic of each message, shape (n,)."""
    times: Callable[[], Sequence[Any]]
    """Called without arguments: the receive times, of any type in a damaged file."""


def _statement(wanted: set[int], unwanted: set[int]) -> str:
    """
    Return the statement for (id, topic id, receive time, message) of rows in a range of ids.

    The message is NULL unless its topic is in `wanted` and it is small. Only rows of `unwanted`
    topics are left out: rows of an undeclared topic are damaged and are counted.
    """
    # NOT INDEXED: a table scan in the order of the ids, without the indices that the file declares.
    return (
        f'SELECT _rowid_, topic_id, timestamp, CASE WHEN topic_id IN ({_listed(wanted)})'
        f' AND length(data) <= {SMALL_BYTES} THEN data END'
        ' FROM messages NOT INDEXED WHERE _rowid_ > ? AND _rowid_ <= ?'
        f' AND (topic_id IN ({_listed(unwanted)})) IS NOT TRUE'
    )


def _listed(numbers: set[int]) -> str:
    """Return numbers as a list in SQL."""
    return ', '.join(map(str, sorted(numbers)))


def _stretch(parts: list[Part]) -> Stretch:
    """Return the Stretch of consecutive Parts."""
    packed = Packed.chain([part.packed for part in parts])
    topic_ids = np.concatenate([part.topic_ids for part in parts])

    def received_ns(index: np.ndarray) -> np.ndarray:
        """Return the receive times at an index of the stretch; read when they are needed."""
        values = chain.from_iterable(part.times() for part in parts)
        return np.array(list(map(_integer, values)), dtype=np.int64)[index]

    return Stretch(topic_ids, packed, received_ns)


def _integer(value: Any) -> int:
    """Return a receive time; 0 for the values of other types in a damaged file."""
    return value if isinstance(value, int) else 0


def _incomplete_page(path: Path) -> bytes | None:
    """
    Return the bytes of an incomplete last page, without the zeros at their end; None without one.

    SQLite reads such a page as if it continued with zeros.
    """
    with open_regular(path) as file:
        header = file.read(32)
        # File format, section 1.3: size of a page at byte 16, with 1 for 65536.
        page_size = int.from_bytes(header[16:18], 'big')
        if page_size == 1:
            page_size = 65536
        n_bytes = os.fstat(file.fileno()).st_size
        n_incomplete = n_bytes % max(page_size, 512)
        file.seek(n_bytes - n_incomplete)
        return file.read(n_incomplete).rstrip(b'\0') if n_incomplete else None


def _connect(path: Path, logged: bool) -> sqlite3.Connection:
    """
    Open read-only; ``immutable`` makes SQLite ignore locks, but hides a write-ahead log.

    `logged`: a log is read without locks and with its index in memory, because SQLite would write
    the index next to the recording (``-shm``).
    """
    if os.path.getsize(path) < 512:
        raise sqlite3.DatabaseError('the file is shorter than one page')
    options = '&immutable=1'
    if logged:
        options = '&vfs=unix-none' if os.name == 'posix' else ''
    address = f'file:{quote(str(path))}?mode=ro{options}'
    connection = sqlite3.connect(address, uri=True, check_same_thread=False)
    if logged:
        connection.execute('PRAGMA locking_mode = EXCLUSIVE')
    # Without this SQLite refuses a truncated file; with it the remaining rows can be read.
    connection.execute('PRAGMA writable_schema = ON')
    # Cells are compared with their page when it is read: damage is an error, not a missing row.
    connection.execute('PRAGMA cell_size_check = ON')
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
    """Writes one new file, which must not be opened elsewhere before ``close``."""

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
        is_defined = self.connection.execute(
            'SELECT 1 FROM message_definitions WHERE topic_type = ?', (definition.type,)
        ).fetchone()
        if not is_defined and definition.text:
            self.connection.execute(
                'INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition,'
                ' type_description_hash) VALUES (?, ?, ?, ?)',
                (definition.type, definition.encoding, definition.text, definition.digest),
            )

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Packed) -> None:
        """Append messages: arrays of topic ids and receive times, and the messages."""
        # topic id, receive time and message of each row, one after the other
        values = chain.from_iterable(
            zip(topic_ids.tolist(), received_ns.tolist(), messages.copies(), strict=True)
        )
        n_in_groups = len(messages) // INSERTED_ROWS * INSERTED_ROWS
        self._insert(islice(values, 3 * n_in_groups), INSERTED_ROWS)
        self._insert(values, 1)

    def _insert(self, values: Iterator, n_rows: int) -> None:
        """Insert rows of three values by statements of `n_rows` rows."""
        places = ', '.join(['(?, ?, ?)'] * n_rows)
        # The same iterator for each place: a tuple of zip is the values of one statement.
        values_of_statements = zip(*[values] * (3 * n_rows), strict=True)
        self.connection.executemany(
            f'INSERT INTO messages (topic_id, timestamp, data) VALUES {places}',
            values_of_statements,
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
