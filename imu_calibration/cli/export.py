"""``imu_calibration export``: a calibration as estimators and autopilots want it."""

from argparse import ArgumentParser, Namespace

from imu_calibration.cli.arguments import add_stand_arguments, add_topic_arguments, stand_of
from imu_calibration.cli.show import console
from imu_calibration.errors import InputError
from imu_calibration.exports.export import holds_in_words
from imu_calibration.exports.registry import all_targets
from imu_calibration.use_cases.exporting import export_calibration
from imu_calibration.use_cases.recordings import Topics

NAME = 'export'
HELP = 'Write a calibration and its noise as another program wants them, and say what that loses.'


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('document', metavar='CALIBRATION', nargs='?', help='calibration.yaml')
    parser.add_argument('--to', metavar='NAME', help='the program: one of those that --list shows')
    parser.add_argument('--list', action='store_true', help='show the programs and what each can hold')
    parser.add_argument('--noise', metavar='FILE', help='noise.yaml of the verb noise')
    parser.add_argument('--rate', metavar='HZ', type=float, help='rate at which the program gets the readings; default that of noise.yaml')
    parser.add_argument('--output', metavar='FILE', help='the file to write')
    parser.add_argument('--bag', metavar='BAG', help='recording on which the loss is measured; default: a standard motion')
    parser.add_argument('--anyway', action='store_true', 
                        help='also the numbers of a sensor whose decision is harms; without it they are nominal')
    add_stand_arguments(parser, 'what says how the recording moved; without it: its own readings')
    add_topic_arguments(parser)


def run(options: Namespace) -> int:
    """Show the list, or write the file and print what is lost."""
    if options.list:
        _show_targets()
        return 0
    for name, given in (('CALIBRATION', options.document), ('--to NAME', options.to), ('--output FILE', options.output)):
        if not given:
            raise InputError(f'an export must have {name}, none came; give it, or see --list')
    stand = stand_of(options)
    if stand is not None and not options.bag:
        raise InputError('a table or arm says how a recording moved and must come with --bag BAG, none came; give both')
    topics = Topics(options.imu_topic, options.joint_topic, options.temperature_topic)
    found = export_calibration(options.document, options.to, output=options.output, noise=options.noise, rate=options.rate,
                               bag=options.bag, stand=stand, topics=topics, anyway=options.anyway)
    for line in found.lines:
        print(line)
    print(f'written: {options.output}')
    return found.exit_code


def _show_targets():
    from rich.table import Table
    table = Table(box=None, pad_edge=False)
    for heading in ('name', 'file', 'of the calibration it holds', 'noise', 'import'):
        table.add_column(heading, no_wrap=heading == 'name', overflow='fold')
    for target in all_targets().values():
        if target.write is not None:
            table.add_row(target.name, target.title, holds_in_words(target), target.noise_is or '-', 'yes' if target.read else '-')
    console().print(table)
