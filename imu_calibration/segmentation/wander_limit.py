"""How long a moving window may be, so that the bias of a quiet accelerometer does not wander within it by more than noise hides."""

from collections import deque

import numpy as np

from imu_calibration.segmentation.window import Window, WindowKind

BEST_BIAS, BEST_TIME = 1e-4, 100.0
"""m/s^2 and s: the best accelerometers hold their bias to 10 ug over minutes (a Gauss-Markov process; field figures in `sensor_noise`)."""
PIECE = 0.25
"""Means over this time tell the noise at low frequency, s: longer than sensor filters."""
LEAST_PIECES = 4
SHORTEST = 2.5
"""Moving windows are not cut shorter, s."""


class WanderLimit:
    """
    The longest moving window that the noise at rest allows.

    Over T the mean of white noise of density d scatters by ``d / sqrt(T)``, a bias by about ``sd sqrt(2 T / time)``. They meet at
    ``T = d sqrt(time / 2) / sd``; a longer window holds a drift that least squares takes for scale factors and arms. That
    is 80 s at 120 ug/sqrt(Hz), and less than a second at 1 ug/sqrt(Hz).
    """

    def __init__(self) -> None:
        self._densities: deque[float] = deque(maxlen=9)

    def take(self, window: Window) -> None:
        """Learn from a window at rest."""
        length = int(round(PIECE / window.period)) if window.kind == WindowKind.STATIC and window.period > 0 else 0
        pieces = len(window) // length if length else 0
        if pieces >= LEAST_PIECES:
            means = window.force_s[:pieces * length].reshape(pieces, length, 3).mean(axis=1)
            self._densities.append(float(np.sqrt(np.median(np.diff(means, axis=0).var(axis=0) / 2) * length * window.period)))

    def longest(self, most: float) -> float:
        """Return the longest moving window, s, at most that which the settings allow; that one where no rest was seen yet."""
        if not self._densities:
            return most
        return min(most, max(SHORTEST, float(np.median(self._densities)) * np.sqrt(BEST_TIME / 2) / BEST_BIAS))
