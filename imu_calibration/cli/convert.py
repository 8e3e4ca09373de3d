"""``imu_calibration convert``: a text log as a bag."""

from argparse import Namespace

from imu_calibration.cli.parser import OneLineParser
from msg_adapters.csv_log import read_csv
from msg_adapters.storages import identifiers
from msg_adapters.write import write_session

NAME = 'convert'
HELP = 'Write a text log (CSV) as a bag; columns and units are found from the header and from the values, and printed.'


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('log', metavar='FILE', help='text with a header and columns separated by comma, semicolon, tab or spaces')
    parser.add_argument('--output', metavar='BAG', required=True, help='rosbag2 folder to make')
    parser.add_argument('--columns', metavar='QUANTITY=NAMES:UNIT', nargs='+', default=[],
                        help='replaces the guess: time=NAME:s force=X,Y,Z:g rate=X,Y,Z:deg/s temperature=NAME:C joint.JOINT=NAME:deg; '
                        'a name may be a column number, a leading minus reverses the sign; units: s ms us ns, m/s^2 g mg, rad/s deg/s '
                        'mdeg/s, rad deg')
    parser.add_argument('--storage', choices=identifiers(), default='mcap')


def run(options: Namespace) -> int:
    """Read the log, print the columns used, write the bag."""
    log = read_csv(options.log, options.columns)
    for columns in log.columns:
        print(columns)
    if log.unused:
        print(f'unused: {", ".join(log.unused)}')
    write_session(options.output, log.imu, log.joints, temperature=log.temperature, storage=options.storage)
    print(f'written: {options.output} ({len(log.imu)} Imu)')
    return 0
