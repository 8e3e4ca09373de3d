"""``imu_calibration diagnose``: what the model gets wrong, why, the extended model, and the measured gain."""

import json

from imu_calibration import documents, workflow
from imu_calibration.cli import files, recordings
from imu_calibration.cli.progress import progress_bar
from imu_calibration.cli.show import console

NAME = 'diagnose'
HELP = 'Show what the model gets wrong, name the cause, extend the model, and measure the gain on data that were not fitted.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--table', metavar='TABLE', required=True, help='table description (YAML)')
    parser.add_argument('--output', metavar='DIR', required=True, help='folder for diagnosis.json, calibration.yaml and report.html')
    recordings.add_topic_arguments(parser)
    recordings.add_model_arguments(parser)


def run(options):
    """Diagnose, write, print the findings."""
    settings = recordings.calibration_options(options)
    table = files.read_table(options.table)
    with files.output_folder(options.output) as folder:
        return _into(folder, options, settings, table)


def _into(folder, options, settings, table):
    """Diagnose into a folder that can be written, print, return the exit code."""
    source = recordings.source_of(options.bag, options, table.joint_names)
    with progress_bar('diagnose', 100, '%') as advance:
        result = workflow.diagnose_recording(source, table, settings, recordings.provenance_of([options.bag], options), advance)
    from imu_calibration.report import diagnosis_report
    page = diagnosis_report(result)
    files.write_text(folder / 'diagnosis.json', json.dumps(result.document, indent=1) + '\n')
    files.write_text(folder / 'report.html', page)
    files.write_text(folder / 'calibration.yaml', documents.calibration_to_text(result.calibration))
    out = console()
    for line in result.lines:
        out.print(line, soft_wrap=True)
    out.print(f'written: diagnosis.json, calibration.yaml and report.html in {folder}', soft_wrap=True)
    return workflow.exit_code(result)
