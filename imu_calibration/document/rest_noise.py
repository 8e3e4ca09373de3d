"""Noise at rest that no sensor has: the IMU moved while it was held."""

from collections.abc import Mapping

import numpy as np

from imu_calibration.core.units import error_text
from imu_calibration.effects.base import UNITS

MOVED_DENSITY = {'accelerometer': 0.02, 'gyroscope': 0.003}
"""
m/s^2/√Hz, rad/s/√Hz: about five times the densities of the noisiest grades of sensors (0.4 mg/√Hz,
0.03 deg/s/√Hz). Hands that hold an IMU still cause less than a tenth of it.
"""


def rest_density(by_hand: Mapping, sensor: str) -> float:
    """
    Return the noise density of a sensor at rest at low frequencies, SI/√Hz; 0 if unknown.

    ``sd * colour * sqrt(period)``, rms of the axes: `colour` is the factor over white noise that
    the means of pieces of the rests show.

    Parameters
    ----------
    by_hand : mapping
        Statistics of the poses (`Calibration.by_hand`).
    sensor : str

    """
    name = 'force' if sensor == 'accelerometer' else 'rate'
    if f'{name}_noise_sd' not in by_hand or 'period' not in by_hand:
        return 0.0
    per_sample = np.asarray(by_hand[f'{name}_noise_sd']) * by_hand[f'{name}_noise_colour']
    return float(np.sqrt(np.mean(per_sample**2) * by_hand['period']))


def moved_at_rest(by_hand: Mapping, sensor: str) -> str:
    """
    Return that the readings of a sensor at rest are those of an IMU that moved, or ''.

    Arguments as for `rest_density`.
    """
    density, limit = rest_density(by_hand, sensor), MOVED_DENSITY[sensor]
    if density <= limit:
        return ''
    unit = UNITS[sensor]
    return (
        f'the {sensor} scatters by {error_text(density, unit)}/√Hz where the IMU was held still,'
        f' noise of sensors is below {error_text(limit, unit)}/√Hz: it moved or vibrated'
    )
