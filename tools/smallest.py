"""
The option ``--smallest`` of the scripts in benchmarks/ and validation/.

The option gives other options of the same script values with which its main path ends in seconds.
"""

import argparse


def add_smallest(parser: argparse.ArgumentParser, **values) -> None:
    """
    Add ``--smallest``, which gives the options `values`, by their names in the result.

    A figure of so small a run is not meaningful: scripts with targets print it and do not judge it.
    """
    shown = ', '.join(f'{name}: {value}' for name, value in values.items())

    class Smallest(argparse.Action):
        """Set all values; an option that follows replaces its own value again."""

        def __call__(self, _parser, namespace, _values, _option=None):
            vars(namespace).update(values, smallest=True)

    parser.add_argument(
        '--smallest',
        nargs=0,
        default=False,
        action=Smallest,
        help=f'a run of seconds, whose figures are not judged ({shown})',
    )
