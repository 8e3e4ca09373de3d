"""The noise of one sensor: white noise, offsets of means, bias processes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

NATURAL = 0.5
"""
Least sd of every bias process over the white noise of one second, with the first of these
correlation times.
"""
HOUR = 3600.0
"""s; sessions are hardly longer, and changes of a bias over days are constant within a session."""
DOF_FACTOR_MOST = 3.0
"""Largest factor by which a variance grows because it was itself estimated."""


@dataclass(frozen=True)
class BiasProcess:
    """
    First-order Gauss-Markov process of the bias.

    Covariance ``sd^2 exp(-|dt| / time)``, the same on all axes, independent.
    """

    sd: float
    """Standard deviation, m/s^2 or rad/s."""
    time: float
    """
    Correlation time, s; a random walk if long compared with the session; several processes at
    spaced times approximate flicker noise.
    """

    def within(self, duration: float) -> float:
        """
        Return the standard deviation about the mean over a duration, s.

        It is the part of the process that a recording of this duration shows. The variance is
        ``sd^2 (1 - 2 r (1 - r (1 - exp(-1 / r))))`` with r the correlation time over the duration.
        """
        ratio = self.time / duration
        if ratio <= 1e-6:
            return self.sd
        return self.sd * float(np.sqrt(1 + 2 * ratio * (ratio * -np.expm1(-1 / ratio) - 1)))


@dataclass(frozen=True, eq=False)
class SensorNoise:
    """
    Noise of one sensor: the white noise of its samples, and how far means scatter beyond it.

    The mean of n samples has the variance ``white_variance * inflation / n + offset_sd^2``, and
    that of the bias processes.
    """

    white_variance: np.ndarray
    """Variance of single samples at rest, shape (3,)."""
    inflation: np.ndarray
    """
    Factor by which the noise at low frequency exceeds white noise of that variance, shape (3,).
    """
    offset_sd: float = 0.0
    """Standard deviation of an independent offset per mean."""
    bias_processes: tuple[BiasProcess, ...] = ()
    """Processes of the bias between means."""

    @property
    def white_sd(self) -> np.ndarray:
        """Standard deviation of single samples at rest, shape (3,)."""
        return np.sqrt(self.white_variance)

    @property
    def low_variance(self) -> np.ndarray:
        """Variance of white noise that would scatter the means of samples as much, shape (3,)."""
        return self.white_variance * self.inflation

    @property
    def bias_variance(self) -> float:
        """Variance of all bias processes together, of slow ones within an hour."""
        return sum(process.sd**2 * min(1.0, HOUR / process.time) for process in self.bias_processes)


def means_beside_middles(
    processes: Sequence[BiasProcess], durations: np.ndarray | float
) -> np.ndarray:
    """
    Return the variance of (mean over a window minus value in its middle) of bias processes.

    `durations`: lengths of the windows, s. For a random walk with ``2 sd^2 / time`` per second it
    is ``sd^2 T / (6 time)``. It decreases in windows longer than the correlation time, where the
    value in the middle overstates the variance of the mean.
    """
    total = np.zeros(np.shape(durations))
    for process in processes:
        step = np.asarray(durations, float) / (6 * process.time)
        total = total + process.sd**2 * step / (1 + (3 * step) ** 2)
    return total


def dof_factor(dof: np.ndarray | float) -> np.ndarray:
    """
    Return dof / (dof - 2), the variance of the t distribution, at most DOF_FACTOR_MOST.

    Factor on a variance from few data.
    """
    return np.minimum(dof / np.maximum(np.subtract(dof, 2), 1e-9), DOF_FACTOR_MOST)
