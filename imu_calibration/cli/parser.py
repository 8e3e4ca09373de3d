"""
Arguments of the offline tool.

The verbs, options that all or several of them have, and refusals in one line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TextIO, cast

import imu_calibration
from imu_calibration.cli.terminal import Terminal, wrapped
from imu_calibration.core.errors import ERROR_KEYS, did_you_mean

if TYPE_CHECKING:
    from imu_calibration.api.choices import Choices
    from imu_calibration.api.recordings import Stand

VERBS = {
    'inspect': (
        'Topics, rates, gaps, stamps, suspicious units and axes, motions found, and the parameters'
        ' that the recording determines.'
    ),
    'calibrate': (
        'Write calibration.yaml and report.html from one or several recordings of the same IMU.'
    ),
    'compensate': 'Write a bag with the corrected Imu topic in addition to all other topics.',
    'check': 'Test a calibration on a recording: errors before and after, by sensor and by motion.',
    'diagnose': (
        'Find the errors of the model, name their causes, extend the model, and measure the gain on'
        ' held-out data.'
    ),
    'simulate': 'Write a bag of a simulated session on a turntable, with truth.yaml.',
    'compare': (
        'Test whether two calibrations agree, in units of their combined standard deviation.'
    ),
    'arm': (
        'Position of one IMU relative to another on the same rigid body, from their measurements in'
        ' motion.'
    ),
    'fleet': (
        'Calibrate a folder of many units: one result each, and a summary table with the spread of'
        ' each parameter.'
    ),
    'noise': (
        'Identify white noise, bias instability and random walk from a recording at rest:'
        ' noise.yaml and report.html.'
    ),
    'plan': (
        'Plan the motions that bring every parameter within its tolerance: plan.yaml, a joint'
        ' trajectory and report.html.'
    ),
    'convert': (
        'Write a text log (CSV) as a bag; columns and units are found from the header and the'
        ' values, and printed.'
    ),
    'export': (
        'Write a calibration and its noise in the format of another program, and state the'
        ' information that is lost.'
    ),
    'import': 'Read the calibration of another program, so that it can be compared and used.',
    'effects': (
        'List the catalogue of effects: sensor, unit, tolerance, equation, and the motion that'
        ' determines each.'
    ),
    'watch': (
        'Watch a running calibration_node: bars in units of tolerance, next motion, streams, first'
        ' finding.'
    ),
    'view': (
        'Write an MCAP for Foxglove: residual before and after, coverage, parameters with bands,'
        ' spectrum of the residual.'
    ),
}
"""
Name -> one line of help; each is a module of this package with EXAMPLES, `add_arguments` and `run`.
"""

EXIT_CODES = (
    'Exit codes: 0 done; 1 refused, nothing written; 3 written, but a parameter is not determined,'
    ' a sensor is unproven or harmful, or part of the input was unusable; 130 interrupted.'
)


class VerbResult(NamedTuple):
    """Result of a verb."""

    exit_code: int
    """See `EXIT_CODES`."""
    document: Mapping[str, Any] = {}
    """The result as data, printed by --json."""
    reasons: Sequence[str] = ()
    """Why the exit code is 3, a line each; printed with --quiet, and part of --json."""


BAG = 'rosbag2 folder, .db3, .mcap, ROS 1 .bag, text (.csv)'


class OneLineParser(argparse.ArgumentParser):
    """
    A parser that refuses arguments with one line and exit code 1.

    `common` and `expert` declare an option in one of the two groups.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make the two groups; arguments as of `argparse.ArgumentParser`."""
        super().__init__(*arguments, **{'add_help': False, **options})
        self.common = self.add_argument_group('common options').add_argument
        self.expert = self.add_argument_group('expert options').add_argument
        self.common('-h', '--help', action='help', help='print this page')

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is refused with the closest known one."""
        options, extra = self.parse_known_args(args, namespace or Options())
        if extra:
            first_name, _, _ = extra[0].partition('=')
            hint = did_you_mean(first_name, getattr(options, 'verb_options', ()))
            self.prog += f' {options.verb}'
            self.error(f'unrecognized arguments: {" ".join(extra)}{hint}')
        return options

    def error(self, message: str) -> NoReturn:
        """Print the requirement and stop."""
        complain(f"{self.prog}: {message}; see '{self.prog} --help'")
        raise SystemExit(1)

    def add_topics(self, *, joints: bool = True) -> None:
        """Add the options that choose topics."""
        self.common(
            '--imu-topic', metavar='TOPIC', help='default /imu/data_raw, else the only Imu topic'
        )
        self.expert(
            '--frame-id',
            metavar='FRAME',
            help='frame_id of the Imu messages; for a topic with several',
        )
        if joints:
            self.common(
                '--joint-topic',
                metavar='TOPIC',
                help='default /joint_states, else the only JointState topic',
            )
        self.expert(
            '--temperature-topic',
            metavar='TOPIC',
            help='default /imu/temperature, else the only one',
        )

    def add_exclusion(self, text: str = 's from the first stamp; or NAME=A:B') -> None:
        """Add the option of times that are not used, with the meaning of a time."""
        self.common('--exclude', metavar='A:B,...', help=f'unused times, {text}')

    def add_rows(self, columns: str = "columns of a text log: 'convert --help'") -> None:
        """Add the options of columns and rows of a text log, with the help of the first."""
        self.common('--columns', metavar='C', nargs='+', default=[], help=columns)
        self.common(
            '--where',
            metavar='COLUMN=VALUE',
            action='append',
            default=[],
            help='only these rows of a text log; may be repeated',
        )

    def add_stand(self, without: str) -> None:
        """
        Add the options of the table or arm that moves the IMU.

        `without` describes the case without them.
        """
        self.common('--table', metavar='TABLE', help=f'description of the table (YAML); {without}')
        self.common(
            '--urdf',
            metavar='FILE',
            help='robot description; --table adds up, gravity, mount',
        )
        self.common(
            '--imu-link',
            metavar='LINK',
            help='link with the IMU, default its frame_id',
        )
        self.expert(
            '--allow-xacro',
            action='store_true',
            help='expand .xacro, a program: only from trusted authors',
        )
        self.expert(
            '--up',
            type=float,
            nargs=3,
            metavar=('X', 'Y', 'Z'),
            help='up in the root frame; default TABLE, /tf_static or z',
        )

    def add_recording(self, without: str) -> None:
        """
        Add the options of the table or arm and of the topics of a recording.

        `without` as for `add_stand`.
        """
        self.add_stand(without)
        self.add_topics()

    def add_gyroscope_topic(self) -> None:
        """Add the option of a topic with the rates only."""
        self.expert(
            '--gyroscope-topic',
            metavar='T',  # short: the help of a verb fits a screen
            help='Imu topic with the rates, if it is another one',
        )

    def add_page(self, name: str) -> None:
        """Add the options of a page that shows the answer."""
        self.common('--output', metavar='DIR', help=f'folder for {name}, the answer as one page')
        self.add_force(f'replace an existing {name}')

    def add_force(self, text: str = 'overwrite the result of another verb or other inputs') -> None:
        """Add the consent to replace files, with its help."""
        self.common('--force', action='store_true', help=text)

    def add_gravity(self) -> None:
        """Add the options of the local gravity."""
        self.common(
            '--gravity',
            type=float,
            help='m/s^2; default that of TABLE, otherwise 9.80665',
        )
        self.common(
            '--latitude', metavar='DEG', type=float, help='gravity from the latitude (WGS 84)'
        )
        self.common(
            '--height', metavar='M', type=float, help='and height above the ellipsoid, default 0 m'
        )

    def add_session(self, *, searched: bool = True) -> None:
        """
        Add the options of a calibration.

        Local gravity, recording, labels of the result, model (`add_model`) and candidates.
        """
        self.add_gravity()
        self.add_recording('without it: by hand')
        self.add_gyroscope_topic()
        self.add_exclusion()
        self.add_rows()
        self.common(
            '--serial', metavar='TEXT', help='serial number of the IMU, for calibration.yaml'
        )
        self.common('--operator', metavar='TEXT', help='name of the operator, likewise')
        self.add_force()
        self.add_model(searched=searched)
        self.expert(
            '--candidates',
            metavar='EFFECT',
            help="effects under test, joined by +; 'none'",
        )

    def add_model(self, *, searched: bool = True) -> None:
        """
        Add the options that choose the parameters to estimate.

        `searched`: and the option that omits the search for effects.
        """
        self.expert(
            '--accelerometer-model',
            metavar='MODEL',
            help='joined by +; default bias+matrix, and arms if seen',
        )
        self.expert('--gyroscope-model', metavar='M', help='likewise; default bias+matrix')
        self.expert(
            '--reference-model',
            metavar='M',
            help="of table and clock, or 'none'; default table_tilt",
        )
        self.add_effects(self.expert)
        self.expert(
            '--tolerances', metavar='FILE', help='largest sd of a determined parameter, by effect'
        )
        self.add_readings()
        self.expert(
            '--noise',
            metavar='FILE',
            help='noise.yaml of this IMU, for its biases (table only)',
        )
        self.expert(
            '--setting',
            metavar='NAME=VALUE',
            action='append',
            default=[],
            help='of the window detection; an unknown name lists all',
        )
        if searched:
            self.expert(
                '--model-as-asked', action='store_true', help='add no effect to the requested model'
            )

    def add_readings(self) -> None:
        """Add the options that describe the readings of a recording."""
        self.common(
            '--accelerometer-unit',
            metavar='UNIT',
            help='of the readings: m/s^2, g, mg, counts:16384/g',
        )
        self.common(
            '--gyroscope-unit',
            metavar='U',
            help='rad/s, deg/s, urad/s, ..., counts:16.4/(deg/s)',
        )
        self.common(
            '--increments',
            metavar='HZ',
            type=float,
            help='readings are increments between samples at this rate',
        )
        self.common('--axes', metavar='AXES', help='flu, frd, or forward, left, up: --axes=-x,y,-z')
        self.expert(
            '--nominal', metavar='FILE', help='units, scales and offsets of the readings, in a file'
        )

    def add_effects(self, add: Callable[..., Any]) -> None:
        """Add the option of effects in addition to the catalogue, by `common` or `expert`."""
        add(
            '--effects',
            dest='catalogue',
            metavar='FILE',
            help='YAML or calibration.yaml with additional effects',
        )


class Options(argparse.Namespace):
    """Parsed arguments of a verb."""

    def stand(self) -> Stand | None:
        """Return the table or arm, or None."""
        if self.urdf is None and self.imu_link is None:
            return self.table
        from imu_calibration.api.recordings import Arm

        return Arm(self.urdf, self.imu_link, self.table, self.up, self.allow_xacro)

    def choices(self) -> Choices:
        """Return the choices for a function of `api`."""
        from imu_calibration.api.choices import Choices

        choices = {}
        for name, value in vars(self).items():
            if name in Choices.__annotations__:
                choices[name] = value
        return cast(Choices, choices)

    def hints(self) -> dict[str, str]:
        """Return {key of an error: option}, of the options that this verb has."""
        return {key: '--' + key.replace('_', '-') for key in ERROR_KEYS if key in vars(self)}

    def page(self, name: str) -> Path | None:
        """Return the path of the page of `add_page`, None without --output."""
        if self.output is None:
            return None
        from imu_calibration.report.answer_page import page_in

        return page_in(self.output, name, force=self.force)

    def require_new(self, path: str) -> None:
        """Refuse to replace an existing file before any work is done, except with --force."""
        from imu_calibration.document.files import require_new

        require_new(path, force=self.force)

    def require_place(self, bags: Sequence[str]) -> None:
        """
        Refuse an output folder with a different result, except with --force.

        The folder is refused if it holds the result of another verb or of other inputs.
        """
        if not self.force:
            from imu_calibration.api.choices import provenance_with, require_same_inputs

            require_same_inputs(
                self.output,
                lambda: provenance_with(self.verb, bags, self.choices(), stand=self.stand()),
                report=not vars(self).get('no_report'),
            )

    def arguments_for(self, function: Callable) -> dict[str, Any]:
        """Return the options whose names are parameters of a function."""
        arguments = {}
        for name, value in vars(self).items():
            if name in signature(function).parameters:
                arguments[name] = value
        return arguments


def complain(text: str) -> None:
    """Print a line on standard error (`print_line`)."""
    print_line(text, stream=sys.stderr)


def print_line(text: str, indent: str = '', *, stream: TextIO | None = None) -> None:
    """
    Print a line on `stream` (standard output), broken between words at the width of a terminal.
    """
    Terminal.of(stream).print(text, indent=indent)


def folded(text: str, indent: str = '', last: str = '') -> str:
    """
    Return a line broken between words at the width of standard output.

    `last` ends every part except the last one, as a backslash of a shell.
    """
    return f'{last}\n'.join(wrapped(text, Terminal.of().width - len(last), indent))


def make_parser(verb: str | None = None) -> OneLineParser:
    """Return the parser of the plain command; `verb` as for `add_verbs`."""
    parser = OneLineParser(
        prog='imu_calibration',
        epilog=EXIT_CODES,
        description=(
            'Calibrate, compensate and diagnose inertial measurement units from recordings.'
        ),
    )
    parser.add_argument(
        '--version', action='version', version=f'imu_calibration {imu_calibration.__version__}'
    )
    add_verbs(parser, verb)
    return parser


def add_verbs(
    parser: argparse.ArgumentParser, verb: str | None = None, *, required: bool = True
) -> None:
    """
    Add the verbs to a parser; only the module of `verb` is imported and declares its arguments.

    An unknown verb is refused.
    """
    if verb is not None and not verb.startswith('-') and verb not in VERBS:
        complain(
            f'{parser.prog}: the verb must be one of {", ".join(VERBS)}, got'
            f" '{verb}'{did_you_mean(verb, VERBS)}; see '{parser.prog} --help'"
        )
        raise SystemExit(1)
    verbs = parser.add_subparsers(
        dest='verb', metavar='VERB', required=required, parser_class=OneLineParser
    )
    for name, text in VERBS.items():
        added = verbs.add_parser(
            name,
            help=text,
            description=folded(text),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name != verb:
            continue
        module = import_module(f'imu_calibration.cli.{name}')
        module.add_arguments(added)
        added.common('--json', action='store_true', help='print the result as one JSON document')
        added.common('--quiet', action='store_true', help='print errors and warnings only')
        added.common(
            '--verbose',
            action='store_true',
            help='print each phase with its time on standard error',
        )
        added.set_defaults(run=module.run, verb_options=sorted(added._option_string_actions))
        required_actions = [action for action in added._actions if action.required]
        added.usage = ' '.join(['%(prog)s', *map(_usage, required_actions), '[options]'])
        epilog = ['examples:']
        for arguments in module.EXAMPLES:
            example = f'  imu_calibration {name} {arguments}'.rstrip()
            epilog.append(folded(example, 6 * ' ', ' \\'))
        added.epilog = '\n'.join(epilog)


def _usage(action: argparse.Action) -> str:
    """Return a required argument as the usage line shows it."""
    name = str(action.metavar or action.dest.upper())
    if action.option_strings:
        return f'{action.option_strings[0]} {name}'
    return f'{name} [{name} ...]' if action.nargs == '+' else name
