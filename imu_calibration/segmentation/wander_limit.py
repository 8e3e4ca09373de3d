"""Largest length of a moving window for which the bias change of a quiet accelerometer is below the noise."""

from collections import deque
from math import ceil

import numpy as np

from imu_calibration.constants import STANDARD_GRAVITY
from imu_calibration.segmentation.window import PhasedSamples

BEST_BIAS, BEST_TIME = 1e-4, 100.0
"""m/s^2 and s: the best accelerometers hold their bias to 10 ug over minutes (a Gauss-Markov process; field figures in `sensor_noise`)."""
PIECE = 0.25
"""Duration of the means from which noise at low frequency is estimated, s: longer than sensor filters."""
LEAST_PIECES = 4
SHORTEST = 5.0
"""Least length of moving windows, s."""


class WanderLimit:
    """
    The longest moving window that the noise at rest allows.

    Over T the sd of the mean of white noise of density d is ``d / sqrt(T)``, of a bias about ``sd sqrt(2 T / time)``. They are equal at
    ``T = d sqrt(time / 2) / sd``; in a longer window, drift biases scale factors and arms. That
    is 80 s at 120 ug/sqrt(Hz), and less than a second at 1 ug/sqrt(Hz). Where the change of gravity during the jitter of the stamps
    exceeds the noise, the reference limits the accuracy, and means over short windows would contain its errors instead.
    """

    def __init__(self) -> None:
        self._densities: deque[float] = deque(maxlen=9)

    def rested(self, samples: PhasedSamples) -> None:
        """Estimate the noise density from a window at rest."""
        period = _period(samples)
        length = int(round(PIECE / period)) if period > 0 else 0
        pieces = len(samples) // length if length else 0
        if pieces >= LEAST_PIECES:
            means = samples.force_s[:pieces * length].reshape(pieces, length, 3).mean(axis=1)
            self._densities.append(float(np.sqrt(np.median(np.diff(means, axis=0).var(axis=0) / 2) * length * period)))

    def pieces(self, samples: PhasedSamples) -> int:
        """Return the number of windows into which motion is cut; one if no rest has occurred yet."""
        if not self._densities or len(samples) < 3:
            return 1
        density = float(np.median(self._densities))
        jitter = np.diff(samples.time, 2).std() / np.sqrt(6)
        if STANDARD_GRAVITY * np.sqrt((samples.rate_s**2).sum(axis=1).mean()) * jitter * np.sqrt(_period(samples)) > density:
            return 1
        longest = max(SHORTEST, density * np.sqrt(BEST_TIME / 2) / BEST_BIAS)
        return ceil((samples.time[-1] - samples.time[0]) / longest)


def _period(samples):
    return (samples.time[-1] - samples.time[0]) / max(len(samples) - 1, 1)
