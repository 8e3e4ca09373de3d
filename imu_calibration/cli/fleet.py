"""``imu_calibration fleet``: many units, one result each, a summary table."""

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult

EXAMPLES = (
    'units --table table.yaml --output fleet',
    'units --table table.yaml --jobs 4 --no-report --output fleet',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'folder',
        metavar='FOLDER',
        help='folder that holds one bag, or one sub-folder with bags, per unit',
    )
    parser.common(
        '--output',
        metavar='DIR',
        required=True,
        help='folder for one result per unit, summary.csv, units.csv and summary.html',
    )
    parser.common(
        '--jobs', type=int, help='units calibrated side by side, default one per processor'
    )
    parser.common(
        '--scheduler', metavar='ADDRESS', help='address of a dask scheduler (needs the extra dask)'
    )
    parser.common('--no-report', action='store_true', help='no report.html per unit')
    parser.add_force()
    parser.add_recording('a table or robot is required, the same for all units')
    parser.add_gyroscope_topic()
    parser.add_exclusion('of every unit, s from the first stamp; or NAME=A:B, of a unit or bag')
    parser.add_rows()
    parser.add_model()


def run(options: Options) -> VerbResult:
    """Calibrate all units, continuing past a bad bag."""
    from imu_calibration.api.choices import calibration_options
    from imu_calibration.cli.fleet_run import run_fleet

    return run_fleet(options, calibration_options(options.choices()))
