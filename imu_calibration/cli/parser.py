"""Arguments of the offline tool."""

import argparse
import sys
from importlib import import_module
from typing import NoReturn

import imu_calibration

VERBS = ('inspect', 'calibrate', 'compensate', 'check', 'diagnose', 'simulate', 'compare', 'arm', 'fleet', 'noise', 'plan', 'convert',
         'export', 'import', 'watch', 'view')
"""Each is a module of this package with NAME, HELP, `add_arguments` and `run`."""


class OneLineParser(argparse.ArgumentParser):
    """Refuses with one line and exit code 1."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong and stop."""
        print(f"{self.prog}: {message}; see '{self.prog} --help'", file=sys.stderr)
        raise SystemExit(1)


EXIT_CODES = ('Exit codes: 0 done; 1 refused, nothing written; 3 written, but some parameters were not determined or part of the input '
              'was lost.')


def make_parser(verb: str | None = None) -> OneLineParser:
    """Return the parser of the plain command; `verb` as for `add_verbs`."""
    parser = OneLineParser(prog='imu_calibration', epilog=EXIT_CODES,
                           description='Calibrate, compensate and diagnose inertial measurement units from recordings.')
    parser.add_argument('--version', action='version', version=f'imu_calibration {imu_calibration.__version__}')
    add_verbs(parser, verb)
    return parser


def add_verbs(parser: argparse.ArgumentParser, verb: str | None = None, *, required: bool = True) -> None:
    """Add the verbs to a parser; each brings its own arguments. When `verb` is one, only its module is imported, which is faster."""
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=required, parser_class=OneLineParser)
    for name in [verb] if verb in VERBS else VERBS:
        module = import_module(f'imu_calibration.cli.{name}')
        verb = verbs.add_parser(module.NAME, help=module.HELP, description=module.HELP)
        module.add_arguments(verb)
        verb.set_defaults(run=module.run)
