"""Noise at rest that no sensor has, or a tilt: the IMU moved while it was held."""

from collections.abc import Mapping, Sequence

import numpy as np

from imu_calibration.core.units import error_text
from imu_calibration.effects.base import UNITS

MOVED_DENSITY = {'accelerometer': 0.02, 'gyroscope': 0.003}
"""
m/s^2/√Hz, rad/s/√Hz: about five times the densities of the noisiest grades of sensors (0.4 mg/√Hz,
0.03 deg/s/√Hz). Hands that hold an IMU still cause less than a tenth of it.
"""

MOVED_TILT = 3e-4
"""
rad: tilt within the rests from which on an IMU swayed. Its rates then scatter by more than
1 mrad/s from rest to rest, and most longer rests are cut.
"""


def rest_density(by_hand: Mapping, sensor: str) -> float:
    """
    Return the noise density of a sensor at rest at low frequencies, SI/√Hz; 0 if unknown.

    It is ``sd * colour * sqrt(period)``, rms of the axes: `colour` is the sd of means of pieces of
    the rests over that by white noise.

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
    Return the statement that the IMU moved, if a sensor at rest is too noisy, or ''.

    Arguments as for `rest_density`.
    """
    density = rest_density(by_hand, sensor)
    limit = MOVED_DENSITY[sensor]
    if density <= limit:
        return ''
    unit = UNITS[sensor]
    return (
        f'the {sensor} scatters by {error_text(density, unit)}/√Hz where the IMU was held still,'
        f' noise of sensors is below {error_text(limit, unit)}/√Hz: it moved or vibrated'
    )


def swayed_at_rest(by_hand: Mapping) -> str:
    """
    Return the statement that the IMU tilted, if both sensors measure it at rest, or ''.

    Arguments as for `rest_density`.
    """
    tilt = by_hand.get('sway', 0.0)
    if tilt <= MOVED_TILT:
        return ''
    return (
        f'the IMU tilted by {1e3 * tilt:.2g} mrad (rms) where it was held still, as both sensors'
        ' measure: it moved'
    )


def motions_at_rest(by_hand: Mapping, sensors: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return statement -> sensors that it concerns, for each motion of an IMU held still."""
    motions: dict[str, tuple[str, ...]] = {}
    for sensor in sensors:
        text = moved_at_rest(by_hand, sensor)
        if text:
            motions[text] = (sensor,)
    if not motions:
        text = swayed_at_rest(by_hand)
        if text:
            motions[text] = tuple(sensors)
    return motions
