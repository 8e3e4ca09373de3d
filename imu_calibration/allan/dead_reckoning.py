"""
The position error of dead reckoning, m, with a bias estimated at rest.

The position after t seconds is a weighted sum of the readings, ``(t - s)`` for specific force and ``g (t - s)^2 / 2`` for rates (a tilt
lets gravity in); the bias is the mean over the time before. The weights sum to zero, so that flicker and random walks have
a variance too.
"""

from collections.abc import Sequence

import numpy as np

from imu_calibration.allan.figures import AxisFigures, NoiseFigures
from imu_calibration.allan.processes import NoiseProcess, mean_covariance
from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.effects.base import SENSORS

FINEST, MOST_BLOCKS = 150, 1000
"""Blocks of the run at most, and of alignment and run together."""
RUNS = (1.0, 10.0, 60.0, 600.0)
"""Lengths of dead reckoning, s."""


def position_budget(figures: NoiseFigures) -> list[tuple[float, dict[str, float]]]:
    """Return the standard deviation of the position along one horizontal axis after each of `RUNS`, m, by sensor, of the worst axes."""
    return [(seconds, {sensor: max(_of_axis(axis, sensor, seconds) for axis in figures.sensor(sensor)) for sensor in SENSORS})
            for seconds in RUNS]


def _of_axis(axis: AxisFigures, sensor: str, seconds: float) -> float:
    processes = axis.processes()
    shares = position_sd([process for process, _ in processes], [coefficient for _, coefficient in processes], sensor, seconds=seconds)
    return float(np.sqrt((shares**2).sum()))


def position_sd(processes: Sequence[NoiseProcess], coefficients: Sequence[float], sensor: str, *, seconds: float,
                alignment: float = 60.0, gravity: float = STANDARD_GRAVITY) -> np.ndarray:
    """
    Return the standard deviation of the position by each process of one axis, m, shape (n_processes,).

    Parameters
    ----------
    processes : sequence of NoiseProcess
    coefficients : sequence of float
        Squares of the figures.
    sensor : str
        'accelerometer' or 'gyroscope'.
    seconds : float
        Length of the run.
    alignment : float
        Time at rest before it, over which the bias is averaged, s.
    gravity : float
        m/s^2.

    """
    after = int(np.ceil(min(FINEST, MOST_BLOCKS * seconds / (seconds + alignment))))
    step = seconds / after
    before = max(round(alignment / step), 1)
    until_end = (after - np.arange(after) - 0.5) * step
    weights = until_end * step if sensor == 'accelerometer' else 0.5 * gravity * until_end**2 * step
    weights = np.concatenate([np.full(before, -weights.sum() / before), weights])
    lag = (np.arange(before + after)[:, None] - np.arange(before + after)[None, :]) * step
    variances = [weights @ mean_covariance(process, lag, step) @ weights for process in processes]
    return np.sqrt(np.maximum(np.array(variances), 0.0) * np.asarray(coefficients, float))
