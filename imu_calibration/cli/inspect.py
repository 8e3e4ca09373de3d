"""
``imu_calibration inspect``.

Topics of a recording, suspicious properties, and the parameters that it determines.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult
from imu_calibration.core.errors import ImuCalibrationError, with_hint

if TYPE_CHECKING:
    from imu_calibration.api.inspect import RecordingSummary
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.document.calibration import Calibration

EXAMPLES = ('session', 'session --table table.yaml')
TOPICS = (('imu_topic', 'imu'), ('joint_topic', 'joints'), ('temperature_topic', 'temperature'))
"""(field of a recording with the name of a topic, key of its statistics) of each stream."""


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help=BAG)
    parser.add_recording(
        'with it, axes and units are compared with the joints and the motions are listed'
    )
    parser.add_gravity()
    parser.add_gyroscope_topic()
    parser.add_exclusion()
    parser.add_rows()
    parser.add_model(searched=False)


def run(options: Options) -> VerbResult:
    """
    Read each Imu topic and print its properties.

    With a table also the motions and the parameters that they determine.
    """
    from imu_calibration.api.inspect import inspect_imus, split_topics
    from imu_calibration.api.recordings import existing
    from imu_calibration.cli.show import show_findings
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.preprocessing.checks import refuse

    # All topics, then findings and calibration of each IMU.
    hints = options.hints()
    summaries = inspect_imus(existing(options.bag), options.stand(), options.choices())
    out = Terminal.of()
    _show_topics(out, summaries)
    _show_unread(out, summaries[0].recording, hints)
    codes = []
    reasons = []
    for summary in summaries:
        out.print()
        if len(summaries) > 1 and summary.recording is not None:
            frame = summary.recording.frame_id
            suffix = '' if frame is None else f' ({frame})'
            out.print(summary.recording.imu_topic + suffix, style='bold')
        show_findings(out, summary.findings, hints)
        for reason, count in summary.lost.items():
            out.print(f'lost: {count} {reason}')
        missing = _show_calibration(out, summary, hints)
        codes.append(summary.exit_code or (3 if missing else 0))
        reasons += [*summary.reasons, *missing]

    # Topics that belong together, and the exit code.
    for pair in split_topics(summaries):
        out.print()
        out.print(
            'one sensor per topic; to read both: --imu-topic'
            f' {pair.imu} --gyroscope-topic {pair.gyroscope}'
        )
    if set(codes) == {1}:  # no topic is usable: also one line on standard error, as every refusal
        refuse(summaries[0].findings)
        if isinstance(summaries[0].calibrated, ImuCalibrationError):
            raise summaries[0].calibrated
    # A recording with a path was inspected, not samples in memory.
    assert summaries[0].recording is not None
    return VerbResult(
        3 if any(codes) else 0,
        {
            'topics': [asdict(topic) for topic in summaries[0].recording.topics],
            'imu': [_document(summary) for summary in summaries],
        },
        reasons if any(codes) else (),
    )


def _document(summary: 'RecordingSummary') -> dict[str, Any]:
    """Return the findings, streams and parameter statuses of one Imu topic as data."""
    assert summary.recording is not None
    streams = {}
    for name, statistics in summary.streams.items():
        streams[name] = {
            'count': statistics.count,
            'rate': statistics.rate,
            'duration': statistics.duration,
            'gaps': statistics.n_gaps,
            'dropped': statistics.dropped,
        }
    document: dict[str, Any] = {
        'topic': summary.recording.imu_topic,
        'frame_id': summary.recording.frame_id,
        'findings': [finding.to_mapping() for finding in summary.findings],
        'lost': summary.lost,
        'streams': streams,
    }
    if isinstance(summary.calibrated, ImuCalibrationError):
        return document | {'not_usable': str(summary.calibrated)}
    if summary.calibrated is None:
        return document
    calibration = summary.calibrated.calibration
    status = {}
    for name, state in calibration.status_by_name.items():
        if name in calibration.param_names:  # not the common scale
            status[name] = state
    return document | {'status': status, 'needs': list(calibration.undetermined)}


def _show_topics(out: 'Terminal', summaries: Sequence['RecordingSummary']) -> None:
    """Print the topics; for the topics that are read also rate, gaps and step of the stamps."""
    from imu_calibration.cli.show import show_table

    assert summaries[0].recording is not None
    statistics_of = {}  # name of a topic that is read -> statistics of its stamps
    for summary in summaries:
        for attribute, stream in TOPICS:
            topic_name = getattr(summary.recording, attribute)
            if topic_name:
                statistics_of[topic_name] = summary.streams.get(stream)
    numbers = ('messages', 'Hz', 'seconds', 'gaps', 'stamp step')
    rows = []
    topics = summaries[0].recording.topics
    for topic in sorted(topics, key=lambda topic: topic.name not in statistics_of):
        statistics = statistics_of.get(topic.name)
        if statistics is None or not statistics.count:
            rows.append((topic.name, topic.type, str(topic.count), *[''] * 5))
            continue
        gaps = 'none'
        if statistics.n_gaps:
            gaps = f'{statistics.n_gaps} ({statistics.gap_total:.2f} s)'
        rows.append(
            (
                topic.name,
                topic.type,
                str(topic.count),
                f'{statistics.rate:.2f}',
                f'{statistics.duration:.1f}',
                gaps,
                _step(statistics.stamp_step_ns),
                'read',
            )
        )
    show_table(out, ('topic', 'type', *numbers, ''), rows, numbers=numbers, dimmed=True)


def _show_unread(out: 'Terminal', recording: Any, hints: dict[str, str]) -> None:
    """Print the topics that are not read because several fit."""
    from msg_adapters.bag import TOPIC_KEYS

    for message_type, key in TOPIC_KEYS.items():
        names = [topic.name for topic in recording.topics if topic.type == message_type]
        if names and getattr(recording, key) is None:
            text = f'not read: {", ".join(names)}, no telling which belongs to the IMU; choose one'
            out.print(with_hint(text, key, hints))


def _step(step_ns: int | None) -> str:
    """Return the finest difference between stamps in the largest unit that needs no fraction."""
    for size, unit in ((10**6, 'ms'), (10**3, 'us')):
        if step_ns and step_ns % size == 0:
            return f'{step_ns // size} {unit}'
    return f'{step_ns} ns' if step_ns else ''


def _show_calibration(
    out: 'Terminal', summary: 'RecordingSummary', hints: dict[str, str]
) -> list[str]:
    """
    Print data and parameters of the calibration; return why it cannot be used, a line each.

    Nothing of a refused recording: its reasons are those of the summary.
    """
    result = summary.calibrated
    if result is None or summary.refused:
        return []
    if isinstance(result, ImuCalibrationError):
        why = f'{summary.reference.not_usable}: {result.with_hint(hints)}'
        out.print(why)
        return summary.reference.reasons(lacking=[why], doubts=[])
    for line in summary.reference.used_lines(result.calibration):
        out.print(line)
    _show_parameters(out, result.calibration, hints)
    return []


def _show_parameters(out: 'Terminal', calibration: 'Calibration', hints: dict[str, str]) -> None:
    """Print the parameters by status, and the motions or options that would determine more."""
    from imu_calibration.estimation.solution import (
        COMMON_SCALE,
        GRAVITY,
        REMEDIES,
        REMEDY_KEYS,
        WEAK,
    )

    names_of: dict[str, list[str]] = {}  # status -> parameters
    for name, status in calibration.status_by_name.items():
        names_of.setdefault(status, []).append(name)
    for status, names in names_of.items():
        out.print(f'{status}: {", ".join(names)}')
    needs: dict[str, dict[str, float]] = {}  # motion or remedy -> weights of parameters
    for direction in calibration.undetermined:
        needs.setdefault(direction['needs'], {}).update(direction['parameters'])
    if COMMON_SCALE in names_of.get(WEAK, []):
        needs[REMEDIES[GRAVITY,]] = {COMMON_SCALE: 1.0}
    for need, weights in needs.items():
        out.print(f'needs: {with_hint(need, REMEDY_KEYS.get(need), hints)}  ({", ".join(weights)})')
