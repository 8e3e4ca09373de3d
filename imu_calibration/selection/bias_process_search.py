"""The likeliest offsets and bias process of a sensor, given some of the candidate effects."""

from collections.abc import Callable, Sequence

import numpy as np

from imu_calibration.estimation.noise_search import FLICKER, NoiseLikelihood

TIMES = (100.0, 300.0, 15.0, 40.0, 1000.0, FLICKER)
"""Correlation times that are tried, s, and flicker; that of the natural process first."""
NATURAL = 0.5
"""Least sd of every bias process over the white noise of one second, with the first of these correlation times."""
SPREAD = 0.8
"""Prior sd of the logarithm of a bias process's sd over the natural one; much larger drifts are hardly a bias process."""
OFFSETS = 10.0
"""Price of offsets of windows: they are no noise of a sensor, and flicker scatters means of windows beyond a wander of 15 s as they do."""
RATIOS = (0.0, *2.0 ** np.arange(-2.0, 8.5, 0.5))
"""
Standard deviations that are tried, in units of the typical noise of a window mean; between steps of two the likelihoods of other times lie.
"""


class BiasProcessSearch:
    """
    The best shape of the noise ``(offset sd, sd of the bias process, its correlation time)`` given a choice of parameters.

    Parameters
    ----------
    likelihood : NoiseLikelihood
    least : float
        Least standard deviation of the bias process.
    usual : float
        The one up to which a larger one is as likely; the least one where that is larger.

    """

    def __init__(self, likelihood: NoiseLikelihood, least: float = 0.0, usual: float = 0.0):
        self.likelihood, self.least, self.usual = likelihood, least / likelihood.typical, max(least, usual) / likelihood.typical

    def best(self, used: Sequence[int]) -> tuple[tuple, float]:
        """Return (shape, loss) of the best noise given the parameters `used`, standard deviations in units of the typical noise."""
        def loss(shape):
            return self.likelihood.loss(shape, used) + self.price(*shape[:2])

        offset = _descend(lambda x: loss((x, self.least, TIMES[0])), RATIOS)
        shapes = [(offset, self.least, TIMES[0])]
        grid = (self.least,) + tuple(ratio for ratio in RATIOS if ratio > 1.2 * self.least)
        if self.likelihood.many:
            for time in TIMES:
                bias = _descend(lambda x: loss((0.0, x, time)), grid)
                shapes += [(_near(share * offset), bias, time) for share in (0.0, 0.25, 0.5, 1.0)]
        shape = min(shapes, key=loss)
        return shape, loss(shape)

    def price(self, offset: float, bias: float) -> float:
        """Return minus twice the log prior of offsets, relative to none, and of the sd of a bias, relative to the usual one."""
        return OFFSETS * (offset > 0) + ((np.log(max(bias / self.usual, 1.0)) / SPREAD)**2 if self.least else 0.0)

    def of_middle_axis(self, shape: tuple, used: Sequence[int]) -> float:
        """Return the median over the axes of the likeliest sd of the bias process of each, with `shape` for the other axes."""
        def likeliest(own):
            offset = shape[0] * self.likelihood.typical / own.typical
            return own.typical * _descend(lambda x: own.loss((offset, x, shape[2]), used), RATIOS)

        return float(np.median([likeliest(self.likelihood.of_axis(axis, shape)) for axis in range(3)]))

    def polished(self, shape: tuple, used: Sequence[int]) -> dict:
        """Return the fields of `NoiseModel` that concern offsets, the standard deviations of a shape refined."""
        offset, bias, time = shape
        offset = _polish(lambda x: self.likelihood.loss((x, bias, time), used), offset)
        bias = max(_polish(lambda x: self.likelihood.loss((offset, x, time), used) + self.price(offset, x), bias), self.least)
        unit = self.likelihood.typical
        return {'offset_sd': offset * unit, 'bias_processes': self.likelihood.processes(bias * unit, time)}


def _near(ratio):
    """Return the tried ratio that is nearest, so that shapes are met again."""
    return min(RATIOS, key=lambda known: abs(known - ratio))


def _descend(loss: Callable, grid):
    """Return the grid value of least loss, going up until the loss has risen twice."""
    losses = []
    for value in grid:
        losses.append(loss(value))
        if len(losses) > 4 and losses[-1] > losses[-2] > losses[-3]:
            break
    return float(grid[losses.index(min(losses))])


def _polish(loss: Callable, value):
    return value if value == 0.0 else min([value * factor for factor in (0.7, 0.85, 1.0, 1.2, 1.4)], key=loss)
