"""An IMU with one sensor: an accelerometer without a gyroscope, or the reverse."""

from dataclasses import replace

import numpy as np

from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.units import STANDARD_GRAVITY

MIN_ABSENT_SAMPLES = 2000
"""
Samples without a finite reading of a sensor after which it counts as absent, where the other sensor
has readings; some drivers start one sensor later. A shorter stream decides at its end.
"""
PLACEHOLDERS = {
    'accelerometer': (0.0, 0.0, STANDARD_GRAVITY),
    'gyroscope': (0.0, 0.0, 0.0),
}
"""Constant columns of an absent sensor, SI: finite, so that they are at rest all the time."""


class SensorPresence:
    """
    Finds which sensors an IMU stream has, independent of its division into pieces.

    The first samples are buffered until both sensors have a finite reading, or one is absent.
    A message states absence by a covariance of -1, a text log by missing columns; both are
    NaN in the samples.
    """

    def __init__(self) -> None:
        self.absent: tuple[str, ...] = ()
        """The sensor that counts as absent."""
        self.n_late = 0
        """Samples with a reading of the absent sensor, which is not used."""
        # Whether it is known which sensors exist, and the samples that were received before.
        self._is_decided = False
        self._buffered: ImuSamples | None = None

    def push(self, samples: ImuSamples) -> ImuSamples:
        """Return the samples that can be processed, none while it is not known which exist."""
        if self._is_decided:
            return self._without_absent(samples)
        samples = samples.after(self._buffered)
        missing = missing_sensors(samples.select(slice(MIN_ABSENT_SAMPLES)))
        if missing and len(samples) < MIN_ABSENT_SAMPLES:
            self._buffered = samples
            return samples.select(slice(0))
        return self._decide(missing, samples)

    def finish(self) -> ImuSamples | None:
        """Return the buffered samples, or None."""
        if self._buffered is None:
            return None
        return self._decide(missing_sensors(self._buffered), self._buffered)

    def _decide(self, missing: tuple[str, ...], samples: ImuSamples) -> ImuSamples:
        """Decide by the sensors that are missing in the first samples, and return these."""
        self._is_decided = True
        self._buffered = None
        # Without a reading of either sensor the samples are not finite, and none is absent.
        if len(missing) == 1:
            self.absent = missing
        return self._without_absent(samples)

    def _without_absent(self, samples: ImuSamples) -> ImuSamples:
        """Return samples with placeholders for the readings of the absent sensor."""
        if not self.absent:
            return samples
        sensor = self.absent[0]
        readings = samples.force_s if sensor == 'accelerometer' else samples.rate_s
        self.n_late += int(np.count_nonzero(np.isfinite(readings).all(axis=1)))
        return without_sensor(samples, sensor)


def without_sensor(samples: ImuSamples, sensor: str) -> ImuSamples:
    """Return samples with constant readings of a sensor, which is marked as absent."""
    constant = np.tile(PLACEHOLDERS[sensor], (len(samples), 1))
    if sensor == 'accelerometer':
        return replace(samples, force_s=constant, absent=(sensor,))
    return replace(samples, rate_s=constant, absent=(sensor,))


def missing_sensors(samples: ImuSamples) -> tuple[str, ...]:
    """Return the sensors without a finite reading."""
    readings_of = {'accelerometer': samples.force_s, 'gyroscope': samples.rate_s}
    missing = []
    for sensor, readings in readings_of.items():
        if not np.isfinite(readings).all(axis=1).any():
            missing.append(sensor)
    return tuple(missing)
