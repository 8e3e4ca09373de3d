"""``imu_calibration check``: is a calibration still good on this recording?"""

from dataclasses import asdict

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult
from imu_calibration.core.settings import CHANGE

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

    Exit code 0 when it helps each sensor and no error has changed, otherwise 3.
    """
    from imu_calibration.cli.show import show_table, warn
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.document import files
    from imu_calibration.preprocessing.checks import visible_findings
    from imu_calibration.report.answer_page import answer_page
    from imu_calibration.use_cases.calibrate import check_recording

    page = options.page('check.html')
    found = check_recording(
        options.bag,
        options.calibration,
        options.stand(),
        change=options.change,
        **options.choices(),
    )
    warn([finding.to_mapping() for finding in visible_findings(found.findings)])
    out = Terminal.of()
    table = _table(found)
    show_table(out, table.columns, list(table.rows), numbers=table.numbers)
    out.print(str(found))
    if page is not None:
        headline, *lines = str(found).split('\n')
        text = answer_page(
            'Check of a calibration',
            headline,
            lines,
            table=table,
            good=not found.exit_code,
            lead=(
                'Errors on the new recording before and after correction, and in the file of the'
                ' calibration on held-out data. A sensor has changed where the 95 % interval of now'
                f' / stored lies above {found.change_limit:g} in a kind of motion.'
            ),
            facts={'recording': str(options.bag), 'calibration': str(options.calibration)},
        )
        files.write_texts(page.parent, {page.name: text})
        out.print(f'written: {page}')
    document = {
        'proof': {sensor: entry.to_mapping() for sensor, entry in found.proof.items()},
        'helps': found.helps,
        'changes': [asdict(each) for each in found.changes],
        'changed': bool(found.changed),
    }
    return VerbResult(found.exit_code, document, found.reasons)


def _table(found):
    """Return the errors by sensor and motion: before, after, and against the stored one."""
    from imu_calibration.core.units import error_text
    from imu_calibration.document.decision import ratio_text
    from imu_calibration.report.answer_page import AnswerTable

    numbers = ('seconds', 'before', 'after', 'after / before, 95 %', 'stored', 'now / stored, 95 %')
    since = {(each.sensor, each.regime): each for each in found.changes}
    rows = []
    for sensor, entry in found.proof.items():
        for motion, part in (('all', entry), *entry.regimes.items()):
            change = since.get((sensor, motion))
            rows.append(
                (
                    sensor,
                    motion,
                    f'{part.seconds:.0f}',
                    error_text(part.before, part.unit),
                    error_text(part.after, part.unit),
                    ratio_text(part),
                    '-' if change is None else error_text(change.stored, change.unit),
                    '-' if change is None else f'{change.low:.2g} to {change.high:.2g}',
                )
            )
    return AnswerTable(('sensor', 'motion', *numbers), numbers, tuple(rows))
