"""``imu_calibration convert``: a text log as a bag."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line
from msg_adapters.storages import identifiers

if TYPE_CHECKING:
    from imu_calibration.preprocessing.sensor_join import JoinedSensors

EXAMPLES = (
    'Accelerometer.csv Gyroscope.csv --output session',
    'log.csv --columns time=t:ms force=ax,ay,az:g rate=gx,gy,gz:deg/s --output session',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'log',
        metavar='FILE',
        nargs='+',
        help=(
            'text with a header and columns separated by comma, semicolon, tab or spaces; two'
            ' files, of accelerometer and gyroscope; or a folder with a file per sensor, as'
            ' phones export'
        ),
    )
    parser.common('--output', metavar='BAG', required=True, help='rosbag2 folder to make')
    parser.add_rows(
        'C is QUANTITY=NAMES:UNIT, as in time=NAME:s force=X,Y,Z:g rate=X,Y,Z:deg/s'
        ' temperature=NAME:C joint.JOINT=NAME:deg; a name may be a column number, a leading minus'
        ' reverses the sign'
    )
    parser.expert('--storage', choices=identifiers(), default='mcap', help='default mcap')


def joined_document(joined: JoinedSensors) -> dict[str, Any]:
    """Return how two sensors were joined: the slower one, and its delay, s, if it is known."""
    delay = joined.delay
    return {
        'slower': joined.slower,
        'delay': None if delay is None else delay.delay,
        'delay_sd': None if delay is None else delay.sd,
    }


def run(options: Options) -> VerbResult:
    """Read the log, print the columns used, write the bag."""
    from msg_adapters.csv_log import read_logs
    from msg_adapters.write import write_session

    log = read_logs(options.log, options.columns, options.where)
    for columns in log.columns:
        print(columns)
    if log.unused:
        print_line(f'unused: {", ".join(log.unused)}')
    if log.joined is not None:
        print_line(f'joined: {log.joined.text}')
    if log.n_dropped:
        print_line(f'dropped: {log.n_dropped} lines with too few columns')
    write_session(
        options.output, log.imu, log.joints, temperature=log.temperature, storage=options.storage
    )
    print_line(f'written: {options.output} ({len(log.imu)} Imu)')
    return VerbResult(
        0,
        {
            'output': str(options.output),
            'count': len(log.imu),
            'columns': list(map(asdict, log.columns)),
            'unused': log.unused,
            'dropped': log.n_dropped,
            'joined': None if log.joined is None else joined_document(log.joined),
        },
    )
