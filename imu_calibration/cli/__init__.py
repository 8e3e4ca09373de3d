"""The offline tool: ``imu_calibration VERB``."""

import sys

from imu_calibration.cli.parser import make_parser
from imu_calibration.errors import ImuCalibrationError


def main(arguments=None):
    """Run one verb; return the exit code (0 done, 1 refused, 3 written but not everything was determined or usable)."""
    options = make_parser().parse_args(arguments)
    try:
        return options.run(options)
    except ImuCalibrationError as error:
        print(f'imu_calibration {options.verb}: {error}', file=sys.stderr)
        return 1
    except BrokenPipeError:
        return 1
    except KeyboardInterrupt:
        print(f'imu_calibration {options.verb}: stopped; nothing was written', file=sys.stderr)
        return 1
