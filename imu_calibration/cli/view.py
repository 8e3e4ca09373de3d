"""``imu_calibration view``: a recording's calibration as a picture that Foxglove opens."""

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, complain, print_line

EXAMPLES = ('session --table table.yaml --output session.mcap', 'result --output parameters.mcap')


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'source',
        metavar='BAG|RESULT',
        help='a recording, which is calibrated, or calibration.yaml (its folder), of which '
        'the parameters are shown',
    )
    parser.common('--output', metavar='FILE', required=True, help='the MCAP to write')
    parser.add_force('replace an existing file')
    parser.common(
        '--gravity',
        type=float,
        help='local gravity, m/s^2, by hand or with --urdf; default 9.80665',
    )
    parser.add_recording('without it: by hand, gravity is the reference')
    parser.add_gyroscope_topic()
    parser.add_exclusion()
    parser.add_rows()
    parser.add_model()


def run(options: Options) -> VerbResult:
    """
    Write the file, print the layout to open it with and the missing parts; return the exit code.
    """
    from imu_calibration.api.resources import config_file
    from imu_calibration.api.view import foxglove, view

    foxglove()  # before the work, not after it
    options.require_new(options.output)
    layout = config_file('view.foxglove.json')
    overlay = view(options.source, options.stand(), **options.choices())
    overlay.save(options.output, force=options.force)
    for line in overlay.lacks:
        complain(f'warning: {line}')
    print_line(f'written: {options.output}; open it in Foxglove with the layout {layout}')
    return VerbResult(
        overlay.exit_code,
        {'output': str(options.output), 'layout': str(layout), 'lacks': overlay.lacks},
        overlay.reasons,
    )
