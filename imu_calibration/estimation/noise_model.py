"""Noise of a session: white noise within windows, an offset per window, a bias that wanders from window to window."""

from dataclasses import dataclass, field

import numpy as np

from imu_calibration.estimation.band_misfit import extra_weight


@dataclass(frozen=True, eq=False)
class WindowNoise:
    """
    Noise of one sensor.

    The mean of window k has variance ``white_variance * inflation / n_k + offset_sd^2`` and, with its neighbours in the
    same recording, the covariance ``wander_sd^2 exp(-|t_k - t_l| / wander_time) + session_variance``.
    """

    white_variance: np.ndarray
    """Variance of single samples, shape (3,)."""
    inflation: np.ndarray
    """Factor by which the noise at low frequency exceeds white noise of that variance, shape (3,)."""
    offset_sd: float = 0.0
    """Standard deviation of an independent offset per window."""
    wander_sd: float = 0.0
    """Standard deviation of a first-order Gauss-Markov wander of the bias."""
    wander_time: float = 100.0
    """Correlation time of the wander, s."""
    kind_scale: dict = field(default_factory=dict)
    """Kind -> factor on the variance of the centred rows, shape (3,): what moving windows scatter beyond the noise at rest."""
    slow_scale: dict = field(default_factory=dict)
    """Kind -> the same of their slow part, where that fits better than the fast part, shape (3,)."""
    session_sd: float = 0.0
    """Standard deviation of the bias from recording to recording; zero when the recordings agree or there is one."""
    session_variance: float = 0.0
    """Its square, larger when few recordings leave it uncertain: what weights and standard deviations are made with."""

    def sample_sd(self):
        """Return the standard deviation of single samples, shape (3,)."""
        return np.sqrt(self.white_variance)

    def within_sd(self, kind):
        """Return the standard deviation per centred row of windows of `kind`, shape (3,)."""
        return np.sqrt(self.white_variance * self.inflation * self.kind_scale.get(kind, np.ones(3)))

    def slow_weight(self, kind):
        """Return the weight of the slow part of centred rows of `kind` beside all of them at `within_sd`, shape (3,)."""
        if kind not in self.slow_scale:
            return np.zeros(3)
        unit = self.white_variance * self.inflation
        return extra_weight(unit * self.kind_scale[kind], unit * self.slow_scale[kind])

    def weighs_alike(self, other, change=0.05):
        """Return whether slow parts count no more than fast ones, or both as with `other`, to a relative change of their variances."""
        unit, other_unit = (noise.white_variance * noise.inflation for noise in (self, other))
        for kind, slow in self.slow_scale.items():
            every = self.kind_scale[kind]
            if np.all(slow == every):
                continue
            if kind not in other.slow_scale:
                return False
            pairs = ((every, other.kind_scale[kind]), (slow, other.slow_scale[kind]))
            if any(np.any(np.abs(unit * mine / (other_unit * its) - 1) > change) for mine, its in pairs):
                return False
        return True


def white_noise(rows, sensor):
    """
    Return (white_variance, inflation) pooled over static windows, each shape (3,), or None without static windows.

    Windows whose variance lies far from the median (clipped, knocked) are left out.
    """
    static = [row for row in rows if row.kind == 'static' and np.all(np.isfinite(row.sensors[sensor].noise_variance))]
    if not static:
        return None
    variances = np.array([row.sensors[sensor].noise_variance for row in static])
    inflations = np.array([row.sensors[sensor].inflation for row in static])
    counts = np.array([row.count for row in static], float)
    pooled, factors = np.empty(3), np.empty(3)
    for axis in range(3):
        median = np.median(variances[:, axis])
        near = (variances[:, axis] <= 2 * median) & (variances[:, axis] >= 0.5 * median)
        weight = counts * near
        pooled[axis] = np.average(variances[:, axis], weights=weight) if weight.sum() else median
        weight = (counts >= 32) * near
        factors[axis] = np.average(inflations[:, axis], weights=weight) if weight.sum() else 1.0
    floor = 1e-30 + np.finfo(float).eps**2 * np.max(np.abs([row.sensors[sensor].mean[-3:] for row in static]))**2
    return np.maximum(pooled, floor), np.clip(factors, 0.8, None)


def sessions_of(rows):
    """Return the index arrays of the rows of each recording, in order of time."""
    numbers = np.array([row.session for row in rows])
    times = np.array([row.time for row in rows])
    return [np.flatnonzero(numbers == number)[np.argsort(times[numbers == number], kind='stable')] for number in np.unique(numbers)]
