"""Arguments of the offline tool."""

import argparse
import sys

import imu_calibration
from imu_calibration.cli import compare, compensate, fleet, inspect, relative, simulate
from imu_calibration.cli import calibrate as calibrate_verb
from imu_calibration.cli import diagnose as diagnose_verb

VERBS = (inspect, calibrate_verb, compensate, diagnose_verb, simulate, compare, relative, fleet)


class OneLineParser(argparse.ArgumentParser):
    """Refuses with one line and exit code 1."""

    def error(self, message):
        """Print what is wrong and stop."""
        print(f"{self.prog}: {message}; see '{self.prog} --help'", file=sys.stderr)
        raise SystemExit(1)


def make_parser():
    """Return the parser; each verb brings its own arguments."""
    parser = OneLineParser(prog='imu_calibration', description='Calibrate, compensate and diagnose inertial measurement units from recordings.',
                           epilog='Exit codes: 0 done; 1 refused, nothing written; 3 written, but some parameters were not determined or '
                                  'part of the input was lost.')
    parser.add_argument('--version', action='version', version=f'imu_calibration {imu_calibration.__version__}')
    verbs = parser.add_subparsers(dest='verb', metavar='VERB', required=True, parser_class=OneLineParser)
    for module in VERBS:
        verb = verbs.add_parser(module.NAME, help=module.HELP, description=module.HELP)
        module.add_arguments(verb)
        verb.set_defaults(run=module.run)
    return parser
