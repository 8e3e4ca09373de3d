"""``imu_calibration compensate``: a bag with the corrected topic beside the others."""

from pathlib import Path

from imu_calibration import files
from imu_calibration.calibration.trust import caveats, objections, refuse_untrusted
from imu_calibration.cli import recordings
from imu_calibration.cli.progress import progress_bar
from imu_calibration.compensation.stream import CompensationStream, late_ns, refuse_corrected, requested_transfer
from imu_calibration.errors import InputError

NAME = 'compensate'
HELP = 'Write a bag with the corrected Imu topic beside all other topics.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG')
    parser.add_argument('--calibration', metavar='FILE', required=True, help='calibration.yaml')
    parser.add_argument('--output', metavar='BAG2', required=True, help='rosbag2 folder to make')
    parser.add_argument('--corrected-topic', metavar='TOPIC', default='/imu/data_corrected', help='default /imu/data_corrected')
    parser.add_argument('--target-frame', metavar='FRAME', default='',
                        help='move the corrected readings to another frame of the same rigid body')
    parser.add_argument('--target-xyz', metavar='M', nargs=3, type=float, default=(0.0, 0.0, 0.0),
                        help='place of the sensor in the target frame, m')
    parser.add_argument('--target-rpy', metavar='RAD', nargs=3, type=float, default=(0.0, 0.0, 0.0),
                        help='roll, pitch, yaw of the sensor in the target frame, rad')
    parser.add_argument('--anyway', action='store_true', help='also with a calibration whose verdict is bad or whose proof failed')
    parser.add_argument('--correct-stamps', action='store_true', help="move the stamps back by the calibration's time_offset")
    recordings.add_topic_arguments(parser)


def run(options):
    """Compensate block by block."""
    from msg_adapters.write import copy_with_corrected
    calibration = files.read_calibration(options.calibration)
    if not options.anyway:
        refuse_untrusted(calibration)
    if Path(options.output).exists():
        raise InputError(f'the output bag {options.output} must not exist yet; choose another name or remove it')
    transfer = requested_transfer(options.target_frame, options.target_xyz, options.target_rpy)
    recording = recordings.open_bag(options.bag, options, want_joints=False)
    with recording, progress_bar('compensate', recording.message_counts.get(recording.imu_topic, 0)) as advance:
        refuse_corrected(recording.imu_topic)
        stream = CompensationStream(calibration, temperature=recordings.temperatures(options.bag, options), transfer=transfer)

        def correct(imu):
            advance(len(imu))
            return stream.correct(imu)
        lost = copy_with_corrected(options.bag, options.output, recording.imu_topic, options.corrected_topic, correct, stream.propagate,
                                   options.target_frame or None, None if transfer is None else transfer.mat_ts,
                                   late_ns(calibration, options.correct_stamps))
    for line in objections(calibration) + caveats(calibration) + stream.warnings():
        print(f'note: {line}')
    print(f'written: {options.output} with {options.corrected_topic} ({stream.count} samples)')
    if lost:
        print('lost: ' + ', '.join(f'{count} {reason}' for reason, count in lost.items()))
    return 3 if lost else 0
