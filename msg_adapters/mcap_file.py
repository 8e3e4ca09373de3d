"""An MCAP file that is read, and its records."""

import os
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from functools import partial
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.core.documents import open_regular
from imu_calibration.core.exit_codes import UNKNOWN_EXTENT
from msg_adapters.compression import decompress_chunk, largest_content
from msg_adapters.layout import Packed, clean_name, overlapping
from msg_adapters.storage import StorageFile, Stretch, batches, read_ahead, type_with_encoding

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(0x01, 0x09)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x0B, 0x10)
LAST_OPCODE = DATA_END
# Fixed parts at the beginning of records; times are in ns.
PREFIX = struct.Struct('<BQ')
"""Opcode and length of the content, in front of every record."""
LENGTH_AT = 1
"""Offset of the length in the prefix."""
SCHEMA_HEAD = struct.Struct('<H')
"""Id, before the strings."""
CHANNEL_HEAD = struct.Struct('<HH')
"""Id and id of the schema, before the strings."""
TIMES = struct.Struct('<QQ')
"""Receive and publish time of a message, before its data; first and last time of a chunk."""
MESSAGE_HEAD_SIZE = struct.calcsize('<HI') + TIMES.size
"""Bytes of channel, sequence and `TIMES`, before the data."""
MESSAGE_PREFIX = PREFIX.size + MESSAGE_HEAD_SIZE
"""Bytes of a Message record before its data."""
CHUNK_SIZES = struct.Struct('<QI')
"""Size and checksum of the decompressed records of a chunk, after `TIMES`."""
SIZE = struct.Struct('<Q')
STRING_HEAD = struct.Struct('<I')
"""Length of a string, before its bytes."""
INDEX_HEAD = struct.Struct('<HI')
"""Of a MessageIndex: channel, bytes of the pairs (time, offset) that follow."""
CHUNK_INDEX_HEAD = struct.Struct('<QQQ')
"""First and last time, and position of the chunk."""
STATISTICS_HEAD = struct.Struct('<QHIIIIQQI')
"""
Numbers of messages, schemas, channels, attachments, metadata and chunks; first and last time; bytes
of the `OF_CHANNEL` pairs that follow.
"""
OF_CHANNEL = struct.Struct('<HQ')
"""Channel and a number: its messages, or the position of its index."""
FOOTER_CONTENT = struct.Struct('<QQI')
"""Positions of the summary and of its offsets, and its checksum."""
MOST_OTHERS = 1 << 17
"""
Records that are not messages in one buffer; there are at most 65,536 schemas and as many channels.
"""
RUN = 8
"""After so many records of one size, the next ones are searched by stride."""
ChannelMessages = tuple[np.ndarray, Packed]
"""Channel id of each message, int64, shape (n,), and the messages in file order."""
MessageIndexes = Sequence[tuple[int, np.ndarray]]
"""Channel id and offsets of its Message records in a chunk, for the channels of the chunk."""


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


class Walk(NamedTuple):
    """Records from one place of a file on, up to a chunk, the end or damage."""

    channels: np.ndarray
    """Channel id of each message, int64, shape (n,)."""
    messages: Packed
    """The messages in file order."""
    others: list[tuple[int, bytes]]
    """(opcode, content) of the records that are not messages."""
    end: int
    """Where the next record would start, in bytes from the first one."""


class McapRecord(NamedTuple):
    """A record of the data section of a file, or a run of messages outside of chunks."""

    opcode: int
    """Of a run: MESSAGE."""
    position: int
    """First byte of the content in the file; of a run, of its first record."""
    length: int
    """Bytes of the content; of a run, of all its records."""
    run: Walk | None = None
    """The records of a run."""


class Statistics(NamedTuple):
    """Content of a Statistics record."""

    first_ns: int
    """Receive time of the first message, 0 if unknown."""
    last_ns: int
    """Receive time of the last message, 0 if unknown."""
    counts: dict[int, int]
    """Channel id -> messages."""


class McapDamage(Exception):
    """A record that violates the format."""


def parse_schema(content: bytes | memoryview) -> tuple[int, Schema]:
    """Return (id, Schema) from the content of a Schema record."""
    (number,) = SCHEMA_HEAD.unpack_from(content)
    name, encoding, text = _strings(content, SCHEMA_HEAD.size, 3)
    return number, Schema(clean_name(name), clean_name(encoding), text.decode(errors='replace'))


def parse_channel(content: bytes | memoryview) -> tuple[int, Channel]:
    """Return (id, Channel) from the content of a Channel record."""
    number, schema_id = CHANNEL_HEAD.unpack_from(content)
    topic, encoding = map(clean_name, _strings(content, CHANNEL_HEAD.size, 2))
    return number, Channel(schema_id, topic, encoding)


def parse_message_index(content: bytes) -> tuple[int, np.ndarray]:
    """
    Return (channel id, offsets of its Message records in the chunk) from a MessageIndex record.
    """
    channel, length = INDEX_HEAD.unpack_from(content)
    entries = np.frombuffer(content, dtype='<u8', count=length // 8, offset=INDEX_HEAD.size)
    return channel, entries[1::2].astype(np.int64)


def parse_statistics(content: bytes) -> Statistics:
    """Return the Statistics from the content of a Statistics record."""
    *_, first_ns, last_ns, n_bytes = STATISTICS_HEAD.unpack_from(content)
    start = STATISTICS_HEAD.size
    return Statistics(
        first_ns, last_ns, dict(OF_CHANNEL.iter_unpack(content[start : start + n_bytes]))
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
    complete : bool
        False when the end is missing.

    """
    try:
        size, crc = CHUNK_SIZES.unpack_from(content, TIMES.size)
        (name,) = _strings(content, TIMES.size + CHUNK_SIZES.size, 1)
        compression = name.decode()
        start = TIMES.size + CHUNK_SIZES.size + STRING_HEAD.size + len(name)
        (packed_size,) = SIZE.unpack_from(content, start)
    except (struct.error, UnicodeDecodeError):
        raise McapDamage('a chunk without its header') from None
    start += SIZE.size
    packed = content[start : start + packed_size]
    try:
        records = packed if compression == '' else decompress_chunk(compression, packed, size)
    except ValueError as error:
        raise McapDamage(str(error)) from error
    complete = len(records) == size and len(packed) == packed_size
    # A checksum of 0 means none.
    if complete and crc and zlib.crc32(records) != crc:
        raise McapDamage('a chunk whose checksum does not fit')
    return records, complete


def indexed_messages(buffer: np.ndarray, indexes: MessageIndexes) -> ChannelMessages | None:
    """
    Find the messages of a chunk by its message indexes.

    Parameters
    ----------
    buffer : ndarray
        Records of the chunk, uint8, shape (n_bytes,).
    indexes : MessageIndexes
        Of its channels.

    Returns
    -------
    (channel, messages) : (ndarray, Packed) or None
        Channel ids, int64, shape (n,), and the messages in file order; None when the indexes do not
        account for every byte of the chunk (definitions in between, or a wrong index).

    """
    if not indexes or len(buffer) < MESSAGE_PREFIX:
        return None
    offset = np.concatenate([offsets for _, offsets in indexes])
    n_of_channel = [len(offsets) for _, offsets in indexes]
    channel = np.repeat([number for number, _ in indexes], n_of_channel)
    order = np.argsort(offset, kind='stable')
    offset = offset[order]
    channel = channel[order]
    if not len(offset) or offset[0] < 0 or offset[-1] + MESSAGE_PREFIX > len(buffer):
        return None
    # The records follow each other without a gap, from the first byte to the last one.
    length = _record_lengths(buffer, offset)
    next_offset = np.append(offset[1:], len(buffer))
    if offset[0] != 0 or not np.array_equal(offset + PREFIX.size + length, next_offset):
        return None
    if (buffer[offset] != MESSAGE).any():
        return None
    if (overlapping(buffer, '<u2')[offset + PREFIX.size] != channel).any():
        return None
    return channel, _packed_messages(buffer, offset, length)


def _record_lengths(buffer: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the lengths of the contents of the records at offsets in a buffer, int64."""
    return overlapping(buffer, '<u8')[offset + LENGTH_AT].astype(np.int64)


def _packed_messages(buffer: np.ndarray, offset: np.ndarray, length: np.ndarray) -> Packed:
    """Return the messages of Message records at offsets in a buffer, with these lengths."""
    return Packed(buffer, offset + MESSAGE_PREFIX, length - MESSAGE_HEAD_SIZE)


def walk(buffer: np.ndarray) -> Walk:
    """
    Step through records until a chunk, the end, or an incomplete or impossible one.

    Runs of one size are parsed at once. `buffer`: uint8, shape (n_bytes,).
    """
    view = buffer.data
    offsets = [np.zeros(0, np.int64)]
    others = []
    position = 0
    last_length = -1
    n_equal = 0  # messages of `last_length` before the present one, records of other kinds aside
    end = len(buffer)
    while position + PREFIX.size <= end:
        opcode, length = PREFIX.unpack_from(view, position)
        record_end = position + PREFIX.size + length
        is_last = opcode in (CHUNK, DATA_END, FOOTER)
        if is_last or not is_record(opcode) or record_end > end:
            break
        # 1. A record that is no message is copied.
        if opcode != MESSAGE:
            if len(others) == MOST_OTHERS:
                break
            others.append((opcode, bytes(view[position + PREFIX.size : record_end])))
            position = record_end
            continue
        # 2. A message, alone or with those of equal length after it. After `RUN` equal ones the
        #    next are compared in one step, at most four times as many as there were.
        if length < MESSAGE_HEAD_SIZE:
            break
        n_equal = n_equal + 1 if length == last_length else 0
        last_length = length
        stride = PREFIX.size + length
        if n_equal < RUN:
            run_offsets = np.array([position])
        else:
            run_offsets = _run_offsets(buffer, position, stride, 4 * n_equal)
        offsets.append(run_offsets)
        n_equal += len(run_offsets) - 1
        position = int(run_offsets[-1]) + stride

    offset = np.concatenate(offsets)
    channel = overlapping(buffer, '<u2')[offset + PREFIX.size].astype(np.int64)
    lengths = _record_lengths(buffer, offset)
    messages = _packed_messages(buffer[:position], offset, lengths)
    return Walk(channel, messages, others, position)


def log_times(messages: Packed, index: np.ndarray) -> np.ndarray:
    """Return the receive times of some messages in their records, int64."""
    return overlapping(messages.buffer, '<i8')[messages.start[index] - TIMES.size]


def is_record(opcode: int) -> bool:
    """Return whether the format defines the opcode, or reserves it for applications."""
    return 1 <= opcode <= LAST_OPCODE or opcode >= 0x80


def _run_offsets(buffer: np.ndarray, position: int, stride: int, most: int) -> np.ndarray:
    """
    Return the offsets of up to `most` Message records of `stride` bytes from `position` on.

    They end at the first record of another kind or length.
    """
    n_fitting = (len(buffer) - position) // stride
    offset = position + stride * np.arange(min(n_fitting, most))
    same_length = overlapping(buffer, '<u8')[offset + LENGTH_AT] == stride - PREFIX.size
    same = (buffer[offset] == MESSAGE) & same_length
    if same.all():
        return offset
    return offset[: int(np.argmin(same))]


def _strings(content: bytes | memoryview, position: int, count: int) -> list[bytes]:
    """Return `count` consecutive strings with their lengths in front, from `position` on."""
    texts = []
    for _ in range(count):
        (length,) = STRING_HEAD.unpack_from(content, position)
        start = position + STRING_HEAD.size
        position = start + length
        texts.append(bytes(content[start:position]))
    return texts


FIRST_BYTES = 1 << 16
"""
Bytes read at first of messages outside of chunks; doubled up to `CHUNK_STRETCH_BYTES` while no
other record is between them, otherwise reduced, so that few bytes are read twice.
"""
CHUNK_STRETCH_BYTES = 4 << 20
"""Chunks are joined to about this size before they are decoded."""
FOOTER_SIZE = PREFIX.size + FOOTER_CONTENT.size + len(MAGIC)
"""Bytes of the Footer record and of the end of the file."""


class McapFile(StorageFile):
    """One .mcap file."""

    def __init__(self, path: str | PathLike[str], unpack: Callable[[bytes], bytes] | None = None):
        super().__init__(path, unpack)
        self.file = open_regular(path)
        self.size = os.fstat(self.file.fileno()).st_size
        self.schemas: dict[int, Schema] = {}
        """Schema id -> Schema."""
        self.channels: dict[int, Channel] = {}
        """Channel id -> Channel."""
        self.chunk_starts: list[int] = []
        """Positions of the chunks by the summary, ascending."""
        self.n_unpacked = 0
        """Decompressed bytes since the begin of a pass through the file."""
        self.statistics: Any = None
        """Statistics of the summary or of a scan; None before either."""
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
        """Topic -> message type (`type_with_encoding`)."""
        types = {}
        for channel in self.channels.values():
            schema = self.schemas.get(channel.schema_id)
            name = 'unknown' if schema is None else schema.name
            types[channel.topic] = type_with_encoding(name, channel.encoding)
        return types

    @property
    def definitions(self) -> dict[str, tuple[str, str]]:
        """Message type -> (language, text)."""
        return {schema.name: (schema.encoding, schema.text) for schema in self.schemas.values()}

    def count(self) -> dict[str, int]:
        """Return topic -> messages."""
        counts = Counter({channel.topic: 0 for channel in self.channels.values()})
        for number, count in self.statistics.counts.items():
            if number in self.channels:
                counts[self.channels[number].topic] += count
        return dict(counts)

    def time_range(self) -> tuple[int, int] | None:
        """Return (first, last) receive time in ns, or None when the file lacks it."""
        first_ns, last_ns, counts = self.statistics
        return (first_ns, last_ns) if any(counts.values()) and last_ns else None

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

    def _stretches(self, topics: Sequence[str]) -> Iterator[Stretch]:
        """Yield the Stretches that may hold messages of the topics, read ahead in a thread."""
        channels_of_topic = self.topic_ids
        wanted = set()
        for topic in topics:
            wanted.update(channels_of_topic.get(topic, ()))
        with closing(read_ahead(self._joined_pieces(wanted))) as pieces:
            for channel, packed in pieces:
                yield Stretch(channel, packed, partial(log_times, packed))

    def _joined_pieces(self, wanted: set[int]) -> Generator[ChannelMessages, None, None]:
        """Yield the pairs of `_pieces`, joined to at least `CHUNK_STRETCH_BYTES`."""
        pieces = self._pieces(wanted)
        for batch in batches(pieces, lambda piece: len(piece[1].buffer), CHUNK_STRETCH_BYTES):
            channels, messages = zip(*batch, strict=True)
            yield np.concatenate(channels), Packed.chain(messages)

    def _pieces(self, wanted: set[int]) -> Iterator[ChannelMessages]:
        """
        Yield (channel ids, messages) of each chunk and of each run of messages outside of chunks.

        Chunks without a channel of `wanted`, by their indexes, are skipped.
        """
        for record in self._records():
            if record.opcode == CHUNK:
                indexes = self._indexes_of(record)
                if not indexes or any(number in wanted for number, _ in indexes):
                    yield from self._chunk(record, indexes)
            elif record.run is not None:
                self._register(record.run.others)
                yield record.run.channels, record.run.messages
            else:
                self._register_at(record)

    def _chunk(self, record: McapRecord, indexes: MessageIndexes) -> Iterator[ChannelMessages]:
        """
        Yield (channel ids, messages) of one chunk; nothing, and counted in `lost`, for damage.

        `indexes` of the chunk are used where they fit; otherwise its records are walked through.
        """
        content = memoryview(self._read(record.position, record.length))
        try:
            records, complete = unpack_chunk(content)
            self.n_unpacked += len(records)
            if self.n_unpacked > largest_content(self.size):
                raise McapDamage('chunks that expand far beyond the size of the file')
        except McapDamage as damage:
            n_lost = sum(len(offsets) for _, offsets in indexes)
            self._lose(f'messages in {damage}', max(n_lost, 1))
            return
        buffer = np.frombuffer(records, np.uint8)
        if complete:
            indexed = indexed_messages(buffer, indexes)
            if indexed is not None:
                yield indexed
                return
        walked = walk(buffer)
        self._register(walked.others)
        if not complete or walked.end < len(buffer):
            self._lose(f'chunks that end early, {UNKNOWN_EXTENT}', 1)
        yield walked.channels, walked.messages

    def _records(self) -> Iterator[McapRecord]:
        """
        Yield the records of the data section; messages outside of chunks in runs.

        A truncated chunk is yielded with its remaining bytes. Behind damage the next record is the
        next chunk that the summary lists.
        """
        position: int | None = len(MAGIC)
        self.n_unpacked = 0
        n_ahead = FIRST_BYTES  # bytes that are read for the next run
        while position is not None:
            opcode, length = self._prefix(position)
            content_start = position + PREFIX.size
            record_end = content_start + length
            if opcode in (DATA_END, FOOTER):
                return
            # Damage, or a record that is cut off.
            if not is_record(opcode) or record_end > self.size:
                if opcode == CHUNK:  # up to the next one, so that no byte is read twice
                    chunk_end = self._next_chunk(position) or self.size
                    yield McapRecord(CHUNK, content_start, chunk_end - content_start)
                position = self._resume(position)
                continue
            if opcode != MESSAGE:
                yield McapRecord(opcode, content_start, length)
                position = record_end
                continue

            # A message outside of chunks, and the run that it begins.
            content = self._read(position, max(n_ahead, record_end - position))
            run = walk(np.frombuffer(content, np.uint8))
            # More bytes next time if most of these are of the run, else twice its length.
            if 2 * run.end > len(content):
                n_ahead = min(2 * n_ahead, CHUNK_STRETCH_BYTES)
            else:
                n_ahead = max(2 * run.end, MESSAGE_PREFIX)
            if not run.end:  # the message is too short for its own head
                position = self._resume(position)
                continue
            yield McapRecord(MESSAGE, position, run.end, run)
            position += run.end

    def _prefix(self, position: int) -> tuple[int, int]:
        """Return (opcode, length) of the record at `position`, zeros at the end of the file."""
        prefix = self._read(position, PREFIX.size)
        return PREFIX.unpack(prefix) if len(prefix) == PREFIX.size else (0, 0)

    def _resume(self, position: int) -> int | None:
        """Count the damage at `position`; return the start of the next known chunk, or None."""
        next_chunk = self._next_chunk(position)
        self._lose(
            f'bytes that are no whole record, messages {UNKNOWN_EXTENT}',
            max((next_chunk or self.size) - position, 1),
        )
        return next_chunk

    def _next_chunk(self, position: int) -> int | None:
        """Return the first start of a chunk after `position` by the summary, or None."""
        place = bisect_right(self.chunk_starts, position)
        return self.chunk_starts[place] if place < len(self.chunk_starts) else None

    def _indexes_of(self, chunk: McapRecord) -> MessageIndexes:
        """
        Return (channel id, offsets) from the MessageIndex records that follow a chunk.

        Empty where one of them is damaged.
        """
        position = chunk.position + chunk.length
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

    def _read_summary(self) -> None:
        """Read channels, counts and positions of chunks from the summary, when the file has one."""
        footer = self._read(max(self.size - FOOTER_SIZE, 0), FOOTER_SIZE)
        if len(footer) < FOOTER_SIZE or not footer.endswith(MAGIC) or footer[0] != FOOTER:
            return
        start, *_ = FOOTER_CONTENT.unpack_from(footer, PREFIX.size)
        if not len(MAGIC) <= start < self.size:
            return
        summary = walk(np.frombuffer(self._read(start, self.size - start), np.uint8))
        for opcode, content in summary.others:
            if opcode == STATISTICS:
                self.statistics = parse_statistics(content)
            elif opcode == CHUNK_INDEX:
                _, _, chunk_start = CHUNK_INDEX_HEAD.unpack_from(content)
                self.chunk_starts.append(chunk_start)
        self._register(summary.others)
        self.chunk_starts.sort()

    def _scan(self) -> Statistics:
        """
        Find channels and counts without a summary, by the message indexes where there are any.
        """
        counts = Counter()
        for record in self._records():
            if record.opcode == CHUNK:
                indexes = self._indexes_of(record)
                # A channel that is still unknown may be defined in the chunk.
                if indexes and all(number in self.channels for number, _ in indexes):
                    counts.update({number: len(offsets) for number, offsets in indexes})
                    continue
                for channels, _ in self._chunk(record, indexes):
                    counts.update(channels.tolist())
            elif record.run is not None:
                self._register(record.run.others)
                counts.update(record.run.channels.tolist())
            else:
                self._register_at(record)
        self.lost.clear()  # it will be counted again when the messages are read
        return Statistics(0, 0, counts)

    def _register_at(self, record: McapRecord) -> None:
        """Read a record and keep it if it is a Schema or a Channel."""
        if record.opcode in (SCHEMA, CHANNEL):
            self._register([(record.opcode, self._read(record.position, record.length))])

    def _register(self, records: Sequence[tuple[int, bytes]]) -> None:
        """Keep the Schemas and Channels among records (opcode, content)."""
        for opcode, content in records:
            if opcode == SCHEMA:
                number, schema = parse_schema(content)
                self.schemas[number] = schema
            elif opcode == CHANNEL:
                number, channel = parse_channel(content)
                self.channels[number] = channel

    def _read(self, position: int, size: int) -> bytes:
        """Return up to `size` bytes from `position` on, fewer at the end of the file."""
        return os.pread(self.file.fileno(), size, position)
