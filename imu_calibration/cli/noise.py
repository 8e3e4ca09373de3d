"""``imu_calibration noise``: the noise of an IMU from a recording at rest."""

from itertools import groupby

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line

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
    from imu_calibration.cli.show import warn
    from imu_calibration.document import files
    from imu_calibration.use_cases.choices import require_same_inputs
    from imu_calibration.use_cases.noise import identify_recording, noise_provenance
    from imu_calibration.use_cases.recordings import existing

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
        found = identify_recording(options.bag, **choices)
        warn(finding.to_mapping() for finding in found.findings)
        found.save(folder, report=not options.no_report, force=True)
        _show(
            found,
            [found.figures.rate, *options.rate],
            folder,
            'noise.yaml' + ('' if options.no_report else ' and report.html'),
        )
        return VerbResult(
            found.exit_code, noise_mapping(found.figures, found.horizon), found.reasons
        )


def _show(found, rates, folder, names):
    """Print the figures, their remarks, and the figures for filters."""
    from imu_calibration.allan import document

    for head, rows in groupby(
        document.rows(found.figures), lambda row: f'{row.sensor}, {row.title}, {row.unit}'
    ):
        print(head)
        for row in rows:
            line = f' {row.axis} {row.value:>8}  {row.interval:>17}  {row.status:<10}  {row.note}'
            print(line.rstrip())
    print()
    for line in [
        *document.lines(found.figures),
        *document.filter_lines(found.figures, rates, found.horizon),
    ]:
        print_line(line, '    ')
    print_line(f'written: {names} in {folder}')
