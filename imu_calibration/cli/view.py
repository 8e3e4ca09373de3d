"""``imu_calibration view``: a recording's calibration as a picture that Foxglove opens."""

import sys
from argparse import Namespace

from imu_calibration.cli.arguments import add_model_arguments, add_stand_arguments, add_topic_arguments, choices_of, stand_of
from imu_calibration.cli.parser import OneLineParser
from imu_calibration.resources import config_file
from imu_calibration.use_cases.foxglove_file import foxglove
from imu_calibration.use_cases.view import view

NAME = 'view'
HELP = 'Write an MCAP for Foxglove: residual before and after, coverage, parameters with bands, spectrum of the residual.'


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('source', metavar='BAG|RESULT', help='a recording, which is calibrated, or calibration.yaml (its folder), of which '
                        'the parameters are shown')
    parser.add_argument('--output', metavar='FILE', required=True, help='the MCAP to write')
    parser.add_argument('--gravity', type=float, help='local gravity in m/s^2 for calibration by hand or with --urdf, default 9.80665')
    add_stand_arguments(parser, 'without any: by hand, gravity as the reference')
    add_topic_arguments(parser)
    add_model_arguments(parser).add_argument('--model-as-asked', action='store_true',
                                             help='add nothing to the model, whatever the recording demands')


def run(options: Namespace) -> int:
    """Write the file, say how it is opened and what it lacks; return the exit code."""
    foxglove()   # before the work, not after it
    layout = config_file('view.foxglove.json')
    found = view(options.source, stand_of(options), **choices_of(options))
    found.save(options.output)
    for line in found.lacks:
        print(f'warning: {line}', file=sys.stderr)
    print(f'written: {options.output}; open it in Foxglove with the layout {layout}')
    return found.exit_code
