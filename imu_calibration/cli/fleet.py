"""``imu_calibration fleet``: many units, one result each, a summary table."""

from argparse import Namespace

from imu_calibration.cli.arguments import add_model_arguments, add_stand_arguments, add_topic_arguments, choices_of
from imu_calibration.cli.parser import OneLineParser
from imu_calibration.use_cases.choices import calibration_options

NAME = 'fleet'
HELP = 'Calibrate a folder of many units: one result each, and a summary table with the spread of each parameter.'


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('folder', metavar='FOLDER', help='folder that holds one bag, or one sub-folder with bags, per unit')
    parser.add_argument('--output', metavar='DIR', required=True,
                        help='folder for one result per unit, summary.csv, units.csv and summary.html')
    parser.add_argument('--jobs', type=int, help='units calibrated side by side, default one per processor')
    parser.add_argument('--scheduler', metavar='ADDRESS', help='address of a dask scheduler (needs the extra dask)')
    parser.add_argument('--no-report', action='store_true', help='no report.html per unit')
    add_stand_arguments(parser, 'one of them is needed, the same for all units')
    add_topic_arguments(parser)
    add_model_arguments(parser)


def run(options: Namespace) -> int:
    """Calibrate all units, continuing past a bad bag."""
    from imu_calibration.cli.fleet_run import run_fleet
    return run_fleet(options, calibration_options(choices_of(options)))
