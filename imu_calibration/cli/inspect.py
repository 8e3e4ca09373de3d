"""``imu_calibration inspect``: what a recording holds, what looks wrong with it, and what it can determine."""

from collections import Counter
from dataclasses import dataclass

from imu_calibration.calibration.calibrate import calibrate
from imu_calibration.calibration.result import exit_code
from imu_calibration.cli.arguments import add_model_arguments, add_stand_arguments, add_topic_arguments, choices_of, stand_of
from imu_calibration.cli.hints import hints_of
from imu_calibration.cli.show import console, show_findings
from imu_calibration.errors import ImuCalibrationError, with_hint
from imu_calibration.preflight.checks import Preflight, unusable
from imu_calibration.preflight.finding import REFUSE
from imu_calibration.segmentation.stream_cleaning import StreamCheck
from imu_calibration.use_cases.choices import calibration_options, topics_of
from imu_calibration.use_cases.progress import progress_bar
from imu_calibration.use_cases.recordings import Topics, existing, open_bag, source_of
from imu_calibration.use_cases.stand import table_of
from msg_adapters.bag import KEYS, Recording, imu_topics, list_topics

NAME = 'inspect'
HELP = 'Topics, rates, gaps, stamps, units and axes that look wrong, motions found, and which parameters the recording can determine.'
TOPICS = (('imu_topic', 'imu'), ('joint_topic', 'joints'), ('temperature_topic', 'temperature'))


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    add_stand_arguments(parser, 'with it axes and units are compared with the joints, and the motions are found and judged')
    add_topic_arguments(parser)
    add_model_arguments(parser)


@dataclass(frozen=True, eq=False)
class Look:
    """What one Imu topic of a recording is like, with the joints and temperatures that go with it."""

    recording: Recording
    """The recording, closed again."""
    checks: dict
    """'imu', 'joints' or 'temperature' -> StreamCheck."""
    findings: tuple
    """What looks wrong."""
    lost: Counter
    """Reason -> messages that could not be read."""

    @property
    def refused(self):
        """Whether a finding says that a calibration would be wrong."""
        return any(finding.severity == REFUSE for finding in self.findings)

    @property
    def exit_code(self):
        """0, or 3 where something is lost, unusable or refused."""
        counts = any(check.counts for check in self.checks.values())
        return 3 if self.refused or self.lost or counts or unusable(self.findings) else 0


def run(options):
    """Read each Imu topic once for streams and checks, and once more with the table for the motions."""
    topics = _topics(options)
    stand = stand_of(options)
    table = None if stand is None else table_of(stand, [options.bag], Topics(topics[0]))
    settings = calibration_options(choices_of(options))
    looks = [_look(options, table, settings.nominal, topic) for topic in topics]
    out = console()
    _show_topics(out, looks)
    _show_unread(out, looks[0].recording, hints_of(options))
    code = 0
    for look in looks:
        out.print()
        if len(looks) > 1:
            out.print(f'{look.recording.imu_topic}', style='bold')
        show_findings(out, look.findings, hints_of(options))
        for reason, count in look.lost.items():
            out.print(f'lost: {count} {reason}')
        judge = table is not None and not look.refused
        code = max(code, look.exit_code, _judge(options, settings, table, out, look.recording.imu_topic) if judge else 0)
    return code


def _topics(options):
    """Return the Imu topics to look at: the one that was asked for, or all."""
    if options.imu_topic is None:
        return imu_topics(list_topics(existing(options.bag))) or [None]
    return [options.imu_topic]


def _look(options, table, nominal, topic):
    """Read one Imu topic through."""
    preflight, checks, lost = Preflight(table and table.gravity_value, nominal), {name: StreamCheck() for _, name in TOPICS}, Counter()
    topics = topics_of(choices_of(options))._replace(imu=topic)
    with open_bag(options.bag, topics, want_joints='optional', want_temperature='optional') as recording:
        with progress_bar('inspect', recording.message_counts.get(recording.imu_topic, 0)) as advance:
            for block in preflight.watch(recording.blocks(), strict=False):
                lost.update(block.dropped or {})
                for name, check in checks.items():
                    check.push(getattr(block, name))
                if block.imu is not None:
                    advance(len(block.imu))
        lost.update(recording.lost)
    for check in checks.values():
        check.finish()
    return Look(recording, checks, preflight.findings, lost)


def _show_topics(out, looks):
    """Print the topics; those that are read come with what their stamps say."""
    from rich.table import Table
    used = {getattr(look.recording, attribute): look.checks[name].statistics() for look in looks for attribute, name in TOPICS
            if getattr(look.recording, attribute)}
    table = Table(box=None, pad_edge=False, header_style='dim')
    for heading in ('topic', 'type', 'messages', 'Hz', 'seconds', 'gaps', 'stamp step', ''):
        table.add_column(heading, justify='right' if heading in ('messages', 'Hz', 'seconds', 'gaps', 'stamp step') else 'left')
    for topic in sorted(looks[0].recording.topics, key=lambda topic: topic.name not in used):
        found = used.get(topic.name)
        if found is None or not found.count:
            table.add_row(topic.name, topic.type, str(topic.count), style='dim')
        else:
            gaps = f'{found.n_gaps} ({found.gap_total:.2f} s)' if found.n_gaps else 'none'
            table.add_row(topic.name, topic.type, str(topic.count), f'{found.rate:.2f}', f'{found.duration:.1f}', gaps,
                          _step(found.stamp_step_ns), 'read')
    out.print(table)


def _show_unread(out, recording, hints):
    """Print which topics were left alone because there is no telling which one belongs to the IMU."""
    for message_type, key in KEYS.items():
        names = [topic.name for topic in recording.topics if topic.type == message_type]
        if names and getattr(recording, key) is None:
            text = f'not read: {", ".join(names)}, no telling which belongs to the IMU; choose one'
            out.print(with_hint(text, key, hints), soft_wrap=True)


def _step(step_ns):
    """Return the finest difference between stamps in the largest unit that needs no fraction."""
    for size, unit in ((10**6, 'ms'), (10**3, 'us')):
        if step_ns and step_ns % size == 0:
            return f'{step_ns // size} {unit}'
    return f'{step_ns} ns' if step_ns else ''


def _judge(options, settings, table, out, topic):
    """Print which motions were found and which parameters they determine; return the exit code."""
    source = source_of(options.bag, topics_of(choices_of(options))._replace(imu=topic), table.joint_names)
    try:
        result = calibrate([source], table, settings)
    except ImuCalibrationError as error:
        out.print(f'not usable for calibration: {error.told(hints_of(options))}', soft_wrap=True, markup=False)
        return 3
    out.print()
    for kind, count in result.calibration.statistics['windows'].items():
        out.print(f'{kind}: {count} windows, {result.calibration.statistics["samples_used"][kind]} samples')
    groups = {}
    for name, status in zip(result.calibration.param_names, result.calibration.status):
        groups.setdefault(status, []).append(name)
    for status, names in groups.items():
        out.print(f'{status}: {", ".join(names)}', soft_wrap=True)
    for direction in result.calibration.undetermined:
        out.print(f'needs: {direction["needs"]}  ({", ".join(direction["parameters"])})', soft_wrap=True)
    return exit_code(result.calibration)
