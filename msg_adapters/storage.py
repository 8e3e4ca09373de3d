"""Common part of the readers of storage files: from stretches of rows to messages by topic."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from msg_adapters.layout import Packed

LARGEST_STRETCH = 64 << 20
"""Bytes of the messages of a stretch when they are decompressed one by one."""


class Stretch(NamedTuple):
    """Consecutive messages of a file, of all topics."""

    topic_ids: np.ndarray
    """The file's own numbers of topics, shape (n,)."""
    packed: Packed
    """The messages."""
    received_ns: Callable
    """Index array -> receive times, int64."""


class RawMessages(NamedTuple):
    """Consecutive messages of some topics, in file order."""

    topic: np.ndarray
    """Index into the requested topics, shape (n,)."""
    received_ns: Callable[[], np.ndarray]
    """Called without arguments: receive times, int64, shape (n,); rarely needed."""
    packed: Packed
    """The messages."""

    def of(self, number: int) -> tuple[Packed, Callable[[], np.ndarray]]:
        """Return (messages, function that returns their receive times) of a requested topic."""
        index = np.flatnonzero(self.topic == number)
        return self.packed.select(index), lambda: self.received_ns()[index]


Piece = TypeVar('Piece')

STRETCH_MESSAGES = 8192
"""Messages, rows or chunks of a batch at most."""


def grouped(messages: Iterable[tuple[int, int, bytes]]) -> Iterator[RawMessages]:
    """Yield RawMessages of (index of the topic, receive time, message) that arrive one by one."""
    for batch in batches(messages, lambda message: len(message[-1]), LARGEST_STRETCH):
        numbers, times, data = zip(*batch, strict=True)
        yield RawMessages(
            np.array(numbers), partial(np.array, times, dtype=np.int64), Packed.join(data)
        )


def batches(
    items: Iterable[Piece], n_bytes_of: Callable[[Piece], int], most_bytes: int
) -> Iterator[list[Piece]]:
    """
    Yield consecutive items in lists that end at a number of bytes, or at `STRETCH_MESSAGES` items.
    """
    batch = []
    n_bytes = 0
    for item in items:
        batch.append(item)
        n_bytes += n_bytes_of(item)
        if len(batch) == STRETCH_MESSAGES or n_bytes >= most_bytes:
            yield batch
            batch = []
            n_bytes = 0
    if batch:
        yield batch


class StorageFile:
    """
    Base of the readers of one file.

    They provide `topic_ids` (topic -> numbers) and `_stretches`, count in `lost`, and have `types`,
    `definitions`, `count`, `time_range` and `close`. Writers have `add_topic`, `write`, `close`
    (finishes the file) and `abort`.

    Parameters
    ----------
    path : path-like
        The file.
    unpack : callable, optional
        Bytes -> bytes for each message (compression by message).

    """

    topic_ids: dict[str, list[int]]
    """Topic -> the file's own numbers of it."""

    def __init__(self, path: str | PathLike[str], unpack: Callable[[bytes], bytes] | None = None):
        self.path = Path(path)
        self.unpack = unpack
        self.lost: dict[str, int] = {}
        """Reason -> messages that could not be read."""

    def _stretches(self, topics: Sequence[str]) -> Iterator[Stretch]:
        """Yield the Stretches of the file that may hold messages of the topics."""
        raise NotImplementedError

    def stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """
        Yield RawMessages of the topics in file order.

        Lost messages of the file are counted in `lost`.
        """
        for stretch in self._stretches(topics):
            number = self._topic_numbers(stretch.topic_ids, topics)
            index = np.flatnonzero(number >= 0)
            if len(index):
                index, packed = self._messages_at(stretch, index)
                yield RawMessages(number[index], partial(stretch.received_ns, index), packed)

    def _topic_numbers(self, topic_ids: np.ndarray, topics: Sequence[str]) -> np.ndarray:
        """
        Return the index into `topics` of each message, -1 for other topics, shape (n,).

        The ids are looked up at once, because a hostile file has thousands of topics.
        """
        # A file without a summary declares topics between its messages.
        ids_of_topic = self.topic_ids
        number_of = {}
        for number, topic in enumerate(topics):
            for topic_id in ids_of_topic.get(topic, ()):
                number_of[topic_id] = number
        if not number_of:
            return np.full(len(topic_ids), -1)
        ids = np.array(sorted(number_of))
        numbers = np.array([number_of[topic_id] for topic_id in ids.tolist()])
        # `place`: where the id of a message is among the sorted ids, if it is one of them.
        place = np.minimum(np.searchsorted(ids, topic_ids), len(ids) - 1)
        return np.where(ids[place] == topic_ids, numbers[place], -1)

    def _messages_at(self, stretch: Stretch, index: np.ndarray) -> tuple[np.ndarray, Packed]:
        """
        Return (index, messages) of a stretch without those that cannot be decompressed.

        `index`: messages of the stretch, shape (n,).
        """
        packed = stretch.packed.select(index)
        if self.unpack is None:
            return index, packed
        readable = []
        messages = []
        n_bytes = 0
        for k in range(len(packed)):
            message = self._unpacked(packed.message(k), n_bytes)
            if message is not None:
                readable.append(k)
                messages.append(message)
                n_bytes += len(message)
        return index[readable], Packed.join(messages)

    def _unpacked(self, data: bytes, n_before: int) -> bytes | None:
        """
        Return a decompressed message of a stretch that has `n_before` bytes already.

        None, and counted in `lost`, when it is damaged or the stretch is too large.
        """
        if n_before >= LARGEST_STRETCH:
            self._lose(f'messages that expand beyond {LARGEST_STRETCH} bytes', 1)
            return None
        # Called only where `unpack` is given.
        assert self.unpack is not None
        try:
            return self.unpack(data)
        except Exception as error:  # decompressors raise various errors on damaged data
            self._lose(f'messages that cannot be decompressed ({error})', 1)
            return None

    def _lose(self, kind: str, count: int) -> None:
        """Count lost data in `lost`; `kind` describes it without the name of the file."""
        reason = f'{kind} of {self.path.name}'
        self.lost[reason] = self.lost.get(reason, 0) + count


def type_with_encoding(message_type: str, encoding: str) -> str:
    """Return a message type; serializations other than CDR are named after it."""
    return message_type if encoding == 'cdr' else f'{message_type} ({encoding})'


PIECES_AHEAD = 3
"""Pieces that are read or wait at most; bounds the memory."""

_END: Any = object()
"""Result of `next` at the end of a generator."""


def read_ahead(pieces: Generator[Piece, None, None]) -> Generator[Piece, None, None]:
    """
    Run a generator in a thread and yield its items in order; its exceptions are raised here.

    The thread ends with the generator, or soon after the consumer has closed this one.
    """
    with ThreadPoolExecutor(1) as thread:
        # Results of the next pieces, in order; the thread works on the first unfinished one.
        futures: deque[Future] = deque()
        try:
            for _ in range(PIECES_AHEAD):
                futures.append(thread.submit(next, pieces, _END))
            while (piece := futures.popleft().result()) is not _END:
                futures.append(thread.submit(next, pieces, _END))
                yield piece
        finally:
            for future in futures:
                future.cancel()
            # In the thread, because an interruption may have left it within the generator.
            thread.submit(pieces.close)
