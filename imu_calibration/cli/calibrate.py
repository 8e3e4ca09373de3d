"""``imu_calibration calibrate``: a recording becomes a calibration file and a report."""

from argparse import Namespace

from imu_calibration import files
from imu_calibration.cli.arguments import add_model_arguments, add_stand_arguments, add_topic_arguments, choices_of, stand_of
from imu_calibration.cli.hints import hints_of
from imu_calibration.cli.parser import OneLineParser
from imu_calibration.cli.show import show_calibration, warn
from imu_calibration.use_cases.calibrate import calibrate

NAME = 'calibrate'
HELP = 'Write calibration.yaml and report.html from one or several recordings of the same IMU.'


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bags', nargs='+', metavar='BAG', help='rosbag2 folder, .db3, .mcap or ROS 1 .bag')
    parser.add_argument('--output', metavar='DIR', required=True, help='folder for calibration.yaml and report.html')
    parser.add_argument('--gravity', type=float, help='local gravity in m/s^2 for calibration by hand or with --urdf, default 9.80665')
    parser.add_argument('--earlier', metavar='FILE', help='calibration.yaml from before, proven on the same recordings (with a table)')
    parser.add_argument('--no-report', action='store_true', help='write calibration.yaml only')
    parser.add_argument('--jobs', type=int, help='recordings read side by side, default one per processor')
    add_stand_arguments(parser, 'without any: by hand, gravity as the reference')
    add_topic_arguments(parser)
    add_model_arguments(parser).add_argument('--model-as-asked', action='store_true',
                                             help='add nothing to the model, whatever the recording demands')


def run(options: Namespace) -> int:
    """Calibrate into a folder that can be written, print the verdict, return the exit code."""
    with files.output_folder(options.output) as folder:
        found = calibrate(options.bags, stand_of(options), jobs=options.jobs, earlier=options.earlier, **choices_of(options))
        warn(found.calibration.statistics['preflight'])
        found.save(folder, report=not options.no_report)
        show_calibration(found, folder, hints_of(options), report=not options.no_report)
        return found.exit_code
