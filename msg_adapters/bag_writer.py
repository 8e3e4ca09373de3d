"""A new rosbag2 folder, written under a temporary name and renamed when it is complete."""

import os
import re
import shutil
import sqlite3
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.document.files import is_running
from msg_adapters.definitions import TypeDefinition
from msg_adapters.layout import Packed
from msg_adapters.storages import STORAGES, identifiers

ROS_DISTRO = 'jazzy'
METADATA_VERSION = 9


class BagWriter:
    """
    Write one rosbag2 folder.

    Parameters
    ----------
    path : path-like
        The folder to make.
    storage : str
        Name in rosbag2 of one of `storages.STORAGES`.
    options : dict
        Passed to the storage (`compression` of the chunks of an mcap).

    """

    def __init__(self, path: str | PathLike[str], storage: str = 'sqlite3', **options: str):
        if storage not in identifiers():
            raise InputError(
                f'the storage of a bag must be {" or ".join(identifiers())}, got {storage!r};'
                ' choose one of these',
                code='storage_unknown',
            )
        self.path = Path(path)
        self.topics: dict[int, tuple[str, TypeDefinition, list]] = {}
        """Topic id -> (name, definition, QoS profiles)."""
        self.counts = Counter()
        """Topic id -> messages."""
        self.first_ns: int | None = None
        """Smallest receive time; None without messages."""
        self.last_ns: int | None = None
        """Largest receive time; None without messages."""
        self.kind = STORAGES[identifiers().index(storage)]
        self.file_name = f'{self.path.name}_0{self.kind.suffix}'
        self.partial = make_partial_folder(self.path)
        """Temporary folder, which `close` renames."""
        self.storage = self.kind.writer(self.partial / self.file_name, ROS_DISTRO, **options)

    def add_topic(self, name: str, definition: TypeDefinition, qos: Sequence[Any] = ()) -> int:
        """
        Declare a topic (`definition` is a TypeDefinition, `qos` a list of rosbag2 QoS mappings).

        Return its id.
        """
        topic_id = len(self.topics) + 1
        self.topics[topic_id] = (name, definition, list(qos))
        self.storage.add_topic(
            topic_id, name, definition, qos=dump_yaml(list(qos)).strip() if qos else ''
        )
        return topic_id

    def write(self, topic_ids: np.ndarray, received_ns: np.ndarray, messages: Packed) -> None:
        """
        Append messages in the order of the file.

        Arrays of topic ids and receive times, and the messages.
        """
        if not len(messages):
            return
        self.storage.write(topic_ids, received_ns, messages)
        for topic_id, count in zip(*np.unique(topic_ids, return_counts=True), strict=True):
            self.counts[int(topic_id)] += int(count)
        first = int(received_ns.min())
        last = int(received_ns.max())
        self.first_ns = first if self.first_ns is None else min(first, self.first_ns)
        self.last_ns = last if self.last_ns is None else max(last, self.last_ns)

    def close(self) -> None:
        """Finish the files and put the folder in its place."""
        information = self._metadata()
        self.storage.close(information, dump_yaml(information).strip())
        (self.partial / 'metadata.yaml').write_text(
            dump_yaml({'rosbag2_bagfile_information': information}), encoding='utf-8'
        )
        if self.path.exists():
            self.abort()
            raise InputError(f'{self.path} must not exist yet; remove it or choose another name')
        os.rename(self.partial, self.path)

    def abort(self) -> None:
        """Delete the written data."""
        self.storage.abort()
        shutil.rmtree(self.partial, ignore_errors=True)

    def _metadata(self) -> dict[str, Any]:
        """Return the content of metadata.yaml."""
        extent = {
            'starting_time': {'nanoseconds_since_epoch': self.first_ns or 0},
            'duration': {'nanoseconds': (self.last_ns or 0) - (self.first_ns or 0)},
            'message_count': self.counts.total(),
        }
        topics = []
        for topic_id, (name, definition, qos) in self.topics.items():
            topics.append(
                {
                    'topic_metadata': {
                        'name': name,
                        'type': definition.type,
                        'serialization_format': 'cdr',
                        'offered_qos_profiles': qos,
                        'type_description_hash': definition.digest,
                    },
                    'message_count': self.counts[topic_id],
                }
            )
        return {
            'version': METADATA_VERSION,
            'storage_identifier': self.kind.identifier,
            **extent,
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self.file_name],
            'files': [{'path': self.file_name, **extent}],
            'custom_data': None,
            'ros_distro': ROS_DISTRO,
        }

    def __enter__(self):
        return self

    def __exit__(self, kind, error, _):
        # A bag is finished only without an error.
        if kind is None:
            try:
                self.close()
                return
            except (OSError, sqlite3.Error) as failure:
                error = failure
        self.abort()
        # An error of the files, while they were written or finished, has its remedy in the text.
        if isinstance(error, (OSError, sqlite3.Error)):
            raise InputError(
                f'{self.path} must be writable to its end, got: {error}; free space or choose'
                ' another output'
            ) from error


def make_partial_folder(path: Path) -> Path:
    """
    Make the temporary folder next to `path`.

    It raises InputError when `path` exists or cannot be written.
    """
    path = Path(path)
    if path.exists():
        raise InputError(
            f'{path} must not exist yet; remove it or choose another name', code='exists_already'
        )
    partial = path.with_name(f'.{path.name}.{os.getpid()}.{token_hex(8)}.partial')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(OSError):  # a folder that can be written and not be listed
            _remove_leftovers(path)
        partial.mkdir()
    except OSError as error:
        raise InputError(
            f'{path.parent} must be a folder that can be written: {error.strerror}; choose another'
            ' output'
        ) from error
    return partial


def _remove_leftovers(path: Path) -> None:
    """
    Remove the temporary folders of processes that were killed while they wrote the same bag.

    Only real folders with the name that `make_partial_folder` gives and the files that `BagWriter`
    writes are removed.
    """
    pattern = re.compile(re.escape(f'.{path.name}.') + r'(\d{1,10})\.[0-9a-f]{16}\.partial')
    for folder in sorted(path.parent.iterdir()):
        name = pattern.fullmatch(folder.name)
        if name is None or folder.is_symlink() or not folder.is_dir():
            continue
        if is_running(int(name[1])):  # the process that writes it
            continue
        content = [file.name for file in folder.iterdir()]
        if all(file == 'metadata.yaml' or file.startswith(f'{path.name}_0.') for file in content):
            shutil.rmtree(folder, ignore_errors=True)
            print(f'removed {folder}, which an ended run has not finished', file=sys.stderr)


def dump_yaml(value: Any) -> str:
    """Return YAML text in the order of the mapping."""
    import yaml

    return yaml.safe_dump(value, sort_keys=False, width=1000)
