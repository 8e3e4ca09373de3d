"""The storages of rosbag2 that are read and written: to add one, add its entry to `STORAGES`."""

from collections.abc import Callable
from typing import NamedTuple

from msg_adapters.mcap_file import McapFile
from msg_adapters.mcap_writer import McapWriter
from msg_adapters.sqlite_file import SqliteFile, SqliteWriter


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


STORAGES = [
    Storage('sqlite3', '.db3', SqliteFile, SqliteWriter),
    Storage('mcap', '.mcap', McapFile, McapWriter),
]


def identifiers() -> list[str]:
    """Return the names of the storages in rosbag2."""
    return [storage.identifier for storage in STORAGES]


def suffixes() -> list[str]:
    """Return how their files end."""
    return [storage.suffix for storage in STORAGES]
