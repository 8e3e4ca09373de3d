"""Window offsets and a wandering bias by restricted maximum likelihood, on a grid of shapes so that it takes few evaluations."""

import numpy as np

from imu_calibration.window_noise import OffsetLikelihood

TIMES = (30.0, 100.0, 300.0)
"""Correlation times that are tried, s."""
RATIOS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""Standard deviations that are tried, in units of the typical noise of a window mean."""


def estimate_wander(rows, white, time, session, information):
    """
    Return (offset_sd, wander_sd, wander_time).

    Parameters
    ----------
    rows : array, shape (k, 3, q + 1)
        Mean rows ``[design | residual]``.
    white : array, shape (k, 3)
        Variance of the means by the noise within windows.
    information : array, shape (q + 1, q + 1)
        Normal matrix of everything else that is known about the q parameters.

    """
    typical = float(np.sqrt(np.median(white)))
    sessions = [np.flatnonzero(session == number) for number in np.unique(session)]
    likelihood, known = OffsetLikelihood(rows, white, time, sessions, information), {}

    def cost(offset, wander, correlation):
        key = (offset, wander, correlation if wander else 0.0)
        if key not in known:
            known[key] = likelihood(offset * typical, wander * typical, correlation)
        return known[key]

    offset = _descend(lambda x: cost(x, 0.0, 100.0), RATIOS)
    best = (cost(offset, 0.0, 100.0), (offset, 0.0, 100.0))
    if len(time) < 12:
        return offset * typical, 0.0, 100.0
    for correlation in TIMES:
        wander = _descend(lambda x: cost(0.0, x, correlation), RATIOS[:6] + RATIOS[6:])
        for share in (0.0, 0.25, 0.5, 1.0):
            shared = min(share * offset, RATIOS[-1])
            best = min(best, (cost(shared, wander, correlation), (shared, wander, correlation)))
    offset, wander, correlation = best[1]
    for _ in range(2):
        offset = _polish(lambda x: cost(x, wander, correlation), offset)
        wander = _polish(lambda x: cost(offset, x, correlation), wander)
    return offset * typical, wander * typical, correlation


def _descend(cost, grid):
    """Return the grid value of least cost, going up until the cost has risen twice."""
    values, costs = [], []
    for value in grid:
        values.append(value)
        costs.append(cost(value))
        if len(costs) > 3 and costs[-1] > costs[-2] > costs[-3]:
            break
    return values[int(np.argmin(costs))]


def _polish(cost, value):
    if value == 0.0:
        return value
    tried = [value * factor for factor in (0.6, 0.8, 1.0, 1.25, 1.6)]
    return min(tried, key=cost)
