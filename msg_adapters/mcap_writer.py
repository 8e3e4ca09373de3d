"""A new MCAP file."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.compression import compressor
from msg_adapters.definitions import TypeDefinition
from msg_adapters.layout import Packed, overlapping
from msg_adapters.mcap_file import (
    CHANNEL,
    CHANNEL_HEAD,
    CHUNK,
    CHUNK_INDEX,
    CHUNK_INDEX_HEAD,
    CHUNK_SIZES,
    DATA_END,
    FOOTER,
    FOOTER_CONTENT,
    HEADER,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    OF_CHANNEL,
    PREFIX,
    SCHEMA,
    SCHEMA_HEAD,
    SIZE,
    STATISTICS,
    STATISTICS_HEAD,
    STRING_HEAD,
    SUMMARY_OFFSET,
    TIMES,
)

CHUNK_SIZE = 1 << 20
NO_CHECKSUM = bytes(4)
MESSAGE_HEADER = np.dtype(
    [
        ('opcode', 'u1'),
        ('length', '<u8'),
        ('channel', '<u2'),
        ('sequence', '<u4'),
        ('log_ns', '<u8'),
        ('publish_ns', '<u8'),
    ]
)
"""Prefix of the data of a Message record, 31 bytes."""


def prefixed_string(value: bytes | str) -> bytes:
    """A string with its length in front."""
    data = value if isinstance(value, bytes) else value.encode()
    return STRING_HEAD.pack(len(data)) + data


def record(opcode: int, *parts: bytes) -> bytes:
    """One record: opcode, length, content."""
    content = b''.join(parts)
    return PREFIX.pack(opcode, len(content)) + content


class McapWriter:
    """Writes one new file; `compression` of the chunks is '', 'zstd' or 'lz4'."""

    def __init__(self, path: Path, _ros_distro: str, compression: str = ''):
        self.file = open(path, 'xb')
        self.compression = compression
        self.compress = compressor(compression)
        self.file.write(
            MAGIC + record(HEADER, prefixed_string('ros2'), prefixed_string('imu_calibration'))
        )
        self.schemas: dict[str, tuple[int, bytes]] = {}
        """Message type -> (id, Schema record)."""
        self.channels: dict[int, bytes] = {}
        """Topic id -> Channel record."""
        self.new_records = b''
        """Schemas and channels that the next chunk begins with."""
        self.chunk_indexes: list[bytes] = []
        """ChunkIndex record of each chunk."""

    def add_topic(self, topic_id: int, name: str, definition: TypeDefinition, *, qos: str) -> None:
        """Declare a topic; `definition` is a TypeDefinition."""
        if definition.type not in self.schemas:
            schema = record(
                SCHEMA,
                SCHEMA_HEAD.pack(len(self.schemas) + 1),
                prefixed_string(definition.type),
                prefixed_string(definition.encoding),
                prefixed_string(definition.text),
            )
            self.schemas[definition.type] = (len(self.schemas) + 1, schema)
            self.new_records += schema
        metadata = (
            prefixed_string('offered_qos_profiles')
            + prefixed_string(qos)
            + prefixed_string('topic_type_hash')
            + prefixed_string(definition.digest)
        )
        channel = record(
            CHANNEL,
            CHANNEL_HEAD.pack(topic_id, self.schemas[definition.type][0]),
            prefixed_string(name),
            prefixed_string('cdr'),
            prefixed_string(metadata),
        )
        self.channels[topic_id] = channel
        self.new_records += channel

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Packed) -> None:
        """Append messages: arrays of topic ids and receive times, and the messages."""
        headers = np.zeros(len(messages), dtype=MESSAGE_HEADER)
        headers['opcode'] = MESSAGE
        headers['length'] = messages.size + MESSAGE_HEAD_SIZE
        headers['channel'] = topic_ids
        headers['log_ns'] = received_ns
        headers['publish_ns'] = received_ns
        # Records of all messages, one after the other: header, then data. `start` and `end` are the
        # first byte of each record and the one after its last.
        n_head = MESSAGE_HEADER.itemsize
        end = np.cumsum(messages.size + n_head)
        start = end - messages.size - n_head
        content = np.empty(end[-1], np.uint8)
        overlapping(content, f'V{n_head}')[start] = headers.view(f'V{n_head}')
        messages.copy_to(content, start + n_head)
        # A chunk ends with the message that passes a multiple of CHUNK_SIZE; `cuts` are the first
        # messages of the chunks after the first one.
        cuts = np.flatnonzero(np.diff(end // CHUNK_SIZE)) + 1
        for first, stop in zip([0, *cuts], [*cuts, len(messages)], strict=True):
            self._write_chunk(
                headers[first:stop],
                start[first:stop] - start[first],
                content[start[first] : end[stop - 1]],
            )

    def _write_chunk(self, headers: np.ndarray, offset: np.ndarray, records: np.ndarray) -> None:
        """
        Write a chunk with its message indexes, and keep its ChunkIndex record.

        `headers` of n messages, shape (n,), and the first byte of their records in `records`,
        `offset`, int64, shape (n,). `records`: uint8, shape (n_bytes,).
        """
        # Definitions of new topics come first, and offsets count from the begin of the chunk.
        content = self.new_records + records.tobytes()
        offset = offset + len(self.new_records)
        self.new_records = b''
        packed = self.compress(content)
        times = int(headers['log_ns'].min()), int(headers['log_ns'].max())
        sizes = prefixed_string(self.compression) + SIZE.pack(len(packed))
        start = self.file.tell()
        self.file.write(
            record(
                CHUNK,
                TIMES.pack(*times),
                CHUNK_SIZES.pack(len(content), zlib.crc32(content)),
                sizes,
                packed,
            )
        )
        chunk_length = self.file.tell() - start
        places = self._write_message_indexes(headers, offset)
        indexes_length = self.file.tell() - start - chunk_length
        self.chunk_indexes.append(
            record(
                CHUNK_INDEX,
                CHUNK_INDEX_HEAD.pack(*times, start),
                SIZE.pack(chunk_length),
                prefixed_string(places),
                SIZE.pack(indexes_length),
                sizes,
                SIZE.pack(len(content)),
            )
        )

    def _write_message_indexes(self, headers: np.ndarray, offset: np.ndarray) -> bytes:
        """
        Write a MessageIndex record for each channel of a chunk.

        Return the pairs (channel id, position of its record) as bytes.
        """
        places = b''
        for channel in np.unique(headers['channel']):
            of_channel = headers['channel'] == channel
            log_ns = headers['log_ns'][of_channel]
            entries = np.stack([log_ns, offset[of_channel].astype('<u8')], axis=1)
            places += OF_CHANNEL.pack(channel, self.file.tell())
            self.file.write(
                record(MESSAGE_INDEX, INDEX_HEAD.pack(channel, entries.nbytes), entries.tobytes())
            )
        return places

    def close(self, information: dict[str, Any], metadata: str) -> None:
        """Write the metadata (also as text), the summary and the footer, and close."""
        if self.new_records:
            self.file.write(self.new_records)
        metadata_start = self.file.tell()
        content = record(
            METADATA,
            prefixed_string('rosbag2'),
            prefixed_string(prefixed_string('serialized_metadata') + prefixed_string(metadata)),
        )
        self.file.write(content + record(DATA_END, NO_CHECKSUM))
        counts = b''.join(
            OF_CHANNEL.pack(channel, entry['message_count'])
            for channel, entry in zip(
                self.channels, information['topics_with_message_count'], strict=True
            )
        )
        first_ns = information['starting_time']['nanoseconds_since_epoch']
        statistics = STATISTICS_HEAD.pack(
            information['message_count'],
            len(self.schemas),
            len(self.channels),
            0,  # attachments
            1,  # metadata
            len(self.chunk_indexes),
            first_ns,
            first_ns + information['duration']['nanoseconds'],
            len(counts),
        )
        groups = {
            SCHEMA: [schema for _, schema in self.schemas.values()],
            CHANNEL: list(self.channels.values()),
            CHUNK_INDEX: self.chunk_indexes,
            METADATA_INDEX: [
                record(
                    METADATA_INDEX,
                    struct.pack('<QQ', metadata_start, len(content)),
                    prefixed_string('rosbag2'),
                )
            ],
            STATISTICS: [record(STATISTICS, statistics, counts)],
        }
        summary_start = self.file.tell()
        offsets = self._write_groups(groups)
        offset_start = self.file.tell()
        self.file.write(
            b''.join(offsets)
            + record(FOOTER, FOOTER_CONTENT.pack(summary_start, offset_start, 0))
            + MAGIC
        )
        self.file.close()

    def _write_groups(self, groups: dict[int, list[bytes]]) -> list[bytes]:
        """Write the records of the summary by opcode; return the SummaryOffset records."""
        offsets = []
        for opcode, records in groups.items():
            start = self.file.tell()
            self.file.write(b''.join(records))
            if records:
                offsets.append(
                    record(
                        SUMMARY_OFFSET, struct.pack('<BQQ', opcode, start, self.file.tell() - start)
                    )
                )
        return offsets

    def abort(self) -> None:
        """Close without finishing."""
        self.file.close()
