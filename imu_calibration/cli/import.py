"""``imu_calibration import``: a calibration that another program made."""

from argparse import ArgumentParser, Namespace

from imu_calibration.calibration.status import HELD
from imu_calibration.use_cases.exporting import import_calibration

NAME = 'import'
HELP = 'Read the calibration that another program made, so that it can be compared and used.'


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('file', metavar='FILE', help='what the other program wrote')
    parser.add_argument('--from', dest='source', metavar='NAME', required=True, help="the program, as 'export --list' shows it")
    parser.add_argument('--output', metavar='FILE', required=True, help='calibration.yaml to write')
    parser.add_argument('--frame-id', metavar='FRAME', default='', help='frame_id of the Imu messages, where it shall be checked')


def run(options: Namespace) -> int:
    """Read, write, and say what is not known."""
    found = import_calibration(options.file, options.source, output=options.output, frame_id=options.frame_id)
    held = [name for name, status in found.requested.items() if status == HELD]
    for sensor, word in found.decisions.items():
        print(': '.join([f'{sensor} {word}', *filter(None, [found.decision_reasons.get(sensor)])]))
    for line in found.notes:
        print(line)
    if held:
        print(f'not in the file, held at the prior: {", ".join(held)}')
    print(f'written: {options.output}')
    return 0
