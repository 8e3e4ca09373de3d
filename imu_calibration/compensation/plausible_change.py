"""
Whether a calibration changes the readings by more than an IMU of its kind can need.

The change is measured on corrected readings, not on parameters, so that an effect with a formula in
the document is bounded like the effects of the catalogue.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.compensation.compensate import FittedErrors, compensated_samples
from imu_calibration.core.units import STANDARD_GRAVITY, significant
from imu_calibration.effects.base import SENSORS, UNITS

MOST_OFFSET = {'accelerometer': 0.5, 'gyroscope': 0.1}
"""
Change of an offset, SI: 50 mg and 5.7 deg/s, the zero offsets in data sheets of consumer IMUs
(BMI088: 20 mg and 1 deg/s, ICM-20948: 50 mg and 5 deg/s). A few old parts exceed it (MPU-6050:
80 mg in z).
"""
MOST_SLOPE = 0.1
"""Change of an element of the matrix: the prior sd of `matrix` in the catalogue."""
PROBE_SIZE = {'accelerometer': STANDARD_GRAVITY, 'gyroscope': 2.0}
"""Readings at which two calibrations are compared: gravity on each axis, and turns of 115 deg/s."""
PROBE_TEMPERATURES_C = (0.0, 25.0, 50.0)
"""Temperatures at which effects of temperature are compared, degrees Celsius."""


@dataclass(frozen=True, eq=False)
class ProbeReadings:
    """Raw readings, or their correction, at the probes of one sensor."""

    force: np.ndarray
    """Specific force, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Angular rate, rad/s, shape (n, 3)."""

    def of(self, sensor: str) -> np.ndarray:
        """Return the readings of one sensor."""
        return self.force if sensor == 'accelerometer' else self.rate


def implausible_change(calibration: FittedErrors, reference: FittedErrors | None) -> str:
    """
    Return the change of readings that no IMU of this kind needs, with its limit; '' without one.

    With corrections d(+a), d(-a) of two calibrations at opposite readings +a, -a on one axis::

        offset = (d(+a) + d(-a)) / 2        at most `MOST_OFFSET`
        slope  = (d(+a) - d(-a)) / (2 |a|)  at most `MOST_SLOPE`

    The change of a sensor by the readings of the other sensor is at most `MOST_OFFSET`.

    Parameters
    ----------
    calibration : Calibration
        The new one.
    reference : Calibration, optional
        The one to compare with; None: uncorrected readings (matrix identity, bias zero).

    """
    for moving in SENSORS:
        axes = PROBE_SIZE[moving] * np.eye(3)
        # All +a first, then all -a; the other sensor reads zero.
        varied = np.concatenate([axes, -axes])
        still = np.zeros_like(varied)
        if moving == 'accelerometer':
            raw = ProbeReadings(varied, still)
        else:
            raw = ProbeReadings(still, varied)
        for temperature_c in PROBE_TEMPERATURES_C:
            new = _corrected(calibration, raw, temperature_c)
            old = raw if reference is None else _corrected(reference, raw, temperature_c)
            for sensor in SENSORS:
                change = new.of(sensor) - old.of(sensor)
                if sensor == moving:
                    text = _beyond(sensor, change, PROBE_SIZE[moving])
                else:
                    text = _beyond_offset(sensor, np.abs(change).max())
                if text:
                    return text
    return ''


def _corrected(
    calibration: FittedErrors, raw: ProbeReadings, temperature_c: float
) -> ProbeReadings:
    """Return the correction of readings without angular acceleration at one temperature."""
    corrected = compensated_samples(
        calibration,
        raw.force,
        raw.rate,
        alpha_s=np.zeros_like(raw.force),
        temperature_c=np.full(len(raw.force), temperature_c),
    )
    return ProbeReadings(corrected.force, corrected.rate)


def _beyond(sensor: str, change: np.ndarray, size: float) -> str:
    """
    Return a text on the limit that an offset or slope of a sensor exceeds; '' without one.

    `change` has the changes d(+a) on each axis, then d(-a), shape (6, 3), with |a| = `size`.
    """
    plus, minus = np.split(change, 2)
    offset = np.abs(plus + minus).max() / 2.0
    slope = np.abs(plus - minus).max() / (2.0 * size)
    # Written as "not within" because a reading that cannot be corrected is NaN.
    if not slope <= MOST_SLOPE:
        return (
            f'a change of the {sensor} matrix must be at most {MOST_SLOPE:g}, it is'
            f' {significant(slope)}'
        )
    return _beyond_offset(sensor, offset)


def _beyond_offset(sensor: str, offset: float) -> str:
    """Return a text on an offset beyond its limit; '' for one within it."""
    if not offset <= MOST_OFFSET[sensor]:
        return (
            f'a change of the {sensor} offset must be at most {MOST_OFFSET[sensor]:g}'
            f' {UNITS[sensor]}, it is {significant(offset)} {UNITS[sensor]}'
        )
    return ''
