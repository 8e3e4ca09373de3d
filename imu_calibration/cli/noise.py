"""``imu_calibration noise``: the noise of an IMU from a recording at rest."""

import sys

from imu_calibration import files
from imu_calibration.allan import summary
from imu_calibration.allan.figures import HORIZON
from imu_calibration.cli.show import console
from imu_calibration.use_cases.noise import noise

NAME = 'noise'
HELP = 'Identify white noise, bias instability and random walk from a recording at rest, with intervals: noise.yaml and report.html.'


def add_arguments(parser):
    """Declare the arguments."""
    parser.add_argument('bag', metavar='BAG', help='a recording that holds rest, an hour if possible; motion is found and left out')
    parser.add_argument('--output', metavar='DIR', required=True, help='folder for noise.yaml and report.html')
    parser.add_argument('--rate', metavar='HZ', type=float, action='append', default=[],
                        help='also print the discrete figures for this sampling rate; may be repeated')
    parser.add_argument('--horizon', metavar='S', type=float, default=HORIZON,
                        help=f'averaging time at which a random walk stands for other slow noise, default {HORIZON:g} s')
    parser.add_argument('--nominal', metavar='FILE', help='YAML with offsets and scales for recordings in volts or counts')
    parser.add_argument('--no-report', action='store_true', help='write noise.yaml only')
    group = parser.add_argument_group('topics', 'default name, else the only topic of that type')
    group.add_argument('--imu-topic', metavar='TOPIC', help='sensor_msgs/Imu, default /imu/data_raw')
    group.add_argument('--temperature-topic', metavar='TOPIC', help='sensor_msgs/Temperature, default /imu/temperature')


def run(options):
    """Identify into a folder that can be written, print the figures, return the exit code."""
    with files.output_folder(options.output) as folder:
        found = noise(options.bag, imu_topic=options.imu_topic, temperature_topic=options.temperature_topic, nominal=options.nominal,
                      horizon=options.horizon)
        for warning in found.warnings:
            print(f'warning: {warning}', file=sys.stderr)
        found.save(folder, report=not options.no_report)
        _show(found, [found.figures.rate, *options.rate], folder, 'noise.yaml' + ('' if options.no_report else ' and report.html'))
        return found.exit_code


def _show(found, rates, folder, names):
    """Print the figures, what to know about them, and what filters ask for."""
    from rich.table import Table
    out, table = console(), Table(box=None, pad_edge=False)
    for heading in ('figure', 'value', '95 %', 'unit', 'status', ''):
        table.add_column(heading, justify='right' if heading in ('value', '95 %') else 'left', overflow='ellipsis' if heading else 'fold')
    for row in summary.rows(found.figures):
        table.add_row(f'{row.sensor}.{row.axis} {row.title}', row.value, row.interval, row.unit, row.status, row.note)
    out.print(table)
    for line in summary.lines(found.figures):
        out.print(line, soft_wrap=True)
    for line in summary.filter_lines(found.figures, rates, found.horizon):
        out.print(line, soft_wrap=True)
    out.print(f'written: {names} in {folder}', soft_wrap=True)
