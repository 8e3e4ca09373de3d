"""Slow tilts within a rest, which both sensors measure and no bias explains."""

import numpy as np

LEAST_REST_CHUNKS = 80
"""Chunks of a rest, at least."""
MEAN_SECONDS = 1.0
"""
Time over which directions are averaged where the rest is long enough, s: the noise of the
accelerometer hides small tilts, and faster motions are found by their rates.
"""
SEGMENT_SECONDS = 100.0
"""
Time within which tilts are compared, s: over longer ones the sum of a gyroscope's noise exceeds
small tilts.
"""
DRIFT_DEGREE = 4
"""
Degree of the polynomial removed from both in each segment: warm-up, drift, and the bias in the sum
of the rates.
"""
LEAST_TILT = 5e-4
"""Rms tilt from which on it is motion, rad."""
LEAST_EXPLAINED_TILT = 0.8
"""Share of the changes of gravity's direction that the rates explain, at least."""
MOST_FACTOR = 1.4
"""Ratio of both tilts, at most: scales are off by less."""


def tilt_at_rest(time: np.ndarray, mean: np.ndarray) -> float:
    """
    Return the rms tilt of a rest that both sensors measure, rad; 0.0 for none.

    The direction u of the specific force turns by ``du/dt = u x (rate - bias)``. The bias of the
    accelerometer changes u too, without the rates, and the bias of the gyroscope changes the sum of
    the rates, without u; both are smooth.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Middle of short means, s.
    mean : ndarray, shape (n, 6)
        Mean force (m/s^2) and rate (rad/s).

    """
    length = np.linalg.norm(mean[:, :3], axis=1)
    if len(time) < LEAST_REST_CHUNKS or not np.isfinite(mean).all() or not length.min() > 0:
        return 0.0

    # Measured direction u, and its change by the rates from their mean, the sum of u x rate dt.
    direction = mean[:, :3] / length[:, None]
    step = np.diff(time, prepend=time[0])[:, None]
    rate = mean[:, 3:] - mean[:, 3:].mean(axis=0)
    predicted = np.cumsum(np.cross(direction, rate) * step, axis=0)

    # Means over `MEAN_SECONDS`, at least `LEAST_REST_CHUNKS` per segment, shape (segment, mean, 3).
    n_segments = max(1, int((time[-1] - time[0]) / SEGMENT_SECONDS))
    n_chunks = len(time) // n_segments
    size = max(1, min(int(MEAN_SECONDS / np.median(step[1:])), n_chunks // LEAST_REST_CHUNKS))
    n_means = n_chunks // size
    used = slice(0, n_segments * n_means * size)
    predicted = predicted[used].reshape(n_segments, n_means, size, 3).mean(axis=2)
    measured = direction[used].reshape(n_segments, n_means, size, 3).mean(axis=2)

    # Movement beyond a polynomial in time.
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, n_means), DRIFT_DEGREE + 1))
    predicted = predicted - basis @ (basis.T @ predicted)
    measured = measured - basis @ (basis.T @ measured)

    # measured = factor predicted, by least squares. The tilt counts if it is large, explained by
    # the rates, and of about their size.
    power = float(np.sum(predicted**2))
    total = float(np.sum(measured**2))
    tilt = np.sqrt(total / (n_segments * n_means))
    if not power > 0.0 or tilt < LEAST_TILT:
        return 0.0
    factor = float(np.sum(predicted * measured)) / power
    explained = factor**2 * power / total
    if explained < LEAST_EXPLAINED_TILT or not 1 / MOST_FACTOR < factor < MOST_FACTOR:
        return 0.0
    return float(tilt)
