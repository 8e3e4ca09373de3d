"""``imu_calibration compensate``: a bag with the corrected topic beside the others."""

from argparse import ArgumentParser, Namespace

from imu_calibration.cli.arguments import add_topic_arguments
from imu_calibration.use_cases.compensate import CORRECTED_TOPIC, compensate

NAME = 'compensate'
HELP = 'Write a bag with the corrected Imu topic beside all other topics.'


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--calibration', metavar='FILE', required=True, help='calibration.yaml')
    parser.add_argument('--output', metavar='BAG2', required=True, help='rosbag2 folder to make')
    parser.add_argument('--corrected-topic', metavar='TOPIC', default=CORRECTED_TOPIC, help=f'default {CORRECTED_TOPIC}')
    parser.add_argument('--target-frame', metavar='FRAME', default='',
                        help='move the corrected readings to another frame of the same rigid body')
    parser.add_argument('--target-xyz', metavar='M', nargs=3, type=float, default=(0.0, 0.0, 0.0),
                        help='place of the sensor in the target frame, m')
    parser.add_argument('--target-rpy', metavar='RAD', nargs=3, type=float, default=(0.0, 0.0, 0.0),
                        help='roll, pitch, yaw of the sensor in the target frame, rad')
    parser.add_argument('--anyway', action='store_true', help='also correct a sensor whose decision is harms')
    parser.add_argument('--noise', metavar='FILE', help='noise.yaml of this IMU, for the covariances where the messages bring none')
    parser.add_argument('--correct-stamps', action='store_true', help="move the stamps back by the calibration's time_offset")
    add_topic_arguments(parser)


def run(options: Namespace) -> int:
    """Compensate into a new bag, print what was noticed, return the exit code."""
    names = ('output', 'corrected_topic', 'target_frame', 'target_xyz', 'target_rpy', 'anyway', 'noise', 'correct_stamps', 'imu_topic',
             'temperature_topic')
    found = compensate(options.bag, options.calibration, **{name: getattr(options, name) for name in names})
    for line in found.warnings:
        print(f'note: {line}')
    print(f'written: {options.output} with {options.corrected_topic} ({found.count} samples)')
    if found.lost:
        print('lost: ' + ', '.join(f'{count} {reason}' for reason, count in found.lost.items()))
    return found.exit_code
