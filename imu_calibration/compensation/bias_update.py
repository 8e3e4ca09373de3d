"""The bias of a gyroscope tracked from stop to stop, with an uncertainty that grows after each stop."""

from dataclasses import dataclass

import numpy as np

EARTH_RATE = 7.292e-5
"""rad/s; a gyroscope at rest measures it about axes that are unknown here."""
MOST_MOVED = 0.02
"""rad/s, 1.1 deg/s: a calibrated bias that has moved farther is a slow turn, or a broken sensor."""


class GyroBiasUpdate:
    """
    The residual bias after compensation, a Gauss-Markov process that every stop measures.

    Between stops ``b <- phi b, P <- phi^2 P + (1 - phi^2) S^2`` with ``phi = exp(-dt / time)``; at a stop the Kalman update with the mean
    of the corrected rate. Without stops the update decays and its uncertainty returns to S: that of the calibration, or that of the stops
    if it is larger.

    Parameters
    ----------
    prior_sd : ndarray, shape (3,)
        Standard deviation of the bias in the calibration, rad/s.
    time : float
        Seconds in which an update loses its meaning.

    """

    def __init__(self, prior_sd: np.ndarray, time: float):
        prior = np.asarray(prior_sd, float)**2
        self._time, self._stop, self.n_stops = time, float('nan'), 0
        self._now = self._before = _State(np.zeros(3), prior, prior, np.zeros(3))

    def predict(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (bias, its variance) at `now`, s; rad/s and its square, each shape (3,)."""
        return self._now.after(now, self._time)[:2]

    def measure(self, start: float, now: float, *, rate: np.ndarray, variance: np.ndarray) -> bool:
        """
        Process the mean of the corrected rate over a stop until now; as the stop grows, the longer mean replaces the shorter one.

        Parameters
        ----------
        start, now : float
            Start of the stop, which identifies it, and the end of the mean, s.
        rate : ndarray, shape (3,)
            Without any update, rad/s.
        variance : ndarray, shape (3,)
            Of that mean; the Earth's rate is added here.

        Returns
        -------
        bool
            Whether it was accepted: a mean beyond any change of bias is a slow rotation.

        """
        if np.linalg.norm(rate) > MOST_MOVED:
            return False
        if start != self._stop:
            self._stop, self._before, self.n_stops = start, self._now, self.n_stops + 1
        variance = variance + EARTH_RATE**2 / 3
        bias, spread, seen, weight = self._before.after(now, self._time)
        seen, weight = seen + rate**2, weight + 1
        stationary = np.maximum(self._before.stationary, seen / weight)
        spread = spread + np.maximum(stationary - self._before.stationary, 0)   # it has been as wide before anybody saw it
        gain = spread / (spread + variance)
        self._now = _State(bias + gain * (rate - bias), (1 - gain) * spread, stationary, seen, weight, now)
        return True


@dataclass(frozen=True, eq=False)
class _State:
    bias: np.ndarray
    variance: np.ndarray
    stationary: np.ndarray
    """Variance without stops."""
    seen: np.ndarray
    """Sum of squares of the updates, with decreasing weight of older stops."""
    weight: float = 0.0
    at: float = 0.0

    def after(self, now, time):
        """Return (bias, variance, seen, weight) at `now`."""
        phi = np.exp(-max(now - self.at, 0.0) / time) if self.weight else 0.0
        return phi * self.bias, phi**2 * self.variance + (1 - phi**2) * self.stationary, phi * self.seen, phi * self.weight
