"""Serialized messages in bulk: their positions in a buffer, and columns of numbers extracted from many at once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from msg_adapters.stamps import ENCAPSULATION_SIZE, NS_PER_S, MessageError

MAX_LAYOUTS = 16
"""A stretch with more layouts than this is not worth grouping; the rest of it is decoded message by message."""


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
        return self.buffer[start:start + int(self.size[index])].tobytes()

    def view(self, index: int) -> memoryview:
        """Return one message without copying it."""
        start = int(self.start[index])
        return self.buffer.data[start:start + int(self.size[index])]

    def select(self, index: np.ndarray) -> 'Packed':
        """Return some of the messages."""
        return Packed(self.buffer, self.start[index], self.size[index])

    @classmethod
    def join(cls, messages: Sequence[bytes]) -> 'Packed':
        """Pack a list of bytes objects."""
        size = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
        start = np.concatenate([np.zeros(1, np.int64), np.cumsum(size)[:-1]]) if messages else size
        return cls(np.frombuffer(b''.join(messages), dtype=np.uint8), start, size)


@dataclass(frozen=True, eq=False)
class MessageLayout:
    """Where the numbers of a message lie, and which bytes must be equal for another message to share it."""

    order: str
    """Byte order, '<' or '>'."""
    size: int
    """Bytes of the message that is the source of `sample`."""
    sample: bytes
    """The message that the layout was found from."""
    fixed: tuple
    """Ranges (first, last + 1) of bytes that must equal the bytes of `sample`; padding and numbers are outside."""
    offsets: dict
    """Field name -> (offset of its first double, number of doubles)."""
    names: tuple = ()
    """Strings of the message: the frame_id, or the joint names."""

    def matches(self, packed: Packed) -> np.ndarray:
        """Return which messages have this layout, bool, shape (n,)."""
        same = packed.size == self.size
        start = packed.start if same.all() else np.where(same, packed.start, packed.start[np.argmax(same)])
        words = overlapping(packed.buffer, '<u8')
        for offset, mask, expected in _checks(self.fixed, self.sample):
            same &= (words[start + offset] & mask) == expected
        return same

    def stamp_ns(self, packed: Packed) -> np.ndarray:
        """Return the header stamps of messages that have this layout, int64, shape (n,)."""
        pairs = overlapping(packed.buffer, 'V8')[packed.start + ENCAPSULATION_SIZE]
        sec, nanosec = pairs.view(self.order + 'i4')[::2], pairs.view(self.order + 'u4')[1::2]
        return sec.astype(np.int64) * NS_PER_S + nanosec

    def column(self, packed: Packed, name: str, count: int | None = None) -> np.ndarray:
        """Return the doubles of field `name`, or its first `count`, of messages that have this layout, shape (n, count)."""
        offset, length = self.offsets[name]
        count = length if count is None else count
        if not count:
            return np.empty((len(packed), 0))
        # One gather of the complete row: several times faster than a gather number by number.
        rows = overlapping(packed.buffer, f'V{8 * count}')[packed.start + offset]
        return rows.view(self.order + 'f8').reshape(-1, count).astype(float, copy=False)


def group_by_layout(packed: Packed, find_layout: Callable) -> tuple[list[tuple[MessageLayout, np.ndarray, Packed]], np.ndarray]:
    """
    Split messages into groups of one layout each.

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
    rest : ndarray
        Indices of the messages that no group holds: invalid ones, and ungrouped ones after `MAX_LAYOUTS`.

    """
    groups, broken, rest = [], [], np.arange(len(packed))
    while len(rest) and len(groups) + len(broken) < MAX_LAYOUTS:
        try:
            layout = find_layout(packed.message(rest[0]))
        except MessageError:
            broken.append(rest[:1])
            rest = rest[1:]
            continue
        left = packed.select(rest) if len(rest) < len(packed) else packed
        same = layout.matches(left)
        if same.all():
            return [*groups, (layout, rest, left)], np.array(broken, dtype=int).ravel()
        groups.append((layout, rest[same], left.select(same)))
        rest = rest[~same]
    return groups, np.sort(np.concatenate([*broken, rest]))


def overlapping(buffer: np.ndarray, dtype: str) -> np.ndarray:
    """View bytes as overlapping, unaligned words: element k is the word that starts at byte k."""
    dtype = np.dtype(dtype)
    return np.ndarray((max(len(buffer) - dtype.itemsize + 1, 0),), dtype, buffer, strides=(1,))


def is_any(values: np.ndarray, wanted: Sequence[float]) -> np.ndarray:
    """Return where an integer array equals one of a few numbers."""
    return np.logical_or.reduce([values == number for number in wanted]) if wanted else np.zeros(len(values), dtype=bool)


def _checks(fixed, sample):
    """Cover the fixed bytes by few 8-byte words inside the message: (offset, mask, expected value)."""
    left = np.zeros(len(sample), dtype=bool)
    for first, last in fixed:
        left[first:last] = True
    while left.any():
        offset = min(int(np.argmax(left)), len(sample) - 8)
        mask = int.from_bytes(np.where(left[offset:offset + 8], 0xff, 0).astype(np.uint8).tobytes(), 'little')
        left[offset:offset + 8] = False
        yield offset, np.uint64(mask), np.uint64(int.from_bytes(sample[offset:offset + 8], 'little') & mask)
