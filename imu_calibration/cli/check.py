"""``imu_calibration check``: is a calibration still good on this recording?"""

from argparse import Namespace

from imu_calibration.cli.parser import BAG, OneLineParser, VerbResult, add_recording_arguments, choices_of, stand_of

EXAMPLES = ('later_session --calibration result/calibration.yaml --table table.yaml',
            'by_hand_session --calibration result/calibration.yaml --json')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    common = parser.common.add_argument
    parser.add_argument('bag', metavar='BAG', help=f'a recording of the calibrated IMU: {BAG}')
    common('--calibration', metavar='FILE', required=True, help='calibration.yaml')
    add_recording_arguments(parser, 'without it: by hand')


def run(options: Namespace) -> VerbResult:
    """Print the errors before and after with their interval and the decision; exit code 0 when it helps each sensor, otherwise 3."""
    from imu_calibration.cli.show import show_table, warn
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.core.units import error_text
    from imu_calibration.document.decision import ratio_text
    from imu_calibration.preprocessing.checks import warnings
    from imu_calibration.use_cases.calibrate import check
    found = check(options.bag, options.calibration, stand_of(options), **choices_of(options))
    warn([finding.to_mapping() for finding in warnings(found.findings)])
    out, numbers = Terminal.standard(), ('seconds', 'before', 'after', 'after / before, 95 %')
    rows = []
    for sensor, entry in found.proof.items():
        for motion, part in (('all', entry), *entry['regimes'].items()):
            rows.append((sensor, motion, f'{part["seconds"]:.0f}',
                         *(error_text(part[when], part.get('unit', entry['unit'])) for when in ('before', 'after')),
                         ratio_text(part)))
    show_table(out, ('sensor', 'motion', *numbers), rows, numbers=numbers)
    out.print(str(found))
    return VerbResult(found.exit_code, {'proof': found.proof, 'helps': found.helps})
