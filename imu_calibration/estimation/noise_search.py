"""
Search for the noise of rows by restricted likelihood: grid, variance components, bias processes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from imu_calibration.estimation.noise_model import BiasProcess, dof_factor, means_beside_middles
from imu_calibration.estimation.whitening import RestrictedLikelihood, eliminate, profile

SCORING_STEPS = 2
"""Scoring steps per call; for rows of one variance a single step is exact."""
DOF_LEAST = 2.0
"""With fewer degrees of freedom a group's variance is not estimated from the data."""
DOF_SEPARATE = 3.0
"""With fewer degrees of freedom the misfit of a group is not separable from that of the others."""
ATTRIBUTION_STEPS = 6
"""Scoring steps for the variance of one group if all misfit is its own."""
SPARE_LEAST = 0.1
"""With fewer degrees of freedom no misfit is attributed to a group."""
WIDENING_PROBABILITY = 0.975
"""
Probability of the quantile whose ratio between Student's t and the normal distribution widens
standard deviations.
"""


@dataclass(frozen=True, eq=False)
class GroupVariances:
    """Variances in addition to the known noise."""

    variance: np.ndarray
    """Additional variance of each group, shape (n_groups,)."""
    dof: np.ndarray
    """Degrees of freedom from which each was estimated, shape (n_groups,)."""
    upper: np.ndarray
    """
    Variance for standard deviations, which allows for the error of `variance`, shape (n_groups,).
    """

    def total(self, noise: np.ndarray, group: np.ndarray, inflated: bool = False) -> np.ndarray:
        """
        Return the variance of each row, shape (m,).

        Parameters
        ----------
        noise : array, shape (m,)
            Known variance.
        group : array, shape (m,)
            Group of each row, -1 for none.
        inflated : bool
            Use `upper`, so that 95 % intervals from few poses are correct.

        """
        return noise + np.append(self.upper if inflated else self.variance, 0.0)[group]


def estimate_group_variances(
    design: np.ndarray,
    residual: np.ndarray,
    noise: np.ndarray,
    *,
    group: np.ndarray,
    start: np.ndarray,
    fallback: np.ndarray,
) -> GroupVariances:
    """
    Estimate the additional variance of each group of rows.

    The rows are ``residual = design @ x + e`` with independent errors of variance ``noise +
    variance[group]``. Scoring on the restricted likelihood, which charges for the parameters that
    were fitted.

    Parameters
    ----------
    design : array, shape (m, p)
        Columns; full column rank (add weak priors as rows of group -1 where needed).
    residual, noise, group : arrays, shape (m,)
        Left-hand side, known variance (above zero), index of the group or -1.
    start : array, shape (n_groups,)
        First guess of the variances.
    fallback : array, shape (n_groups,)
        Variance of a group with fewer than two degrees of freedom.

    """
    rows = np.column_stack([design, residual])[:, None]
    problem = _Groups(
        RestrictedLikelihood(rows, np.zeros(len(rows)), [np.arange(len(rows))]),
        noise,
        group,
        len(start),
    )
    # at a large variance the degrees of freedom depend on the layout of the rows only
    none, large = (
        np.zeros(len(start), bool),
        100 * (np.asarray(fallback, float) + problem.typical(np.zeros(len(start)))),
    )
    spare = problem.step(large, none)[1]
    free = spare >= DOF_LEAST
    current = np.where(free, start, fallback)
    for _ in range(SCORING_STEPS):
        typical, (changed, dof) = problem.typical(current), problem.step(current, free)
        settled = np.all(np.abs(changed - current) <= 1e-3 * typical)
        current = changed
        if settled:
            break
    dof = np.where(free, dof, 0.0)
    upper = current * np.where(dof > DOF_LEAST, student_factor(dof), 1.0)
    for alone in np.eye(len(free), dtype=bool)[spare < DOF_SEPARATE]:
        upper[alone] = np.maximum(upper[alone], _attributed(problem, alone, fallback)[alone])
    return GroupVariances(current, dof, upper)


def student_factor(dof: np.ndarray) -> np.ndarray:
    """
    Return the squared ratio of Student's and normal 97.5 % quantiles.

    Student's t has `dof` (at least 1) degrees of freedom and is compared with the normal law.
    """
    return (stdtrit(np.maximum(dof, 1.0), WIDENING_PROBABILITY) / ndtri(WIDENING_PROBABILITY)) ** 2


def _attributed(problem, alone, fallback):
    """
    Return the variance of one group if all misfit is its own, shape (n_groups,).

    It is at least `fallback` and widened by Student's t.
    """
    least = np.where(alone, fallback, 0.0)
    current, dof = problem.step(least, np.zeros(len(alone), bool))
    for _ in range(ATTRIBUTION_STEPS if dof[alone] > SPARE_LEAST else 0):
        current = problem.step(current, alone)[0]
    current = np.where(alone, np.maximum(current, fallback), 0.0)
    return current * student_factor(problem.step(current, np.zeros(len(alone), bool))[1])


class _Groups:
    """The likelihood as a function of the additional variances of groups."""

    def __init__(self, likelihood, noise, group, count):
        self.likelihood, self.noise, self.group = likelihood, noise, group
        self.members = np.array([group == number for number in range(count)], float)

    def variance(self, extra):
        """Return the variance of each row."""
        return self.noise + np.append(extra, 0.0)[self.group]

    def typical(self, extra):
        """Return the mean variance of each group's rows."""
        return (self.members @ self.variance(extra)) / np.maximum(self.members.sum(1), 1)

    def step(self, extra, free):
        """
        Return the next variances and each one's degrees of freedom.

        The variances follow from a scoring step over the free groups that are not pinned at zero.
        """
        score, information = self.likelihood.scoring(self.variance(extra)[:, None], self.members)
        index, step, typical = (
            np.flatnonzero(free & ~((extra <= 0) & (score < 0))),
            np.zeros(len(extra)),
            self.typical(extra),
        )
        if len(index):
            step[index] = np.linalg.solve(information[np.ix_(index, index)], score[index])
        return (
            np.clip(extra + step, 0.0, extra + 100 * typical),
            2 * np.diag(information) * typical**2,
        )


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
SESSION_GRID = 4.0 ** np.arange(-3, 8)
"""
Steps from recording to recording in the same units; the best of them is refined by factors of two
and of the root of two.
"""
FLICKER_MARK, FLICKER_TIMES = 0.0, (1.0, 5.0, 25.0, 125.0, 625.0)
"""
Correlation time that denotes flicker: equal variance at spaced times, s, from the length of a
window to the length of a session.
"""
MIN_PROCESS_WINDOWS = 12
"""Fewest windows for the estimate of a bias process."""


class NoiseLikelihood:
    """
    Restricted likelihood of mean rows over shapes of the noise.

    A shape is ``(offset sd, sd of the bias process, its correlation time)``.

    Standard deviations are in units of `typical`, the noise of a typical window mean.

    Parameters
    ----------
    rows, times, sessions, information
        As in `RestrictedLikelihood`.
    white : ndarray, shape (n, n_axes)
        Variance of the means by the noise within windows.
    known : tuple of BiasProcess
        Processes that are always included.
    durations : ndarray, shape (n,), optional
        Lengths of the windows, s.
    common : int
        The first parameters, which are part of every choice: eliminated once per shape.

    """

    def __init__(
        self,
        rows: np.ndarray,
        white: np.ndarray,
        times: np.ndarray,
        *,
        sessions: list[np.ndarray],
        information: np.ndarray | None = None,
        known: tuple[BiasProcess, ...] = (),
        durations: np.ndarray | float = 0.0,
        common: int = 0,
    ):
        self._common, self._durations = common, np.broadcast_to(durations, len(rows))
        self.typical = float(np.sqrt(np.median(white)))
        self.many, self.known = len(rows) >= MIN_PROCESS_WINDOWS, known
        self._rows, self._white, self._times, self._sessions = rows, white, times, sessions
        self._likelihood, self._losses = (
            RestrictedLikelihood(rows, times, sessions, information=information),
            {},
        )
        self._profiles = {}

    def loss(
        self, shape: tuple, used: Sequence[int] | np.ndarray | None = None, *, session: float = 0.0
    ) -> float:
        """
        Return minus twice the restricted log likelihood with the parameters `used`.

        The parameters are counted after the common ones and are all parameters by default.
        """
        key = (*map(float, shape), float(session))
        if key not in self._losses:
            offset, bias, time, step = np.multiply(
                key, (self.typical, self.typical, 1.0, self.typical)
            )
            processes = self.processes(bias, time)
            within = means_beside_middles(processes, self._durations)[:, None]
            logs, normal = self._likelihood.whitened(
                self._white + within + offset**2, processes, step**2
            )
            of_common, normal = eliminate(normal, self._common)
            self._losses[key] = logs + of_common, normal
        logs, normal = self._losses[key]
        choice = (key, None if used is None else tuple(used))
        if choice not in self._profiles:
            at = np.arange(len(normal)) if used is None else [*used, len(normal) - 1]
            self._profiles[choice] = logs + profile(normal[np.ix_(at, at)])
        return self._profiles[choice]

    def of_axis(self, axis: int, shape: tuple) -> 'NoiseLikelihood':
        """
        Return the likelihood of the noise of one axis, the other axes fixed at the shape.

        In units of the axis' own typical noise.
        """
        offset, bias, time = np.multiply(shape, (self.typical, self.typical, 1.0))
        others = np.arange(self._white.shape[1]) != axis
        processes = self.processes(bias, time)
        variance = (
            self._white[:, others]
            + means_beside_middles(processes, self._durations)[:, None]
            + offset**2
        )
        information = self._likelihood.of_axes(others).whitened(variance, processes)[1]
        return NoiseLikelihood(
            self._rows[:, [axis]],
            self._white[:, [axis]],
            self._times,
            sessions=self._sessions,
            information=information,
            known=self.known,
            durations=self._durations,
            common=self._common,
        )

    def processes(self, sd: float, time: float) -> tuple[BiasProcess, ...]:
        """
        Return the known processes plus one more (or the flicker processes).

        The further one is added if its standard deviation is above zero.
        """
        times = FLICKER_TIMES if time == FLICKER_MARK else (time,)
        return (
            (*self.known, *(BiasProcess(sd / float(np.sqrt(len(times))), each) for each in times))
            if sd > 0
            else self.known
        )


def estimate_offsets(
    rows: np.ndarray,
    white: np.ndarray,
    times: np.ndarray,
    *,
    sessions: list[np.ndarray],
    information: np.ndarray,
    known: tuple[BiasProcess, ...] = (),
    durations: np.ndarray | float = 0.0,
) -> dict:
    """
    Return the fields of `NoiseModel` that concern offsets.

    Offset_sd, bias_processes, session_sd, session_variance.

    A short session does not determine the size of a bias process, and the sd of a bias depends on
    that size. So the variances are averaged over the likelihood (posterior means on a grid); only a
    significant process is set to its best estimate. With several recordings a bias per recording is
    included if the likelihood gains `SESSION_GAIN` over the best fit with offsets and process.
    Where bias processes are known, a further process must be significant.

    Parameters
    ----------
    rows, white, times, sessions, information, known, durations
        As in `NoiseLikelihood`.

    """
    search = _Search(
        NoiseLikelihood(
            rows,
            white,
            times,
            sessions=sessions,
            information=information,
            known=known,
            durations=durations,
        )
    )
    trials, costs = search.grid(0.0)
    session = search.best_session(trials[np.argmin(costs)]) if len(sessions) > 1 else 0.0
    if session > 0:
        apart = search.grid(session)
        if costs.min() - apart[1].min() > SESSION_GAIN:
            trials, costs = apart
        else:
            session = 0.0
    typical = search.likelihood.typical
    offset, bias, time = search.conclusion(trials, costs, session)
    dof = 3 * (len(sessions) - 1)
    factor = float(dof_factor(dof)) if dof else 1.0
    return {
        'offset_sd': offset * typical,
        'bias_processes': search.likelihood.processes(bias * typical, time),
        'session_sd': session * typical,
        'session_variance': (session * typical) ** 2 * factor,
    }


class _Search:
    """
    The likelihood times the prior of correlation times, on a grid of shapes.

    For a given sd between recordings.
    """

    def __init__(self, likelihood):
        self.likelihood = likelihood
        self.biases = BIAS_GRID if likelihood.many else BIAS_GRID[:0]

    def cost(self, shape, session=0.0):
        """Return minus twice the log of likelihood times prior."""
        return (
            self.likelihood.loss(shape, session=session)
            + (np.log(shape[2] / TYPICAL_TIME) / TIME_SPREAD) ** 2
        )

    def grid(self, session):
        """
        Return the shapes tried, shape (k, 3), and their costs.

        Shapes without bias process are first.
        """
        trials = [(offset, 0.0, TYPICAL_TIME) for offset in OFFSET_GRID]
        alone = np.array([self.cost(trial, session) for trial in trials])
        offsets = np.unique(np.concatenate([[0.0], OFFSET_GRID[alone < alone.min() + 20.0]]))
        moving = [
            (offset, bias, time) for bias in self.biases for time in TIME_GRID for offset in offsets
        ]
        return np.array(trials + moving), np.concatenate(
            [alone, [self.cost(trial, session) for trial in moving]]
        )

    def best_session(self, shape):
        """
        Return the likeliest sd between recordings, over three choices of the noise.

        The choices are the best offsets and process, the offsets without process, and neither.
        """
        shapes = [tuple(shape), (shape[0], 0.0, TYPICAL_TIME), (0.0, 0.0, TYPICAL_TIME)]
        shapes += [(0.0, bias, TYPICAL_TIME) for bias in self.biases[::4]]

        def cost(session):
            return min(self.cost(candidate, session) for candidate in shapes)

        best = min(SESSION_GRID, key=cost)
        for factor in (2.0, np.sqrt(2.0)):
            best = min((best, best / factor, best * factor), key=cost)
        return float(best)

    def conclusion(self, trials, costs, session):
        """Return offset sd, sd of the bias process and its correlation time."""
        best = int(np.argmin(costs))
        if costs[: len(OFFSET_GRID)].min() - costs[best] > CLEAR_GAIN:
            return self._best(trials[best], session)
        if self.likelihood.known:
            trials, costs = trials[: len(OFFSET_GRID)], costs[: len(OFFSET_GRID)]
            best = int(np.argmin(costs))
        return _posterior_mean(trials, costs - costs[best])

    def _best(self, start, session):
        """Return the best values near a grid point."""
        from scipy.optimize import minimize  # here, because its import is slow

        unit = self.likelihood.typical

        def shape(x):
            return np.exp(x[0]) / unit, np.exp(x[1]) / unit, np.exp(np.clip(x[2], 1.6, 8.0))

        found = minimize(
            lambda x: self.cost(shape(x), session),
            np.log([max(start[0], 0.1) * unit, start[1] * unit, start[2]]),
            method='Nelder-Mead',
            options={'maxfev': 80, 'xatol': 0.03, 'fatol': 0.03},
        )
        return tuple(float(value) for value in shape(found.x))


def _posterior_mean(trials, costs):
    """
    Return averages over the likelihood of the shapes of the noise.

    They are the roots of the mean variances, and the mean logarithm of the correlation time.
    """
    weight = np.exp(-0.5 * costs) * np.where(trials[:, 1] == 0, 1.0, 1.0 / len(TIME_GRID))
    weight /= weight.sum()
    offset, bias = np.sqrt(weight @ trials[:, :2] ** 2)
    moving = weight * trials[:, 1] ** 2
    if moving.sum() <= 0:
        return float(offset), 0.0, TYPICAL_TIME
    return float(offset), float(bias), float(np.exp(moving @ np.log(trials[:, 2]) / moving.sum()))


CORRELATION_TIMES = (100.0, 300.0, 15.0, 40.0, 1000.0, FLICKER_MARK)
"""Correlation times that are tried, s, and flicker; that of the natural process first."""
NATURAL = 0.5
"""
Least sd of every bias process over the white noise of one second, with the first of these
correlation times.
"""
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
SD_RATIOS = (0.0, *2.0 ** np.arange(-2.0, 8.5, 0.5))
"""
Standard deviations that are tried, in units of the typical noise of a window mean; between steps of
two the likelihoods of other times lie.
"""


class BiasProcessSearch:
    """
    The best shape of the noise given a choice of parameters.

    The shape is ``(offset sd, sd of the bias process, its correlation time)``.

    Parameters
    ----------
    likelihood : NoiseLikelihood
    least : float
        Least standard deviation of the bias process.
    usual : float
        The one up to which a larger one is as likely; the least one where that is larger.

    """

    def __init__(self, likelihood: NoiseLikelihood, least: float = 0.0, usual: float = 0.0):
        self.likelihood, self.least, self.usual = (
            likelihood,
            least / likelihood.typical,
            max(least, usual) / likelihood.typical,
        )

    def best(self, used: Sequence[int]) -> tuple[tuple, float]:
        """
        Return (shape, loss) of the best noise given the parameters `used`.

        The standard deviations are in units of the typical noise.
        """

        def loss(shape):
            return self.likelihood.loss(shape, used) + self.price(*shape[:2])

        offset = _descend(lambda x: loss((x, self.least, CORRELATION_TIMES[0])), SD_RATIOS)
        shapes = [(offset, self.least, CORRELATION_TIMES[0])]
        grid = (self.least,) + tuple(ratio for ratio in SD_RATIOS if ratio > 1.2 * self.least)
        if self.likelihood.many:
            for time in CORRELATION_TIMES:
                bias = _descend(lambda x: loss((0.0, x, time)), grid)
                shapes += [(_near(share * offset), bias, time) for share in (0.0, 0.25, 0.5, 1.0)]
        shape = min(shapes, key=loss)
        return shape, loss(shape)

    def price(self, offset: float, bias: float) -> float:
        """
        Return minus twice the log prior of offsets and of the sd of a bias.

        The prior of offsets is relative to none, and that of the sd of a bias is relative to the
        usual one.
        """
        return OFFSET_PRICE * (offset > 0) + (
            (np.log(max(bias / self.usual, 1.0)) / BIAS_LOG_SD) ** 2 if self.least else 0.0
        )

    def of_middle_axis(self, shape: tuple, used: Sequence[int]) -> float:
        """
        Return the median over the axes of the likeliest sd of the bias process of each.

        With `shape` for the other axes.
        """

        def likeliest(own):
            offset = shape[0] * self.likelihood.typical / own.typical
            return own.typical * _descend(
                lambda x: own.loss((offset, x, shape[2]), used), SD_RATIOS
            )

        return float(
            np.median([likeliest(self.likelihood.of_axis(axis, shape)) for axis in range(3)])
        )

    def polished(self, shape: tuple, used: Sequence[int]) -> dict:
        """
        Return the fields of `NoiseModel` that concern offsets.

        The standard deviations of a shape are refined.
        """
        offset, bias, time = shape
        offset = _polish(lambda x: self.likelihood.loss((x, bias, time), used), offset)
        bias = max(
            _polish(
                lambda x: self.likelihood.loss((offset, x, time), used) + self.price(offset, x),
                bias,
            ),
            self.least,
        )
        unit = self.likelihood.typical
        return {
            'offset_sd': offset * unit,
            'bias_processes': self.likelihood.processes(bias * unit, time),
        }


def _near(ratio):
    """Return the tried ratio that is nearest, so that shapes are met again."""
    return min(SD_RATIOS, key=lambda known: abs(known - ratio))


def _descend(loss: Callable, grid):
    """Return the grid value of least loss, going up until the loss has risen twice."""
    losses = []
    for value in grid:
        losses.append(loss(value))
        if len(losses) > 4 and losses[-1] > losses[-2] > losses[-3]:
            break
    return float(grid[losses.index(min(losses))])


def _polish(loss: Callable, value):
    return (
        value
        if value == 0.0
        else min([value * factor for factor in (0.7, 0.85, 1.0, 1.2, 1.4)], key=loss)
    )
