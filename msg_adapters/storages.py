"""The storages of rosbag2 that are read and written: to add one, add its entry to `STORAGES`."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from msg_adapters.definitions import TypeDefinition
from msg_adapters.mcap_file import McapFile, McapWriter
from msg_adapters.sqlite_file import SqliteFile, SqliteWriter
from msg_adapters.storage import Arrived, RawMessages


class BagSource(Protocol):
    """The messages of one recording, independent of its file format: `rosbag2.Rosbag2` or `bag.Ros1File`."""

    ros1: bool
    """Whether the messages are serialized as in ROS 1."""
    types: dict[str, str]
    """Topic -> message type."""
    definitions: dict[str, tuple[str, str]]
    """Message type -> (encoding, text) of its definition."""
    counts: dict[str, int]
    """Topic -> number of messages by the recording's metadata."""

    @property
    def lost(self) -> dict[str, int]:
        """Unreadable data, reason -> count."""

    @property
    def duration_ns(self) -> int:
        """Time between the first and the last message by the clock of the recorder."""

    def stretches(self, topics: Sequence[str]) -> Iterator[dict[str, Arrived]]:
        """Yield dicts topic -> Arrived in file order."""

    def close(self) -> None:
        """Close the files."""


class StorageReader(Protocol):
    """One storage file that is open for reading; `storage.StorageFile` does most of it."""

    lost: dict[str, int]
    """Reason -> messages that could not be read."""

    @property
    def types(self) -> dict[str, str]:
        """Topic -> message type."""

    @property
    def definitions(self) -> dict[str, tuple[str, str]]:
        """Message type -> (encoding, text) of its definition."""

    def stretches(self, topics: Sequence[str]) -> Iterator[dict[str, Arrived]]:
        """Yield dicts topic -> Packed in file order."""

    def raw_stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """Yield messages of the topics in file order, with their receive times."""

    def count(self) -> dict[str, int]:
        """Return the number of messages of each topic."""

    def time_range(self) -> tuple[int, int] | None:
        """Return the first and last receive time, ns, or None."""

    def close(self) -> None:
        """Close the file."""


class StorageWriter(Protocol):
    """One new storage file."""

    def add_topic(self, topic_id: int, name: str, definition: TypeDefinition, *, qos: str) -> None:
        """Declare a topic before its messages; `qos` are the profiles of its publishers as YAML."""

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Sequence[memoryview]) -> None:
        """Append messages in the order of the file."""

    def close(self, metadata_version: int, metadata: str, /) -> None:
        """Finish the file with the metadata of the bag as YAML, and close."""

    def abort(self) -> None:
        """Close without finishing."""


class Storage(NamedTuple):
    """One kind of storage file."""

    identifier: str
    """Name in rosbag2."""
    suffix: str
    """How its files end."""
    reader: type[StorageReader]
    """Opens (path, decompressor of each message, or None) for reading."""
    writer: Callable[..., StorageWriter]
    """Makes (path, ROS distribution, options by name)."""


STORAGES = [Storage('sqlite3', '.db3', SqliteFile, SqliteWriter), Storage('mcap', '.mcap', McapFile, McapWriter)]


def identifiers() -> list[str]:
    """Return the names of the storages in rosbag2."""
    return [storage.identifier for storage in STORAGES]


def suffixes() -> list[str]:
    """Return how their files end."""
    return [storage.suffix for storage in STORAGES]
