"""The assumed noise of a plan: that of a grade, or the result of an Allan analysis."""

import numpy as np

from imu_calibration.allan.bias_processes import bias_processes
from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.effects.base import SENSORS
from imu_calibration.errors import InputError
from imu_calibration.estimation.noise_model import BiasProcess, NoiseModel
from imu_calibration.simulation.sensor_noise import GRADES, SimulatedNoise


def noise_of_grade(noise: SimulatedNoise, rate: float) -> dict[str, NoiseModel]:
    """
    Return sensor -> NoiseModel of the samples of a simulated IMU: white noise, and a bias that wanders by its instability.

    Parameters
    ----------
    noise : SimulatedNoise
    rate : float
        Samples per second.

    """
    figures = {'accelerometer': (noise.accel_density, noise.accel_instability, noise.accel_resolution),
               'gyroscope': (noise.gyro_density, noise.gyro_instability, noise.gyro_resolution)}
    return {sensor: NoiseModel(np.full(3, density**2 * rate + resolution**2 / 12), np.ones(3),
                               bias_processes=(BiasProcess(instability, noise.correlation_time),) if instability > 0 else ())
            for sensor, (density, instability, resolution) in figures.items()}


def expected_noise(figures: NoiseFigures | None, grade: str, rate: float) -> dict[str, NoiseModel]:
    """Return sensor -> NoiseModel of samples at `rate` (Hz): the identified model, or that of a grade."""
    require_grade(grade)
    return noise_of_grade(GRADES[grade].noise, rate) if figures is None else noise_of_figures(figures, rate)


def require_grade(grade: str) -> None:
    """Refuse a grade that is none with an InputError."""
    if grade not in GRADES:
        raise InputError(f"the grade must be one of {', '.join(sorted(GRADES))}, got '{grade}'; choose one, or give the noise")


def noise_of_figures(figures: NoiseFigures, rate: float) -> dict[str, NoiseModel]:
    """Return sensor -> NoiseModel of samples at `rate` (Hz) from identified noise, its slow part as Gauss-Markov processes."""
    slow = bias_processes(figures)
    return {sensor: NoiseModel(np.array([axis.white**2 * rate for axis in figures.sensor(sensor)]), np.ones(3), bias_processes=slow[sensor])
            for sensor in SENSORS}
