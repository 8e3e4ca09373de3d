"""Short pieces of windows by regime of motion: held-out data on which a calibration is evaluated."""

from enum import StrEnum

import numpy as np

from imu_calibration.core.units import DEG

PIECE_TIME = 0.25
"""Length of a piece, s: noise averages out, and a sweep of a table is still several pieces."""
SLOW, FAST = 30.0 * DEG, 120.0 * DEG
"""Rates between the regimes, rad/s."""
ACCELERATING = 90.0 * DEG
"""Change of the rate per second from which on a piece counts as accelerating, rad/s^2."""
AXES = 3


class Regime(StrEnum):
    """Regime of motion of a piece."""

    REST = 'rest'
    SLOW = 'slow turns'
    MEDIUM = 'turns at 30 to 120 deg/s'
    FAST = 'fast turns'
    ACCELERATING = 'angular acceleration'


def pieces_at_rest(mean: np.ndarray, duration: float) -> dict[str, np.ndarray]:
    """Return {regime: rows} of a static window: its mean row ``[columns | output]``, weighed as so many pieces, and no change of input."""
    row = np.concatenate([mean[:-AXES], np.zeros(AXES), mean[-AXES:]])
    return {Regime.REST: np.sqrt(count_pieces(duration)) * row[None]}


def count_pieces(duration: float) -> int:
    """Return as how many pieces a window of a length counts."""
    return max(round(duration / PIECE_TIME), 1)


def moving_pieces(rows: np.ndarray, time: np.ndarray, true_input: np.ndarray, *, rate_s: np.ndarray) -> dict[str, np.ndarray]:
    """
    Return {regime: rows ``[columns | d(true input)/dt | output]``} of a moving window, a row for the mean over each piece.

    The mean derivative is the difference of the true input at both ends of the piece; it separates an unmodelled delay of the sensor from a
    wrong scale.

    Parameters
    ----------
    rows : array, shape (n, n_columns + 3)
        ``[columns | output]``.
    time : array, shape (n,)
        s.
    true_input, rate_s : array, shape (n, 3)
        True input of the sensor according to the reference, and the rate of the reference, rad/s.

    """
    count = max(int((time[-1] - time[0]) / PIECE_TIME), 1)
    edges = np.round(np.linspace(0, len(rows), count + 1)).astype(int)
    length = np.diff(edges)[:, None]
    means = np.add.reduceat(rows, edges[:-1], axis=0) / length
    rate, change = np.linalg.norm(np.add.reduceat(rate_s, edges[:-1], axis=0) / length, axis=1), _slope(rate_s, time, edges)
    pieces = np.concatenate([means[:, :-AXES], _slope(true_input, time, edges), means[:, -AXES:]], axis=1)
    regime = np.select([np.linalg.norm(change, axis=1) > ACCELERATING, rate > FAST, rate > SLOW], [3, 2, 1], 0)
    names = (Regime.SLOW, Regime.MEDIUM, Regime.FAST, Regime.ACCELERATING)
    return {name: pieces[regime == k] for k, name in enumerate(names) if np.any(regime == k)}


def _slope(values, time, edges):
    """Return the mean derivative over each piece, from edge to edge."""
    period = (time[-1] - time[0]) / max(len(time) - 1, 1)
    inner = edges[1:-1]
    at_edges = np.concatenate([values[:1], 0.5 * (values[inner - 1] + values[inner]), values[-1:]])
    span = np.diff(np.concatenate([[0.0], inner - 0.5, [len(time) - 1.0]])) * period
    return np.diff(at_edges, axis=0) / np.maximum(span, period)[:, None]
