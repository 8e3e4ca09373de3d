"""Arguments of the offline tool: the verbs, options that every verb has, and refusals in one line."""

import argparse
import sys
from argparse import Namespace
from collections.abc import Mapping
from importlib import import_module
from shutil import get_terminal_size
from typing import Any, NamedTuple, NoReturn, TextIO

import imu_calibration
from imu_calibration.cli.terminal import wrapped
from imu_calibration.core.errors import ERROR_KEYS, did_you_mean

VERBS = {
    'inspect': 'Topics, rates, gaps, stamps, suspicious units and axes, motions found, and the parameters that the recording determines.',
    'calibrate': 'Write calibration.yaml and report.html from one or several recordings of the same IMU.',
    'compensate': 'Write a bag with the corrected Imu topic in addition to all other topics.',
    'check': 'Test a calibration on a recording: errors before and after, by sensor and by motion.',
    'diagnose': 'Find the errors of the model, name their causes, extend the model, and measure the gain on held-out data.',
    'simulate': 'Write a bag of a simulated session on a turntable, with truth.yaml.',
    'compare': 'Test whether two calibrations agree, in units of their combined standard deviation.',
    'arm': 'Position of one IMU relative to another on the same rigid body, from their measurements in motion.',
    'fleet': 'Calibrate a folder of many units: one result each, and a summary table with the spread of each parameter.',
    'noise': 'Identify white noise, bias instability and random walk from a recording at rest: noise.yaml and report.html.',
    'plan': 'Plan the motions that bring every parameter within its tolerance: plan.yaml, a joint trajectory and report.html.',
    'convert': 'Write a text log (CSV) as a bag; columns and units are found from the header and the values, and printed.',
    'export': 'Write a calibration and its noise in the format of another program, and state the information that is lost.',
    'import': 'Read the calibration of another program, so that it can be compared and used.',
    'effects': 'List the catalogue of effects: sensor, unit, tolerance, equation, and the motion that determines each.',
    'watch': 'Watch a running calibration_node: bars in units of tolerance, next motion, streams, first finding.',
    'view': 'Write an MCAP for Foxglove: residual before and after, coverage, parameters with bands, spectrum of the residual.',
}
"""Name -> one line of help; each is a module of this package with EXAMPLES, `add_arguments` and `run`."""

EXIT_CODES = ('Exit codes: 0 done; 1 refused, nothing written; 3 written, but a parameter is not determined, a sensor is unproven or '
              'harmful, or part of the input was unusable; 130 interrupted.')


class VerbResult(NamedTuple):
    """Result of a verb."""

    exit_code: int
    """See `EXIT_CODES`."""
    document: Mapping[str, Any] = {}
    """The result as data, printed by --json."""


class OneLineParser(argparse.ArgumentParser):
    """Refuses with one line and exit code 1; options are in the groups `common` and `expert`."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{'add_help': False, **options})
        self.common = self.add_argument_group('common options')
        self.expert = self.add_argument_group('expert options')
        self.common.add_argument('-h', '--help', action='help', help='print this page')

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; an unknown option is refused with the closest known one."""
        options, extra = self.parse_known_args(args, namespace)
        if extra:
            known = getattr(options, 'verb_options', ())
            self.prog += f' {options.verb}'
            self.error(f'unrecognized arguments: {" ".join(extra)}{did_you_mean(extra[0].partition("=")[0], known)}')
        return options

    def error(self, message: str) -> NoReturn:
        """Print the requirement and stop."""
        complain(f"{self.prog}: {message}; see '{self.prog} --help'")
        raise SystemExit(1)


def complain(text: str) -> None:
    """Print a line on standard error (`print_line`)."""
    print_line(text, stream=sys.stderr)


def print_line(text: str, indent: str = '', *, stream: TextIO | None = None) -> None:
    """Print a line on `stream` (standard output), broken between words at the width of a terminal."""
    print(folded(text, indent, stream=stream), file=stream or sys.stdout)


def folded(text: str, indent: str = '', last: str = '', *, stream: TextIO | None = None) -> str:
    """Return a line for `stream` (standard output), broken between words at the width of a terminal; `last` ends each but the last part."""
    if not (stream or sys.stdout).isatty():
        return text
    return f'{last}\n'.join(wrapped(text, get_terminal_size().columns - len(last), indent))


def make_parser(verb: str | None = None) -> OneLineParser:
    """Return the parser of the plain command; `verb` as for `add_verbs`."""
    parser = OneLineParser(prog='imu_calibration', epilog=EXIT_CODES,
                           description='Calibrate, compensate and diagnose inertial measurement units from recordings.')
    parser.add_argument('--version', action='version', version=f'imu_calibration {imu_calibration.__version__}')
    add_verbs(parser, verb)
    return parser


def add_verbs(parser: argparse.ArgumentParser, verb: str | None = None, *, required: bool = True) -> None:
    """Add the verbs to a parser; only the module of `verb` is imported and declares its arguments; an unknown verb is refused."""
    if verb is not None and not verb.startswith('-') and verb not in VERBS:
        complain(f"{parser.prog}: the verb must be one of {', '.join(VERBS)}, got '{verb}'{did_you_mean(verb, VERBS)}; "
                 f"see '{parser.prog} --help'")
        raise SystemExit(1)
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=required, parser_class=OneLineParser)
    for name, text in VERBS.items():
        added = verbs.add_parser(name, help=text, description=folded(text), formatter_class=argparse.RawDescriptionHelpFormatter)
        if name != verb:
            continue
        module = import_module(f'imu_calibration.cli.{name}')
        module.add_arguments(added)
        added.common.add_argument('--json', action='store_true', help='print the result as one JSON document')
        added.common.add_argument('--quiet', action='store_true', help='print errors and warnings only')
        added.common.add_argument('--verbose', action='store_true', help='print each phase with its time on standard error')
        added.set_defaults(run=module.run, verb_options=sorted(added._option_string_actions))
        words = [action for action in added._actions if action.required]
        added.usage = ' '.join(['%(prog)s', *map(_usage, words), '[options]'])
        examples = (f'  imu_calibration {name} {example}'.rstrip() for example in module.EXAMPLES)
        added.epilog = '\n'.join(['examples:', *(folded(example, 6 * ' ', ' \\') for example in examples)])


def _usage(action):
    """Return a required argument as the usage line shows it."""
    name = action.metavar or action.dest.upper()
    return f'{action.option_strings[0]} {name}' if action.option_strings else f'{name} [{name} ...]' if action.nargs == '+' else name


def hints_of(options: Namespace) -> dict[str, str]:
    """Return {key of an error: option}, of the options that this verb has."""
    return {key: '--' + key.replace('_', '-') for key in ERROR_KEYS if key in vars(options)}
