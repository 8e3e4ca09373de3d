"""ROS 1 bags, read by rosbags one raw message at a time."""

import bz2
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.layout import Packed, clean_name
from msg_adapters.mcap_records import LARGEST_CHUNK, decompress
from msg_adapters.storage import Arrived

STRETCH = 8192
"""Messages per stretch."""


class Ros1File:
    """One .bag file through rosbags' reader."""

    ros1 = True

    def __init__(self, path: Path):
        from rosbags.rosbag1 import Reader
        self.reader = Reader(Path(path))
        self.reader.open()
        self.reader.chunks = {place: _bounded(chunk) for place, chunk in self.reader.chunks.items()}
        self.lost = {}
        self.counts = {}
        self.types = {}
        self.definitions = {}
        self.topics = {}
        """Id of a connection -> topic."""
        for connection in self.reader.connections:
            topic = self.topics[connection.id] = clean_name(connection.topic)
            self.types[topic] = message_type = clean_name(connection.msgtype)
            self.counts[topic] = self.counts.get(topic, 0) + connection.msgcount
            self.definitions[message_type] = ('ros2msg', connection.msgdef.data)

    @property
    def duration_ns(self) -> int:
        """Time between the first and the last message by the clock of the recorder."""
        return max(self.reader.end_time - self.reader.start_time - 1, 0) if self.reader.message_count else 0

    def stretches(self, topics: Sequence[str]) -> Iterator[dict[str, Packed]]:
        """Yield dicts topic -> Arrived in file order; lost messages of the file are counted in `lost`."""
        connections = [c for c in self.reader.connections if self.topics[c.id] in topics]
        pending, n_pending, n_read = defaultdict(list), 0, 0
        expected = sum(c.msgcount for c in connections)
        messages = self.reader.messages(connections) if connections else iter(())
        while True:
            try:
                connection, received_ns, data = next(messages)
            except StopIteration:
                break
            except Exception as error:   # rosbags raises various errors on damaged files
                self.lost[f'messages after damage ({error})'] = max(expected - n_read, 1)
                break
            pending[self.topics[connection.id]].append((bytes(data), received_ns))
            n_pending, n_read = n_pending + 1, n_read + 1
            if n_pending == STRETCH:
                yield _arrived(pending)
                pending, n_pending = defaultdict(list), 0
        if pending:
            yield _arrived(pending)

    def close(self) -> None:
        """Close the file."""
        with suppress(Exception):
            self.reader.close()


def _bounded(chunk: Any) -> Any:
    """Return a chunk of rosbags' reader that decompresses within limits."""
    from lz4 import frame
    compression = {bz2.decompress: 'bz2', frame.decompress: 'lz4'}.get(chunk.decompressor)
    return chunk if compression is None else chunk._replace(decompressor=lambda data: decompress(compression, data, LARGEST_CHUNK))


def _arrived(pending):
    """Return topic -> Arrived from topic -> [(message, receive time)]."""
    found = {}
    for topic, entries in pending.items():
        messages, times = zip(*entries, strict=True)
        found[topic] = Arrived(Packed.join(list(messages)), partial(np.array, times, dtype=np.int64))
    return found
