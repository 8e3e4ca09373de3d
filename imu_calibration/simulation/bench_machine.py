"""A machine next to the table, for sensors with biases that depend on vibration: off, or in one of several gears."""

import numpy as np

LOUDEST = 0.25
"""Its rms in the band of each axis in its loudest gear, m/s^2."""
GEARS, HOLD = (0.0, 1.0, 0.5, 0.0, 0.75), 11.0
"""Sequence of relative amplitudes of its gears, and time in each gear, s."""
ALIASED = 0.31
"""Frequency to which the sampling brings it, of the sample rate."""


def hum_and_variance(time: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the contribution of the machine to the specific force, m/s^2, and its variance, (m/s^2)^2, each shape (n, 3).

    Parameters
    ----------
    time : ndarray, shape (n,)
        Seconds.
    rate : float
        Samples per second.

    """
    loudness = LOUDEST * np.array(GEARS)[(np.asarray(time) // HOLD).astype(int) % len(GEARS)][:, None]
    return np.sqrt(2.0) * loudness * np.sin(2 * np.pi * ALIASED * rate * time[:, None] + np.arange(3.0)), np.tile(loudness**2, 3)
