"""The offline tool: ``imu_calibration VERB``."""

import os
import sys
from argparse import Namespace
from collections.abc import Sequence

from imu_calibration.cli.hints import hints_of
from imu_calibration.errors import ImuCalibrationError

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
"""The matrices are narrow: threads of BLAS cost more than they give, above all where other programs run."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; return the exit code (0 done, 1 refused, 3 written but not everything was determined or usable)."""
    from imu_calibration.cli.parser import make_parser  # numpy counts its threads when it is imported
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    return run(make_parser(*arguments[:1]).parse_args(arguments))


def run(options: Namespace) -> int:
    """Run the verb that was parsed; return its exit code."""
    try:
        return options.run(options)
    except ImuCalibrationError as error:
        print(f'imu_calibration {options.verb}: {error.told(hints_of(options))}', file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print(f'imu_calibration {options.verb}: stopped; nothing was written', file=sys.stderr)
        return 1
