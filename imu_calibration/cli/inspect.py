"""``imu_calibration inspect``: what a recording holds and what it can determine."""

from collections import Counter

from imu_calibration import workflow
from imu_calibration.cli import files, recordings
from imu_calibration.cli.show import console
from imu_calibration.errors import ImuCalibrationError
from imu_calibration.stream_check import StreamCheck

NAME = 'inspect'
HELP = 'Topics, rates, gaps, stamps, units that look wrong, motions found, and which parameters the recording can determine.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--table', metavar='TABLE', help='table description (YAML); with it the motions are found and judged')
    recordings.add_topic_arguments(parser)
    recordings.add_model_arguments(parser)


def run(options):
    """Read once for the streams, and once more with the table for the motions."""
    out = console()
    with recordings.open_bag(options.bag, options, want_joints='optional') as recording:
        for topic in recording.topics:
            out.print(f'{topic.name}  {topic.type}  {topic.count}')
        checks, drops = _read(recording)
        lost = dict(recording.lost)
    for name, check in checks.items():
        statistics = check.statistics()
        if statistics.count:
            out.print(f'{name}: {statistics.count} samples, {statistics.rate:.2f} Hz, {statistics.duration:.1f} s, {statistics.n_gaps} gaps '
                      f'({statistics.gap_total:.2f} s), longest step {statistics.longest_step * 1e3:.1f} ms, stamps in steps of {statistics.stamp_step_ns} ns')
            for reason, count in statistics.dropped.items():
                if count:
                    drops[f'{name} {reason}'] += count
    for reason, count in (drops + Counter(lost)).items():
        out.print(f'dropped: {count} {reason}')
    code = 3 if sum(drops.values()) or lost else 0
    return _judge(options, out, code) if options.table else code


def _read(recording):
    checks, drops = {name: StreamCheck() for name in ('imu', 'joints', 'temperature')}, Counter()
    for block in recording.blocks():
        drops.update(block.dropped or {})
        for name, check in checks.items():
            samples = getattr(block, name)
            if samples is not None and len(samples):
                check.push(samples)
    for check in checks.values():
        check.finish()
    return checks, drops


def _judge(options, out, code):
    table = files.read_table(options.table)
    source = recordings.source_of(options.bag, options, table.joint_names)
    try:
        result = workflow.calibrate([source], table, recordings.calibration_options(options))
    except ImuCalibrationError as error:
        out.print(f'not usable for calibration: {error}', soft_wrap=True)
        return 3
    for kind, count in result.calibration.statistics['windows'].items():
        out.print(f'{kind}: {count} windows, {result.calibration.statistics["samples_used"][kind]} samples')
    groups = {}
    for name, status in zip(result.calibration.param_names, result.calibration.status):
        groups.setdefault(status, []).append(name)
    for status, names in groups.items():
        out.print(f'{status}: {", ".join(names)}', soft_wrap=True)
    for direction in result.calibration.undetermined:
        out.print(f'needs: {direction["needs"]}  ({", ".join(direction["parameters"])})', soft_wrap=True)
    return max(code, workflow.exit_code(result))
