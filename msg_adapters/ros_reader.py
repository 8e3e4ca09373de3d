"""
Recordings through rosbag2_py of a ROS 2 system.

It reads what this Python cannot decompress: an installation by apt has no zstd before Python 3.14.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from msg_adapters.compression import all_installed
from msg_adapters.layout import clean_name
from msg_adapters.rosbag2 import COMPRESSED, Rosbag2, read_metadata
from msg_adapters.storage import RawMessages, grouped
from msg_adapters.storages import STORAGES


class RosReader(Rosbag2):
    """One recording as one file of rosbag2_py; the metadata are read as in its base."""

    @staticmethod
    def installed() -> bool:
        """Return whether rosbag2_py can be imported."""
        with suppress(ImportError):
            import_module('rosbag2_py')
            return True
        return False

    @staticmethod
    def needed(path: Path) -> bool:
        """Return whether a recording may be compressed by something that is not installed here."""
        if all_installed():
            return False
        files = [path]
        if path.is_dir():
            if read_metadata(path).get('compression_mode'):
                return True
            files = list(path.iterdir())
        # Chunks of an .mcap file may be compressed; a plain SQLite file has no compressed parts.
        suffixes = {file.suffix for file in files if file.is_file()}
        return not suffixes.isdisjoint((*COMPRESSED, '.mcap'))

    @property
    def storage(self) -> str:
        """Name in rosbag2 of the storage."""
        return self.files[0].identifier

    def _storage_paths(self) -> list[Path]:
        """Return the recording itself: rosbag2_py finds its files."""
        return [self.path]

    def _open(self, path, unpack):  # noqa: ARG002
        """Open the recording, which rosbag2_py decompresses; return the error when that fails."""
        try:
            self.files.append(RosFile(path, self.metadata))
        except Exception as error:  # rosbag2_py raises RuntimeError of many causes
            return f'{path.name}: {error}'
        return None


class RosFile:
    """All messages of one recording."""

    definitions: dict[str, tuple[str, str]] = {}
    """rosbag2_py has none: the types are those of the sourced ROS 2."""

    def __init__(self, path: Path, metadata: dict[str, Any]):
        self.path = path
        self.lost: dict[str, int] = {}
        """No loss is known: rosbag2_py raises for damage."""
        self._compressed = bool(metadata.get('compression_mode'))
        storages = {storage.suffix: storage.identifier for storage in STORAGES}
        self.identifier = metadata.get('storage_identifier') or storages.get(path.suffix, '')
        reader = self._reader()
        self.types = {
            clean_name(topic.name): clean_name(topic.type)
            for topic in reader.get_all_topics_and_types()
        }
        self._content = reader.get_metadata()

    def _reader(self) -> Any:
        """Return a reader at the first message."""
        ros = import_module('rosbag2_py')
        reader = ros.SequentialCompressionReader() if self._compressed else ros.SequentialReader()
        reader.open(
            ros.StorageOptions(uri=str(self.path), storage_id=self.identifier),
            ros.ConverterOptions('', ''),
        )
        return reader

    def count(self) -> Counter:
        """Return the messages of each topic."""
        return Counter(
            {
                clean_name(entry.topic_metadata.name): entry.message_count
                for entry in self._content.topics_with_message_count
            }
        )

    def time_range(self) -> tuple[int, int]:
        """Return the receive times of the first and the last message, ns."""
        first = self._content.starting_time.nanoseconds
        return first, first + self._content.duration.nanoseconds

    def stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """Yield RawMessages of the topics in the order of the recording."""
        return grouped(self._messages(list(topics)))

    def _messages(self, topics: list[str]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index of the topic, receive time, message)."""
        ros = import_module('rosbag2_py')
        reader = self._reader()
        reader.set_filter(ros.StorageFilter(topics=topics))
        while reader.has_next():
            topic, data, received_ns = reader.read_next()
            if topic in topics:
                yield topics.index(topic), received_ns, bytes(data)

    def close(self) -> None:
        """Leave nothing open: each reader ends with its object."""
