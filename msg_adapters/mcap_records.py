"""MCAP records (mcap.dev/spec): parsing, and location of the messages of a chunk without stepping through them."""

import struct
import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from msg_adapters.layout import overlapping
from msg_adapters.stamps import clean_name

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(0x01, 0x09)
STATISTICS, DATA_END = 0x0B, 0x0F
LAST_OPCODE = 0x0F
PREFIX = struct.Struct('<BQ')
"""Opcode and length of the content, in front of every record."""
MESSAGE_PREFIX = PREFIX.size + 22
"""Bytes of a Message record in front of its data: prefix, channel, sequence, two times."""
MOST_OTHERS = 1 << 17
"""Records that are not messages in one buffer; there are at most 65,536 schemas and as many channels."""
RUN = 8
"""After so many records of one size, the next ones are searched by stride."""


class Schema(NamedTuple):
    """A message type and its definition."""

    name: str
    """Message type."""
    encoding: str
    """Language of the definition."""
    text: str
    """The definition."""


class Channel(NamedTuple):
    """A topic."""

    schema_id: int
    """Its Schema; 0 for none."""
    topic: str
    """Name."""
    encoding: str
    """Serialization of the messages."""


class Messages(NamedTuple):
    """Where the messages of a buffer lie, in file order."""

    channel: np.ndarray
    """Channel ids, int64, shape (n,)."""
    start: np.ndarray
    """First byte of the data of each message, int64, shape (n,)."""
    size: np.ndarray
    """Bytes of the data, int64, shape (n,)."""


class McapDamage(Exception):
    """A record that violates the format."""


def parse_schema(content: bytes | memoryview) -> tuple[int, Schema]:
    """Return (id, Schema) from the content of a Schema record."""
    number, = struct.unpack_from('<H', content)
    name, encoding, text = _strings(content, 2, 3)
    return number, Schema(clean_name(name), clean_name(encoding), text.decode(errors='replace'))


def parse_channel(content: bytes | memoryview) -> tuple[int, Channel]:
    """Return (id, Channel) from the content of a Channel record."""
    number, schema_id = struct.unpack_from('<HH', content)
    topic, encoding = map(clean_name, _strings(content, 4, 2))
    return number, Channel(schema_id, topic, encoding)


def parse_message_index(content: bytes) -> tuple[int, np.ndarray]:
    """Return (channel id, offsets of its Message records in the chunk) from a MessageIndex record."""
    channel, length = struct.unpack_from('<HI', content)
    entries = np.frombuffer(content, dtype='<u8', count=length // 8, offset=6)
    return channel, entries[1::2].astype(np.int64)


def parse_statistics(content: memoryview) -> tuple[int, int, dict[int, int]]:
    """Return (first time, last time, channel id -> messages) from a Statistics record."""
    first, last = struct.unpack_from('<QQ', content, 26)
    return first, last, dict(struct.iter_unpack('<HQ', content[46:46 + struct.unpack_from('<I', content, 42)[0]]))


def unpack_chunk(content: memoryview, decompress: Callable) -> tuple[bytes | memoryview, bool]:
    """
    Return the records inside a Chunk record (raises McapDamage).

    Parameters
    ----------
    content : buffer
        Content of the Chunk record, perhaps cut off.
    decompress : callable
        (compression, bytes, size) -> at most that many bytes; gives the readable part of a truncated stream.

    Returns
    -------
    records : bytes-like
        The records.
    whole : bool
        False when the end is missing.

    """
    try:
        size, crc, length = struct.unpack_from('<QII', content, 16)
        compression = bytes(content[32:32 + length]).decode()
        packed_size, = struct.unpack_from('<Q', content, 32 + length)
    except (struct.error, UnicodeDecodeError):
        raise McapDamage('a chunk without its header') from None
    packed = content[40 + length:40 + length + packed_size]
    records = packed if compression == '' else decompress(compression, packed, size)
    whole = len(records) == size and len(packed) == packed_size
    if whole and crc and zlib.crc32(records) != crc:
        raise McapDamage('a chunk whose checksum does not fit')
    return records, whole


def indexed_messages(buffer: np.ndarray, indexes: Sequence[tuple[float, np.ndarray]]) -> Messages | None:
    """
    Find the messages of a chunk by its message indexes.

    Returns
    -------
    messages : Messages or None
        None when the indexes do not account for every byte of the chunk (definitions in between, or a wrong index).

    """
    if not indexes or len(buffer) < MESSAGE_PREFIX:
        return None
    offset = np.concatenate([offsets for _, offsets in indexes])
    channel = np.repeat([number for number, _ in indexes], [len(offsets) for _, offsets in indexes])
    order = np.argsort(offset, kind='stable')
    offset, channel = offset[order], channel[order]
    if not len(offset) or offset[0] < 0 or offset[-1] + MESSAGE_PREFIX > len(buffer):
        return None
    length = overlapping(buffer, '<u8')[offset + 1].astype(np.int64)
    gapless = offset[0] == 0 and np.array_equal(offset + PREFIX.size + length, np.append(offset[1:], len(buffer)))
    if not gapless or (buffer[offset] != MESSAGE).any() or (overlapping(buffer, '<u2')[offset + PREFIX.size] != channel).any():
        return None
    return Messages(channel, offset + MESSAGE_PREFIX, length - 22)


def walk(buffer: np.ndarray) -> tuple[Messages, list[tuple[int, bytes]], int]:
    """
    Step through records until a chunk, the end, or an incomplete or impossible one; runs of one size are parsed at once.

    Returns
    -------
    messages : Messages
    others : list of (opcode, content)
        Records that are not messages.
    end : int
        Where the next record would start.

    """
    view, offsets, others = buffer.data, [], []
    position, previous, run, end = 0, -1, 0, len(buffer)
    while position + PREFIX.size <= end:
        opcode, length = PREFIX.unpack_from(view, position)
        behind = position + PREFIX.size + length
        if not is_record(opcode) or opcode in (CHUNK, DATA_END, FOOTER) or behind > end or (opcode == MESSAGE and length < 22):
            break
        if opcode != MESSAGE:
            if len(others) == MOST_OTHERS:
                break
            others.append((opcode, bytes(view[position + PREFIX.size:behind])))
        else:
            run = run + 1 if length == previous else 0
            previous = length
            offsets.append(np.array([position]) if run < RUN else _run(buffer, position, PREFIX.size + length, 4 * run))
            run += len(offsets[-1]) - 1
            behind = int(offsets[-1][-1]) + PREFIX.size + length
        position = behind
    offset = np.concatenate(offsets) if offsets else np.zeros(0, np.int64)
    length = overlapping(buffer, '<u8')[offset + 1].astype(np.int64) if len(offset) else offset
    channel = overlapping(buffer, '<u2')[offset + PREFIX.size].astype(np.int64) if len(offset) else offset
    return Messages(channel, offset + MESSAGE_PREFIX, length - 22), others, position


def log_times(buffer: np.ndarray, messages: Messages, index: np.ndarray) -> np.ndarray:
    """Return the receive times of some Messages of a buffer, int64."""
    return overlapping(buffer, '<i8')[messages.start[index] - 16]


def is_record(opcode: int) -> bool:
    """Return whether the format defines the opcode, or reserves it for applications."""
    return 1 <= opcode <= LAST_OPCODE or opcode >= 0x80


def _run(buffer, position, stride, reach):
    """Return offsets of up to `reach` records from `position` on that follow each other with the same opcode and length."""
    offset = position + stride * np.arange(min((len(buffer) - position) // stride, reach))
    same = (buffer[offset] == MESSAGE) & (overlapping(buffer, '<u8')[offset + 1] == stride - PREFIX.size)
    return offset[:len(offset) if same.all() else int(np.argmin(same))]


def _strings(content, position, count):
    texts = []
    for _ in range(count):
        length, = struct.unpack_from('<I', content, position)
        texts.append(bytes(content[position + 4:position + 4 + length]))
        position += 4 + length
    return texts
