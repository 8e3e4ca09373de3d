"""
``imu_calibration compensate``: a bag with the corrected topic in addition to the original ones.

Or a text log with corrected readings.
"""

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult, print_line

EXAMPLES = (
    'drive --calibration result/calibration.yaml --output drive_corrected',
    (
        'drive --calibration calibration.yaml --target-frame base_link --target-xyz 0.1 0 0.2'
        ' --output drive_corrected'
    ),
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help=BAG)
    parser.common('--calibration', metavar='FILE', required=True, help='calibration.yaml')
    parser.common(
        '--output',
        metavar='BAG2',
        required=True,
        help='rosbag2 folder to make; from a text log also a text log (.csv)',
    )
    parser.common(
        '--corrected-topic',
        metavar='TOPIC',
        default='/imu/data_corrected',
        help='default /imu/data_corrected',
    )
    parser.common(
        '--target-frame',
        metavar='FRAME',
        default='',
        help='move the corrected readings to another frame of the same rigid body',
    )
    parser.expert(
        '--target-xyz',
        metavar='M',
        nargs=3,
        type=float,
        default=(0.0, 0.0, 0.0),
        help='place of the sensor in the target frame, m',
    )
    parser.expert(
        '--target-rpy',
        metavar='RAD',
        nargs=3,
        type=float,
        default=(0.0, 0.0, 0.0),
        help='roll, pitch, yaw of the sensor in the target frame, rad',
    )
    parser.common(
        '--anyway', action='store_true', help='also correct a sensor with the decision harms'
    )
    parser.expert(
        '--noise',
        metavar='FILE',
        help='noise.yaml of this IMU, for the covariances where the messages bring none',
    )
    parser.expert(
        '--correct-stamps',
        action='store_true',
        help="move the stamps back by the calibration's time_offset",
    )
    parser.add_topics(joints=False)
    parser.add_gyroscope_topic()
    parser.add_readings()
    parser.add_exclusion()
    parser.add_rows()


def run(options: Options) -> VerbResult:
    """Compensate into a new bag, print warnings and losses, return the exit code."""
    from imu_calibration.api.compensate import compensate_recording
    from msg_adapters.csv_log import is_text_log

    compensated = compensate_recording(options.bag, **options.arguments_for(compensate_recording))
    for line in compensated.warnings:
        print_line(f'note: {line}')
    for line in compensated.reasons:
        if line not in compensated.warnings:
            print_line(f'warning: {line}')
    topic = '' if is_text_log(options.output) else options.corrected_topic
    place = f'{options.output} with {topic}' if topic else options.output
    print_line(f'written: {place} ({compensated.count} samples)')
    if compensated.lost:
        print(
            'lost: ' + ', '.join(f'{count} {reason}' for reason, count in compensated.lost.items())
        )
    return VerbResult(
        compensated.exit_code,
        {
            'output': str(options.output),
            'topic': topic,
            'count': compensated.count,
            'warnings': list(compensated.warnings),
            'lost': compensated.lost,
        },
        compensated.reasons,
    )
