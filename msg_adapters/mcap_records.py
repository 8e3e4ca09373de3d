"""Records of an MCAP file, and its compressed chunks."""

import bz2
import shutil
import struct
import sys
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from msg_adapters.layout import Packed, clean_name, overlapping

PACKED_PIECE_BYTES = 1 << 20
LARGEST_CHUNK, LARGEST_MESSAGE = 64 << 20, 32 << 20
"""Bytes of a chunk and of a message when decompressed; recorders write chunks of a few megabytes."""
MESSAGE_BASE = 4 << 20
"""A message may grow to this many bytes, plus `FILE_RATIO` times its compressed size; each of many may be a bomb."""
MOST_FRAMES = 10_000
"""Frames of one stream; each costs time and gives at least a megabyte in files that compress in parallel."""
FILE_BASE, FILE_RATIO = 256 << 20, 100
"""A file may grow to this many bytes, plus this many times its compressed size; recordings of sensors shrink by a factor of ten at most."""


@cache
def zstd() -> ModuleType:
    """Return the zstd module: of the standard library where available, otherwise of the package that rosbags requires."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        from backports import zstd as module
    return module


def decompress_chunk(compression: str, packed: memoryview, size: int) -> bytes:
    """Return the content of a chunk, at most the `size` bytes that its header declares, or its readable part (raises McapDamage)."""
    if size > LARGEST_CHUNK:
        raise McapDamage(f'a chunk of {size} bytes, more than the {LARGEST_CHUNK} that are accepted')
    try:
        return decompress(compression, packed, size)
    except KeyError as error:
        raise McapDamage(f'a chunk with the unknown compression {compression!r}') from error
    except _errors() as error:
        raise McapDamage(f'a chunk that cannot be decompressed ({error})') from error


def decompress(compression: str, packed: bytes | memoryview, limit: int) -> bytes:
    """Return at most `limit` bytes of a stream: zstd, lz4 or bz2 (raises KeyError for another compression, `_errors` for damaged data)."""
    make, parts, n_bytes = _decompressor(compression), [], 0
    for _ in range(MOST_FRAMES):
        decompressor = make()
        parts.append(decompressor.decompress(packed, limit - n_bytes))
        n_bytes += len(parts[-1])
        packed = decompressor.unused_data if decompressor.eof else b''
        if not packed or n_bytes >= limit:
            break
    return parts[0] if len(parts) == 1 else b''.join(parts)


def _decompressor(compression: str) -> Callable[[], Any]:
    if compression == 'lz4':
        from lz4 import frame
        return frame.LZ4FrameDecompressor
    return {'zstd': zstd().ZstdDecompressor, 'bz2': bz2.BZ2Decompressor}[compression]


def _errors():
    return zstd().ZstdError, RuntimeError, EOFError, OSError, ValueError


def decompress_message(data: bytes) -> bytes:
    """Return one message of a bag that is compressed by message (raises ValueError for one that expands too much)."""
    limit = min(LARGEST_MESSAGE, MESSAGE_BASE + FILE_RATIO * len(data))
    plain = decompress('zstd', data, limit)
    if len(plain) == limit:
        raise ValueError('a message expands beyond its limit')
    return plain


def largest_content(file_size: int) -> int:
    """Return how many bytes a compressed file of a size may contain."""
    return FILE_BASE + FILE_RATIO * file_size


def decompress_file(source: Path, target: Path) -> str | None:
    """
    Decompress a zstd file into another; return the error that ended it early, or None.

    Data decompressed before the damage are written in any case.

    Raises
    ------
    ValueError
        When it is much larger than a recording would be, or than the free space.

    """
    module, source = zstd(), Path(source)
    limit = min(largest_content(source.stat().st_size), shutil.disk_usage(target.parent).free * 9 // 10)
    with source.open('rb') as packed, Path(target).open('wb') as plain:
        decompressor, n_frames, data, started = module.ZstdDecompressor(), 0, b'', True
        try:
            while data or not decompressor.needs_input or (data := packed.read(PACKED_PIECE_BYTES)):
                plain.write(decompressor.decompress(data, PACKED_PIECE_BYTES))
                data, started = b'', True
                if decompressor.eof:   # a file may hold several frames
                    data, decompressor, n_frames = decompressor.unused_data, module.ZstdDecompressor(), n_frames + 1
                    started = bool(data)
                if plain.tell() > limit or n_frames > MOST_FRAMES:
                    raise ValueError(f'it expands beyond the {limit} bytes or {MOST_FRAMES} frames that are accepted')
        except module.ZstdError as error:
            return str(error)
    return 'the stream is cut off' if started else None


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


def parse_statistics(content: bytes) -> tuple[int, int, dict[int, int]]:
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


def indexed_messages(buffer: np.ndarray, indexes: Sequence[tuple[float, np.ndarray]]) -> tuple[np.ndarray, Packed] | None:
    """
    Find the messages of a chunk by its message indexes.

    Returns
    -------
    (channel, messages) : (ndarray, Packed) or None
        Channel ids, int64, shape (n,), and the messages in file order; None when the indexes do not account for every byte of the chunk
        (definitions in between, or a wrong index).

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
    return channel, Packed(buffer, offset + MESSAGE_PREFIX, length - 22)


def walk(buffer: np.ndarray) -> tuple[tuple[np.ndarray, Packed], list[tuple[int, bytes]], int]:
    """
    Step through records until a chunk, the end, or an incomplete or impossible one; runs of one size are parsed at once.

    Returns
    -------
    (channel, messages) : (ndarray, Packed)
        Channel ids, int64, shape (n,), and the messages in file order.
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
    return (channel, Packed(buffer[:position], offset + MESSAGE_PREFIX, length - 22)), others, position


def log_times(messages: Packed, index: np.ndarray) -> np.ndarray:
    """Return the receive times of some messages in their records, int64."""
    return overlapping(messages.buffer, '<i8')[messages.start[index] - 16]


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
