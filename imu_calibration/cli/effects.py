"""``imu_calibration effects``: the catalogue."""

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line

EXAMPLES = ('', '--effects my_effects.yaml --json')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_effects(parser.common)


def run(options: Options) -> VerbResult:
    """Print one paragraph per effect."""
    from imu_calibration.api.choices import effect_rows

    rows = effect_rows(options.catalogue)
    for row in rows:
        print_line(
            f'{row["effect"]} ({row["sensor"]}, {row["unit"]}, tolerance {row["tolerance"]:g}, '
            f'compensation {row["compensation"]})',
            4 * ' ',
        )
        for label in ('text', 'equation', 'needs'):
            if row[label]:
                print_line(f'    {"" if label == "text" else label + ": "}{row[label]}', 8 * ' ')
    return VerbResult(0, {'effects': rows})
