"""``imu_calibration compare``: whether two calibrations agree."""

from dataclasses import asdict

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult

EXAMPLES = ('result/calibration.yaml earlier/calibration.yaml', 'a.yaml b.yaml --json')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('first', metavar='A.yaml')
    parser.add_argument('second', metavar='B.yaml')


def run(options: Options) -> VerbResult:
    """Compare and print."""
    from imu_calibration.cli.show import show_table
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.core.units import for_people, with_sd
    from imu_calibration.document import comparison, files

    result = comparison.compare(
        files.read_calibration(options.first), files.read_calibration(options.second)
    )
    out = Terminal.of()
    numbers = ('A', 'B', 'B - A', 'combined sd', 'in sd')
    shown = []
    for row in result.rows:
        factor, unit = for_people(row.unit, row.name)
        difference, sd = with_sd((row.second - row.first) * factor, row.sd * factor)
        shown.append(
            (
                row.name,
                *(with_sd(v * factor, row.sd * factor)[0] for v in (row.first, row.second)),
                difference,
                sd,
                unit,
                '-' if row.ratio is None else f'{row.ratio:.1f}',
            )
        )
    show_table(out, ('parameter', *numbers[:-1], 'unit', 'in sd'), shown, numbers=numbers)
    out.print('\n'.join(result.lines))
    return VerbResult(
        0, {'rows': [asdict(row) for row in result.rows], 'lines': list(result.lines)}
    )
