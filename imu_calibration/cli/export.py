"""``imu_calibration export``: a calibration as estimators and autopilots want it."""

from imu_calibration.cli.parser import OneLineParser, Options, VerbResult, print_line
from imu_calibration.core.errors import InputError

EXAMPLES = (
    '--list',
    'result/calibration.yaml --to kalibr --noise noise/noise.yaml --output imu.yaml',
)


def add_arguments(parser: OneLineParser) -> None:
    """Declare the arguments."""
    parser.add_argument('document', metavar='CALIBRATION', nargs='?', help='calibration.yaml')
    parser.common('--to', metavar='NAME', help='name of the program, listed by --list')
    parser.common(
        '--list', action='store_true', help='list the programs and the parameters that each accepts'
    )
    parser.common('--noise', metavar='FILE', help='noise.yaml of the verb noise')
    parser.expert(
        '--rate',
        metavar='HZ',
        type=float,
        help='rate at which the program gets the readings; default that of noise.yaml',
    )
    parser.common('--output', metavar='FILE', help='the file to write')
    parser.add_force('replace an existing file')
    parser.expert(
        '--bag',
        metavar='BAG',
        help='recording on which the loss is measured; default: a standard motion',
    )
    parser.expert(
        '--anyway',
        action='store_true',
        help='also write a sensor with the decision harms; without it nominal values',
    )
    parser.common(
        '--axes',
        metavar='AXES',
        help='of the readings, where calibration.yaml states none: flu, frd or --axes=-x,y,-z',
    )
    parser.add_recording('motion of --bag; without it: from its readings')
    parser.add_gyroscope_topic()
    parser.add_exclusion()
    parser.add_rows()


def run(options: Options) -> VerbResult:
    """Show the list, or write the file and print the information that is lost."""
    if options.list:
        return VerbResult(0, {'targets': _show_targets()})
    required = {
        'CALIBRATION': options.document,
        '--to NAME': options.to,
        '--output FILE': options.output,
    }
    for name, argument in required.items():
        if not argument:
            raise InputError(f'an export must have {name}, none was given; give it, or see --list')
    from imu_calibration.api.choices import topics_of
    from imu_calibration.api.exporting import export_calibration
    from imu_calibration.api.recordings import refuse_stand

    if not options.bag:
        refuse_stand(options.stand(), 'the recording --bag BAG, none was given; give both')
    exported = export_calibration(
        options.document,
        stand=options.stand(),
        topics=topics_of(vars(options)),
        **options.arguments_for(export_calibration),
    )
    for line in (*exported.lines, f'written: {options.output}'):
        print_line(line)
    document = {'output': options.output, 'lines': exported.lines}
    return VerbResult(exported.exit_code, document, exported.reasons)


def _show_targets() -> list[dict[str, str]]:
    """Print the programs to whose files an export can write; return them as data."""
    from imu_calibration.cli.show import show_table
    from imu_calibration.cli.terminal import Terminal
    from imu_calibration.document.exports.export import all_targets, holds_in_words

    rows = []
    for target in all_targets().values():
        if target.write is not None:
            noise = target.noise_is or '-'
            read = 'yes' if target.read else '-'
            rows.append((target.name, target.title, holds_in_words(target), noise, read))
    show_table(
        Terminal.of(), ('name', 'file', 'of the calibration it holds', 'noise', 'read'), rows
    )
    keys = ('name', 'file', 'holds', 'noise', 'import')
    return [dict(zip(keys, row, strict=True)) for row in rows]
