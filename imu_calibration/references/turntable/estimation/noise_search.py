"""
Search for the noise of mean rows: offsets of windows, a bias process, steps between recordings.

A shape of the noise (`NoiseShape`) is the sd of the offsets and that of the bias process, in units
of the typical noise of a window mean, and the correlation time of the process in s.
`estimate_offsets` averages over the likelihood of shapes; `BiasProcessSearch` finds the best shape
for a choice of parameters. A loss is minus twice a log likelihood.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from imu_calibration.estimation.noise_likelihood import (
    FLICKER_MARK,
    NoiseLikelihood,
    NoiseShape,
)
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.sensor_noise import dof_factor

TYPICAL_TIME = 100.0
"""
Median of the log-normal prior of the correlation times of MEMS biases, s; a short session does not
determine them (field catalogue, section 6).
"""
TIME_SPREAD = 0.8
"""Prior sd of the logarithm of the correlation time."""
CLEAR_GAIN = 30.0
"""
Fall of minus twice the log likelihood beyond which a bias process is significant and its
maximum-likelihood estimate is used.
"""
SESSION_GAIN = 6.6
"""
Fall of minus twice the log likelihood beyond which the biases of recordings differ: chi-square, one
degree of freedom on its boundary, 0.5 %.
"""
OFFSET_GRID = np.array([0.0, 0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0])
"""Sds of offsets, in units of the typical noise of a window mean."""
BIAS_GRID = np.array([0.15, 0.25, 0.4, 0.63, 1.0, 1.6, 2.5, 4.0, 6.3, 10.0, 25.0, 60.0])
"""Sds of a bias process, in the same units."""
TIME_GRID = np.array([40.0, 100.0, 250.0])
"""Correlation times, s."""
LIKELY_SPAN = 20.0
"""Largest cost above the least one of an offset that is tried with a process."""
LOG_TIME_RANGE = (1.6, 8.0)
"""Range of the logarithm of the correlation time, s."""
SESSION_GRID = 4.0 ** np.arange(-3, 8)
"""
Sds of the bias between recordings in the same units; the best of them is refined by factors of two
and of the root of two.
"""


def estimate_offsets(rows: Rows) -> dict[str, Any]:
    """
    Return the fields of `NoiseModel` that concern offsets.

    They are offset_sd, bias_processes, session_sd and session_variance.

    A short session does not determine the size of a bias process, and the sd of a bias depends on
    that size. So the variances are averaged over the likelihood (posterior means on a grid); only a
    significant process is set to its best estimate. With several recordings a bias per recording is
    included if the likelihood gains `SESSION_GAIN` over the best fit with offsets and process.
    Where bias processes are known, a further process must be significant.

    Parameters
    ----------
    rows : Rows
        Of means, as in `NoiseLikelihood`.

    """
    likelihood = NoiseLikelihood(rows)
    n_sessions = len(rows.sessions)
    search = _ShapeSearch(likelihood)
    shapes, costs = search.grid(0.0)

    # A bias for each recording, if the likelihood gains enough over the best fit without.
    session = 0.0
    if n_sessions > 1:
        likeliest = search.best_session(shapes[np.argmin(costs)])
        if likeliest > 0:
            shapes_with_biases, costs_with_biases = search.grid(likeliest)
            if costs.min() - costs_with_biases.min() > SESSION_GAIN:
                session = likeliest
                shapes = shapes_with_biases
                costs = costs_with_biases

    shape = search.conclusion(shapes, costs, session)
    typical = likelihood.typical
    # The few recordings widen the variance that enters standard deviations.
    dof = 3 * (n_sessions - 1)
    factor = float(dof_factor(dof)) if dof else 1.0
    return {
        'offset_sd': shape.offset * typical,
        'bias_processes': likelihood.processes(shape.bias * typical, shape.time),
        'session_sd': session * typical,
        'session_variance': (session * typical) ** 2 * factor,
    }


class _ShapeSearch:
    """
    Search for the shape of the noise by its likelihood and the prior of correlation times.

    In the methods `session` is the sd of the bias between recordings, in units of the typical noise
    of a window mean.
    """

    def __init__(self, likelihood: NoiseLikelihood):
        self.likelihood = likelihood
        # Bias processes only with enough windows.
        self.biases = BIAS_GRID if likelihood.many else BIAS_GRID[:0]

    def cost(self, shape: Sequence[float], session: float = 0.0) -> float:
        """Return minus twice the log of likelihood times prior."""
        _, _, time = shape
        prior = (np.log(time / TYPICAL_TIME) / TIME_SPREAD) ** 2
        return self.likelihood.loss(shape, session=session) + prior

    def grid(self, session: float) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the tried shapes of the noise, shape (k, 3), and their costs, shape (k,).

        The shapes without a bias process are first, as many as `OFFSET_GRID` has.
        """
        shapes = [NoiseShape(offset, 0.0, TYPICAL_TIME) for offset in OFFSET_GRID]
        without_process = np.array([self.cost(shape, session) for shape in shapes])
        # Offsets that are much too large without a process are so with one.
        likely = OFFSET_GRID[without_process < without_process.min() + LIKELY_SPAN]
        offsets = np.unique(np.concatenate([[0.0], likely]))
        for bias in self.biases:
            for time in TIME_GRID:
                shapes += [NoiseShape(offset, bias, time) for offset in offsets]
        with_process = [self.cost(shape, session) for shape in shapes[len(OFFSET_GRID) :]]
        return np.array(shapes), np.concatenate([without_process, with_process])

    def best_session(self, shape: Sequence[float]) -> float:
        """
        Return the likeliest sd of the bias between recordings.

        For each sd the noise within recordings is the likeliest of a few: the best `shape` without
        such biases, its offsets only, none, and some bias processes only.
        """
        offset, _, _ = shape
        shapes = [
            tuple(shape),
            NoiseShape(offset, 0.0, TYPICAL_TIME),
            NoiseShape(0.0, 0.0, TYPICAL_TIME),
            *(NoiseShape(0.0, bias, TYPICAL_TIME) for bias in self.biases[::4]),
        ]

        def cost(session: float) -> float:
            """Return the least cost over the shapes."""
            return min(self.cost(candidate, session) for candidate in shapes)

        best = min(SESSION_GRID, key=cost)
        for factor in (2.0, np.sqrt(2.0)):
            best = min((best, best / factor, best * factor), key=cost)
        return float(best)

    def conclusion(self, shapes: np.ndarray, costs: np.ndarray, session: float) -> NoiseShape:
        """
        Return the best shape where its bias process is significant, otherwise the posterior mean.

        The shapes and costs are those of a `grid`. With known bias processes the mean is over
        shapes without a further one.
        """
        best = int(np.argmin(costs))
        n_without_process = len(OFFSET_GRID)
        if costs[:n_without_process].min() - costs[best] > CLEAR_GAIN:
            return self._refined(shapes[best], session)
        if self.likelihood.known:
            shapes = shapes[:n_without_process]
            costs = costs[:n_without_process]
        return _posterior_mean(shapes, costs - costs.min())

    def _refined(self, start: np.ndarray, session: float) -> NoiseShape:
        """Return the shape of least cost near a shape of the grid."""
        from scipy.optimize import minimize  # here, because its import is slow

        unit = self.likelihood.typical

        def shape(logs: np.ndarray) -> NoiseShape:
            """Return the shape of the logarithms of its sds, SI, and of its time."""
            offset = np.exp(logs[0])
            bias = np.exp(logs[1])
            time = np.exp(np.clip(logs[2], *LOG_TIME_RANGE))
            return NoiseShape(float(offset / unit), float(bias / unit), float(time))

        # An offset of zero has no logarithm. Sds to 3 %: the likelihood determines them less well.
        offset, bias, time = start
        minimum = minimize(
            lambda logs: self.cost(shape(logs), session),
            np.log([max(offset, 0.1) * unit, bias * unit, time]),
            method='Nelder-Mead',
            options={'maxfev': 80, 'xatol': 0.03, 'fatol': 0.03},
        )
        return shape(minimum.x)


def _posterior_mean(shapes: np.ndarray, costs: np.ndarray) -> NoiseShape:
    """
    Return the average over the likelihood of the shapes of the noise.

    The sds are the roots of the mean variances. The correlation time is the mean of its logarithm,
    weighted by the variance of the bias process too.

    Parameters
    ----------
    shapes : ndarray, shape (k, 3)
        (offset, bias, time).
    costs : ndarray, shape (k,)
        Minus twice the log likelihood, 0 for the best.

    """
    # Each sd of a process is on the grid once per correlation time.
    multiplicity = np.where(shapes[:, 1] == 0, 1.0, 1.0 / len(TIME_GRID))
    weight = np.exp(-0.5 * costs) * multiplicity
    weight /= weight.sum()
    offset, bias = np.sqrt(weight @ shapes[:, :2] ** 2)
    of_process = weight * shapes[:, 1] ** 2
    if of_process.sum() <= 0:
        return NoiseShape(float(offset), 0.0, TYPICAL_TIME)
    time = np.exp(of_process @ np.log(shapes[:, 2]) / of_process.sum())
    return NoiseShape(float(offset), float(bias), float(time))


CORRELATION_TIMES = (100.0, 300.0, 15.0, 40.0, 1000.0, FLICKER_MARK)
"""Correlation times that are tried, s, and flicker; that of the natural process first."""
BIAS_LOG_SD = 0.8
"""Prior sd of the logarithm of the sd of a bias process, over that of the natural process."""
OFFSET_PRICE = 10.0
"""
Minus twice the log prior of offsets of windows: no sensor has such noise, and flicker noise has the
same effect on the means beyond a wander of 15 s.
"""
OFFSET_SHARES = (0.0, 0.25, 0.5, 1.0)
"""Shares of the offsets without a larger bias process that are tried with one."""
POLISH_FACTORS = (0.7, 0.85, 1.0, 1.2, 1.4)
"""Factors by which a standard deviation is refined."""
SD_RATIOS = (0.0, *2.0 ** np.arange(-2.0, 8.5, 0.5))
"""
Standard deviations that are tried, in units of the typical noise of a window mean; steps of a
factor of two would be coarser than the differences between correlation times.
"""


class BiasProcessSearch:
    """
    The best shape of the noise given a choice of parameters.

    Parameters
    ----------
    likelihood : NoiseLikelihood
    least : float
        Least standard deviation of the bias process, SI.
    usual : float
        Standard deviation up to which all are equally likely, SI; at least `least`.

    """

    def __init__(self, likelihood: NoiseLikelihood, least: float = 0.0, usual: float = 0.0):
        self.likelihood = likelihood
        self.least = least / likelihood.typical
        self.usual = max(least, usual) / likelihood.typical

    def best(self, used: Sequence[int]) -> tuple[NoiseShape, float]:
        """Return (shape, loss with the price) of the best noise given the parameters `used`."""

        def loss(shape: NoiseShape) -> float:
            """Return the loss of a shape with its price."""
            return self.likelihood.loss(shape, used) + self.price(shape.offset, shape.bias)

        # Offsets with the least bias process.
        first_time = CORRELATION_TIMES[0]
        offset = _descend(lambda x: loss(NoiseShape(x, self.least, first_time)), SD_RATIOS)
        shapes = [NoiseShape(offset, self.least, first_time)]

        # With enough windows, for each correlation time: the best bias process without offsets,
        # from the least one on, with shares of these offsets.
        larger = [ratio for ratio in SD_RATIOS if ratio > 1.2 * self.least]
        if self.likelihood.many:
            offsets = [_nearest_ratio(share * offset) for share in OFFSET_SHARES]
            for time in CORRELATION_TIMES:
                bias = _descend(lambda x: loss(NoiseShape(0.0, x, time)), [self.least, *larger])
                shapes += [NoiseShape(of_share, bias, time) for of_share in offsets]
        best = min(shapes, key=loss)
        return best, loss(best)

    def price(self, offset: float, bias: float) -> float:
        """
        Return minus twice the log prior of the sds of offsets and of a bias process.

        It is relative to no offsets and to the usual sd of the process.
        """
        price = OFFSET_PRICE * (offset > 0)
        if self.least:
            price += (np.log(max(bias / self.usual, 1.0)) / BIAS_LOG_SD) ** 2
        return price

    def of_middle_axis(self, shape: NoiseShape, used: Sequence[int]) -> float:
        """
        Return the median over the axes of the likeliest sd of the bias process of each axis, SI.

        Offsets and correlation time are those of `shape`, and the other axes have its noise.
        """
        sds = []
        for axis in range(3):
            of_axis = self.likelihood.of_axis(axis, shape)
            offset = shape.offset * self.likelihood.typical / of_axis.typical
            ratio = _descend(
                lambda x: of_axis.loss(NoiseShape(offset, x, shape.time), used), SD_RATIOS
            )
            sds.append(of_axis.typical * ratio)
        return float(np.median(sds))

    def polished(self, shape: NoiseShape, used: Sequence[int]) -> dict[str, Any]:
        """
        Return the fields of `NoiseModel` that concern offsets, by a shape with refined sds.

        First the sd of the offsets is refined, then that of the bias process.
        """
        # The price of offsets is the same for all sds that are not zero.
        _, bias, time = shape
        offset = _polish(
            lambda x: self.likelihood.loss(NoiseShape(x, bias, time), used), shape.offset
        )
        bias = _polish(
            lambda x: (
                self.likelihood.loss(NoiseShape(offset, x, time), used) + self.price(offset, x)
            ),
            bias,
        )
        unit = self.likelihood.typical
        processes = self.likelihood.processes(max(bias, self.least) * unit, time)
        return {'offset_sd': offset * unit, 'bias_processes': processes}


def _nearest_ratio(ratio: float) -> float:
    """Return the nearest of the `SD_RATIOS`: the likelihood keeps the losses of known shapes."""
    return min(SD_RATIOS, key=lambda tried: abs(tried - ratio))


def _descend(loss: Callable[[float], float], grid: Iterable[float]) -> float:
    """Return the value of a rising grid with the least loss, up to two rises of the loss."""
    values = []
    losses = []
    for value in grid:
        values.append(value)
        losses.append(loss(value))
        # At least five values are tried.
        if len(losses) > 4 and losses[-1] > losses[-2] > losses[-3]:
            break
    return float(values[losses.index(min(losses))])


def _polish(loss: Callable[[float], float], value: float) -> float:
    """Return the best of a value and some factors of it; zero remains zero."""
    if value == 0.0:
        return value
    return min([value * factor for factor in POLISH_FACTORS], key=loss)
