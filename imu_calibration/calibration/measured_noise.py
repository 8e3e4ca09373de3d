"""Noise measured at rest instead of the noise estimated within the windows of a calibration."""

from dataclasses import replace

import numpy as np

from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.calibration.document import Calibration
from imu_calibration.effects.base import SENSORS


def with_measured_noise(calibration: Calibration, figures: NoiseFigures) -> Calibration:
    """
    Return the calibration with the white noise of noise.yaml in its statistics.

    `noise_density` (per root hertz, by axis) gives the standard deviation of a sample at any rate; `noise_sd` is that at the rate at
    which the noise was recorded. Compensation and its covariances read both through `Calibration.noise`.
    """
    statistics = dict(calibration.statistics)
    for sensor in SENSORS:
        density = np.array([axis.white for axis in figures.sensor(sensor)])
        statistics[sensor] = dict(statistics.get(sensor, {})) | {
            'noise_sd': (density * np.sqrt(figures.rate)).tolist(), 'noise_density': density.tolist()}
    return replace(calibration, statistics=statistics)
