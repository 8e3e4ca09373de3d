"""``imu_calibration diagnose``: what the model gets wrong, why, the extended model, and the measured gain."""

import json

from imu_calibration import files
from imu_calibration.calibration.document import calibration_to_text
from imu_calibration.calibration.result import exit_code
from imu_calibration.cli import recordings
from imu_calibration.cli.progress import progress_bar
from imu_calibration.cli.show import console, warn
from imu_calibration.diagnosis.workflow import diagnose_recording, diagnose_without_table

NAME = 'diagnose'
HELP = 'Show what the model gets wrong, name the cause, extend the model, and measure the gain on data that were not fitted.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--table', metavar='TABLE', help='table description (YAML); without it: by hand, gravity as the reference')
    parser.add_argument('--output', metavar='DIR', required=True, help='folder for diagnosis.json, calibration.yaml and report.html')
    parser.add_argument('--gravity', type=float, help='local gravity in m/s^2 for a diagnosis by hand, default 9.80665')
    recordings.add_topic_arguments(parser)
    recordings.add_model_arguments(parser)


def run(options):
    """Diagnose, write, print the findings."""
    settings = recordings.calibration_options(options)
    table = files.read_table(options.table) if options.table else None
    with files.output_folder(options.output) as folder:
        return _into(folder, options, settings, table)


def _into(folder, options, settings, table):
    """Diagnose into a folder that can be written, print, return the exit code."""
    source = recordings.source_of(options.bag, options, table and table.joint_names, table is not None)
    provenance = recordings.provenance_of([options.bag], options)
    with progress_bar('diagnose', 100, '%') as advance:
        if table is None:
            result = diagnose_without_table(source, settings, options.gravity, provenance, advance)
        else:
            result = diagnose_recording(source, table, settings, provenance, advance)
    warn(result.calibration.statistics['preflight'])
    from imu_calibration.report.diagnosis_page import diagnosis_report
    page = diagnosis_report(result)
    files.write_text(folder / 'diagnosis.json', json.dumps(result.document, indent=1) + '\n')
    files.write_text(folder / 'report.html', page)
    files.write_text(folder / 'calibration.yaml', calibration_to_text(result.calibration))
    out = console()
    for line in result.lines:
        out.print(line, soft_wrap=True)
    out.print(f'written: diagnosis.json, calibration.yaml and report.html in {folder}', soft_wrap=True)
    return exit_code(result)
