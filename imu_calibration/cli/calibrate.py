"""``imu_calibration calibrate``: a recording becomes a calibration file and a report."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from imu_calibration import files
from imu_calibration.by_hand.workflow import calibrate_without_table
from imu_calibration.calibration.calibrate import calibrate
from imu_calibration.calibration.document import calibration_to_text
from imu_calibration.calibration.result import exit_code
from imu_calibration.cli import recordings
from imu_calibration.cli.hints import hints_of
from imu_calibration.cli.pool import jobs_for, process_mapper
from imu_calibration.cli.progress import progress_bar
from imu_calibration.cli.show import show_calibration, warn

NAME = 'calibrate'
HELP = 'Write calibration.yaml and report.html from one or several recordings of the same IMU.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bags', nargs='+', metavar='BAG', help='rosbag2 folder, .db3, .mcap or ROS 1 .bag')
    parser.add_argument('--table', metavar='TABLE', help='table description (YAML); without it: by hand, gravity as the reference')
    parser.add_argument('--output', metavar='DIR', required=True, help='folder for calibration.yaml and report.html')
    parser.add_argument('--gravity', type=float, help='local gravity in m/s^2 for calibration by hand, default 9.80665')
    parser.add_argument('--no-report', action='store_true', help='write calibration.yaml only')
    parser.add_argument('--jobs', type=int, help='recordings read side by side, default one per processor')
    recordings.add_topic_arguments(parser)
    recordings.add_model_arguments(parser)


def run(options):
    """Calibrate, write, print the verdict."""
    settings = recordings.calibration_options(options)
    table = files.read_table(options.table) if options.table else None
    for bag in options.bags:
        recordings.open_bag(bag, options, want_joints=table is not None).close()
    with files.output_folder(options.output) as folder:
        return _into(folder, options, settings, table)


def _into(folder, options, settings, table):
    """Calibrate into a folder that can be written, print, return the exit code."""
    names, jobs = None if table is None else table.joint_names, jobs_for(options.jobs, len(options.bags))
    sources = [recordings.source_of(bag, options, names, table is not None, quiet=jobs > 1) for bag in options.bags]
    with ThreadPoolExecutor(1) as hashing:   # reads the files beside the work, not before it
        provenance = hashing.submit(recordings.provenance_of, options.bags, options)
        if table is None:
            result = calibrate_without_table(sources, settings, options.gravity)
        else:
            result = _on_table(sources, table, settings, options.bags, jobs)
        result = replace(result, calibration=replace(result.calibration, provenance=result.calibration.provenance | provenance.result()))
    warn(result.calibration.statistics['preflight'])
    text = calibration_to_text(result.calibration)
    if not options.no_report:
        from imu_calibration.report.calibration_page import calibration_report
        files.write_text(folder / 'report.html', calibration_report(result))
    files.write_text(folder / 'calibration.yaml', text)
    show_calibration(result, folder, hints_of(options), report=not options.no_report)
    return exit_code(result)


def _on_table(sources, table, settings, bags, jobs):
    """Calibrate with the table, recordings side by side; with several processes one bar counts the recordings."""
    names = [Path(bag).name for bag in bags]
    names = [name if names.count(name) == 1 else str(bag) for name, bag in zip(names, bags, strict=True)]
    with progress_bar('recordings', len(bags) if jobs > 1 else 0, 'recordings') as advance:
        mapper = process_mapper(jobs, lambda part: advance(1)) if jobs > 1 else map
        return calibrate(sources, table, settings, mapper=mapper, names=names)
