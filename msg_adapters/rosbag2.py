"""
rosbag2 recordings: a folder with its metadata, a folder without them, or a single storage file.
"""

import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from os import PathLike
from pathlib import Path, PurePath
from tempfile import mkdtemp
from typing import Any

from imu_calibration.core import documents
from imu_calibration.core.documents import open_regular, parsed
from imu_calibration.core.errors import InputError, shortened
from imu_calibration.core.schema import Document, list_of, mapping, maybe, require, text, whole
from msg_adapters.compression import decompress_file, decompress_message
from msg_adapters.definitions import (
    STANDARD_TYPES,
    TypeDefinition,
    is_standard,
    standard_definition,
)
from msg_adapters.layout import clean_name
from msg_adapters.storage import RawMessages
from msg_adapters.storages import STORAGES, suffixes

QOS_POLICIES = {
    'history': ('system_default', 'keep_last', 'keep_all'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': (
        'system_default',
        'automatic',
        'manual_by_node',
        'manual_by_topic',
        'unknown',
        'best_available',
    ),
}
"""Policy -> names of its numbers, as in rmw/types.h."""


def spelled_out(profiles: Sequence) -> list:
    """
    Return offered_qos_profiles as a list of mappings with names in place of numbers.

    Empty when they make no sense.
    """
    if isinstance(profiles, str):
        try:
            profiles = parsed(profiles, 'QoS profile')
        except InputError:
            profiles = []
    if not isinstance(profiles, list) or not all(isinstance(profile, dict) for profile in profiles):
        return []
    return [{key: _name(key, value) for key, value in profile.items()} for profile in profiles]


def _name(key: str, value: Any) -> Any:
    """Return the name of the number of a QoS policy; unchanged for another key or value."""
    if key not in QOS_POLICIES or not isinstance(value, int):
        return value
    names = QOS_POLICIES[key]
    return names[value] if 0 <= value < len(names) else 'unknown'


COMPRESSED = ('.zstd', '.zst')
_TOPIC = mapping({'name': text(), 'type': text()}, {'type_description_hash': maybe(text())})
_INFORMATION = mapping(
    {
        'topics_with_message_count': list_of(
            mapping({'topic_metadata': _TOPIC, 'message_count': whole()})
        ),
        'relative_file_paths': list_of(text()),
    },
    {
        'duration': mapping({'nanoseconds': whole(-(2**63))}),
        'compression_mode': maybe(text()),
        'storage_identifier': maybe(text()),
    },
)
METADATA = Document(
    'metadata.yaml',
    mapping({'rosbag2_bagfile_information': _INFORMATION}),
    'delete it, the files have the same content',
)
"""Parts of metadata.yaml that are used; QoS profiles are of no consequence (`spelled_out`)."""


class Rosbag2:
    """
    Storage files of one recording, read one after the other.

    Parameters
    ----------
    path : path-like
        The folder or the file.

    Raises
    ------
    ValueError, OSError, sqlite3.Error
        When no file of it can be read.

    """

    ros1 = False

    def __init__(self, path: str | PathLike[str]):
        self.path = Path(path)
        self.folder: str | None = None
        """Temporary folder of decompressed copies; None without any."""
        self.metadata = read_metadata(self.path) if self.path.is_dir() else {}
        self._lost: dict[str, int] = {}
        """Losses outside of the files' own counts, reason -> count."""
        self.files: list = []
        """Readers of the files that can be read, in their order."""
        self.types: dict[str, str] = {}
        """Topic -> message type."""
        self.definitions: dict[str, tuple[str, str]] = {}
        """Message type -> (language, text)."""
        by_message = (self.metadata.get('compression_mode') or '').lower() == 'message'
        unpack = decompress_message if by_message else None
        try:
            errors = [self._open(path, unpack) for path in self._storage_paths()]
            if not self.files:
                raise ValueError(
                    '; '.join(filter(None, errors)) or f'there is no {" or ".join(suffixes())} file'
                )
            for file in self.files:
                self.types.update(file.types)
                self.definitions.update(file.definitions)
            self.counts = self._counts()
        except BaseException:
            self.close()
            raise

    @property
    def duration_ns(self) -> int:
        """Time between the first and the last message by the clock of the recorder."""
        if 'duration' in self.metadata:
            return self.metadata['duration']['nanoseconds']
        ranges = [file.time_range() for file in self.files]
        ranges = [times for times in ranges if times]
        if not ranges:
            return 0
        return max(last for _, last in ranges) - min(first for first, _ in ranges)

    @property
    def lost(self) -> dict[str, int]:
        """Unreadable data, reason -> count."""
        lost = dict(self._lost)
        for file in self.files:
            lost.update(file.lost)
        return lost

    @property
    def storage(self) -> str:
        """Name in rosbag2 of the storage of the first file."""
        return next(
            storage.identifier for storage in STORAGES if isinstance(self.files[0], storage.reader)
        )

    def definition(self, topic: str) -> TypeDefinition:
        """Return the TypeDefinition of a topic; the standard one where the bag has none."""
        message_type = self.types[topic]
        encoding, text = self.definitions.get(message_type, ('', ''))
        if message_type in STANDARD_TYPES and is_standard(message_type, encoding, text):
            return standard_definition(message_type)
        digest = self._entry(topic).get('type_description_hash', '')
        return TypeDefinition(message_type, encoding if text else '', text, digest)

    def qos(self, topic: str) -> list:
        """Return the QoS profiles of a topic's publishers that the metadata contain."""
        return spelled_out(self._entry(topic).get('offered_qos_profiles', []))

    def stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """
        Yield RawMessages of the topics, file by file.

        Count the messages in the metadata that damaged files lack.
        """
        n_read = 0
        for file in self.files:
            file.lost.clear()
            try:
                for raw in file.stretches(topics):
                    n_read += len(raw.topic)
                    yield raw
            except InputError:  # no damage: something is not installed
                raise
            except Exception as error:  # readers raise various errors on hostile or damaged files
                file.lost[
                    f'rest of {file.path.name} after damage'
                    f' ({shortened(f"{type(error).__name__}: {error}", 100)})'
                ] = 1
        announced_counts = self._announced_counts()
        n_missing = sum(announced_counts.get(topic, 0) for topic in topics) - n_read
        if self.lost and n_missing > 0:
            reason = 'messages that the metadata announce and the files do not hold'
            self._lost[reason] = n_missing

    def _entry(self, topic: str) -> dict[str, Any]:
        """Return the description of a topic in the metadata, {} without one."""
        for entry in self.metadata.get('topics_with_message_count', ()):
            if entry['topic_metadata']['name'] == topic:
                return entry['topic_metadata']
        return {}

    def close(self) -> None:
        """Close the files and remove decompressed copies."""
        for file in self.files:
            file.close()
        if self.folder:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _storage_paths(self) -> list[Path]:
        """Return the storage files in the order of recording."""
        if not self.path.is_dir():
            return [self.path]
        if self.metadata.get('relative_file_paths'):
            names = [PurePath(name).name for name in self.metadata['relative_file_paths']]
            return [self.path / name for name in dict.fromkeys(names)]
        paths = [path for path in self.path.iterdir() if _storage_suffix(path) in suffixes()]
        return sorted(paths, key=_natural)

    def _open(self, path: Path, unpack: Callable[[bytes], bytes] | None) -> str | None:
        """Open one storage file; return the error when that fails. `unpack`: for each message."""
        try:
            readers = {storage.suffix: storage.reader for storage in STORAGES}
            reader = readers.get(_storage_suffix(path))
            if reader is None:
                raise ValueError(
                    f'a storage file must end in {", ".join(suffixes())}, with'
                    f' {" or ".join(COMPRESSED)} behind it when compressed'
                )
            if path.exists() and not path.is_file():
                raise ValueError('it is not a regular file')
            plain = self._decompressed(path) if path.suffix in COMPRESSED else path
            self.files.append(reader(plain, unpack))
            self._lost.update(self.files[-1].lost)
        # Sqlite3, struct, OS and decompression errors: a damaged file must not prevent reading of
        # intact ones
        except Exception as error:
            self._lost[f'file {path.name} that cannot be read ({error})'] = 1
            return f'{path.name}: {error}'
        return None

    def _decompressed(self, path: Path) -> Path:
        """Decompress a file into the temporary folder; return the copy."""
        self.folder = self.folder or mkdtemp(prefix='imu_calibration_')
        target = Path(self.folder, path.stem)
        error = decompress_file(path, target)
        if error:
            self._lost[f'end of {path.name} ({error})'] = 1
        return target

    def _announced_counts(self) -> dict[str, int]:
        """Return topic -> messages by the metadata; {} without metadata."""
        return {
            entry['topic_metadata']['name']: entry['message_count']
            for entry in self.metadata.get('topics_with_message_count', ())
        }

    def _counts(self) -> dict[str, int]:
        """Return topic -> messages by the metadata, without them by the files."""
        counts = Counter(self._announced_counts())
        if not counts:
            for file in self.files:
                counts.update(file.count())
        return {name: counts[name] for name in self.types}


def read_metadata(folder: Path) -> dict[str, Any]:
    """
    Return the content of metadata.yaml.

    Empty when there is none or it is damaged, as after a crash of the recorder.
    """
    try:
        with open_regular(folder / 'metadata.yaml') as file:
            content = file.read(documents.MAX_DOCUMENT_CHARACTERS + 1).decode()
        return _information(content)
    except (OSError, InputError, UnicodeDecodeError):
        return {}


@lru_cache(maxsize=1)
def _information(content: str) -> dict[str, Any]:
    """
    Return the checked content of metadata.yaml, which nothing changes.

    One verb opens a recording several times.
    """
    document = documents.parsed(content, METADATA.name, aliases=True)
    require(document, METADATA)
    information: dict[str, Any] = document['rosbag2_bagfile_information']
    for entry in information['topics_with_message_count']:
        topic = entry['topic_metadata']
        topic['name'] = clean_name(topic['name'])
        topic['type'] = clean_name(topic['type'])
    return information


def _storage_suffix(path: Path) -> str:
    """Return the suffix of a storage file without that of its compression."""
    return Path(path.stem).suffix if path.suffix in COMPRESSED else path.suffix


def _natural(path: Path) -> list[int | str]:
    """Sort key that places bag_10 after bag_9."""
    return [int(part) if part.isdigit() else part for part in re.split(r'(\d+)', path.name)]
