"""The storages of rosbag2 that are read and written: to add one, add its entry to `STORAGES`."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

from msg_adapters.mcap_file import McapFile, McapWriter
from msg_adapters.sqlite_file import SqliteFile, SqliteWriter
from msg_adapters.storage import RawMessages


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

    def stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """Yield RawMessages of the topics in file order."""

    def close(self) -> None:
        """Close the files."""


class Storage(NamedTuple):
    """One kind of storage file."""

    identifier: str
    """Name in rosbag2."""
    suffix: str
    """How its files end."""
    reader: type[SqliteFile] | type[McapFile]
    """Opens (path, decompressor of each message, or None) for reading."""
    writer: Callable[..., SqliteWriter | McapWriter]
    """Makes (path, ROS distribution, options by name)."""


STORAGES = [Storage('sqlite3', '.db3', SqliteFile, SqliteWriter), Storage('mcap', '.mcap', McapFile, McapWriter)]


def identifiers() -> list[str]:
    """Return the names of the storages in rosbag2."""
    return [storage.identifier for storage in STORAGES]


def suffixes() -> list[str]:
    """Return how their files end."""
    return [storage.suffix for storage in STORAGES]
