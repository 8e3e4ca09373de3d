"""Recordings as sources of samples: opened with the topics that were chosen, read ahead, and named in documents."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from functools import partial
from hashlib import sha256
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from imu_calibration.core.errors import InputError
from imu_calibration.core.progress import counter
from imu_calibration.core.samples import SampleBlock, TemperatureSamples
from imu_calibration.document import files
from msg_adapters.bag import Recording, open_recording
from msg_adapters.storage import read_ahead

Source = Callable[[], Iterator[SampleBlock]]
"""Yields the blocks of a recording; can be called repeatedly."""


class Topics(NamedTuple):
    """Names of the topics to read; None: the default name, otherwise the only topic of the type."""

    imu: str | None = None
    """sensor_msgs/Imu, default /imu/data_raw."""
    joints: str | None = None
    """sensor_msgs/JointState, default /joint_states."""
    temperature: str | None = None
    """sensor_msgs/Temperature, default /imu/temperature."""
    frame: str | None = None
    """frame_id of the Imu messages; None: that of all."""

    def chosen(self) -> dict[str, Any]:
        """Return them as arguments of `msg_adapters.bag.open_recording`."""
        return {'imu_topic': self.imu, 'joint_topic': self.joints, 'temperature_topic': self.temperature, 'frame_id': self.frame}


def existing(path: str | PathLike) -> Path:
    """Return the path of a bag that is there."""
    if not Path(path).exists():
        raise InputError(f'the bag {path} must exist, no such file; correct the path')
    return Path(path)


def open_bag(path: str | PathLike, topics: Topics, *, want_joints: bool | str = True, want_temperature: bool | str = True) -> Recording:
    """Open a recording with the topics that were chosen; the rest as for `msg_adapters.bag.open_recording`."""
    return open_recording(existing(path), **topics.chosen(), want_joints=want_joints, want_temperature=want_temperature)


def read_blocks(path: str, topics: Topics, joint_names: Iterable[str] | None, *, want_joints: bool | str, want_temperature: bool | str,
                quiet: bool) -> Iterator[SampleBlock]:
    """Yield the blocks of a recording and report the progress unless `quiet`; a plain function, so that another process can run it."""
    recording = open_recording(path, **topics.chosen(), want_joints=want_joints, want_temperature=want_temperature)
    advance = counter(f'reading {Path(path).name}', 0 if quiet else recording.message_counts.get(recording.imu_topic, 0))
    with recording:
        with closing(read_ahead(recording.blocks(joint_names) if want_joints else recording.blocks())) as blocks:
            for block in blocks:
                if block.imu is not None:
                    advance(len(block.imu))
                yield block
        if recording.lost:
            yield SampleBlock(dropped=recording.lost)


def source_of(recording: str | PathLike | SampleBlock, topics: Topics = Topics(), joint_names: Iterable[str] | None = None, *,
              want_joints: bool | str | None = None, want_temperature: bool | str = True, quiet: bool = False) -> Source:
    """
    Return a callable, for repeated use, that yields the blocks of a recording; samples in memory are a recording of one block.

    `want_joints` and `want_temperature` as for `msg_adapters.bag.open_recording`; joints are read if `joint_names` is given.
    """
    want_joints = joint_names is not None if want_joints is None else want_joints
    if isinstance(recording, SampleBlock):
        return partial(iter, (recording if want_joints else SampleBlock(recording.imu, None, recording.temperature),))
    return partial(read_blocks, str(existing(recording)), topics, joint_names, want_joints=want_joints, want_temperature=want_temperature,
                   quiet=quiet)


def provenance_of(recordings: Iterable[str | PathLike | SampleBlock], options: dict) -> dict:
    """Return names and hashes of recordings and the options for a document: the same in every run."""
    return {'bags': [{'name': name_of(recording), 'sha256': _hash_of(recording)} for recording in recordings], 'options': options}


def name_of(recording: str | PathLike | SampleBlock) -> str:
    """Return the name of a recording in documents."""
    return 'samples in memory' if isinstance(recording, SampleBlock) else Path(recording).name


def _hash_of(recording):
    if not isinstance(recording, SampleBlock):
        return files.hash_of(recording)
    imu = recording.imu
    return sha256(imu.stamp_ns.tobytes() + imu.force_s.tobytes() + imu.rate_s.tobytes()).hexdigest()


def temperatures(path: str | PathLike, topics: Topics) -> TemperatureSamples | None:
    """Return all temperatures of a recording, or None."""
    parts = []
    with open_bag(path, topics, want_joints=False) as recording:
        if recording.temperature_topic:
            parts = [block.temperature for block in recording.blocks() if block.temperature is not None and len(block.temperature)]
    return TemperatureSamples.concatenate(parts) if parts else None
