"""
``imu_calibration inspect``.

Topics of a recording, suspicious properties, and the parameters that it determines.
"""

from dataclasses import asdict

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult
from imu_calibration.core.errors import ImuCalibrationError, with_hint

EXAMPLES = ('session', 'session --table table.yaml')
TOPICS = (('imu_topic', 'imu'), ('joint_topic', 'joints'), ('temperature_topic', 'temperature'))


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
    from imu_calibration.cli.show import show_findings
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.preprocessing.checks import refuse
    from imu_calibration.use_cases.inspect import inspect_imus, split_topics
    from imu_calibration.use_cases.recordings import existing

    hints = options.hints()
    looks = inspect_imus(existing(options.bag), options.stand(), options.choices())
    out = Terminal.of()
    _show_topics(out, looks)
    _show_unread(out, looks[0].recording, hints)
    codes, reasons = [], []
    for look in looks:
        out.print()
        if len(looks) > 1 and look.recording is not None:
            frame = look.recording.frame_id
            out.print(
                look.recording.imu_topic + ('' if frame is None else f' ({frame})'), style='bold'
            )
        show_findings(out, look.findings, hints)
        for reason, count in look.lost.items():
            out.print(f'lost: {count} {reason}')
        missing = _judge(out, look, hints)
        codes.append(look.exit_code or (3 if missing else 0))
        reasons += [*look.reasons, *missing]
    for pair in split_topics(looks):
        out.print()
        out.print(
            'one sensor per topic; to read both: --imu-topic'
            f' {pair.imu} --gyroscope-topic {pair.gyroscope}'
        )
    if set(codes) == {1}:  # no topic is usable: also one line on standard error, as every refusal
        refuse(looks[0].findings)
        if isinstance(looks[0].calibrated, ImuCalibrationError):
            raise looks[0].calibrated
    # A recording with a path was inspected, not samples in memory.
    assert looks[0].recording is not None
    return VerbResult(
        3 if any(codes) else 0,
        {
            'topics': [asdict(topic) for topic in looks[0].recording.topics],
            'imu': [_document(look) for look in looks],
        },
        reasons if any(codes) else (),
    )


def _document(look):
    """Return the findings, streams and parameter statuses of one Imu topic as data."""
    found = look.calibrated
    document = {
        'topic': look.recording.imu_topic,
        'frame_id': look.recording.frame_id,
        'findings': [finding.to_mapping() for finding in look.findings],
        'lost': look.lost,
        'streams': {
            name: {
                'count': s.count,
                'rate': s.rate,
                'duration': s.duration,
                'gaps': s.n_gaps,
                'dropped': s.dropped,
            }
            for name, s in look.streams.items()
        },
    }
    if isinstance(found, ImuCalibrationError):
        return document | {'not_usable': str(found)}
    if found is None:
        return document
    return document | {
        'status': {
            name: status
            for name, status in found.calibration.status_by_name.items()
            if name in found.calibration.param_names
        },
        'needs': list(found.calibration.undetermined),
    }


def _show_topics(out, looks):
    """Print the topics; for the topics that are read also rate, gaps and step of the stamps."""
    from imu_calibration.cli.show import show_table

    used = {}
    for look in looks:
        for attribute, name in TOPICS:
            if getattr(look.recording, attribute):
                used[getattr(look.recording, attribute)] = look.streams.get(name)
    numbers = ('messages', 'Hz', 'seconds', 'gaps', 'stamp step')
    rows = []
    for topic in sorted(looks[0].recording.topics, key=lambda topic: topic.name not in used):
        found = used.get(topic.name)
        if found is None or not found.count:
            rows.append((topic.name, topic.type, str(topic.count), *[''] * 5))
        else:
            gaps = f'{found.n_gaps} ({found.gap_total:.2f} s)' if found.n_gaps else 'none'
            rows.append(
                (
                    topic.name,
                    topic.type,
                    str(topic.count),
                    f'{found.rate:.2f}',
                    f'{found.duration:.1f}',
                    gaps,
                    _step(found.stamp_step_ns),
                    'read',
                )
            )
    show_table(out, ('topic', 'type', *numbers, ''), rows, numbers=numbers, dimmed=True)


def _show_unread(out, recording, hints):
    """Print the topics that are not read because several fit."""
    from msg_adapters.bag import TOPIC_KEYS

    for message_type, key in TOPIC_KEYS.items():
        names = [topic.name for topic in recording.topics if topic.type == message_type]
        if names and getattr(recording, key) is None:
            text = f'not read: {", ".join(names)}, no telling which belongs to the IMU; choose one'
            out.print(with_hint(text, key, hints))


def _step(step_ns):
    """Return the finest difference between stamps in the largest unit that needs no fraction."""
    for size, unit in ((10**6, 'ms'), (10**3, 'us')):
        if step_ns and step_ns % size == 0:
            return f'{step_ns // size} {unit}'
    return f'{step_ns} ns' if step_ns else ''


def _judge(out, look, hints):
    """Print data and parameters of the calibration; return why it is missing, a line each."""
    result = look.calibrated
    if result is None or look.refused:
        return []
    if isinstance(result, ImuCalibrationError):
        why = f'{look.reference.not_usable}: {result.with_hint(hints)}'
        out.print(why)
        return look.reference.reasons([why], [])
    for line in look.reference.used_lines(result.calibration):
        out.print(line)
    _show_parameters(out, result.calibration, hints)
    return []


def _show_parameters(out, calibration, hints):
    """Print the parameters by status, and the motions or options that would determine more."""
    from imu_calibration.estimation.solution import (
        COMMON_SCALE,
        GRAVITY,
        REMEDIES,
        REMEDY_KEYS,
        WEAK,
    )

    groups = {}
    for name, status in calibration.status_by_name.items():
        groups.setdefault(status, []).append(name)
    for status, names in groups.items():
        out.print(f'{status}: {", ".join(names)}')
    needs = {}
    for direction in calibration.undetermined:
        needs.setdefault(direction['needs'], {}).update(direction['parameters'])
    if COMMON_SCALE in groups.get(WEAK, []):
        needs[REMEDIES[GRAVITY,]] = {COMMON_SCALE: 1.0}
    for motion, names in needs.items():
        out.print(
            f'needs: {with_hint(motion, REMEDY_KEYS.get(motion), hints)}  ({", ".join(names)})'
        )
