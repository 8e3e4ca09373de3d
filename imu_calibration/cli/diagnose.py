"""``imu_calibration diagnose``: what the model gets wrong, why, the extended model, and the measured gain."""

from argparse import Namespace

from imu_calibration import files
from imu_calibration.cli.arguments import add_model_arguments, add_stand_arguments, add_topic_arguments, choices_of, stand_of
from imu_calibration.cli.parser import OneLineParser
from imu_calibration.cli.show import console, warn
from imu_calibration.use_cases.diagnose import diagnose

NAME = 'diagnose'
HELP = 'Show what the model gets wrong, name the cause, extend the model, and measure the gain on data that were not fitted.'


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--output', metavar='DIR', required=True, help='folder for diagnosis.json, calibration.yaml and report.html')
    parser.add_argument('--gravity', type=float, help='local gravity in m/s^2 for a diagnosis by hand or with --urdf, default 9.80665')
    add_stand_arguments(parser, 'without any: by hand, gravity as the reference')
    add_topic_arguments(parser)
    add_model_arguments(parser)


def run(options: Namespace) -> int:
    """Diagnose into a folder that can be written, print the findings, return the exit code."""
    with files.output_folder(options.output) as folder:
        found = diagnose(options.bag, stand_of(options), **choices_of(options))
        warn(found.calibration.statistics['preflight'])
        found.save(folder)
        out = console()
        out.print(str(found), soft_wrap=True)
        also = '' if found.proposed is None else ', and extended.yaml with the proposed formula in the model,'
        out.print(f'written: diagnosis.json, calibration.yaml and report.html{also} in {folder}', soft_wrap=True)
        return found.exit_code
