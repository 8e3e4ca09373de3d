"""Options of the command line for the keys of errors."""

from argparse import Namespace

from imu_calibration.errors import KEYS


def hints_of(options: Namespace) -> dict[str, str]:
    """Return {key of an error: option}, of the options that this verb has."""
    return {key: '--' + key.replace('_', '-') for key in KEYS if key in vars(options)}
