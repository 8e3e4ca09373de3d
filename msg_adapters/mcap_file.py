"""An MCAP file that is read, and its records."""

import os
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.documents import open_regular
from imu_calibration.core.exit_codes import UNKNOWN_EXTENT
from msg_adapters.compression import decompress_chunk, largest_content
from msg_adapters.layout import Packed, clean_name, overlapping
from msg_adapters.storage import StorageFile, Stretch, read_ahead

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(0x01, 0x09)
STATISTICS, DATA_END = 0x0B, 0x0F
LAST_OPCODE = 0x0F
PREFIX = struct.Struct('<BQ')
"""Opcode and length of the content, in front of every record."""
MESSAGE_PREFIX = PREFIX.size + 22
"""Bytes of a Message record in front of its data: prefix, channel, sequence, two times."""
MOST_OTHERS = 1 << 17
"""
Records that are not messages in one buffer; there are at most 65,536 schemas and as many channels.
"""
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
    (number,) = struct.unpack_from('<H', content)
    name, encoding, text = _strings(content, 2, 3)
    return number, Schema(clean_name(name), clean_name(encoding), text.decode(errors='replace'))


def parse_channel(content: bytes | memoryview) -> tuple[int, Channel]:
    """Return (id, Channel) from the content of a Channel record."""
    number, schema_id = struct.unpack_from('<HH', content)
    topic, encoding = map(clean_name, _strings(content, 4, 2))
    return number, Channel(schema_id, topic, encoding)


def parse_message_index(content: bytes) -> tuple[int, np.ndarray]:
    """
    Return (channel id, offsets of its Message records in the chunk) from a MessageIndex record.
    """
    channel, length = struct.unpack_from('<HI', content)
    entries = np.frombuffer(content, dtype='<u8', count=length // 8, offset=6)
    return channel, entries[1::2].astype(np.int64)


def parse_statistics(content: bytes) -> tuple[int, int, dict[int, int]]:
    """Return (first time, last time, channel id -> messages) from a Statistics record."""
    first, last = struct.unpack_from('<QQ', content, 26)
    return (
        first,
        last,
        dict(
            struct.iter_unpack('<HQ', content[46 : 46 + struct.unpack_from('<I', content, 42)[0]])
        ),
    )


def unpack_chunk(content: memoryview) -> tuple[bytes | memoryview, bool]:
    """
    Return the records inside a Chunk record (raises McapDamage).

    Parameters
    ----------
    content : buffer
        Content of the Chunk record, perhaps cut off.

    Returns
    -------
    records : bytes-like
        The records.
    whole : bool
        False when the end is missing.

    """
    try:
        size, crc, length = struct.unpack_from('<QII', content, 16)
        compression = bytes(content[32 : 32 + length]).decode()
        (packed_size,) = struct.unpack_from('<Q', content, 32 + length)
    except (struct.error, UnicodeDecodeError):
        raise McapDamage('a chunk without its header') from None
    packed = content[40 + length : 40 + length + packed_size]
    try:
        records = packed if compression == '' else decompress_chunk(compression, packed, size)
    except ValueError as error:
        raise McapDamage(str(error)) from error
    whole = len(records) == size and len(packed) == packed_size
    if whole and crc and zlib.crc32(records) != crc:
        raise McapDamage('a chunk whose checksum does not fit')
    return records, whole


def indexed_messages(
    buffer: np.ndarray, indexes: Sequence[tuple[float, np.ndarray]]
) -> tuple[np.ndarray, Packed] | None:
    """
    Find the messages of a chunk by its message indexes.

    Returns
    -------
    (channel, messages) : (ndarray, Packed) or None
        Channel ids, int64, shape (n,), and the messages in file order; None when the indexes do not
        account for every byte of the chunk (definitions in between, or a wrong index).

    """
    if not indexes or len(buffer) < MESSAGE_PREFIX:
        return None
    offset = np.concatenate([offsets for _, offsets in indexes])
    channel = np.repeat([number for number, _ in indexes], [len(offsets) for _, offsets in indexes])
    order = np.argsort(offset, kind='stable')
    offset = offset[order]
    channel = channel[order]
    if not len(offset) or offset[0] < 0 or offset[-1] + MESSAGE_PREFIX > len(buffer):
        return None
    length = overlapping(buffer, '<u8')[offset + 1].astype(np.int64)
    gapless = offset[0] == 0 and np.array_equal(
        offset + PREFIX.size + length, np.append(offset[1:], len(buffer))
    )
    if (
        not gapless
        or (buffer[offset] != MESSAGE).any()
        or (overlapping(buffer, '<u2')[offset + PREFIX.size] != channel).any()
    ):
        return None
    return channel, Packed(buffer, offset + MESSAGE_PREFIX, length - 22)


def walk(buffer: np.ndarray) -> tuple[tuple[np.ndarray, Packed], list[tuple[int, bytes]], int]:
    """
    Step through records until a chunk, the end, or an incomplete or impossible one.

    Runs of one size are parsed at once.

    Returns
    -------
    (channel, messages) : (ndarray, Packed)
        Channel ids, int64, shape (n,), and the messages in file order.
    others : list of (opcode, content)
        Records that are not messages.
    end : int
        Where the next record would start.

    """
    view = buffer.data
    offsets = []
    others = []
    position = 0
    previous = -1
    run = 0
    end = len(buffer)
    while position + PREFIX.size <= end:
        opcode, length = PREFIX.unpack_from(view, position)
        behind = position + PREFIX.size + length
        if (
            not is_record(opcode)
            or opcode in (CHUNK, DATA_END, FOOTER)
            or behind > end
            or (opcode == MESSAGE and length < 22)
        ):
            break
        # After `RUN` records of one length the next ones are compared in one step.
        if opcode != MESSAGE:
            if len(others) == MOST_OTHERS:
                break
            others.append((opcode, bytes(view[position + PREFIX.size : behind])))
        else:
            run = run + 1 if length == previous else 0
            previous = length
            offsets.append(
                np.array([position])
                if run < RUN
                else _run(buffer, position, PREFIX.size + length, 4 * run)
            )
            run += len(offsets[-1]) - 1
            behind = int(offsets[-1][-1]) + PREFIX.size + length
        position = behind

    # Length and channel of each message.
    offset = np.concatenate(offsets) if offsets else np.zeros(0, np.int64)
    length = overlapping(buffer, '<u8')[offset + 1].astype(np.int64) if len(offset) else offset
    channel = (
        overlapping(buffer, '<u2')[offset + PREFIX.size].astype(np.int64) if len(offset) else offset
    )
    return (
        (channel, Packed(buffer[:position], offset + MESSAGE_PREFIX, length - 22)),
        others,
        position,
    )


def log_times(messages: Packed, index: np.ndarray) -> np.ndarray:
    """Return the receive times of some messages in their records, int64."""
    return overlapping(messages.buffer, '<i8')[messages.start[index] - 16]


def is_record(opcode: int) -> bool:
    """Return whether the format defines the opcode, or reserves it for applications."""
    return 1 <= opcode <= LAST_OPCODE or opcode >= 0x80


def _run(buffer, position, stride, reach):
    """
    Return offsets of up to `reach` records from `position` on.

    The records follow each other with the same opcode and length.
    """
    offset = position + stride * np.arange(min((len(buffer) - position) // stride, reach))
    same = (buffer[offset] == MESSAGE) & (
        overlapping(buffer, '<u8')[offset + 1] == stride - PREFIX.size
    )
    return offset[: len(offset) if same.all() else int(np.argmin(same))]


def _strings(content, position, count):
    texts = []
    for _ in range(count):
        (length,) = struct.unpack_from('<I', content, position)
        texts.append(bytes(content[position + 4 : position + 4 + length]))
        position += 4 + length
    return texts


FIRST_BYTES = 1 << 16
"""
Bytes read at first of messages outside of chunks; doubled up to `CHUNK_STRETCH_BYTES` while no
other record is between them, otherwise reduced, so that few bytes are read twice.
"""
CHUNK_STRETCH_BYTES = 4 << 20
"""Chunks are joined to about this size before they are decoded."""
FOOTER_SIZE = PREFIX.size + 20


class McapFile(StorageFile):
    """
    One .mcap file.

    Parameters
    ----------
    path : path-like
        The file.
    unpack : callable, optional
        Bytes -> bytes for each message (compression by message).

    """

    def __init__(self, path: str | PathLike[str], unpack: Callable[[bytes], bytes] | None = None):
        self.path = Path(path)
        self.unpack = unpack
        self.file = open_regular(path)
        self.size = os.fstat(self.file.fileno()).st_size
        self.schemas = {}
        self.channels = {}
        self.lost = {}
        self.chunk_starts, self.n_unpacked = [], 0
        self.statistics: Any = None
        try:
            if self._read(0, len(MAGIC)) != MAGIC:
                raise ValueError('the file does not begin as an MCAP file')
            self._read_summary()
            if self.statistics is None or not self.channels:
                self.statistics = self._scan()
        except BaseException:
            self.file.close()
            raise

    @property
    def types(self) -> dict[str, str]:
        """Topic -> message type; serializations other than CDR are named after the type."""
        types = {}
        for channel in self.channels.values():
            name = (
                self.schemas[channel.schema_id].name
                if channel.schema_id in self.schemas
                else 'unknown'
            )
            types[channel.topic] = (
                name if channel.encoding == 'cdr' else f'{name} ({channel.encoding})'
            )
        return types

    @property
    def definitions(self) -> dict[str, tuple[str, str]]:
        """Message type -> (language, text)."""
        return {schema.name: (schema.encoding, schema.text) for schema in self.schemas.values()}

    def count(self) -> dict[str, int]:
        """Return topic -> messages."""
        counts = Counter({channel.topic: 0 for channel in self.channels.values()})
        for number, count in self.statistics[2].items():
            if number in self.channels:
                counts[self.channels[number].topic] += count
        return dict(counts)

    def time_range(self) -> tuple[int, int] | None:
        """Return (first, last) receive time in ns, or None when the file lacks it."""
        first, last, counts = self.statistics
        return (first, last) if any(counts.values()) and last else None

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    @property
    def topic_ids(self) -> dict[str, list[int]]:  # type: ignore[override]
        """Topic -> channel ids."""
        ids = {}
        for number, channel in self.channels.items():
            ids.setdefault(channel.topic, []).append(number)
        return ids

    def _stretches(self, topics):
        known = self.topic_ids
        wanted = {number for topic in topics for number in known.get(topic, ())}
        with closing(read_ahead(self._joined_pieces(wanted))) as pieces:
            for channel, packed in pieces:
                yield Stretch(
                    channel,
                    lambda index, packed=packed: (index, packed.select(index)),
                    partial(log_times, packed),
                )

    def _joined_pieces(self, wanted):
        """Join pieces to stretches."""
        waiting, n_waiting = [], 0
        for piece in self._pieces(wanted):
            waiting.append(piece)
            n_waiting += len(piece[1].buffer)
            if n_waiting >= CHUNK_STRETCH_BYTES:
                yield _join(waiting)
                waiting, n_waiting = [], 0
        if waiting:
            yield _join(waiting)

    def _pieces(self, wanted):
        """
        Yield (channel ids, Packed) for chunks and for runs of messages outside of chunks.

        Each chunk with wanted channels and each such run gives one pair.
        """
        for opcode, position, length, walked in self._records():
            if opcode == CHUNK:
                indexes = self._indexes_behind(position + length)
                if not indexes or any(number in wanted for number, _ in indexes):
                    yield from self._chunk(position, length, indexes)
            elif opcode == MESSAGE:
                self._register(walked[1])
                yield walked[0]
            elif opcode in (SCHEMA, CHANNEL):
                self._register([(opcode, self._read(position, length))])

    def _chunk(self, position, length, indexes):
        content = memoryview(self._read(position, length))
        try:
            records, whole = unpack_chunk(content)
            self.n_unpacked += len(records)
            if self.n_unpacked > largest_content(self.size):
                raise McapDamage('chunks that expand far beyond the size of the file')
        except McapDamage as damage:
            self._lose(f'messages in {damage}', max(sum(len(offsets) for _, offsets in indexes), 1))
            return
        buffer = np.frombuffer(records, np.uint8)
        messages = indexed_messages(buffer, indexes) if whole else None
        if messages is None:
            messages, others, end = walk(buffer)
            self._register(others)
            if not whole or end < len(buffer):
                self._lose(f'chunks that end early, {UNKNOWN_EXTENT}', 1)
        yield messages

    def _records(self):
        """
        Yield (opcode, position, length, None) of the records of the data section.

        A truncated chunk is yielded with its remaining bytes.

        Messages outside of chunks are yielded in groups, with ((channel ids, Packed), other
        records) in place of None.
        """
        position = len(MAGIC)
        self.n_unpacked = 0
        ahead = FIRST_BYTES
        while position is not None:
            opcode, length = self._prefix(position)
            behind = position + PREFIX.size + length
            if opcode in (DATA_END, FOOTER):
                return
            if not is_record(opcode) or behind > self.size:
                if opcode == CHUNK:  # up to the next one, so that no byte is read twice
                    yield (
                        CHUNK,
                        position + PREFIX.size,
                        (self._following(position) or self.size) - position - PREFIX.size,
                        None,
                    )
                position = self._resume(position)
            elif opcode == MESSAGE:
                buffer = np.frombuffer(
                    self._read(position, max(ahead, behind - position)), np.uint8
                )
                messages, others, end = walk(buffer)
                if 2 * end > len(buffer):
                    ahead = min(2 * ahead, CHUNK_STRETCH_BYTES)
                else:
                    ahead = max(2 * end, MESSAGE_PREFIX)
                if end:
                    yield MESSAGE, position, end, (messages, others)
                position = position + end if end else self._resume(position)
            else:
                yield opcode, position + PREFIX.size, length, None
                position = behind

    def _prefix(self, position):
        """Return (opcode, length) of the record at `position`, zeros at the end of the file."""
        prefix = self._read(position, PREFIX.size)
        return PREFIX.unpack(prefix) if len(prefix) == PREFIX.size else (0, 0)

    def _resume(self, position):
        """
        Count the damage at `position` and return the start of the next chunk in the summary.

        Or None.
        """
        following = self._following(position)
        self._lose(
            f'bytes that are no whole record, messages {UNKNOWN_EXTENT}',
            max((following or self.size) - position, 1),
        )
        return following

    def _following(self, position):
        """Return the first known start of a chunk after `position`, or None."""
        place = bisect_right(self.chunk_starts, position)
        return self.chunk_starts[place] if place < len(self.chunk_starts) else None

    def _indexes_behind(self, position):
        """Return (channel id, offsets) from the MessageIndex records that start at `position`."""
        indexes = []
        while True:
            opcode, length = self._prefix(position)
            if opcode != MESSAGE_INDEX or position + PREFIX.size + length > self.size:
                return indexes
            try:
                indexes.append(parse_message_index(self._read(position + PREFIX.size, length)))
            except (struct.error, ValueError):
                return []  # the chunk is then walked through
            position += PREFIX.size + length

    def _read_summary(self):
        """Read channels, counts and positions of chunks from the summary, when the file has one."""
        footer = self._read(max(self.size - FOOTER_SIZE - len(MAGIC), 0), FOOTER_SIZE + len(MAGIC))
        if (
            len(footer) < FOOTER_SIZE + len(MAGIC)
            or footer[FOOTER_SIZE:] != MAGIC
            or footer[0] != FOOTER
        ):
            return
        (start,) = struct.unpack_from('<Q', footer, PREFIX.size)
        if not len(MAGIC) <= start < self.size:
            return
        _, records, _ = walk(np.frombuffer(self._read(start, self.size - start), np.uint8))
        for opcode, content in records:
            if opcode == STATISTICS:
                self.statistics = parse_statistics(content)
            elif opcode == CHUNK_INDEX:
                self.chunk_starts.append(struct.unpack_from('<Q', content, 16)[0])
        self._register(records)
        self.chunk_starts.sort()

    def _scan(self):
        """
        Find channels and counts without a summary, by the message indexes where there are any.
        """
        counts = Counter()
        for opcode, position, length, walked in self._records():
            indexes = self._indexes_behind(position + length) if opcode == CHUNK else []
            if indexes and all(number in self.channels for number, _ in indexes):
                counts.update({number: len(offsets) for number, offsets in indexes})
            elif opcode == CHUNK:
                for channel, _ in self._chunk(position, length, indexes):
                    counts.update(channel.tolist())
            elif opcode == MESSAGE:
                self._register(walked[1])
                counts.update(walked[0][0].tolist())
            elif opcode in (SCHEMA, CHANNEL):
                self._register([(opcode, self._read(position, length))])
        self.lost.clear()  # it will be counted again when the messages are read
        return 0, 0, counts

    def _register(self, records):
        for opcode, content in records:
            if opcode == SCHEMA:
                number, schema = parse_schema(content)
                self.schemas[number] = schema
            elif opcode == CHANNEL:
                number, channel = parse_channel(content)
                self.channels[number] = channel

    def _read(self, position, size):
        return os.pread(self.file.fileno(), size, position)


def _join(pieces):
    """Join (channel ids, Packed) pieces into one."""
    channels, parts = zip(*pieces, strict=True)
    return np.concatenate(channels), Packed.chain(parts)
