"""``imu_calibration compare``: whether two calibrations agree."""

from dataclasses import asdict
from typing import TYPE_CHECKING

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult

if TYPE_CHECKING:
    from imu_calibration.document.comparison import Comparison
    from imu_calibration.report.answer_page import AnswerTable

EXAMPLES = ('result/calibration.yaml earlier/calibration.yaml', 'a.yaml b.yaml --json')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('first', metavar='A.yaml')
    parser.add_argument('second', metavar='B.yaml')
    parser.add_page('compare.html')


def run(options: Options) -> VerbResult:
    """Compare and print; exit code 3 where the calibrations of the IMU disagree."""
    from imu_calibration.cli.show import show_answer
    from imu_calibration.document import comparison, files

    page = options.page('compare.html')
    result = comparison.compare(
        files.read_calibration(options.first), files.read_calibration(options.second)
    )

    show_answer(
        '\n'.join(result.lines),
        page=page,
        table=_table(result),
        title='Two calibrations',
        headline=result.lines[-1],  # the verdict
        lines=result.lines[:-1],
        good=bool(result.agree),
        lead=(
            'Differences in combined standard deviations; a group of parameters differs at 1 %'
            ' over all groups.'
        ),
        facts={'A': options.first, 'B': options.second},
    )
    document = {
        'rows': [asdict(row) for row in result.rows],
        'lines': list(result.lines),
        'agree': result.agree,
        'reference_agree': result.reference_agree,
    }
    return VerbResult(result.exit_code, document, result.reasons)


def _table(result: 'Comparison') -> 'AnswerTable':
    """Return each parameter in a customary unit, with as many digits as its sd supports."""
    from imu_calibration.core.units import for_people, with_sd
    from imu_calibration.report.answer_page import AnswerTable

    rows = []
    for row in result.rows:
        factor, unit = for_people(row.unit, row.name)
        difference, sd = with_sd((row.second - row.first) * factor, row.sd * factor)
        first, _ = with_sd(row.first * factor, row.sd * factor)
        second, _ = with_sd(row.second * factor, row.sd * factor)
        ratio = '-' if row.ratio is None else f'{row.ratio:.1f}'
        rows.append((row.name, first, second, difference, sd, unit, ratio))
    return AnswerTable(
        columns=('parameter', 'A', 'B', 'B - A', 'combined sd', 'unit', 'in sd'),
        numbers=('A', 'B', 'B - A', 'combined sd', 'in sd'),
        rows=tuple(rows),
    )
