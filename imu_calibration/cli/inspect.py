"""``imu_calibration inspect``: what a recording holds, what looks wrong with it, and what it can determine."""

from collections import Counter

from imu_calibration import files
from imu_calibration.calibration.calibrate import calibrate
from imu_calibration.calibration.result import exit_code
from imu_calibration.cli import recordings
from imu_calibration.cli.progress import progress_bar
from imu_calibration.cli.show import console, show_findings
from imu_calibration.errors import ImuCalibrationError
from imu_calibration.preflight.checks import Preflight, unusable
from imu_calibration.preflight.finding import REFUSE
from imu_calibration.segmentation.stream_cleaning import StreamCheck

NAME = 'inspect'
HELP = 'Topics, rates, gaps, stamps, units and axes that look wrong, motions found, and which parameters the recording can determine.'
TOPICS = (('imu_topic', 'imu'), ('joint_topic', 'joints'), ('temperature_topic', 'temperature'))


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--table', metavar='TABLE', help='table description (YAML); with it axes and units are compared with the joints, '
                        'and the motions are found and judged')
    recordings.add_topic_arguments(parser)
    recordings.add_model_arguments(parser)


def run(options):
    """Read once for streams and checks, and once more with the table for the motions."""
    table = files.read_table(options.table) if options.table else None
    settings = recordings.calibration_options(options)
    preflight = Preflight(None if table is None else table.gravity_value, settings.nominal)
    out = console()
    with recordings.open_bag(options.bag, options, want_joints='optional') as recording:
        checks, drops = _read(recording, preflight)
        lost = Counter(recording.lost)
    _show_topics(out, recording, {name: check.statistics() for name, check in checks.items()})
    show_findings(out, preflight.findings)
    for reason, count in (drops + lost).items():
        out.print(f'lost: {count} {reason}')
    refused = any(finding.severity == REFUSE for finding in preflight.findings)
    lacking = drops or lost or any(check.counts for check in checks.values())
    code = 3 if refused or lacking or unusable(preflight.findings) else 0
    return _judge(options, settings, table, out, code) if table is not None and not refused else code


def _read(recording, preflight):
    checks, drops = {name: StreamCheck() for _, name in TOPICS}, Counter()
    with progress_bar('inspect', recording.message_counts.get(recording.imu_topic, 0)) as advance:
        for block in preflight.watch(recording.blocks(), strict=False):
            drops.update(block.dropped or {})
            for name, check in checks.items():
                check.push(getattr(block, name))
            if block.imu is not None:
                advance(len(block.imu))
    for check in checks.values():
        check.finish()
    return checks, drops


def _show_topics(out, recording, statistics):
    """Print the topics; those that are read come with what their stamps say."""
    from rich.table import Table
    used = {getattr(recording, attribute): name for attribute, name in TOPICS if getattr(recording, attribute)}
    table = Table(box=None, pad_edge=False, header_style='dim')
    for heading in ('topic', 'type', 'messages', 'Hz', 'seconds', 'gaps', 'stamp step', ''):
        table.add_column(heading, justify='right' if heading in ('messages', 'Hz', 'seconds', 'gaps', 'stamp step') else 'left')
    for topic in sorted(recording.topics, key=lambda topic: topic.name not in used):
        found = statistics.get(used.get(topic.name))
        if found is None or not found.count:
            table.add_row(topic.name, topic.type, str(topic.count), style='dim')
        else:
            gaps = f'{found.n_gaps} ({found.gap_total:.2f} s)' if found.n_gaps else 'none'
            table.add_row(topic.name, topic.type, str(topic.count), f'{found.rate:.2f}', f'{found.duration:.1f}', gaps, _step(found.stamp_step_ns), 'read')
    out.print(table)
    out.print()


def _step(step_ns):
    """Return the finest difference between stamps in the largest unit that needs no fraction."""
    for size, unit in ((10**6, 'ms'), (10**3, 'us')):
        if step_ns and step_ns % size == 0:
            return f'{step_ns // size} {unit}'
    return f'{step_ns} ns' if step_ns else ''


def _judge(options, settings, table, out, code):
    source = recordings.source_of(options.bag, options, table.joint_names)
    try:
        result = calibrate([source], table, settings)
    except ImuCalibrationError as error:
        out.print(f'not usable for calibration: {error}', soft_wrap=True, markup=False)
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
    return max(code, exit_code(result))
