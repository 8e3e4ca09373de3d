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
    from imu_calibration.cli.show import show_table
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.document import comparison, files
    from imu_calibration.report.answer_page import answer_page

    page = options.page('compare.html')
    result = comparison.compare(
        files.read_calibration(options.first), files.read_calibration(options.second)
    )

    out = Terminal.of()
    table = _table(result)
    show_table(out, table.columns, table.rows, numbers=table.numbers)
    out.print('\n'.join(result.lines))
    if page is not None:
        text = answer_page(
            'Two calibrations',
            result.lines[-1],
            result.lines[:-1],
            table=table,
            good=bool(result.agree),
            lead=(
                'Differences in combined standard deviations; a group of parameters differs at 1 %'
                ' over all groups.'
            ),
            facts={'A': options.first, 'B': options.second},
        )
        files.write_texts(page.parent, {page.name: text})
        out.print(f'written: {page}')
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
