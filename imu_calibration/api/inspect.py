"""
Inspect: content of the topics of a recording, their faults, and the parameters that they determine.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

from imu_calibration.api.choices import calibration_options, topics_of
from imu_calibration.api.recordings import (
    Stand,
    Topics,
    open_bag,
    source_of,
    sources_without,
)
from imu_calibration.api.references import reference_of
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.reference import MotionReference
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.exit_codes import dropped_text, exit_code_of
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.outcome import shortcomings
from imu_calibration.preprocessing.checks import unusable, warnings
from imu_calibration.preprocessing.recording_evidence import NOTE, REFUSE, CheckFinding
from imu_calibration.preprocessing.stream_cleaning import StreamStatistics
from imu_calibration.references.gravity.gravity_reference import GravityReference
from msg_adapters.bag import Recording, list_topics
from msg_adapters.csv_log import autopilot_of
from msg_adapters.imu import IMU_TYPE

MOST_IMUS = 64
"""Imu topics and frames of a recording that are inspected at most; each needs a few scans."""


@dataclass(frozen=True, eq=False)
class RecordingSummary:
    """Properties of one Imu topic of a recording, with the joints and temperatures used with it."""

    recording: Recording | None
    """The recording, closed again; None for samples in memory."""
    streams: dict[str, StreamStatistics]
    """'imu', 'joints' or 'temperature' -> statistics of its stamps."""
    findings: tuple[CheckFinding, ...]
    """Detected faults."""
    lost: dict[str, int]
    """Reason -> messages that could not be read."""
    calibrated: CalibrationResult | ImuCalibrationError | None
    """Result of a calibration, or the error; None by hand where it would be wrong."""
    reference: MotionReference = GravityReference()
    """The reference of that calibration."""

    @property
    def refused(self) -> bool:
        """Whether a finding implies that a calibration would be wrong."""
        return any(finding.severity == REFUSE for finding in self.findings)

    @property
    def exit_code(self) -> int:
        """
        1 where a calibration would be wrong, 3 where it is incomplete or may suffer, otherwise 0.

        Where a complete calibration results from the recording the code is 0, as that of
        `calibrate`, whatever the warnings; on a table it is always that of `calibrate`.
        """
        is_error = isinstance(self.calibrated, ImuCalibrationError)
        if self.refused or (is_error and self.reference.is_calibration_wanted):
            return 1
        return exit_code_of(self.reasons)

    @property
    def result(self) -> CalibrationResult | None:
        """Result of the calibration; None without one."""
        return None if isinstance(self.calibrated, ImuCalibrationError) else self.calibrated

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is not 0, a line each."""
        lines = [finding.text for finding in warnings(self.findings)]
        received = self.streams['imu'].count if 'imu' in self.streams else 0
        dropped = dict(self.lost)
        count = unusable(self.findings)
        if count:
            dropped['unusable'] = count
        lost = dropped_text(dropped, received)
        if lost:
            lines.append(lost)
        if self.result is None:
            return lines
        return self.reference.reasons(shortcomings(self.result.calibration), lines)


def imu_topics_of(bag: str | PathLike, topics: Topics) -> list[Topics]:
    """
    Return the topics of each IMU to inspect: with the requested Imu topic, or with each one.

    A topic with messages of several frame_ids is returned once for each of them.

    Raises
    ------
    InputError
        When there are more than `MOST_IMUS`.

    """
    if topics.imu is not None or topics.gyroscope is not None:
        names = [topics.imu]
    else:
        listed = list_topics(bag, topics.log)
        names = [topic.name for topic in listed if topic.type == IMU_TYPE]
    _limit_imus(bag, len(names))
    imus = []
    for name in names:
        of_topic = topics._replace(imu=name)
        imus += [of_topic] if topics.frame is not None else _by_frame(bag, of_topic)
        _limit_imus(bag, len(imus))
    return imus or [topics]


def _limit_imus(bag: str | PathLike, n_imus: int) -> None:
    """Refuse a recording of too many IMUs, before each of them is read."""
    if n_imus > MOST_IMUS:
        raise InputError(
            f'a recording must have at most {MOST_IMUS} Imu topics and frames to be inspected'
            f' together, {bag} has {n_imus} or more; choose one',
            key='imu_topic',
            code='imu_topics_many',
        )


def _by_frame(bag: str | PathLike, topics: Topics) -> list[Topics]:
    """Return the topics with each frame_id of the Imu messages, unchanged if they have one."""
    with open_bag(bag, topics, want_joints=False, want_temperature=False) as recording:
        frames = recording.frames()
    if len(frames) <= 1:
        return [topics]
    return [topics._replace(frame=frame) for frame in frames]


def inspect_imus(
    recording: str | PathLike | SampleBlock, stand: Stand | None, choices: Mapping[str, Any]
) -> list[RecordingSummary]:
    """
    Inspect the chosen Imu topic of a recording, or each one; see `inspect_recording`.

    Parameters
    ----------
    recording : path-like or SampleBlock
    stand : path-like, Table or Arm, optional
        The reference, see `reference_of`.
    choices : mapping
        See `Choices`.

    """
    options = calibration_options(choices)
    topics = [topics_of(choices)]
    if not isinstance(recording, SampleBlock):
        topics = imu_topics_of(recording, *topics)
    reference = reference_of(stand, [recording], topics[0], options=options)
    exclude = choices.get('exclude')
    return inspect_recording(recording, topics, reference, options=options, exclude=exclude)


def inspect_recording(
    bag: str | PathLike | SampleBlock,
    topics: Iterable[Topics],
    reference: MotionReference,
    *,
    options: CalibrationOptions,
    exclude: str | None = None,
) -> list[RecordingSummary]:
    """
    Inspect each Imu topic of a recording, with the joints and temperatures used with it.

    `exclude`: times that are not used, as in `Choices`.
    """
    summaries = []
    for of_imu in topics:
        summaries.append(_summary(bag, of_imu, reference, options=options, exclude=exclude))

    # A note on both topics of an IMU with one topic for each sensor.
    notes = {}  # topic -> note
    for pair in split_topics(summaries):
        note = CheckFinding(
            'split',
            NOTE,
            f'{pair.imu} has the accelerometer only and {pair.gyroscope} the gyroscope only: read'
            ' both together as one IMU',
        )
        notes[pair.imu] = note
        notes[pair.gyroscope] = note
    with_notes = []
    for summary in summaries:
        topic = None if summary.recording is None else summary.recording.imu_topic
        if topic in notes:
            summary = replace(summary, findings=(*summary.findings, notes[topic]))
        with_notes.append(summary)
    return with_notes


def split_topics(summaries: Sequence[RecordingSummary]) -> list[Topics]:
    """
    Return the pairs of Imu topics with one sensor each, as `Topics`.

    Several pairs are separated by their names: each topic of a pair has more words in common with
    its mate than with the other topics of that sensor.
    """
    # Sensor -> topics in which only this sensor has readings that change.
    topics_of: dict[str, list[str]] = {'accelerometer': [], 'gyroscope': []}
    for summary in summaries:
        lacking = set()
        for finding in summary.findings:
            if finding.check == 'frozen' and finding.sensor:
                lacking.add(finding.sensor)
        if 'imu' in summary.streams:
            lacking.update(summary.streams['imu'].absent)
        present = [sensor for sensor in topics_of if sensor not in lacking]
        if len(present) == 1 and summary.recording is not None:
            topics_of[present[0]].append(summary.recording.imu_topic)
    pairs = []
    for accelerometer in sorted(set(topics_of['accelerometer'])):
        gyroscope = _closest_name(accelerometer, topics_of['gyroscope'])
        if gyroscope is None:
            continue
        if _closest_name(gyroscope, topics_of['accelerometer']) == accelerometer:
            pairs.append(Topics(imu=accelerometer, gyroscope=gyroscope))
    return pairs


def _closest_name(name: str, candidates: Sequence[str]) -> str | None:
    """Return the topic that has most words in common with a name; None if several have."""
    words = Counter(re.findall('[a-z]+|[0-9]+', name.lower()))
    n_common = {}
    for candidate in candidates:
        candidate_words = Counter(re.findall('[a-z]+|[0-9]+', candidate.lower()))
        n_common[candidate] = (words & candidate_words).total()
    most = max(n_common.values(), default=0)
    closest = [candidate for candidate, count in n_common.items() if count == most]
    return closest[0] if len(closest) == 1 else None


def _summary(
    bag: str | PathLike | SampleBlock,
    topics: Topics,
    reference: MotionReference,
    *,
    options: CalibrationOptions,
    exclude: str | None,
) -> RecordingSummary:
    """Inspect one IMU of a recording."""
    recording = None
    if not isinstance(bag, SampleBlock):
        recording = open_bag(bag, topics, want_joints='optional', want_temperature='optional')
        recording.close()
    source = source_of(bag, topics, reference.joint_names)
    # The checks of the streams read what there is; the calibration refuses missing joints.
    available = source_of(bag, topics, want_joints='optional', want_temperature='optional')
    (source,) = sources_without([source], [bag], exclude)
    (available,) = sources_without([available], [bag], exclude)
    inspection = reference.inspect(source, available, options)
    return RecordingSummary(
        recording=recording,
        streams=inspection.preflight.streams,
        findings=(*inspection.findings, *_axes_question(bag, options)),
        lost=inspection.preflight.lost,
        calibrated=inspection.calibrated,
        reference=reference,
    )


def _axes_question(
    bag: str | PathLike | SampleBlock, options: CalibrationOptions
) -> list[CheckFinding]:
    """Return a note where the log of an autopilot is read without a statement of its axes."""
    if options.nominal is not None and options.nominal.axes:
        return []
    if isinstance(bag, SampleBlock):  # arrays have no header
        return []
    autopilot = autopilot_of(bag)
    if not autopilot:
        return []
    return [
        CheckFinding(
            'axes',
            NOTE,
            f'the columns are those of {autopilot}, whose readings are forward-right-down: state'
            ' the axes, so that exports have the right signs',
            key='axes',
            value='frd',
        )
    ]
