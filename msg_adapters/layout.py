"""Layout of messages in CDR, and header stamps."""

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.errors import printable

MAX_LAYOUTS = 16
"""
A stretch with more layouts than this is not worth grouping; its further messages are decoded one by
one.
"""


@dataclass(frozen=True, eq=False)
class Packed:
    """Serialized messages of one topic, in order, anywhere in one buffer."""

    buffer: np.ndarray
    """The bytes, uint8, shape (n_bytes,)."""
    start: np.ndarray
    """First byte of each message, int64, shape (n,)."""
    size: np.ndarray
    """Bytes of each message, int64, shape (n,)."""

    def __len__(self) -> int:
        return len(self.start)

    def message(self, index: int) -> bytes:
        """Return the bytes of one message."""
        start = int(self.start[index])
        return self.buffer[start : start + int(self.size[index])].tobytes()

    def views(self) -> list[memoryview]:
        """Return the messages without copying them."""
        return list(self._parts(self.buffer.data))

    def copies(self) -> Iterator[bytearray]:
        """
        Yield copies of the messages.

        SQLite binds a bytearray in half the time of bytes, for which Python looks for an adapter.
        """
        return self._parts(bytearray(self.buffer))

    def _parts(self, data: Any) -> Iterator:
        """Yield the bytes of each message in the buffer `data`, in its type."""
        ends = (self.start + self.size).tolist()
        return (data[start:end] for start, end in zip(self.start.tolist(), ends, strict=True))

    def copy_to(self, target: np.ndarray, place: np.ndarray) -> None:
        """
        Copy each message into the bytes `target`, from its `place` on: one gather for each size.
        """
        # Messages of one size as words of this many bytes; `overlapping` has a word at each byte.
        order = np.argsort(self.size, kind='stable')
        size_changes = np.flatnonzero(np.diff(self.size[order])) + 1
        for of_size in np.split(order, size_changes):
            if len(of_size) and self.size[of_size[0]]:
                word = f'V{self.size[of_size[0]]}'
                words = overlapping(self.buffer, word)[self.start[of_size]]
                overlapping(target, word)[place[of_size]] = words

    def items_at(self, offset: int, dtype: str) -> np.ndarray:
        """
        Return the item at `offset` bytes from the start of each message, shape (n,).

        A strided view where the messages have one distance: a gather needs four times as long.
        """
        if self._distance is None:
            return overlapping(self.buffer, dtype)[self.start + offset]
        first = int(self.start[0]) + offset
        return np.ndarray((len(self),), dtype, self.buffer, first, (self._distance,))

    @cached_property
    def _distance(self) -> int | None:
        """Bytes between the starts of neighbours, None where they differ."""
        steps = np.diff(self.start)
        return int(steps[0]) if len(steps) and (steps == steps[0]).all() else None

    def select(self, index: np.ndarray) -> 'Packed':
        """Return some of the messages."""
        return Packed(self.buffer, self.start[index], self.size[index])

    @classmethod
    def join(cls, messages: Sequence[bytes]) -> 'Packed':
        """Pack a list of bytes objects."""
        size = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
        return cls.of_sizes(b''.join(messages), size)

    @classmethod
    def of_sizes(cls, data: bytes, size: np.ndarray) -> 'Packed':
        """Return the messages that follow each other in `data`; `size`: int64, shape (n,)."""
        return cls(np.frombuffer(data, dtype=np.uint8), np.cumsum(size) - size, size)

    @classmethod
    def of_rows(cls, table: np.ndarray) -> 'Packed':
        """Pack the rows of a byte table, one message each."""
        count, size = table.shape
        return cls(table.reshape(-1), size * np.arange(count), np.full(count, size))

    @classmethod
    def chain(cls, parts: Sequence['Packed']) -> 'Packed':
        """Return the messages of all parts, one part after the other."""
        if len(parts) == 1:
            return parts[0]
        buffers = []
        starts = []
        sizes = []
        n_bytes = 0
        for part in parts:
            buffers.append(part.buffer)
            starts.append(part.start + n_bytes)
            sizes.append(part.size)
            n_bytes += len(part.buffer)
        return cls(np.concatenate(buffers), np.concatenate(starts), np.concatenate(sizes))


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """
    Positions of the numbers of a message, and its bytes that decide on the layout.

    Another message has the same layout if its size and its `fixed` bytes are equal.
    """

    order: str
    """Byte order, '<' or '>'."""
    size: int
    """Bytes of the message that is the source of `sample`."""
    sample: bytes
    """The message that the layout was found from."""
    fixed: tuple
    """
    Ranges (first, last + 1) of bytes that must equal the bytes of `sample`; padding and numbers are
    outside.
    """
    offsets: dict
    """Field name -> (offset of its first double, number of doubles)."""
    names: tuple = ()
    """Strings of the message: the frame_id, or the joint names."""

    def matches(self, packed: Packed) -> np.ndarray:
        """Return which messages have this layout, bool, shape (n,)."""
        same = packed.size == self.size
        # A message of another size could end beyond the buffer: one of this size replaces it.
        start = np.where(same, packed.start, packed.start[np.argmax(same)])
        complete = Packed(packed.buffer, start, packed.size)
        for offset, mask, expected in _checks(self.fixed, self.sample):
            same &= (complete.items_at(offset, '<u8') & mask) == expected
        return same

    def stamp_ns(self, packed: Packed) -> np.ndarray:
        """Return the header stamps of messages that have this layout, int64, shape (n,)."""
        # Seconds and nanoseconds alternate, four bytes each; seconds are signed.
        pairs = np.ascontiguousarray(packed.items_at(ENCAPSULATION_SIZE, 'V8'))
        sec = pairs.view(self.order + 'i4')[::2]
        nanosec = pairs.view(self.order + 'u4')[1::2]
        return sec.astype(np.int64) * NS_PER_S + nanosec

    def column(self, packed: Packed, name: str, count: int | None = None) -> np.ndarray:
        """
        Return the doubles of field `name`, or its first `count`, of messages that have this layout.

        Shape (n, count).
        """
        offset, length = self.offsets[name]
        count = length if count is None else count
        if not count:
            return np.empty((len(packed), 0))
        # The complete row at once: several times faster than number by number.
        rows = np.ascontiguousarray(packed.items_at(offset, f'V{8 * count}'))
        return rows.view(self.order + 'f8').reshape(-1, count).astype(float, copy=False)


def group_by_layout(
    packed: Packed, find_layout: Callable
) -> tuple[list[tuple[MessageLayout, np.ndarray, Packed]], int]:
    """
    Split messages into groups of one layout each; after `MAX_LAYOUTS` groups each message is one.

    Parameters
    ----------
    packed : Packed
        Messages of one topic.
    find_layout : callable
        Message bytes -> MessageLayout; raises MessageError when the bytes are not such a message.

    Returns
    -------
    groups : list of (MessageLayout, index, Packed)
        Integer indices in ascending order per group, and these messages.
    n_broken : int
        Messages that are invalid.

    """
    groups = []
    n_broken = 0
    remaining = np.arange(len(packed))
    while len(remaining):
        # The layout of the first message, then all messages that have it too.
        try:
            layout = find_layout(packed.message(remaining[0]))
        except MessageError:
            n_broken += 1
            remaining = remaining[1:]
            continue
        # With many layouts a comparison of all messages with each one would be slow.
        if len(groups) + n_broken < MAX_LAYOUTS:
            same = layout.matches(packed.select(remaining))
            of_layout = remaining[same]
            remaining = remaining[~same]
        else:
            of_layout = remaining[:1]
            remaining = remaining[1:]
        groups.append((layout, of_layout, packed.select(of_layout)))
    return groups, n_broken


def overlapping(buffer: np.ndarray, dtype: str) -> np.ndarray:
    """View bytes as overlapping, unaligned words: element k is the word that starts at byte k."""
    dtype = np.dtype(dtype)
    return np.ndarray((max(len(buffer) - dtype.itemsize + 1, 0),), dtype, buffer, strides=(1,))


def _checks(fixed: tuple, sample: bytes) -> Iterator[tuple[int, np.uint64, np.uint64]]:
    """
    Yield (offset, mask, value) of few 8-byte words that cover the fixed bytes of a message.

    A message has the fixed bytes of `sample` if ``word & mask == value`` for each word, read as a
    little-endian integer at the offset.
    """
    uncovered = np.zeros(len(sample), dtype=bool)
    for first, end in fixed:
        uncovered[first:end] = True
    while uncovered.any():
        # Inside the message: the last word may begin before the first uncovered byte.
        offset = min(int(np.argmax(uncovered)), len(sample) - 8)
        place = slice(offset, offset + 8)
        mask_bytes = np.where(uncovered[place], 0xFF, 0).astype(np.uint8).tobytes()
        mask = int.from_bytes(mask_bytes, 'little')
        value = int.from_bytes(sample[place], 'little') & mask
        uncovered[place] = False
        yield offset, np.uint64(mask), np.uint64(value)


NS_PER_S = 1_000_000_000

ENCAPSULATION_SIZE = 4
"""CDR aligns relative to the byte after the encapsulation header."""

FRAME_OFFSET = ENCAPSULATION_SIZE + 8
"""Position of the length of the frame_id, after the stamp."""

LONGEST_NAME = 256
"""Bytes of a name; ROS 2 itself allows 255 for a topic."""
LONGEST_FRAME = 4096
"""
Bytes of a frame_id in a message that is used; the time to compare frames grows with the square of
their length.
"""

_STARTS = {order: struct.Struct(order + 'iII') for order in '<>'}
_BYTE_ORDERS = {b'\x00\x00': '>', b'\x00\x01': '<'}


class MessageError(ValueError):
    """A serialized message does not have the layout of its type."""


class UnusableMessage(MessageError):
    """A well-formed message that gives no sample; its text is the reason to count it under."""


def clean_name(name: str | bytes) -> str:
    """
    Return a frame, topic, type or joint name without control characters.

    It has at most `LONGEST_NAME` bytes, because a recording may contain any name.
    """
    raw = name.encode(errors='replace') if isinstance(name, str) else bytes(name)
    return printable(raw[:LONGEST_NAME].decode(errors='replace'))


class Header(NamedTuple):
    """Header of every stamped message."""

    order: str
    """Byte order of the message, '<' or '>'."""
    stamp_ns: int
    """Header stamp."""
    frame: bytes
    """frame_id without its closing zero."""
    end: int
    """First byte after the frame_id, not yet aligned."""

    @property
    def frame_id(self) -> str:
        """The frame_id as text."""
        return clean_name(self.frame)


def open_header(data: bytes) -> Header:
    """
    Return the Header of a serialized message (raises MessageError).

    Plain CDR (XCDR1) is the only representation in ROS 2.
    """
    order = _BYTE_ORDERS.get(bytes(data[:2]))
    if order is None:
        raise MessageError(
            f'encapsulation must be plain CDR (0x0000 or 0x0001), got 0x{bytes(data[:2]).hex()}'
        )
    if len(data) < FRAME_OFFSET + 4:
        raise MessageError(
            f'a stamped message has at least {FRAME_OFFSET + 4} bytes, got {len(data)}'
        )
    sec, nanosec, length = _STARTS[order].unpack_from(data, ENCAPSULATION_SIZE)
    if length > LONGEST_FRAME:
        raise MessageError(f'a frame_id must have at most {LONGEST_FRAME} bytes, got {length}')
    start = FRAME_OFFSET + 4
    end = start + length
    if end > len(data):
        raise MessageError(
            f'a frame_id of {length} bytes ends at byte {end}, the message has {len(data)}'
        )
    # Without the closing zero.
    frame = data[start : end - 1] if length else b''
    return Header(order, sec * NS_PER_S + nanosec, bytes(frame), end)


def frame_head(frame_id: str, order: str = '<') -> bytes:
    """
    Return the bytes of a frame_id after the stamp.

    Its length, text and padding to the doubles that follow.
    """
    text = frame_id.encode() + b'\0'
    return struct.pack(order + 'I', len(text)) + text + bytes(-(4 + len(text)) % 8)


def aligned(position: int, size: int) -> int:
    """
    Return the first position from `position` on that CDR aligns to `size`.

    Positions count from the start of the message.
    """
    return position + (ENCAPSULATION_SIZE - position) % size
