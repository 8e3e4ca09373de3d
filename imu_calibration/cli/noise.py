"""``imu_calibration noise``: the noise of an IMU from a recording at rest."""

import sys
from argparse import ArgumentParser, Namespace
from itertools import groupby
from textwrap import fill

from imu_calibration import files
from imu_calibration.allan import summary
from imu_calibration.allan.figures import HORIZON
from imu_calibration.use_cases.noise import noise

NAME = 'noise'
HELP = 'Identify white noise, bias instability and random walk from a recording at rest, with intervals: noise.yaml and report.html.'


def add_arguments(parser: ArgumentParser) -> None:
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


def run(options: Namespace) -> int:
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
    """Print the figures, what to know about them, and what filters ask for, in 80 columns."""
    for head, rows in groupby(summary.rows(found.figures), lambda row: f'{row.sensor}, {row.title}, {row.unit}'):
        print(head)
        for row in rows:
            print(f' {row.axis} {row.value:>8}  {row.interval:>17}  {row.status:<10}  {row.note}'.rstrip())
    print()
    for line in [*summary.lines(found.figures), *summary.filter_lines(found.figures, rates, found.horizon)]:
        print(fill(line, 80, subsequent_indent='    '))
    print(f'written: {names} in {folder}')
