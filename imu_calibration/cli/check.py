"""``imu_calibration check``: is a calibration still good on this recording?"""

from dataclasses import asdict
from typing import TYPE_CHECKING

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult
from imu_calibration.core.settings import CHANGE

if TYPE_CHECKING:
    from imu_calibration.calibration.check_result import CheckResult
    from imu_calibration.report.answer_page import AnswerTable

EXAMPLES = (
    'later_session --calibration result/calibration.yaml --table table.yaml',
    'by_hand_session --calibration result/calibration.yaml --json',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help=f'a recording of the calibrated IMU: {BAG}')
    parser.common('--calibration', metavar='FILE', required=True, help='calibration.yaml')
    parser.common(
        '--change',
        metavar='FACTOR',
        type=float,
        default=CHANGE,
        help=f'factor of the stored error from which a significant change counts, default {CHANGE}',
    )
    parser.add_page('check.html')
    parser.add_gravity()
    parser.add_recording('without it: by hand')
    parser.add_gyroscope_topic()
    parser.add_readings()
    parser.add_exclusion()
    parser.add_rows()


def run(options: Options) -> VerbResult:
    """
    Print the errors before and after with their interval and the decision.

    The exit code is 0 when it helps each sensor and no error has changed, otherwise 3.
    """
    from imu_calibration.api.calibrate import check_recording
    from imu_calibration.cli.show import show_answer, warn
    from imu_calibration.preprocessing.checks import visible_findings

    page = options.page('check.html')
    result = check_recording(
        options.bag,
        options.calibration,
        options.stand(),
        change=options.change,
        **options.choices(),
    )
    warn([finding.to_mapping() for finding in visible_findings(result.findings)])
    text = str(result)
    headline, *lines = text.split('\n')
    show_answer(
        text,
        page=page,
        table=_table(result),
        title='Check of a calibration',
        headline=headline,
        lines=lines,
        good=not result.exit_code,
        lead=(
            'Errors on the new recording before and after correction, and in the file of the'
            ' calibration on held-out data. A sensor has changed where the 95 % interval of now'
            f' / stored lies above {result.change_limit:g} in a kind of motion.'
        ),
        facts={'recording': str(options.bag), 'calibration': str(options.calibration)},
    )
    document = {
        'proof': {sensor: entry.to_mapping() for sensor, entry in result.proof.items()},
        'helps': result.helps,
        'changes': [asdict(change) for change in result.changes],
        'changed': bool(result.changed),
    }
    return VerbResult(result.exit_code, document, result.reasons)


def _table(result: 'CheckResult') -> 'AnswerTable':
    """Return the errors by sensor and motion: before, after, and now against the stored one."""
    from imu_calibration.core.units import error_text
    from imu_calibration.document.decision import ratio_text
    from imu_calibration.report.answer_page import AnswerTable

    numbers = ('seconds', 'before', 'after', 'after / before, 95 %', 'stored', 'now / stored, 95 %')
    change_of = {(change.sensor, change.regime): change for change in result.changes}
    rows = []
    for sensor, entry in result.proof.items():
        for motion, errors in (('all', entry), *entry.regimes.items()):
            change = change_of.get((sensor, motion))
            rows.append(
                (
                    sensor,
                    motion,
                    f'{errors.seconds:.0f}',
                    error_text(errors.before, errors.unit),
                    error_text(errors.after, errors.unit),
                    ratio_text(errors),
                    '-' if change is None else error_text(change.stored, change.unit),
                    '-' if change is None else f'{change.low:.2g} to {change.high:.2g}',
                )
            )
    return AnswerTable(('sensor', 'motion', *numbers), numbers, tuple(rows))
