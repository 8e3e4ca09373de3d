"""``imu_calibration calibrate``: a recording becomes a calibration file and a report."""

from imu_calibration.cli.parser import BAG, OneLineParser, Options, VerbResult

EXAMPLES = (
    'session --table table.yaml --output result',
    'by_hand_session --gravity 9.81 --output result',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('bags', nargs='+', metavar='BAG', help=BAG)
    parser.common(
        '--output', metavar='DIR', required=True, help='folder for calibration.yaml and report.html'
    )
    parser.expert(
        '--earlier', metavar='FILE', help='earlier calibration.yaml to compare (table only)'
    )
    parser.common('--no-report', action='store_true', help='write calibration.yaml only')
    parser.expert('--jobs', type=int, help='recordings read at a time, default one per core')
    parser.add_session()


def run(options: Options) -> VerbResult:
    """Calibrate into a folder that can be written, print the verdict, return the exit code."""
    from imu_calibration.api.calibrate import calibrate_recordings
    from imu_calibration.cli.show import show_calibration, warn
    from imu_calibration.document import files
    from imu_calibration.document.calibration_text import calibration_mapping

    options.require_place(options.bags)
    with files.output_folder(options.output) as folder:
        choices = options.choices()
        calibrated = calibrate_recordings(
            options.bags, options.stand(), jobs=options.jobs, earlier=options.earlier, **choices
        )
        warn(calibrated.calibration.statistics['preflight'])
        calibrated.save(folder, report=not options.no_report, force=True)  # `require_place`
        show_calibration(calibrated, folder, options.hints(), report=not options.no_report)
        return VerbResult(
            calibrated.exit_code, calibration_mapping(calibrated.calibration), calibrated.reasons
        )
