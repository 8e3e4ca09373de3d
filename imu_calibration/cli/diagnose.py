"""
``imu_calibration diagnose``.

The errors of the model, their causes, the extended model, and the measured gain.
"""

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult, print_line

EXAMPLES = ('session --table table.yaml --output finding', 'by_hand_session --output finding')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help=BAG)
    parser.common(
        '--output',
        metavar='DIR',
        required=True,
        help='folder for diagnosis.json, calibration.yaml and report.html',
    )
    parser.common(
        '--mcap',
        metavar='FILE',
        help='also write measured and simulated signals and the residuals as MCAP for Foxglove',
    )
    parser.add_session(searched=False)


def run(options: Options) -> VerbResult:
    """Diagnose into a folder that can be written, print the findings, return the exit code."""
    from imu_calibration.cli.show import warn
    from imu_calibration.document import files
    from imu_calibration.use_cases.diagnose import diagnose
    from imu_calibration.use_cases.view import foxglove

    if options.mcap:
        foxglove()  # before the work, not after it
        options.require_new(options.mcap)
    options.require_place([options.bag])
    with files.output_folder(options.output) as folder:
        found = diagnose(options.bag, options.stand(), **options.choices())
        warn(found.calibration.statistics['preflight'])
        found.save(folder, force=True)  # `require_place` has looked
        if options.mcap:
            found.save_overlay(options.mcap, force=options.force)
        also = (
            ''
            if found.transferable is None
            else ', and extended.yaml with the proposed formula in the model,'
        )
        for line in (
            *str(found).splitlines(),
            f'written: diagnosis.json, calibration.yaml and report.html{also} in {folder}',
        ):
            print_line(line)
        return VerbResult(found.exit_code, found.document, found.reasons)
