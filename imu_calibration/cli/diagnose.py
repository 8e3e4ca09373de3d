"""``imu_calibration diagnose``: what the model gets wrong, why, the extended model, and the measured gain."""

import json

from imu_calibration import documents, workflow
from imu_calibration.cli import files, recordings
from imu_calibration.cli.progress import progress_bar
from imu_calibration.cli.show import console
from imu_calibration.diagnosing import diagnose_recording

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
    folder = files.make_folder(options.output)
    source = recordings.source_of(options.bag, options, table.joint_names)
    with progress_bar('diagnose', 1000, 'parts') as advance:
        result = diagnose_recording(source(), table, settings, recordings.provenance_of([options.bag], options), _steps(advance))
    from imu_calibration.report import diagnosis_report
    files.write_text(folder / 'report.html', diagnosis_report(result))
    files.write_text(folder / 'calibration.yaml', documents.calibration_to_text(result.calibration))
    files.write_text(folder / 'diagnosis.json', json.dumps(result.document, indent=1) + '\n')
    out = console()
    for line in result.lines:
        out.print(line, soft_wrap=True)
    out.print(f'written: diagnosis.json, calibration.yaml and report.html in {folder}', soft_wrap=True)
    return workflow.exit_code(result)


def _steps(advance):
    """Turn shares that are done into steps of a thousand."""
    done = [0]

    def progress(share):
        now = int(1000 * share)
        advance(max(now - done[0], 0))
        done[0] = max(now, done[0])
    return progress
