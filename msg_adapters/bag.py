"""A recording by path, whatever its storage, and a robot description in it."""

import bz2
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from imu_calibration.core.errors import InputError, did_you_mean, shortened
from imu_calibration.core.exit_codes import UNKNOWN_EXTENT
from imu_calibration.core.samples import ImuSamples, JointSamples, SampleBlock, TemperatureSamples
from msg_adapters.compression import LARGEST_CHUNK, decompress
from msg_adapters.csv_log import (
    SUFFIXES,
    CsvBag,
    LogOptions,
    is_log_folder,
    is_text_log,
    require_no_rows,
)
from msg_adapters.decode import OTHER_FRAME, Decoder, FrameChoice, JointDecoder, take_counts
from msg_adapters.definitions import DEFAULT_TOPICS, deserializer, is_standard, rosbags_missing
from msg_adapters.imu import IMU_TYPE, TEMPERATURE_TYPE
from msg_adapters.joint_state import JOINT_STATE_TYPE
from msg_adapters.layout import clean_name
from msg_adapters.ros_reader import RosReader
from msg_adapters.rosbag2 import Rosbag2
from msg_adapters.storage import RawMessages, grouped
from msg_adapters.storages import suffixes

DESCRIPTION_TOPIC = '/robot_description'
STRING_TYPE = 'std_msgs/msg/String'
STATIC_TOPIC = '/tf_static'
TF_TYPE = 'tf2_msgs/msg/TFMessage'
Sample = TypeVar('Sample')


def frame_of(path: str, imu_topic: str | None = None) -> str:
    """Return the frame_id of the first Imu message."""
    with open_recording(path, imu_topic, want_joints=False, want_temperature=False) as recording:
        for block in recording.blocks(block_samples=1):
            if block.imu is not None and len(block.imu):
                return block.imu.frame_id
    return ''


def description_in(path: str, imu_topic: str | None = None) -> str:
    """
    Return the last robot description of a recording that can be decoded.

    Raises
    ------
    InputError
        When it holds none.

    """
    texts = list(
        _messages(
            path, imu_topic, DESCRIPTION_TOPIC, STRING_TYPE, lambda message: str(message.data)
        )
    )
    if not texts:
        raise InputError(
            f'{path} must hold the robot description on {DESCRIPTION_TOPIC} ({STRING_TYPE}), it'
            ' holds none; record that topic, or give the file',
            key='urdf',
            code='description_missing',
        )
    return texts[-1]


def static_transforms(path: str, imu_topic: str | None = None) -> list[tuple[str, str, np.ndarray]]:
    """
    Return (parent, child, quaternion) of every static transform of a recording.

    The quaternion is x y z w of the child in the parent.
    """
    found = []
    for rows in _messages(path, imu_topic, STATIC_TOPIC, TF_TYPE, transform_rows):
        found.extend(rows)
    return found


def transform_rows(message: Any) -> list[tuple[str, str, np.ndarray]]:
    """
    Return (parent, child, quaternion) of each transform of a TFMessage.

    As an object of rclpy or rosbags.
    """
    found = []
    for t in message.transforms:
        found.append(
            (
                clean_name(t.header.frame_id).lstrip('/'),
                clean_name(t.child_frame_id).lstrip('/'),
                np.array([float(getattr(t.transform.rotation, a)) for a in 'xyzw']),
            )
        )
    return found


def _messages(
    path, imu_topic, topic, message_type, read: Callable[[Any], Sample]
) -> Iterator[Sample]:
    """
    Yield the result of `read` for each decodable message of a topic.

    No results when the recording lacks it.
    """
    with open_recording(path, imu_topic, want_joints=False, want_temperature=False) as recording:
        if recording.source.types.get(topic) == message_type:
            deserialize = recording.deserializer(message_type)
            for raw in recording.source.stretches([topic]):
                for k in range(len(raw.packed)):
                    with suppress(Exception):  # rosbags raises many kinds on broken bytes
                        yield read(deserialize(raw.packed.message(k)))


LISTED_TOPICS = 20
"""Topics that an error shows."""
TOPIC_KEYS = {
    IMU_TYPE: 'imu_topic',
    JOINT_STATE_TYPE: 'joint_topic',
    TEMPERATURE_TYPE: 'temperature_topic',
}
"""Key in errors for the choice of a topic."""

BLOCK_SAMPLES = 65536
"""IMU and joint samples per block, about."""


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    name: str
    """Name with its leading slash."""
    type: str
    """Message type, as in sensor_msgs/msg/Imu."""
    count: int
    """Number of messages by the recording's metadata."""


def open_recording(
    path: str | PathLike[str],
    imu_topic: str | None = None,
    joint_topic: str | None = None,
    *,
    temperature_topic: str | None = None,
    want_joints: bool | str = True,
    want_temperature: bool | str = True,
    frame_id: str | None = None,
    log: LogOptions = LogOptions(),
) -> 'Recording':
    """
    Open a bag and choose its topics.

    By the given name, the default name, or the only one of the type, in this order.

    Parameters
    ----------
    path : path-like
        A rosbag2 folder, a bare .db3 or .mcap file, a ROS 1 .bag file, or a text log (.csv) whose
        columns and units are unambiguous.
    imu_topic, joint_topic, temperature_topic : str, optional
        Names of topics.
    want_joints : bool or 'optional'
        True: refuse a recording without JointState; 'optional': read none where the topic is
        missing or ambiguous.
    want_temperature : bool or 'optional'
        Whether to read temperatures when the recording has them; 'optional': read none where the
        topic is ambiguous.
    frame_id : str, optional
        Frame of the Imu messages that are read; needed for a topic with messages of several frames.
    log : LogOptions
        Columns, rows and units of a text log.

    Returns
    -------
    recording : Recording

    Raises
    ------
    InputError
        When the path is no readable bag, or a topic cannot be chosen.

    """
    path = Path(path)
    source = _open_source(path, log)
    try:
        topics = _listed(source)
        imu = _choose(path, topics, IMU_TYPE, imu_topic, required=True)
        joints = temperature = None
        if want_joints:
            joints = _choose(
                path,
                topics,
                JOINT_STATE_TYPE,
                joint_topic,
                want_joints is True,
                want_joints == 'optional',
            )
        if want_temperature:
            temperature = _choose(
                path,
                topics,
                TEMPERATURE_TYPE,
                temperature_topic,
                False,
                want_temperature == 'optional',
            )
    except BaseException:
        source.close()
        raise
    return Recording(
        path,
        source,
        topics,
        imu_topic=imu,
        joint_topic=joints,
        temperature_topic=temperature,
        frame_id=frame_id,
    )


class Recording:
    """An open bag; use it as a context manager or call `close`."""

    def __init__(
        self,
        path: Path,
        source: 'Rosbag2 | Ros1File',
        topics: tuple[Topic, ...],
        *,
        imu_topic: str,
        joint_topic: str | None,
        temperature_topic: str | None,
        frame_id: str | None = None,
    ):
        self.path = path
        self.topics = topics
        self.imu_topic = imu_topic
        self.joint_topic = joint_topic
        self.temperature_topic = temperature_topic
        self.source, self.frame_id = source, frame_id

    @property
    def message_counts(self) -> dict[str, int]:
        """Topic name -> number of messages by the recording's metadata."""
        return {topic.name: topic.count for topic in self.topics}

    @property
    def duration(self) -> float:
        """Seconds between the first and the last message by the recorder's clock."""
        return self.source.duration_ns * 1e-9

    @property
    def lost(self) -> dict[str, int]:
        """Unreadable data, reason -> count; complete when `blocks` has run to its end."""
        return dict(self.source.lost)

    def blocks(
        self, joint_names: Iterable[str] | None = None, block_samples: int = BLOCK_SAMPLES
    ) -> Generator[SampleBlock, None, None]:
        """
        Read the samples in file order.

        Parameters
        ----------
        joint_names : sequence of str, optional
            Joints of the table, in its order; default: those of the first JointState message.
        block_samples : int
            A block is handed out when it has at least this many IMU and joint samples.

        Yields
        ------
        block : SampleBlock
            IMU, joints and temperature of one stretch of the file; `dropped` counts the messages of
            the stretch that are unusable.

        Raises
        ------
        InputError
            When the JointState messages do not name the joints of the table.

        """
        decoders = self._decoders(joint_names, self.frame_id)
        parts, n_samples = {}, 0
        for raw in self.source.stretches(list(decoders)):
            for number, decoder in enumerate(decoders.values()):
                samples = decoder.decode(*raw.of(number))
                if samples is not None:
                    parts.setdefault(type(samples), []).append(samples)
                    n_samples += len(samples)
            if n_samples >= block_samples:
                yield _block(parts, decoders)
                parts, n_samples = {}, 0
        if self.joint_topic:
            decoders[self.joint_topic].check()
        decoders[self.imu_topic].choice.check()
        last = _block(parts, decoders)
        if parts or last.dropped:
            yield last

    def _decoders(self, joint_names, frame_id):
        source = self.source
        decoders: dict[str, Decoder] = {}
        for topic in filter(None, (self.imu_topic, self.joint_topic, self.temperature_topic)):
            message_type = source.types[topic]
            standard = not source.ros1 and is_standard(
                message_type, *source.definitions.get(message_type, ('', ''))
            )
            deserialize = None if standard else self.deserializer(message_type)
            if message_type == JOINT_STATE_TYPE:
                decoders[topic] = JointDecoder(joint_names, deserialize)
            else:
                decoders[topic] = Decoder(
                    message_type,
                    deserialize,
                    FrameChoice(topic, frame_id) if message_type == IMU_TYPE else None,
                )
        return decoders

    def frames(self) -> list[str]:
        """
        Return the frames of the first stretch of the Imu topic, in order of name.

        [] without messages.
        """
        # With a chosen frame, several frames are no error.
        decoder = self._decoders(None, '')[self.imu_topic]
        raw = next(iter(self.source.stretches([self.imu_topic])), None)
        if raw is not None:
            decoder.decode(*raw.of(0))
        return sorted(
            frame for frame, count in decoder.choice.counts.items() if count >= OTHER_FRAME
        )

    def deserializer(self, message_type: str) -> Callable:
        """
        Return a function from message bytes to a message object.

        It raises InputError for a definition that cannot be used.
        """
        try:
            return deserializer(message_type, self.source.definitions, self.source.ros1)
        except ModuleNotFoundError as error:
            raise rosbags_missing(f'the definition of {message_type} in {self.path}') from error
        except Exception as error:  # rosbags' parser raises many kinds
            raise InputError(
                f'the definition of {message_type} in {self.path} must be one that rosbags'
                f' understands, got: {shortened(str(error), 200)}; record again with standard'
                ' messages',
                code='definition_damaged',
            ) from error

    def close(self) -> None:
        """Close the files."""
        self.source.close()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.close()


def _block(parts, decoders):
    """
    Join the parts of a block and add the counts of dropped messages.

    These are the messages dropped by the decoders since the last block.
    """
    dropped, notes = take_counts(decoders.values())
    joined = {kind: kind.concatenate(samples) for kind, samples in parts.items()}
    return SampleBlock(
        joined.get(ImuSamples),
        joined.get(JointSamples),
        joined.get(TemperatureSamples),
        dropped,
        notes,
    )


def _open_source(path, log=LogOptions()):
    if not path.exists():
        raise InputError(
            f'a recording must be a rosbag2 folder, a {", ".join(suffixes())}, .bag or .csv file,'
            f' got {path}, which does not exist; check the path'
        )
    if not (path.is_dir() or path.is_file()):
        raise InputError(
            f'a recording must be a folder or a regular file, got {path}, which is a pipe or a'
            ' device; give a file'
        )
    try:
        if is_text_log(path) or is_log_folder(path):
            return CsvBag(path, log)
        require_no_rows(log, path)
        if path.suffix == '.bag':
            return Ros1File(path)
        by_ros = RosReader.needed(path) and RosReader.installed()
        return RosReader(path) if by_ros else Rosbag2(path)
    except InputError:
        raise
    except Exception as error:  # rosbags, sqlite3 and the system raise many kinds
        came = shortened(str(error), 300)
        raise InputError(
            f'{path} must be a readable bag (rosbag2 folder, {", ".join(suffixes())} or .bag file)'
            f' or a text log ({", ".join(SUFFIXES)}), got: {came}; check the path, record again, or'
            ' write the data as CSV and use the verb convert'
        ) from error


def list_topics(path: str | PathLike[str], log: LogOptions = LogOptions()) -> tuple[Topic, ...]:
    """
    Return the topics of a recording in order of name.

    `log` and errors: `open_recording`.
    """
    source = _open_source(Path(path), log)
    try:
        return _listed(source)
    finally:
        source.close()


def _listed(source):
    return tuple(
        Topic(name, source.types[name], source.counts[name]) for name in sorted(source.types)
    )


def _choose(path, topics, message_type, asked, required, lenient=False):
    """
    Return the topic of a type by the rule of `open_recording`, or None.

    Where there is none, or, when `lenient`, no telling which.
    """
    key = TOPIC_KEYS[message_type]
    fitting = [topic.name for topic in topics if topic.type == message_type]
    if asked is not None:
        names = [name for name in (asked, '/' + asked.lstrip('/')) if name in fitting]
        if not names:
            raise InputError(
                f'the topic that is read must be a {message_type} topic of {path}, got {asked}'
                f'{did_you_mean(asked, fitting)}; {_listing(topics, fitting)}',
                key=key,
                code='topic_unknown',
            )
        return names[0]
    if DEFAULT_TOPICS[message_type] in fitting:
        return DEFAULT_TOPICS[message_type]
    if len(fitting) == 1:
        return fitting[0]
    if fitting and not lenient:
        raise InputError(
            f'{path} must have one {message_type} topic or one named'
            f' {DEFAULT_TOPICS[message_type]}, got {_some(fitting)}; choose one',
            key=key,
            code='topic_ambiguous',
        )
    if required:
        raise InputError(
            f'{path} must have a {message_type} topic, got none: {_listing(topics, fitting)};'
            ' record'
            f' it{", or calibrate by hand, without a table" * (message_type == JOINT_STATE_TYPE)}',
            code='no_topic_of_type',
        )
    return None


def _listing(topics, fitting):
    if fitting:
        return f'choose one of {_some(fitting)}'
    return 'it holds ' + (
        _some([f'{topic.name} ({topic.type})' for topic in topics]) or 'no topics'
    )


def _some(names):
    """Return the first names as a text, and how many more there are."""
    text = ', '.join(names[:LISTED_TOPICS])
    if len(names) > LISTED_TOPICS:
        text += f' and {len(names) - LISTED_TOPICS} more'
    return text


class Ros1File:
    """One .bag file through rosbags' reader."""

    ros1 = True

    def __init__(self, path: Path):
        try:
            from rosbags.rosbag1 import Reader
        except ModuleNotFoundError as error:
            raise rosbags_missing(f'the ROS 1 bag {path}') from error
        self.reader = Reader(Path(path))
        self.reader.open()
        self.reader.chunks = {place: _bounded(chunk) for place, chunk in self.reader.chunks.items()}
        self.lost = {}
        self._drop_repeated_entries()
        self.counts = {}
        self.types = {}
        self.definitions = {}
        self.topics = {}
        """Id of a connection -> topic."""
        for connection in self.reader.connections:
            topic = self.topics[connection.id] = clean_name(connection.topic)
            self.types[topic] = message_type = clean_name(connection.msgtype)
            self.counts[topic] = self.counts.get(topic, 0) + connection.msgcount
            self.definitions[message_type] = ('ros2msg', connection.msgdef.data)

    def _drop_repeated_entries(self):
        """Keep one index entry for each place of a message, so that none is read twice."""
        indexes, n_repeated = {}, 0
        for connection, entries in self.reader.indexes.items():
            by_place = {}
            for entry in entries:
                by_place.setdefault((entry.chunk_pos, entry.offset), entry)
            indexes[connection] = list(by_place.values())
            n_repeated += len(entries) - len(by_place)
        self.reader.indexes = indexes
        if n_repeated:
            self.lost['index entries that repeat a message'] = n_repeated

    @property
    def duration_ns(self) -> int:
        """Time between the first and the last message by the clock of the recorder."""
        return (
            max(self.reader.end_time - self.reader.start_time - 1, 0)
            if self.reader.message_count
            else 0
        )

    def stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """
        Yield RawMessages of the topics in file order.

        Lost messages of the file are counted in `lost`.
        """
        return grouped(self._messages(topics))

    def _messages(self, topics):
        """Yield (index of the topic, receive time, message); count what is lost by damage."""
        connections = [c for c in self.reader.connections if self.topics[c.id] in topics]
        if not connections:
            return
        n_read = 0
        expected = sum(c.msgcount for c in connections)
        try:
            for connection, received_ns, data in self.reader.messages(connections):
                n_read += 1
                yield topics.index(self.topics[connection.id]), received_ns, bytes(data)
        except Exception as error:  # rosbags raises various errors on damaged files
            extent = '' if expected > n_read else f' {UNKNOWN_EXTENT}'
            lost = max(expected - n_read, 1)
            self.lost[f'messages{extent} after damage ({error})'] = lost

    def close(self) -> None:
        """Close the file."""
        with suppress(Exception):
            self.reader.close()


def _bounded(chunk: Any) -> Any:
    """Return a chunk of rosbags' reader that decompresses within limits."""
    from lz4 import frame

    compression = {bz2.decompress: 'bz2', frame.decompress: 'lz4'}.get(chunk.decompressor)
    return (
        chunk
        if compression is None
        else chunk._replace(decompressor=lambda data: decompress(compression, data, LARGEST_CHUNK))
    )
