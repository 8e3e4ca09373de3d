"""White noise from windows at rest, and the variance of the means of vibrating windows."""

from collections.abc import Sequence

import numpy as np

LEAST_INFLATION, LEAST_SHAKEN = 0.8, 0.01
"""Least noise at low frequency as a share of white noise of the same variance, at rest and under vibration."""
LEAST_NOISE = {'accelerometer': 1e-6, 'gyroscope': 1e-7}
"""Least noise of a sample, m/s^2 and rad/s: readings of a noise-free simulator are exact except for stamps in integer ns."""
VIBRATES = 4.0
"""A table vibrates in a window whose variance exceeds the quiet level by this factor."""


def white_noise(rows: Sequence, sensor: str) -> tuple[np.ndarray, np.ndarray] | None:
    """
    Return (white_variance, inflation) pooled over static windows, each shape (3,), or None without static windows.

    Windows whose variance differs from the median by more than a factor of two (clipped, knocked) are excluded. If vibration varies, the
    reference is the quietest level instead of the median, because vibration hardly affects the means.

    Parameters
    ----------
    rows : sequence of WindowStatistics

    """
    static = [row for row in rows if row.kind == 'static' and np.all(np.isfinite(row.sensors[sensor].noise_variance))]
    if not static:
        return None
    rounding = np.array([row.sensors[sensor].noise_variance for row in rows if row.kind != 'static']).reshape(-1, 3)
    floor = np.min(np.where(rounding > 0, rounding, np.inf), axis=0, initial=np.inf)   # a code may be constant at rest
    variances = np.maximum([row.sensors[sensor].noise_variance for row in static], np.where(np.isfinite(floor), floor, 0.0))
    inflations = np.array([row.sensors[sensor].inflation for row in static])
    counts = np.array([row.count for row in static], float)
    pooled, factors = np.empty(3), np.empty(3)
    for axis in range(3):
        usual, shaken = _usual(variances[:, axis], inflations[:, axis])
        near = (variances[:, axis] <= 2 * usual) & (variances[:, axis] >= 0.5 * usual)
        weight = counts * near
        pooled[axis] = np.average(variances[:, axis], weights=weight) if weight.sum() else usual
        weight = (counts >= 32) * near
        factors[axis] = np.average(inflations[:, axis], weights=weight) if weight.sum() else 1.0
        factors[axis] = max(factors[axis], LEAST_SHAKEN if shaken else LEAST_INFLATION)
    return np.maximum(pooled, LEAST_NOISE[sensor]**2), factors


def _usual(variances, inflations):
    """Return (the median variance, False); where most windows vibrate far above the band of their means, (the second least, True)."""
    median = float(np.median(variances))
    quiet = float(np.partition(variances, 1)[1]) if len(variances) > 3 else median
    louder = variances > VIBRATES * quiet
    shaken = 0.0 < VIBRATES * quiet < median and float(np.median(inflations[louder])) < LEAST_INFLATION
    return (quiet if shaken else median), shaken


def shaken_means(rows: Sequence, sensor: str) -> dict[tuple[int, float], np.ndarray]:
    """Return `NoiseModel.shaken` of a sensor, for each rest whose vibration exceeds the quiet level."""
    static = [row for row in rows if row.kind == 'static' and np.all(np.isfinite(row.sensors[sensor].noise_variance))]
    if not static:
        return {}
    variances, inflations = (np.array([getattr(row.sensors[sensor], name) for row in static]) for name in ('noise_variance', 'inflation'))
    own = np.zeros(variances.shape)
    for axis in range(3):
        quiet, shaken = _usual(variances[:, axis], inflations[:, axis])
        loud = (variances[:, axis] > VIBRATES * quiet) & shaken
        own[loud, axis] = variances[loud, axis] * inflations[loud, axis]
    return {(row.session, row.time): each / row.count for row, each in zip(static, own) if each.any()}
