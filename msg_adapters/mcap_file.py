"""An MCAP file, read and written."""

import os
import struct
import zlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from imu_calibration.core.documents import open_regular
from msg_adapters.definitions import TypeDefinition
from msg_adapters.layout import Packed, overlapping
from msg_adapters.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    PREFIX,
    SCHEMA,
    STATISTICS,
    McapDamage,
    decompress_chunk,
    indexed_messages,
    is_record,
    largest_content,
    log_times,
    parse_channel,
    parse_message_index,
    parse_schema,
    parse_statistics,
    unpack_chunk,
    walk,
)
from msg_adapters.storage import StorageFile, Stretch, read_ahead

CHUNK_SIZE = 1 << 20
MESSAGE_HEADER = np.dtype([('opcode', 'u1'), ('length', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
                           ('log_ns', '<u8'), ('publish_ns', '<u8')])
"""Prefix of the data of a Message record, 31 bytes."""


def text(value: bytes | str) -> bytes:
    """A string with its length in front."""
    data = value if isinstance(value, bytes) else value.encode()
    return struct.pack('<I', len(data)) + data


def record(opcode: int, *parts: bytes) -> bytes:
    """One record: opcode, length, content."""
    content = b''.join(parts)
    return struct.pack('<BQ', opcode, len(content)) + content


class McapWriter:
    """Writes one new file; `compression` of the chunks is '', 'zstd' or 'lz4'."""

    def __init__(self, path: Path, _ros_distro: str, compression: str = ''):
        self.file = open(path, 'xb')
        self.compression, self.compress = compression, compressor(compression)
        self.file.write(MAGIC + record(0x01, text('ros2'), text('imu_calibration')))
        self.schemas, self.channels = {}, {}
        self.new_records = b''
        self.chunk_indexes, self.counts = [], Counter()
        self.first_ns, self.last_ns = None, 0

    def add_topic(self, topic_id: int, name: str, definition: TypeDefinition, *, qos: str) -> None:
        """Declare a topic; `definition` is a TypeDefinition."""
        if definition.type not in self.schemas:
            schema = record(0x03, struct.pack('<H', len(self.schemas) + 1), text(definition.type), text(definition.encoding),
                            text(definition.text))
            self.schemas[definition.type] = (len(self.schemas) + 1, schema)
            self.new_records += schema
        metadata = text('offered_qos_profiles') + text(qos) + text('topic_type_hash') + text(definition.digest)
        channel = record(0x04, struct.pack('<HH', topic_id, self.schemas[definition.type][0]), text(name), text('cdr'), text(metadata))
        self.channels[topic_id] = channel
        self.new_records += channel

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Packed) -> None:
        """Append messages: arrays of topic ids and receive times, and the messages."""
        headers, head = np.zeros(len(messages), dtype=MESSAGE_HEADER), MESSAGE_HEADER.itemsize
        headers['opcode'], headers['length'], headers['channel'] = 0x05, messages.size + 22, topic_ids
        headers['log_ns'] = headers['publish_ns'] = received_ns
        end = np.cumsum(messages.size + head)
        place = end - messages.size - head
        content = np.empty(end[-1], np.uint8)
        overlapping(content, f'V{head}')[place] = headers.view(f'V{head}')
        messages.copy_to(content, place + head)
        cuts = np.flatnonzero(np.diff(end // CHUNK_SIZE)) + 1
        for first, last in zip([0, *cuts], [*cuts, len(messages)], strict=True):
            self._write_chunk(headers[first:last], place[first:last] - place[first], content[place[first]:end[last - 1]])

    def _write_chunk(self, headers, offset, messages):
        content = self.new_records + messages.tobytes()
        offset += len(self.new_records)
        self.new_records = b''
        packed = self.compress(content)
        times = struct.pack('<QQ', int(headers['log_ns'].min()), int(headers['log_ns'].max()))
        sizes = text(self.compression) + struct.pack('<Q', len(packed))
        start = self.file.tell()
        self.file.write(record(0x06, times, struct.pack('<QI', len(content), zlib.crc32(content)), sizes, packed))
        length = self.file.tell() - start
        places = self._write_message_indexes(headers, offset)
        self.chunk_indexes.append(record(0x08, times, struct.pack('<QQ', start, length), text(places),
                                         struct.pack('<Q', self.file.tell() - start - length), sizes, struct.pack('<Q', len(content))))
        self.first_ns = min(int(headers['log_ns'].min()), self.first_ns if self.first_ns is not None else 1 << 63)
        self.last_ns = max(int(headers['log_ns'].max()), self.last_ns)

    def _write_message_indexes(self, headers, offset):
        places = b''
        for channel in np.unique(headers['channel']):
            mine = headers['channel'] == channel
            entries = np.stack([headers['log_ns'][mine], offset[mine].astype('<u8')], axis=1)
            places += struct.pack('<HQ', channel, self.file.tell())
            self.file.write(record(0x07, struct.pack('<H', channel), text(entries.tobytes())))
            self.counts[int(channel)] += len(entries)
        return places

    def close(self, _metadata_version: int, metadata: str) -> None:
        """Write the metadata, the summary and the footer, and close."""
        if self.new_records:
            self.file.write(self.new_records)
        metadata_start = self.file.tell()
        content = record(0x0C, text('rosbag2'), text(text('serialized_metadata') + text(metadata)))
        self.file.write(content + record(0x0F, struct.pack('<I', 0)))
        counts = b''.join(struct.pack('<HQ', channel, self.counts[channel]) for channel in sorted(self.channels))
        statistics = struct.pack('<QHIIIIQQ', self.counts.total(), len(self.schemas), len(self.channels), 0, 1, len(self.chunk_indexes),
                                 self.first_ns or 0, self.last_ns)
        groups = {0x03: [schema for _, schema in self.schemas.values()], 0x04: list(self.channels.values()), 0x08: self.chunk_indexes,
                  0x0D: [record(0x0D, struct.pack('<QQ', metadata_start, len(content)), text('rosbag2'))],
                  0x0B: [record(0x0B, statistics, text(counts))]}
        summary_start = self.file.tell()
        offsets = self._write_groups(groups)
        offset_start = self.file.tell()
        self.file.write(b''.join(offsets) + record(0x02, struct.pack('<QQI', summary_start, offset_start, 0)) + MAGIC)
        self.file.close()

    def _write_groups(self, groups):
        offsets = []
        for opcode, records in groups.items():
            start = self.file.tell()
            self.file.write(b''.join(records))
            if records:
                offsets.append(record(0x0E, struct.pack('<BQQ', opcode, start, self.file.tell() - start)))
        return offsets

    def abort(self) -> None:
        """Close without finishing."""
        self.file.close()


def compressor(name: str) -> Callable | type:
    """Return the function that compresses a chunk."""
    if name == 'zstd':
        from msg_adapters.mcap_records import zstd
        return zstd().compress
    if name == 'lz4':
        from lz4.frame import compress
        return compress
    return bytes


FIRST_BYTES = 1 << 16
"""Bytes read at once of messages outside of chunks; doubled up to `STRETCH_BYTES` while no other record is between them."""
STRETCH_BYTES = 4 << 20
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
        self.path, self.unpack = Path(path), unpack
        self.file = open_regular(path)
        self.size = os.fstat(self.file.fileno()).st_size
        self.schemas, self.channels, self.lost = {}, {}, {}
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
            name = self.schemas[channel.schema_id].name if channel.schema_id in self.schemas else 'unknown'
            types[channel.topic] = name if channel.encoding == 'cdr' else f'{name} ({channel.encoding})'
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
        wanted = {number for topic in topics for number in self.topic_ids.get(topic, ())}
        with closing(read_ahead(self._joined_pieces(wanted))) as pieces:
            for channel, packed in pieces:
                yield Stretch(channel, lambda index, packed=packed: (index, packed.select(index)), partial(log_times, packed))

    def _joined_pieces(self, wanted):
        """Join pieces to stretches."""
        waiting, n_waiting = [], 0
        for piece in self._pieces(wanted):
            waiting.append(piece)
            n_waiting += len(piece[1].buffer)
            if n_waiting >= STRETCH_BYTES:
                yield _join(waiting)
                waiting, n_waiting = [], 0
        if waiting:
            yield _join(waiting)

    def _pieces(self, wanted):
        """Yield (channel ids, Packed) for each chunk with wanted channels and each run of messages outside of chunks."""
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
            records, whole = unpack_chunk(content, decompress_chunk)
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
                self._lose('chunks that end early', 1)
        yield messages

    def _records(self):
        """
        Yield (opcode, position, length, None) of the records of the data section; a truncated chunk is yielded with its remaining bytes.

        Messages outside of chunks are yielded in groups, with ((channel ids, Packed), other records) in place of None.
        """
        position = len(MAGIC)
        self.n_unpacked = 0
        ahead = FIRST_BYTES
        while position is not None:
            prefix = self._read(position, PREFIX.size)
            opcode, length = PREFIX.unpack(prefix) if len(prefix) == PREFIX.size else (0, 0)
            behind = position + PREFIX.size + length
            if opcode in (DATA_END, FOOTER):
                return
            if not is_record(opcode) or behind > self.size:
                if opcode == CHUNK:   # up to the next one, so that no byte is read twice
                    yield CHUNK, position + PREFIX.size, (self._following(position) or self.size) - position - PREFIX.size, None
                position = self._resume(position)
            elif opcode == MESSAGE:
                buffer = np.frombuffer(self._read(position, max(ahead, behind - position)), np.uint8)
                messages, others, end = walk(buffer)
                ahead = min(2 * ahead, STRETCH_BYTES) if 2 * end > len(buffer) else FIRST_BYTES
                if end:
                    yield MESSAGE, position, end, (messages, others)
                position = position + end if end else self._resume(position)
            else:
                yield opcode, position + PREFIX.size, length, None
                position = behind

    def _resume(self, position):
        """Count the damage at `position` and return the start of the next chunk in the summary, or None."""
        following = self._following(position)
        self._lose('bytes that are no whole record', max((following or self.size) - position, 1))
        return following

    def _following(self, position):
        """Return the first known start of a chunk after `position`, or None."""
        place = bisect_right(self.chunk_starts, position)
        return self.chunk_starts[place] if place < len(self.chunk_starts) else None

    def _indexes_behind(self, position):
        """Return (channel id, offsets) from the MessageIndex records that start at `position`."""
        indexes = []
        while True:
            prefix = self._read(position, PREFIX.size)
            opcode, length = PREFIX.unpack(prefix) if len(prefix) == PREFIX.size else (0, 0)
            if opcode != MESSAGE_INDEX or position + PREFIX.size + length > self.size:
                return indexes
            try:
                indexes.append(parse_message_index(self._read(position + PREFIX.size, length)))
            except (struct.error, ValueError):
                return []   # the chunk is then walked through
            position += PREFIX.size + length

    def _read_summary(self):
        """Read channels, counts and positions of chunks from the summary, when the file has one."""
        footer = self._read(max(self.size - FOOTER_SIZE - len(MAGIC), 0), FOOTER_SIZE + len(MAGIC))
        if len(footer) < FOOTER_SIZE + len(MAGIC) or footer[FOOTER_SIZE:] != MAGIC or footer[0] != FOOTER:
            return
        start, = struct.unpack_from('<Q', footer, PREFIX.size)
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
        """Find channels and counts without a summary, by the message indexes where there are any."""
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
        self.lost.clear()   # it will be counted again when the messages are read
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
