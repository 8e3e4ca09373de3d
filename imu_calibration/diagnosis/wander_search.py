"""
Window offsets and a wandering bias by maximum likelihood, beside effects that are smooth in time as well.

A bias that wanders passes for a warm-up or a thermal drift, and these pass for wander. So the rivals are compared with the noise
estimated anew beside each of them.
"""

import numpy as np

from imu_calibration.estimation.restricted_likelihood import OffsetLikelihood

TIMES = (100.0, 300.0)
"""Correlation times that are tried, s."""
NATURAL_WANDER = 0.5
"""Every bias is taken to wander by at least this many times the white noise of one second, with a correlation time of 100 s."""
RATIOS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
"""Standard deviations that are tried, in units of the typical noise of a window mean."""


class WanderSearch:
    """
    Likelihood of the means of the windows of one sensor over a set of noise shapes.

    Parameters
    ----------
    rows : array, shape (k, 3, q + 1)
        Mean rows ``[design | residual]``.
    white : array, shape (k, 3)
        Variance of the means by the noise within windows.
    information : array, shape (q + 1, q + 1)
        Normal matrix of everything else that is known about the q parameters.
    least : float
        Least standard deviation of the wander.

    """

    def __init__(self, rows, white, time, session, information, least=0.0):
        sessions = [np.flatnonzero(session == number) for number in np.unique(session)]
        self.typical = float(np.sqrt(np.median(white)))
        self.many = len(time) >= 12
        self.least = least / self.typical
        self._likelihood = OffsetLikelihood(rows, white, time, sessions, information)
        self._known = {}

    def whitened(self, shape):
        """Return (log|V|, Gram matrix) for a shape (offset, wander, time), sds in units of the typical noise."""
        if shape not in self._known:
            self._known[shape] = self._likelihood.whitened(shape[0] * self.typical, shape[1] * self.typical, shape[2])
        return self._known[shape]

    def cost(self, shape, used, restricted=True):
        """Return minus twice the (restricted) log likelihood with the parameters `used`."""
        logs, gram = self.whitened(shape)
        at = np.r_[used, len(gram) - 1]
        return logs + _profile(gram[np.ix_(at, at)], restricted)

    def best(self, used, restricted=True):
        """Return (shape, cost) of the best noise beside the parameters `used`."""
        def cost(shape):
            return self.cost(shape, used, restricted)

        offset = _descend(lambda x: cost((x, self.least, TIMES[0])), RATIOS)
        shapes = [(offset, self.least, TIMES[0])]
        grid = (self.least,) + tuple(ratio for ratio in RATIOS if ratio > 1.2 * self.least)
        if self.many:
            for time in TIMES:
                wander = _descend(lambda x: cost((0.0, x, time)), grid)
                shapes += [(_near(share * offset), wander, time) for share in (0.0, 0.25, 0.5, 1.0)]
        shape = min(shapes, key=cost)
        return shape, cost(shape)

    def polished(self, shape, used):
        """Return the shape with its standard deviations refined, by restricted likelihood."""
        offset, wander, time = shape
        offset = _polish(lambda x: self.cost((x, wander, time), used), offset)
        return (offset, max(_polish(lambda x: self.cost((offset, x, time), used), wander), self.least), time)


def _profile(gram, restricted):
    scale = 1 / np.sqrt(np.maximum(np.diag(gram)[:-1], 1e-300))
    scaled = gram[:-1, :-1] * np.outer(scale, scale)
    scaled.flat[::len(scaled) + 1] += 1e-11
    factor = np.linalg.cholesky(scaled)
    solved = np.linalg.solve(factor, gram[:-1, -1] * scale)
    logs = 2 * np.log(np.diag(factor)).sum() - 2 * np.log(scale).sum() if restricted else 0.0
    return logs + gram[-1, -1] - solved @ solved


def _near(ratio):
    """Return the tried ratio that is nearest, so that shapes are met again."""
    return min(RATIOS, key=lambda known: abs(known - ratio))


def _descend(cost, grid):
    """Return the grid value of least cost, going up until the cost has risen twice."""
    costs = []
    for value in grid:
        costs.append(cost(value))
        if len(costs) > 4 and costs[-1] > costs[-2] > costs[-3]:
            break
    return grid[int(np.argmin(costs))]


def _polish(cost, value):
    return value if value == 0.0 else min([value * factor for factor in (0.7, 0.85, 1.0, 1.2, 1.4)], key=cost)
