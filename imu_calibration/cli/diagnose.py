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
    from imu_calibration.api.diagnose import diagnose
    from imu_calibration.api.view import foxglove
    from imu_calibration.cli.show import warn
    from imu_calibration.document import files

    if options.mcap:
        foxglove()  # before the work, not after it
        options.require_new(options.mcap)
    options.require_place([options.bag])
    with files.output_folder(options.output) as folder:
        diagnosis = diagnose(options.bag, options.stand(), **options.choices())
        warn(diagnosis.calibration.statistics['preflight'])
        diagnosis.save(folder, force=True)  # after `require_place`
        if options.mcap:
            diagnosis.save_overlay(options.mcap, force=options.force)
        extended = ''
        if diagnosis.transferable is not None:
            extended = ', and extended.yaml with the proposed formula in the model,'
        for line in str(diagnosis).splitlines():
            print_line(line)
        print_line(
            f'written: diagnosis.json, calibration.yaml and report.html{extended} in {folder}'
        )
        return VerbResult(diagnosis.exit_code, diagnosis.document, diagnosis.reasons)
