"""Slow sway in rests by hand, which both sensors measure."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.kinematics.rotations import unit_rows

REST_PIECES = 8
"""Means per rest: the noise of the accelerometer hides the tilt of single samples."""
LEAST_CORRELATION = 2.5
"""
Correlation of both tilts, at least, times ``sqrt(2 k)`` for k rests: the noise of the gyroscope,
summed over a rest, gives about one independent value for each of the two axes across gravity.
"""


def sway_at_rest(
    forces: Sequence[np.ndarray], rates: Sequence[np.ndarray], length: np.ndarray
) -> float:
    """
    Return the rms tilt within rests that both sensors measure, rad; 0.0 without a significant one.

    The direction u of the specific force turns by ``du/dt = u x (rate - bias)``. With the changes
    m of u within the rests and p, the sum of the rates, ``tilt^2 = sum(p . m) / count``: noise of
    the two sensors is independent and averages to zero.

    Parameters
    ----------
    forces, rates : sequence of ndarray, shape (n, 3)
        Samples of each rest (m/s^2, rad/s).
    length : ndarray, shape (k,)
        Duration of each rest, s.

    """
    bias = np.mean([rate.mean(axis=0) for rate in rates], axis=0)
    shared = 0.0
    measured_power = 0.0
    predicted_power = 0.0
    n_rests = 0
    for force, rate, seconds in zip(forces, rates, length, strict=True):
        # Without readings for each piece, or with a mean force of zero, a rest does not count.
        size = len(force) // REST_PIECES
        mean_length = float(np.linalg.norm(force.mean(axis=0)))
        if not size or not mean_length > 0.0:
            continue

        # Direction by the accelerometer, and by the integral of the rates, less their means.
        direction = unit_rows(force)
        turned = np.cumsum(np.cross(direction, rate - bias), axis=0) * seconds / len(force)
        used = slice(0, size * REST_PIECES)
        measured = direction[used].reshape(REST_PIECES, size, 3).mean(axis=1)
        predicted = turned[used].reshape(REST_PIECES, size, 3).mean(axis=1)
        measured -= measured.mean(axis=0)
        predicted -= predicted.mean(axis=0)
        shared += float(np.sum(measured * predicted))
        measured_power += float(np.sum(measured**2))
        predicted_power += float(np.sum(predicted**2))
        n_rests += 1
    least = LEAST_CORRELATION * np.sqrt(measured_power * predicted_power / max(1, 2 * n_rests))
    if not shared > least:
        return 0.0
    return float(np.sqrt(shared / (n_rests * REST_PIECES)))
