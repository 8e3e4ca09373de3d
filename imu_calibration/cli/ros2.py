"""
``ros2 imu VERB``: the verbs of the plain command with the same options, output and exit codes.
"""

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from types import MethodType

from ros2cli.command import CommandExtension

from imu_calibration.cli.main import run
from imu_calibration.cli.parser import EXIT_CODES, OneLineParser, Options, add_verbs


class ImuCommand(CommandExtension):
    """Calibrate, compensate and diagnose inertial measurement units."""

    def add_arguments(
        self, parser: ArgumentParser, cli_name: str, *, argv: Sequence[str] | None = None
    ) -> None:
        """Add the verbs; of the one that is called, only its module is imported."""
        self._parser = parser
        parser.epilog = EXIT_CODES
        # One line, and the exit code of the plain command.
        setattr(parser, 'error', MethodType(OneLineParser.error, parser))
        words = list(sys.argv[1:] if argv is None else argv)
        command = cli_name.split()[-1]
        verb = None
        if command in words[:-1]:
            verb = words[words.index(command) + 1]
        add_verbs(parser, verb, required=False)

    def main(self, *, args: Namespace, **_: ArgumentParser) -> int:
        """
        Run the verb and return its exit code; without a verb print the list, as `ros2` commands do.
        """
        if getattr(args, 'verb', None) is None:
            self._parser.print_help()
            return 0
        return run(Options(**vars(args)))
