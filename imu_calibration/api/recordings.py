"""Recordings by path, and the table or arm that carried the IMU."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from imu_calibration.core.errors import InputError
from imu_calibration.core.processes import Returned
from imu_calibration.core.progress import counter, remark
from imu_calibration.core.samples import (
    BlockSource,
    ImuSamples,
    SampleBlock,
    TemperatureSamples,
    joined_stream,
)
from imu_calibration.document import files
from imu_calibration.kinematics.table import Table
from imu_calibration.kinematics.urdf import root_of, table_from_urdf, up_of
from imu_calibration.preprocessing.exclusion import (
    WithoutExcluded,
    exclusions_by_recording,
    parse_exclusions,
)
from imu_calibration.preprocessing.sensor_join import (
    JoinedSensors,
    OtherSensor,
    finite_stream,
    join_sensors,
)
from msg_adapters.bag import Recording, description_in, frame_of, open_recording, static_transforms
from msg_adapters.csv_log import LogOptions
from msg_adapters.storage import read_ahead


class Topics(NamedTuple):
    """Names of the topics to read; None: the default name, otherwise the only topic of the type."""

    imu: str | None = None
    """sensor_msgs/Imu, default /imu/data_raw."""
    joints: str | None = None
    """sensor_msgs/JointState, default /joint_states."""
    temperature: str | None = None
    """sensor_msgs/Temperature, default /imu/temperature."""
    frame: str | None = None
    """frame_id of the Imu messages to read; None: all messages have the same."""
    gyroscope: str | None = None
    """sensor_msgs/Imu topic of the rates, where they have one of their own; None: as `imu`."""
    log: LogOptions = LogOptions()
    """Columns, rows and units of a text log."""

    def chosen(self) -> dict[str, Any]:
        """Return the names as arguments of `msg_adapters.bag.open_recording`."""
        return {
            'imu_topic': self.imu,
            'joint_topic': self.joints,
            'temperature_topic': self.temperature,
            'frame_id': self.frame,
            'log': self.log,
        }


def existing(path: str | PathLike) -> Path:
    """Return the path of a bag that is there."""
    if not Path(path).exists():
        raise InputError(
            f'the bag {path} must exist, no such file; correct the path', code='bag_missing'
        )
    return Path(path)


def open_bag(
    path: str | PathLike,
    topics: Topics,
    *,
    want_joints: bool | str = True,
    want_temperature: bool | str = True,
) -> Recording:
    """
    Open a recording with the topics that were chosen.

    `want_joints` and `want_temperature` as for `msg_adapters.bag.open_recording`.
    """
    return open_recording(
        existing(path),
        **topics.chosen(),
        want_joints=want_joints,
        want_temperature=want_temperature,
    )


@dataclass(frozen=True, eq=False)
class RecordingFile:
    """A recording in a file or folder, which any process reads from its start."""

    path: str
    """Path of the recording."""
    topics: Topics
    """Topics of the recording."""
    joint_names: Iterable[str] | None
    """Joints to read; None: all."""
    want_joints: bool | str
    """As for `msg_adapters.bag.open_recording`."""
    want_temperature: bool | str
    """As for `msg_adapters.bag.open_recording`."""
    quiet: bool = False
    """Whether no progress is reported."""

    def open(self) -> Recording:
        """
        Return the recording, to be closed.

        Raises
        ------
        InputError
            When it cannot be read, or a topic is missing.

        """
        return open_bag(
            self.path,
            self.topics,
            want_joints=self.want_joints,
            want_temperature=self.want_temperature,
        )

    def __iter__(self) -> Iterator[SampleBlock]:
        """
        Yield the blocks and report the progress; of sensors on two topics all samples as one block.
        """
        gyroscope = self.topics.gyroscope
        if gyroscope is not None:
            without_rates = replace(self, topics=self.topics._replace(gyroscope=None), quiet=True)
            yield _with_gyroscope(list(without_rates), self.path, gyroscope)
            return
        recording = self.open()
        n_messages = 0 if self.quiet else recording.message_counts.get(recording.imu_topic, 0)
        advance = counter(f'reading {files.name_of_path(self.path)}', n_messages)
        with recording:
            read = recording.blocks(self.joint_names) if self.want_joints else recording.blocks()
            with closing(read_ahead(read)) as blocks:
                for block in blocks:
                    if block.imu is not None:
                        advance(len(block.imu))
                    yield block
            if recording.lost:
                yield SampleBlock(dropped=recording.lost)


def _with_gyroscope(blocks: Sequence[SampleBlock], path: str, topic: str) -> SampleBlock:
    """Return the blocks of a recording as one, with the rates of another Imu topic."""
    dropped: Counter[str] = Counter()
    notes: Counter[str] = Counter()
    for block in blocks:
        dropped.update(block.dropped or {})
        notes.update(block.notes or {})

    # The rates of the other topic, at the stamps of the first one.
    gyroscope = _imu_messages(path, Topics(imu=topic))
    dropped.update(gyroscope.lost)
    imu = joined_stream(blocks, 'imu')
    if imu is None:
        raise _no_samples('the topic of the accelerometer')
    joined = join_sensors(
        finite_stream(imu.stamp_ns, imu.force_s),
        finite_stream(gyroscope.imu.stamp_ns, gyroscope.imu.rate_s),
        imu.frame_id,
    )
    remark(joined.text)
    return SampleBlock(
        imu=joined.imu,
        joints=joined_stream(blocks, 'joints'),
        temperature=joined_stream(blocks, 'temperature'),
        dropped=dict(dropped),
        notes=dict(notes),
    )


@dataclass(frozen=True, eq=False)
class _ImuMessages:
    """All messages of an Imu topic."""

    topic: str
    """Name of the topic."""
    imu: ImuSamples
    """Samples of the messages."""
    lost: dict[str, int]
    """Reason -> messages that could not be read."""


def _imu_messages(path: str | PathLike, topics: Topics) -> _ImuMessages:
    """Read an Imu topic to its end."""
    with open_bag(path, topics, want_joints=False, want_temperature=False) as recording:
        imu = joined_stream(recording.blocks(), 'imu')
    if imu is None:
        raise _no_samples(recording.imu_topic)
    return _ImuMessages(recording.imu_topic, imu, recording.lost)


def _no_samples(topic: str) -> InputError:
    """Return the error of an Imu topic without messages."""
    return InputError(
        f'both topics must hold Imu messages, {topic} holds none; check the topics',
        key='imu_topic',
        code='no_samples',
    )


@dataclass(frozen=True, eq=False)
class SplitRecording:
    """A recording with accelerometer and gyroscope on two Imu topics."""

    joined: JoinedSensors
    """Both sensors as one stream."""
    topic: str
    """Topic of the slower sensor, whose messages the stream follows."""
    other: OtherSensor
    """The sensor on the other topic."""


def read_split(path: str | PathLike, topics: Topics) -> SplitRecording:
    """
    Return both sensors of a recording with one Imu topic for each, and report their delay.

    Raises
    ------
    InputError
        When a topic is missing or empty, or the two hardly overlap in time.

    """
    # The delay needs all readings of both sensors.
    accelerometer = _imu_messages(path, topics._replace(gyroscope=None))
    gyroscope = _imu_messages(path, Topics(imu=topics.gyroscope))
    frame = accelerometer.imu.frame_id
    force = finite_stream(accelerometer.imu.stamp_ns, accelerometer.imu.force_s)
    rate = finite_stream(gyroscope.imu.stamp_ns, gyroscope.imu.rate_s)
    joined = join_sensors(force, rate, frame)
    remark(joined.text)
    if joined.slower == 'accelerometer':
        return SplitRecording(joined, accelerometer.topic, OtherSensor('rate', rate, frame))
    return SplitRecording(joined, gyroscope.topic, OtherSensor('force', force, frame))


def source_of(
    recording: str | PathLike | SampleBlock,
    topics: Topics = Topics(),
    joint_names: Iterable[str] | None = None,
    *,
    want_joints: bool | str | None = None,
    want_temperature: bool | str = True,
    quiet: bool = False,
) -> BlockSource:
    """
    Return a recording as blocks that can be read repeatedly; samples in memory are one block.

    `want_joints` and `want_temperature` as for `msg_adapters.bag.open_recording`; by default joints
    are read if `joint_names` is given.
    """
    if want_joints is None:
        want_joints = joint_names is not None
    if isinstance(recording, SampleBlock):
        if not want_joints:
            recording = SampleBlock(recording.imu, None, recording.temperature)
        return [recording]
    return RecordingFile(
        str(existing(recording)),
        topics,
        joint_names,
        want_joints=want_joints,
        want_temperature=want_temperature,
        quiet=quiet,
    )


def sources_without(
    sources: Sequence[BlockSource],
    recordings: Sequence[str | PathLike | SampleBlock],
    exclude: str | None,
) -> list[BlockSource]:
    """
    Return the sources without the times that the user excludes (`exclusion.parse_exclusions`).

    Raises
    ------
    InputError
        When the text has another form, or names no recording.

    """
    if not exclude:
        return list(sources)
    names = [name_of(recording) for recording in recordings]
    exclusions_of = exclusions_by_recording(parse_exclusions(exclude), names)
    reduced = []
    for source, exclusions in zip(sources, exclusions_of, strict=True):
        reduced.append(WithoutExcluded(source, exclusions) if exclusions else source)
    return reduced


def provenance_of(recordings: Iterable[str | PathLike | SampleBlock], options: dict) -> dict:
    """
    Return names and hashes of recordings and the options for a document: the same in every run.
    """
    bags = []
    for recording in recordings:
        bags.append({'name': name_of(recording), 'sha256': _hash_of(recording)})
    return {'bags': bags, 'options': options}


def name_of(recording: str | PathLike | SampleBlock) -> str:
    """Return the name of a recording in documents."""
    if isinstance(recording, SampleBlock):
        return 'samples in memory'
    return files.name_of_path(recording)


def _hash_of(recording: str | PathLike | SampleBlock) -> str:
    """Return the SHA-256 of a file or folder, or of the samples of the IMU in memory."""
    if not isinstance(recording, SampleBlock):
        return files.hash_of(existing(recording))
    imu = recording.imu
    # A recording in memory has samples of an IMU.
    assert imu is not None
    return sha256(imu.stamp_ns.tobytes() + imu.force_s.tobytes() + imu.rate_s.tobytes()).hexdigest()


def temperatures(path: str | PathLike, topics: Topics) -> TemperatureSamples | None:
    """Return all temperatures of a recording, or None."""
    with open_bag(path, topics, want_joints=False) as recording:
        if not recording.temperature_topic:
            return None
        return joined_stream(recording.blocks(), 'temperature')


def jobs_for(requested: int | None, n_items: int) -> int:
    """
    Return the number of processes for some items, at most one for each.

    It is the requested number, by default one per processor.
    """
    if requested is not None and requested < 1:
        raise InputError(
            f'at least one process must work, got {requested}; omit the number to use every'
            ' processor',
            key='jobs',
        )
    return max(1, min(requested or os.cpu_count() or 1, n_items))


def on_cluster(
    address: str,
    function: Callable[..., Returned],
    items: Sequence[tuple],
    *,
    advance: Callable[[int], object],
) -> list[Returned]:
    """
    Return the results of a function on the workers of a dask scheduler, in the order of the items.

    They must see the same paths and have this package. Arguments as for `in_processes`.

    Raises
    ------
    InputError
        When dask is not installed or the scheduler does not respond.

    """
    try:
        from dask import distributed
    except ImportError as error:
        raise InputError(
            'a scheduler needs dask.distributed, which is not installed; install'
            ' imu_calibration[dask], or omit it',
            key='scheduler',
        ) from error

    try:
        client = distributed.Client(address, timeout='10s', set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f'a dask scheduler must be reachable at {address}: {" ".join(str(error).split())}; '
            'start one with dask scheduler',
            key='scheduler',
        ) from error
    with client, client.as_current():
        futures = client.map(function, *zip(*items), pure=False)
        for _ in distributed.as_completed(futures):
            advance(1)
        return [future.result() for future in futures]


LIKELY_LINK = 'imu_link'
"""The IMU's link where no recording names its frame."""
DESCRIPTIONS = ('.urdf', '.xacro')
"""Endings of files that describe robots."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot that carries the IMU; missing entries are read from a recording."""

    urdf: str | PathLike | None = None
    """
    Robot description (.urdf or .xacro); None: that on the topic /robot_description of the
    recording.
    """
    imu_link: str | None = None
    """Link that carries the IMU; None: the frame of its messages."""
    site: str | PathLike | Mapping[str, Any] | None = None
    """
    Entries of a table description other than the joints: file or mapping; its joints may give
    limits by name.
    """
    up: Sequence[float] | None = None
    """
    Up in the frame of the root; None: from the site, otherwise from /tf_static of the recording,
    otherwise z.
    """
    allow_xacro: bool = False
    """Whether a .xacro file may be expanded, which runs its expressions as Python code."""


Stand = str | PathLike | Table | Arm
"""A table description or a robot description (file), a table, or an arm."""


def options_of(stand: Stand | None) -> dict[str, Any]:
    """Return a table or an arm as options of a document: the fields of an arm, or the table."""
    return vars(stand) if isinstance(stand, Arm) else {'table': stand}


def table_of(
    stand: Stand,
    recordings: Sequence[str | PathLike | SampleBlock] = (),
    topics: Topics = Topics(),
    *,
    gravity: float | None = None,
    gravity_sd: float = 0.0,
) -> Table:
    """
    Return the chain of joints of a table or an arm.

    Parameters
    ----------
    stand : path-like, Table or Arm
    recordings : sequence
        The first one gives the IMU's frame, the attitude of a robot's root, and its description
        where no file is named.
    topics : Topics
        Topics of the recordings.
    gravity, gravity_sd : float, optional
        Local gravity and its standard deviation, m/s^2, as for `Table.at`.

    Raises
    ------
    InputError
        When a file cannot be used, or required data are not in the recordings.

    """
    # A table, or its description.
    if isinstance(stand, Table):
        description = {field.name: getattr(stand, field.name) for field in fields(stand)}
        return Table.at(gravity, gravity_sd, description)
    if not isinstance(stand, Arm):
        if Path(stand).suffix not in DESCRIPTIONS:
            return files.read_table(stand, gravity=gravity, gravity_sd=gravity_sd)
        stand = Arm(stand)  # a robot description without further data

    # A robot: data that the user does not give are those of the first recording in a file.
    if isinstance(stand.site, Mapping | None):
        site = dict(stand.site or {})
    else:
        site = files.read_mapping(stand.site, 'table description')
    bag = None  # path and Imu topic
    for recording in recordings:
        if not isinstance(recording, SampleBlock):
            bag = (str(existing(recording)), topics.imu)
            break
    text = _description(stand, bag)
    if stand.up is not None:
        site['up'] = list(stand.up)
    elif bag is not None and site.get('up') is None:
        site['up'] = list(up_of(root_of(text), static_transforms(*bag)))
    imu_link = stand.imu_link or topics.frame or _frame(recordings, bag)
    return table_from_urdf(text, imu_link, site, gravity=gravity, gravity_sd=gravity_sd)


def refuse_stand(stand: Stand | None, recording: str) -> None:
    """
    Refuse a table or an arm where there is no recording.

    `recording`: the one that it needs, and why there is none, for the message.
    """
    if stand is not None:
        raise InputError(f'a table or arm needs {recording}')


def _description(arm: Arm, bag: tuple[str, str | None] | None) -> str:
    """
    Return the text of the robot description: of the file, otherwise of the recording's topic.

    `bag`: (path, Imu topic) of the recording.
    """
    if arm.urdf is not None:
        return files.read_robot_description(arm.urdf, arm.allow_xacro)
    if bag is None:
        raise InputError(
            'the description of the robot whose link was named must be given, got none; give the'
            ' file',
            key='urdf',
        )
    return description_in(*bag)


def _frame(
    recordings: Sequence[str | PathLike | SampleBlock], bag: tuple[str, str | None] | None
) -> str:
    """
    Return the frame of the IMU: that of a bag (path, Imu topic), or of samples in memory.

    Without either it is `LIKELY_LINK`.
    """
    if bag is not None:
        return frame_of(*bag)
    for recording in recordings:
        if isinstance(recording, SampleBlock) and recording.imu is not None:
            return recording.imu.frame_id
    return LIKELY_LINK
