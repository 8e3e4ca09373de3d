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
        _read_messages(
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
    transforms = []
    for rows in _read_messages(path, imu_topic, STATIC_TOPIC, TF_TYPE, transform_rows):
        transforms.extend(rows)
    return transforms


def transform_rows(message: Any) -> list[tuple[str, str, np.ndarray]]:
    """
    Return (parent, child, quaternion) of each transform of a TFMessage.

    `message`: an object of rclpy or rosbags. Quaternion: x y z w of the child in the parent.
    """
    rows = []
    for transform in message.transforms:
        parent = clean_name(transform.header.frame_id).lstrip('/')
        child = clean_name(transform.child_frame_id).lstrip('/')
        rotation = transform.transform.rotation
        quaternion = np.array([float(getattr(rotation, axis)) for axis in 'xyzw'])
        rows.append((parent, child, quaternion))
    return rows


def _read_messages(
    path: str,
    imu_topic: str | None,
    topic: str,
    message_type: str,
    read: Callable[[Any], Sample],
) -> Iterator[Sample]:
    """
    Yield ``read(message object)`` for each message of a topic that can be decoded and read.

    No results where the recording has no topic of this name and type. `imu_topic`: as for
    `open_recording`.
    """
    with open_recording(path, imu_topic, want_joints=False, want_temperature=False) as recording:
        if recording.source.types.get(topic) != message_type:
            return
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
                required=want_joints is True,
                lenient=want_joints == 'optional',
            )
        if want_temperature:
            temperature = _choose(
                path,
                topics,
                TEMPERATURE_TYPE,
                temperature_topic,
                lenient=want_temperature == 'optional',
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


@dataclass(eq=False, repr=False)
class Recording:
    """An open bag; use it as a context manager or call `close`."""

    path: Path
    source: 'Rosbag2 | Ros1File'
    """Reader of the messages."""
    topics: tuple[Topic, ...]
    """All topics, in order of name."""
    imu_topic: str
    joint_topic: str | None
    """None where no joints are read."""
    temperature_topic: str | None
    """None where no temperatures are read."""
    frame_id: str | None = None
    """Frame of the Imu messages that are read; None: of all, which must have one frame."""

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
        # Class of the samples -> samples of the present block.
        parts = {}
        n_samples = 0
        for raw in self.source.stretches(list(decoders)):
            for number, decoder in enumerate(decoders.values()):
                samples = decoder.decode(*raw.of(number))
                if samples is not None:
                    parts.setdefault(type(samples), []).append(samples)
                    n_samples += len(samples)
            if n_samples >= block_samples:
                yield _block(parts, decoders.values())
                parts = {}
                n_samples = 0
        # A short recording ends before the decoders report joints or a frame that never occur.
        if self.joint_topic:
            decoders[self.joint_topic].check()
        decoders[self.imu_topic].choice.check()
        last = _block(parts, decoders.values())
        if parts or last.dropped:
            yield last

    def _decoders(self, joint_names: Iterable[str] | None, frame_id: str | None) -> dict[str, Any]:
        """
        Return topic -> Decoder of the topics that are read.

        `joint_names`: joints of the table; `frame_id`: frame of the Imu messages, None for any.
        """
        source = self.source
        decoders: dict[str, Decoder] = {}
        for topic in filter(None, (self.imu_topic, self.joint_topic, self.temperature_topic)):
            message_type = source.types[topic]
            encoding, text = source.definitions.get(message_type, ('', ''))
            deserialize = None
            if source.ros1 or not is_standard(message_type, encoding, text):
                deserialize = self.deserializer(message_type)
            if message_type == JOINT_STATE_TYPE:
                decoders[topic] = JointDecoder(joint_names, deserialize)
                continue
            choice = FrameChoice(topic, frame_id) if message_type == IMU_TYPE else None
            decoders[topic] = Decoder(message_type, deserialize, choice)
        return decoders

    def frames(self) -> list[str]:
        """
        Return the frames of the first stretch of the Imu topic, in order of name.

        [] without messages.
        """
        # Several frames are an error unless one is chosen. Here it is '': all frames are counted.
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


def _block(parts: dict[Any, list], decoders: Iterable[Decoder]) -> SampleBlock:
    """
    Return the samples of a block and the counts of the decoders since the last block.

    `parts`: class of the samples -> consecutive samples.
    """
    dropped, notes = take_counts(decoders)
    joined = {kind: kind.concatenate(samples) for kind, samples in parts.items()}
    return SampleBlock(
        joined.get(ImuSamples),
        joined.get(JointSamples),
        joined.get(TemperatureSamples),
        dropped,
        notes,
    )


def _open_source(path: Path, log: LogOptions = LogOptions()) -> 'Rosbag2 | Ros1File':
    """Return the reader of a recording, by the name of its file or folder; raises InputError."""
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
        if RosReader.needed(path) and RosReader.installed():
            return RosReader(path)
        return Rosbag2(path)
    except InputError:
        raise
    except Exception as error:  # rosbags, sqlite3 and the system raise many kinds
        raise InputError(
            f'{path} must be a readable bag (rosbag2 folder, {", ".join(suffixes())} or .bag file)'
            f' or a text log ({", ".join(SUFFIXES)}), got: {shortened(str(error), 300)}; check the'
            ' path, record again, or write the data as CSV and use the verb convert'
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


def _listed(source: 'Rosbag2 | Ros1File') -> tuple[Topic, ...]:
    """Return the topics of a recording in order of name."""
    return tuple(
        Topic(name, source.types[name], source.counts[name]) for name in sorted(source.types)
    )


def _choose(
    path: Path,
    topics: Sequence[Topic],
    message_type: str,
    requested: str | None,
    *,
    required: bool = False,
    lenient: bool = False,
) -> Any:
    """
    Return the name of the topic of a type: `requested`, the default name, or the only one.

    None without a topic of the type unless `required`, and with several if `lenient`; otherwise
    InputError.
    """
    key = TOPIC_KEYS[message_type]
    fitting = [topic.name for topic in topics if topic.type == message_type]
    if requested is not None:
        for name in (requested, '/' + requested.lstrip('/')):
            if name in fitting:
                return name
        raise InputError(
            f'the topic that is read must be a {message_type} topic of {path}, got {requested}'
            f'{did_you_mean(requested, fitting)}; {_listing(topics, fitting)}',
            key=key,
            code='topic_unknown',
        )
    if DEFAULT_TOPICS[message_type] in fitting:
        return DEFAULT_TOPICS[message_type]
    if len(fitting) == 1:
        return fitting[0]
    if fitting and not lenient:
        raise InputError(
            f'{path} must have one {message_type} topic or one named'
            f' {DEFAULT_TOPICS[message_type]}, got {_first_names(fitting)}; choose one',
            key=key,
            code='topic_ambiguous',
        )
    if required:
        remedy = 'record it'
        if message_type == JOINT_STATE_TYPE:
            remedy += ', or calibrate by hand, without a table'
        raise InputError(
            f'{path} must have a {message_type} topic, got none: {_listing(topics, fitting)};'
            f' {remedy}',
            code='no_topic_of_type',
        )
    return None


def _listing(topics: Sequence[Topic], fitting: Sequence[str]) -> str:
    """Return the end of an error: the `fitting` names, or all topics where none fits."""
    if fitting:
        return f'choose one of {_first_names(fitting)}'
    listed = _first_names([f'{topic.name} ({topic.type})' for topic in topics])
    return f'it holds {listed or "no topics"}'


def _first_names(names: Sequence[str]) -> str:
    """Return the first names as a text, and the number of the further ones."""
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
        """Unreadable data, reason -> count."""
        self._drop_repeated_entries()
        self.counts = {}
        """Topic -> messages."""
        self.types = {}
        """Topic -> message type."""
        self.definitions = {}
        """Message type -> (language, text)."""
        self.topics = {}
        """Id of a connection -> topic."""
        for connection in self.reader.connections:
            topic = clean_name(connection.topic)
            message_type = clean_name(connection.msgtype)
            self.topics[connection.id] = topic
            self.types[topic] = message_type
            self.counts[topic] = self.counts.get(topic, 0) + connection.msgcount
            self.definitions[message_type] = ('ros2msg', connection.msgdef.data)

    def _drop_repeated_entries(self) -> None:
        """Keep one index entry for each place of a message, so that none is read twice."""
        indexes = {}
        n_repeated = 0
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
        if not self.reader.message_count:
            return 0
        # The end time of rosbags is one nanosecond after the last message.
        return max(self.reader.end_time - self.reader.start_time - 1, 0)

    def stretches(self, topics: Sequence[str]) -> Iterator[RawMessages]:
        """
        Yield RawMessages of the topics in file order.

        Lost messages of the file are counted in `lost`.
        """
        return grouped(self._messages(topics))

    def _messages(self, topics: Sequence[str]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (index of the topic, receive time, message); count the loss by damage in `lost`."""
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
            n_lost = max(expected - n_read, 1)
            self.lost[f'messages{extent} after damage ({error})'] = n_lost

    def close(self) -> None:
        """Close the file."""
        with suppress(Exception):
            self.reader.close()


def _bounded(chunk: Any) -> Any:
    """Return a chunk of rosbags' reader that decompresses within limits."""
    from lz4 import frame

    compression = {bz2.decompress: 'bz2', frame.decompress: 'lz4'}.get(chunk.decompressor)
    if compression is None:
        return chunk
    return chunk._replace(decompressor=lambda data: decompress(compression, data, LARGEST_CHUNK))
