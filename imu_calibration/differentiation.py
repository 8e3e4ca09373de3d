"""Angular acceleration from the measured rate: a causal filter whose delay and noise are known."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CausalDerivative:
    """
    Slope of a straight line through the last `taps` samples of the rate.

    The slope is that of the middle of the window: the delay is ``(taps - 1) / 2`` periods. The noise of the slope is
    ``rate_sd * sqrt(12 / (taps (taps^2 - 1))) / period``, the smallest that a linear filter of that length can have.
    """

    taps: int
    """Number of samples, at least 2."""
    period: float
    """Sampling period, s."""

    @property
    def delay(self):
        """Delay of the angular acceleration, s."""
        return (self.taps - 1) / 2 * self.period

    @property
    def weights(self):
        """Weights of the newest to the oldest sample, 1/s, shape (taps,)."""
        index = (self.taps - 1) / 2 - np.arange(self.taps)
        return index / (index @ index) / self.period

    def noise_sd(self, rate_sd):
        """Return the standard deviation of the angular acceleration for white rate noise, rad/s^2."""
        return rate_sd * np.sqrt(12.0 / (self.taps * (self.taps**2 - 1.0))) / self.period


def choose_derivative(period, rate_sd, arm, force_sd, largest_delay=0.02):
    """
    Return the shortest window whose noise, through the arm, stays below a third of the accelerometer's own noise.

    Parameters
    ----------
    period : float
        Sampling period, s.
    rate_sd, force_sd : float
        Noise of single samples, rad/s and m/s^2; when one is unknown (zero) the window has half the largest delay.
    arm : float
        Longest lever arm that the correction takes out, m.
    largest_delay : float
        The window does not grow beyond this delay, s.

    """
    longest = max(2, int(2 * largest_delay / period) + 1)
    if not (rate_sd > 0 and force_sd > 0):
        return CausalDerivative((longest + 2) // 2, period)
    for taps in range(2, longest + 1):
        derivative = CausalDerivative(taps, period)
        if derivative.noise_sd(rate_sd) * arm <= force_sd / 3:
            return derivative
    return CausalDerivative(longest, period)
