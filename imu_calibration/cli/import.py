"""``imu_calibration import``: a calibration that another program made."""

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line

EXAMPLES = (
    'imu.yaml --from kalibr --output calibration.yaml',
    'params.txt --from px4 --output calibration.yaml',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('file', metavar='FILE', help='file of the other program')
    parser.common(
        '--from',
        dest='source',
        metavar='NAME',
        required=True,
        help="the program, as 'export --list' shows it",
    )
    parser.common('--output', metavar='FILE', required=True, help='calibration.yaml to write')
    parser.add_force('replace an existing file')
    parser.common(
        '--frame-id',
        metavar='FRAME',
        default='',
        help='frame_id of the Imu messages, where it shall be checked',
    )


def run(options: Options) -> VerbResult:
    """Read, write, and list the parameters that the file lacks."""
    from imu_calibration.api.exporting import import_calibration
    from imu_calibration.estimation.solution import HELD

    calibration = import_calibration(options.file, **options.arguments_for(import_calibration))
    held = [name for name, status in calibration.requested.items() if status == HELD]
    for sensor, decision in calibration.decisions.items():
        line = f'{sensor} {decision}'
        reason = calibration.decision_reasons.get(sensor)
        if reason:
            line += f': {reason}'
        print_line(line)
    for line in calibration.notes:
        print_line(line)
    if held:
        print_line(f'not in the file, held at the prior: {", ".join(held)}')
    print_line(f'written: {options.output}')
    return VerbResult(0, {'output': str(options.output), 'held': held})
