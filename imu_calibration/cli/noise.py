"""``imu_calibration noise``: the noise of an IMU from a recording at rest."""

from itertools import groupby
from typing import TYPE_CHECKING

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line

if TYPE_CHECKING:
    from imu_calibration.api.noise import IdentifiedNoise

EXAMPLES = ('still_hour --output noise', 'still_hour --rate 200 --output noise')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'bag',
        metavar='BAG',
        help='a recording that holds rest, an hour if possible; motion is found and left out',
    )
    parser.common(
        '--output', metavar='DIR', required=True, help='folder for noise.yaml and report.html'
    )
    parser.common(
        '--rate',
        metavar='HZ',
        type=float,
        action='append',
        default=[],
        help='also print the discrete figures for this sampling rate; may be repeated',
    )
    parser.expert(
        '--horizon',
        metavar='S',
        type=float,
        help='averaging time at which a random walk replaces other slow noise, default 100 s',
    )
    parser.common('--no-report', action='store_true', help='write noise.yaml only')
    parser.add_force('overwrite the noise of other inputs')
    parser.add_topics(joints=False)
    parser.add_gyroscope_topic()
    parser.add_readings()
    parser.add_exclusion()
    parser.add_rows()


def run(options: Options) -> VerbResult:
    """Identify into a folder that can be written, print the figures, return the exit code."""
    from imu_calibration.allan.document import noise_mapping
    from imu_calibration.api.choices import require_same_inputs
    from imu_calibration.api.noise import identify_recording, noise_provenance
    from imu_calibration.api.recordings import existing
    from imu_calibration.cli.show import warn
    from imu_calibration.document import files

    choices = {}
    for name, value in options.arguments_for(identify_recording).items():
        if value is not None:
            choices[name] = value
    if not options.force:
        require_same_inputs(
            options.output,
            lambda: noise_provenance(existing(options.bag)),
            'noise.yaml',
            report=not options.no_report,
        )
    with files.output_folder(options.output) as folder:
        noise = identify_recording(options.bag, **choices)
        warn(finding.to_mapping() for finding in noise.findings)
        noise.save(folder, report=not options.no_report, force=True)
        _show(noise, [noise.figures.rate, *options.rate])
        names = 'noise.yaml' if options.no_report else 'noise.yaml and report.html'
        print_line(f'written: {names} in {folder}')
        document = noise_mapping(noise.figures, noise.horizon)
        return VerbResult(noise.exit_code, document, noise.reasons)


def _show(noise: 'IdentifiedNoise', rates: list[float]) -> None:
    """Print the figures, their remarks, and the figures for filters at sampling rates, Hz."""
    from imu_calibration.allan import document

    rows = document.rows(noise.figures)
    for head, rows_of_head in groupby(rows, lambda row: f'{row.sensor}, {row.title}, {row.unit}'):
        print(head)
        for row in rows_of_head:
            line = f' {row.axis} {row.value:>8}  {row.interval:>17}  {row.status:<10}  {row.note}'
            print(line.rstrip())
    print()
    lines = document.lines(noise.figures)
    filter_lines = document.filter_lines(noise.figures, rates, noise.horizon)
    for line in [*lines, *filter_lines]:
        print_line(line, '    ')
