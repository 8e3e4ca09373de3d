"""``imu_calibration check``: is a calibration still good on this recording?"""

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult

EXAMPLES = (
    'later_session --calibration result/calibration.yaml --table table.yaml',
    'by_hand_session --calibration result/calibration.yaml --json',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help=f'a recording of the calibrated IMU: {BAG}')
    parser.common('--calibration', metavar='FILE', required=True, help='calibration.yaml')
    parser.add_gravity()
    parser.add_recording('without it: by hand')


def run(options: Options) -> VerbResult:
    """
    Print the errors before and after with their interval and the decision.

    Exit code 0 when it helps each sensor, otherwise 3.
    """
    from imu_calibration.cli.show import show_table, warn
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.core.units import error_text
    from imu_calibration.document.decision import ratio_text
    from imu_calibration.preprocessing.checks import warnings
    from imu_calibration.use_cases.calibrate import check

    found = check(options.bag, options.calibration, options.stand(), **options.choices())
    warn([finding.to_mapping() for finding in warnings(found.findings)])
    out, numbers = Terminal.of(), ('seconds', 'before', 'after', 'after / before, 95 %')
    rows = []
    for sensor, entry in found.proof.items():
        for motion, part in (('all', entry), *entry['regimes'].items()):
            rows.append(
                (
                    sensor,
                    motion,
                    f'{part["seconds"]:.0f}',
                    *(
                        error_text(part[when], part.get('unit', entry['unit']))
                        for when in ('before', 'after')
                    ),
                    ratio_text(part),
                )
            )
    show_table(out, ('sensor', 'motion', *numbers), rows, numbers=numbers)
    out.print(str(found))
    return VerbResult(found.exit_code, {'proof': found.proof, 'helps': found.helps}, found.reasons)
