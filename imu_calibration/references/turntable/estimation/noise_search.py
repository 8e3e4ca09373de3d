"""
Search for the noise of mean rows: offsets of windows, a bias process, steps between recordings.

`estimate_offsets` averages over the likelihood; `BiasProcessSearch` finds the best noise for a
choice of parameters.
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

TYPICAL_TIME, TIME_SPREAD = 100.0, 0.8
"""
Correlation times of MEMS biases: around 100 s, log-normal; a short session does not determine them
(field catalogue, section 6).
"""
CLEAR_GAIN = 30.0
"""
Fall of minus twice the log likelihood beyond which a bias process is significant and its
maximum-likelihood estimate is used.
"""
SESSION_GAIN = 6.6
"""
The same for biases that differ between recordings: chi-square, one degree of freedom on its
boundary, 0.5 %.
"""
OFFSET_GRID = np.array([0.0, 0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0])
BIAS_GRID = np.array([0.15, 0.25, 0.4, 0.63, 1.0, 1.6, 2.5, 4.0, 6.3, 10.0, 25.0, 60.0])
TIME_GRID = np.array([40.0, 100.0, 250.0])
"""
Offset and bias process in units of the typical noise of a window mean; correlation times in s.
"""
LIKELY_SPAN = 20.0
"""Offsets whose cost exceeds the least one by more than this are not tried with a process."""
LOG_TIME_RANGE = (1.6, 8.0)
"""Range of the logarithm of the correlation time, s."""
SESSION_GRID = 4.0 ** np.arange(-3, 8)
"""
Steps from recording to recording in the same units; the best of them is refined by factors of two
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
    search = _Search(likelihood)
    trials, costs = search.grid(0.0)

    # A bias for each recording, if the likelihood gains enough over the best fit without.
    session = 0.0
    if n_sessions > 1:
        likeliest = search.best_session(trials[np.argmin(costs)])
        if likeliest > 0:
            with_biases = search.grid(likeliest)
            if costs.min() - with_biases[1].min() > SESSION_GAIN:
                session, (trials, costs) = likeliest, with_biases

    shape = search.conclusion(trials, costs, session)
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


class _Search:
    """
    The likelihood times the prior of correlation times, on a grid of shapes.

    For a given sd between recordings.
    """

    def __init__(self, likelihood: NoiseLikelihood):
        self.likelihood = likelihood
        self.biases = BIAS_GRID if likelihood.many else BIAS_GRID[:0]

    def cost(self, shape: Sequence[float], session: float = 0.0) -> float:
        """Return minus twice the log of likelihood times prior."""
        _, _, time = shape
        prior = (np.log(time / TYPICAL_TIME) / TIME_SPREAD) ** 2
        return self.likelihood.loss(shape, session=session) + prior

    def grid(self, session: float) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the shapes tried, shape (k, 3), and their costs, shape (k,).

        Shapes without bias process are first.
        """
        trials = [NoiseShape(offset, 0.0, TYPICAL_TIME) for offset in OFFSET_GRID]
        without_process = np.array([self.cost(trial, session) for trial in trials])
        # Offsets that are much too large without a process are so with one.
        likely = OFFSET_GRID[without_process < without_process.min() + LIKELY_SPAN]
        offsets = np.unique(np.concatenate([[0.0], likely]))
        for bias in self.biases:
            for time in TIME_GRID:
                trials += [NoiseShape(offset, bias, time) for offset in offsets]
        with_process = [self.cost(trial, session) for trial in trials[len(OFFSET_GRID) :]]
        return np.array(trials), np.concatenate([without_process, with_process])

    def best_session(self, shape: Sequence[float]) -> float:
        """
        Return the likeliest sd between recordings, over three choices of the noise.

        The choices are the best offsets and process, the offsets without process, and neither.
        """
        offset, _, _ = shape
        shapes = [
            tuple(shape),
            NoiseShape(offset, 0.0, TYPICAL_TIME),
            NoiseShape(0.0, 0.0, TYPICAL_TIME),
            *(NoiseShape(0.0, bias, TYPICAL_TIME) for bias in self.biases[::4]),
        ]

        def cost(session: float) -> float:
            return min(self.cost(candidate, session) for candidate in shapes)

        best = min(SESSION_GRID, key=cost)
        for factor in (2.0, np.sqrt(2.0)):
            best = min((best, best / factor, best * factor), key=cost)
        return float(best)

    def conclusion(self, trials: np.ndarray, costs: np.ndarray, session: float) -> NoiseShape:
        """Return the best shape where its bias process is significant, otherwise the mean one."""
        best = int(np.argmin(costs))
        if costs[: len(OFFSET_GRID)].min() - costs[best] > CLEAR_GAIN:
            return self._refined(trials[best], session)
        if self.likelihood.known:
            trials = trials[: len(OFFSET_GRID)]
            costs = costs[: len(OFFSET_GRID)]
        return _posterior_mean(trials, costs - costs.min())

    def _refined(self, start: np.ndarray, session: float) -> NoiseShape:
        """Return the best values near a grid point."""
        from scipy.optimize import minimize  # here, because its import is slow

        unit = self.likelihood.typical

        def shape(logs: np.ndarray) -> NoiseShape:
            offset = np.exp(logs[0])
            bias = np.exp(logs[1])
            time = np.exp(np.clip(logs[2], *LOG_TIME_RANGE))
            return NoiseShape(float(offset / unit), float(bias / unit), float(time))

        offset, bias, time = start
        found = minimize(
            lambda logs: self.cost(shape(logs), session),
            np.log([max(offset, 0.1) * unit, bias * unit, time]),
            method='Nelder-Mead',
            options={'maxfev': 80, 'xatol': 0.03, 'fatol': 0.03},
        )
        return shape(found.x)


def _posterior_mean(trials: np.ndarray, costs: np.ndarray) -> NoiseShape:
    """
    Return averages over the likelihood of the shapes of the noise.

    They are the roots of the mean variances, and the mean logarithm of the correlation time.
    """
    weight = np.exp(-0.5 * costs) * np.where(trials[:, 1] == 0, 1.0, 1.0 / len(TIME_GRID))
    weight /= weight.sum()
    offset, bias = np.sqrt(weight @ trials[:, :2] ** 2)
    moving = weight * trials[:, 1] ** 2
    if moving.sum() <= 0:
        return NoiseShape(float(offset), 0.0, TYPICAL_TIME)
    time = np.exp(moving @ np.log(trials[:, 2]) / moving.sum())
    return NoiseShape(float(offset), float(bias), float(time))


CORRELATION_TIMES = (100.0, 300.0, 15.0, 40.0, 1000.0, FLICKER_MARK)
"""Correlation times that are tried, s, and flicker; that of the natural process first."""
BIAS_LOG_SD = 0.8
"""
Prior sd of the logarithm of a bias process's sd over the natural one; much larger drifts are hardly
a bias process.
"""
OFFSET_PRICE = 10.0
"""
Price of offsets of windows: they are no noise of a sensor, and flicker scatters means of windows
beyond a wander of 15 s as they do.
"""
OFFSET_SHARES = (0.0, 0.25, 0.5, 1.0)
"""Shares of the offsets without a larger bias process that are tried with one."""
POLISH_FACTORS = (0.7, 0.85, 1.0, 1.2, 1.4)
"""Factors of a standard deviation that refine it."""
SD_RATIOS = (0.0, *2.0 ** np.arange(-2.0, 8.5, 0.5))
"""
Standard deviations that are tried, in units of the typical noise of a window mean; between steps of
two the likelihoods of other times lie.
"""


class BiasProcessSearch:
    """
    The best shape of the noise given a choice of parameters.

    Parameters
    ----------
    likelihood : NoiseLikelihood
    least : float
        Least standard deviation of the bias process.
    usual : float
        The one up to which a larger one is as likely; the least one where that is larger.

    """

    def __init__(self, likelihood: NoiseLikelihood, least: float = 0.0, usual: float = 0.0):
        self.likelihood = likelihood
        self.least = least / likelihood.typical
        self.usual = max(least, usual) / likelihood.typical

    def best(self, used: Sequence[int]) -> tuple[NoiseShape, float]:
        """Return (shape, loss) of the best noise given the parameters `used`."""

        def loss(shape: NoiseShape) -> float:
            return self.likelihood.loss(shape, used) + self.price(shape.offset, shape.bias)

        # Offsets with the least bias process; then, for each correlation time, a bias process
        # with no offsets and with shares of these.
        first_time = CORRELATION_TIMES[0]
        offset = _descend(lambda x: loss(NoiseShape(x, self.least, first_time)), SD_RATIOS)
        shapes = [NoiseShape(offset, self.least, first_time)]
        larger = [ratio for ratio in SD_RATIOS if ratio > 1.2 * self.least]
        if self.likelihood.many:
            for time in CORRELATION_TIMES:
                bias = _descend(lambda x: loss(NoiseShape(0.0, x, time)), [self.least, *larger])
                for share in OFFSET_SHARES:
                    shapes.append(NoiseShape(_nearest_ratio(share * offset), bias, time))
        best = min(shapes, key=loss)
        return best, loss(best)

    def price(self, offset: float, bias: float) -> float:
        """
        Return minus twice the log prior of offsets and of the sd of a bias.

        The prior of offsets is relative to none, and that of the sd of a bias is relative to the
        usual one.
        """
        price = OFFSET_PRICE * (offset > 0)
        if self.least:
            price += (np.log(max(bias / self.usual, 1.0)) / BIAS_LOG_SD) ** 2
        return price

    def of_middle_axis(self, shape: NoiseShape, used: Sequence[int]) -> float:
        """
        Return the median over the axes of the likeliest sd of the bias process of each.

        With `shape` for the other axes.
        """
        likeliest = []
        for axis in range(3):
            own = self.likelihood.of_axis(axis, shape)
            offset = shape.offset * self.likelihood.typical / own.typical
            ratio = _descend(lambda x: own.loss(NoiseShape(offset, x, shape.time), used), SD_RATIOS)
            likeliest.append(own.typical * ratio)
        return float(np.median(likeliest))

    def polished(self, shape: NoiseShape, used: Sequence[int]) -> dict[str, Any]:
        """
        Return the fields of `NoiseModel` that concern offsets.

        The standard deviations of a shape are refined.
        """
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
    """Return the tried ratio that is nearest, so that shapes are met again."""
    return min(SD_RATIOS, key=lambda known: abs(known - ratio))


def _descend(loss: Callable[[float], float], grid: Iterable[float]) -> float:
    """Return the grid value of least loss, going up until the loss has risen twice."""
    values, losses = [], []
    for value in grid:
        values.append(value)
        losses.append(loss(value))
        if len(losses) > 4 and losses[-1] > losses[-2] > losses[-3]:
            break
    return float(values[losses.index(min(losses))])


def _polish(loss: Callable[[float], float], value: float) -> float:
    """Return the best of a value and some factors of it; zero remains zero."""
    if value == 0.0:
        return value
    return min([value * factor for factor in POLISH_FACTORS], key=loss)
