"""Serialized messages in bulk: where they lie in a buffer, and columns of numbers taken out of many at once."""

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

    def __len__(self):
        return len(self.start)

    def message(self, index):
        """Return the bytes of one message."""
        start = int(self.start[index])
        return self.buffer[start:start + int(self.size[index])].tobytes()

    @classmethod
    def join(cls, messages):
        """Pack a list of bytes objects."""
        size = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
        start = np.concatenate([np.zeros(1, np.int64), np.cumsum(size)[:-1]]) if messages else size
        return cls(np.frombuffer(b''.join(messages), dtype=np.uint8), start, size)


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the numbers of a message lie, and which bytes must be equal for another message to share it."""

    order: str
    """Byte order, '<' or '>'."""
    size: int
    """Bytes of the message that `sample` was taken from."""
    sample: bytes
    """The message that the layout was found from."""
    fixed: tuple
    """Ranges (first, last + 1) of bytes that must equal those of `sample`; padding and numbers lie outside."""
    offsets: dict
    """Field name -> (offset of its first double, number of doubles)."""
    names: tuple = ()
    """Strings of the message: the frame_id, or the joint names."""

    def matches(self, packed, index):
        """Return a mask over `index`: which of these messages have this layout."""
        same = packed.size[index] == self.size
        words = _words(packed.buffer, '<u8')
        start = np.where(same, packed.start[index], packed.start[index[0]])
        for offset, mask, expected in _checks(self.fixed, self.sample):
            same &= (words[start + offset] & mask) == expected
        return same

    def stamp_ns(self, packed, index):
        """Return the header stamps, int64."""
        word = _words(packed.buffer, self.order + 'u4')
        start = packed.start[index] + ENCAPSULATION_SIZE
        return word[start].view(self.order + 'i4').astype(np.int64) * NS_PER_S + word[start + 4].astype(np.int64)

    def column(self, packed, index, name):
        """Return the doubles of field `name`, shape (n, count)."""
        offset, count = self.offsets[name]
        word = _words(packed.buffer, self.order + 'f8')
        return word[(packed.start[index] + offset)[:, np.newaxis] + 8 * np.arange(count)].astype(float, copy=False)


def group_by_layout(packed, find_layout):
    """
    Split messages into groups of one layout each.

    Parameters
    ----------
    packed : Packed
        Messages of one topic.
    find_layout : callable
        Message bytes -> Layout; raises MessageError when the bytes are not such a message.

    Returns
    -------
    groups : list of (Layout, index)
        Integer indices in ascending order per group.
    rest : ndarray
        Indices of the messages that no group holds: broken ones, and what is left after `MAX_LAYOUTS`.

    """
    groups, broken, rest = [], [], np.arange(len(packed))
    while len(rest) and len(groups) + len(broken) < MAX_LAYOUTS:
        try:
            layout = find_layout(packed.message(rest[0]))
        except MessageError:
            broken.append(rest[:1])
            rest = rest[1:]
            continue
        same = layout.matches(packed, rest)
        groups.append((layout, rest[same]))
        rest = rest[~same]
    return groups, np.sort(np.concatenate([*broken, rest]))


def _words(buffer, dtype):
    """View the buffer as overlapping, unaligned words: element k is the word that starts at byte k."""
    dtype = np.dtype(dtype)
    return np.ndarray((max(len(buffer) - dtype.itemsize + 1, 0),), dtype, buffer, strides=(1,))


def _checks(fixed, sample):
    """Cover the byte ranges by 8-byte words inside the message: (offset, mask, expected value)."""
    for first, last in fixed:
        for offset in range(first, last, 8):
            begin = min(offset, len(sample) - 8)
            mask = bytes(0xff if first <= begin + k < last else 0 for k in range(8))
            mask = int.from_bytes(mask, 'little')
            yield begin, np.uint64(mask), np.uint64(int.from_bytes(sample[begin:begin + 8], 'little') & mask)
