"""A rosbag2 sqlite3 storage file, schema version 4."""

import sqlite3
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from msg_adapters.definitions import TypeDefinition

SCHEMA = (
    'CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)',
    'CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL)',
    'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, '
    'offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL)',
    'CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL, '
    'encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL)',
    'CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL)',
)


class SqliteWriter:
    """Writes one new file, which must not be opened elsewhere before `close`."""

    def __init__(self, path: Path, ros_distro: str):
        self.connection = sqlite3.connect(path, isolation_level=None)
        # The file is made under another name and deleted on failure: a journal would have no benefit.
        for pragma in ('journal_mode = OFF', 'synchronous = OFF', 'locking_mode = EXCLUSIVE', 'cache_size = -16000'):
            self.connection.execute('PRAGMA ' + pragma)
        self.connection.execute('BEGIN')
        for statement in SCHEMA:
            self.connection.execute(statement)
        self.connection.execute('INSERT INTO schema VALUES (4, ?)', (ros_distro,))

    def add_topic(self, topic_id: int, name: str, definition: TypeDefinition, *, qos: str) -> None:
        """Declare a topic; `definition` is a TypeDefinition."""
        self.connection.execute('INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)',
                                (topic_id, name, definition.type, 'cdr', qos, definition.digest))
        known = self.connection.execute('SELECT 1 FROM message_definitions WHERE topic_type = ?', (definition.type,)).fetchone()
        if not known and definition.text:
            self.connection.execute(
                'INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition, type_description_hash) '
                'VALUES (?, ?, ?, ?)', (definition.type, definition.encoding, definition.text, definition.digest))

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Sequence[memoryview]) -> None:
        """Append messages: arrays of topic ids and receive times, and a list of byte strings."""
        self.connection.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)',
                                    zip(topic_ids.tolist(), received_ns.tolist(), messages, strict=True))

    def close(self, metadata_version: int, metadata: str) -> None:
        """Add the index by time and the metadata, and close."""
        self.connection.execute('CREATE INDEX timestamp_idx ON messages (timestamp ASC)')
        self.connection.execute('INSERT INTO metadata (metadata_version, metadata) VALUES (?, ?)', (metadata_version, metadata))
        self.connection.execute('COMMIT')
        self.connection.close()

    def abort(self) -> None:
        """Close without finishing."""
        self.connection.close()
