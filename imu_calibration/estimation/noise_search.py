"""Standard deviations of window offsets, of the bias process and of its steps between recordings: means over the restricted likelihood."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.estimation.noise_model import BiasProcess, dof_factor, means_beside_middles
from imu_calibration.estimation.restricted_likelihood import RestrictedLikelihood, profile

TYPICAL_TIME, TIME_SPREAD = 100.0, 0.8
"""Correlation times of MEMS biases: around 100 s, log-normal; a short session does not determine them (field catalogue, section 6)."""
CLEAR_GAIN = 30.0
"""Fall of minus twice the log likelihood beyond which a bias process is significant and its maximum-likelihood estimate is used."""
SESSION_GAIN = 6.6
"""The same for biases that differ between recordings: chi-square, one degree of freedom on its boundary, 0.5 %."""
OFFSET_GRID = np.array([0.0, 0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0])
BIAS_GRID = np.array([0.15, 0.25, 0.4, 0.63, 1.0, 1.6, 2.5, 4.0, 6.3, 10.0, 25.0, 60.0])
TIME_GRID = np.array([40.0, 100.0, 250.0])
"""Offset and bias process in units of the typical noise of a window mean; correlation times in s."""
SESSION_GRID = 4.0 ** np.arange(-3, 8)
"""Steps from recording to recording in the same units; the best of them is refined by factors of two and of the root of two."""
FLICKER, FLICKER_TIMES = 0.0, (1.0, 5.0, 25.0, 125.0, 625.0)
"""Correlation time that denotes flicker: equal variance at spaced times, s, from the length of a window to the length of a session."""
LEAST_WINDOWS = 12
"""Fewest windows for the estimate of a bias process."""


class NoiseLikelihood:
    """
    Restricted likelihood of mean rows over shapes of the noise ``(offset sd, sd of the bias process, its correlation time)``.

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

    """

    def __init__(self, rows: np.ndarray, white: np.ndarray, times: np.ndarray, *, sessions: list[np.ndarray],
                 information: np.ndarray | None = None, known: tuple[BiasProcess, ...] = (), durations: np.ndarray | float = 0.0):
        self._durations = np.broadcast_to(durations, len(rows))
        self.typical = float(np.sqrt(np.median(white)))
        self.many, self.known = len(rows) >= LEAST_WINDOWS, known
        self._rows, self._white, self._times, self._sessions = rows, white, times, sessions
        self._likelihood, self._losses = RestrictedLikelihood(rows, times, sessions, information=information), {}

    def loss(self, shape: tuple, used: Sequence[int] | np.ndarray | None = None, *, session: float = 0.0) -> float:
        """Return minus twice the restricted log likelihood with the parameters `used`, by default all."""
        key = (*map(float, shape), float(session))
        if key not in self._losses:
            offset, bias, time, step = np.multiply(key, (self.typical, self.typical, 1.0, self.typical))
            processes = self.processes(bias, time)
            within = means_beside_middles(processes, self._durations)[:, None]
            self._losses[key] = self._likelihood.whitened(self._white + within + offset**2, processes, step**2)
        logs, normal = self._losses[key]
        if used is not None:
            at = np.r_[used, len(normal) - 1]
            normal = normal[np.ix_(at, at)]
        return logs + profile(normal)

    def of_axis(self, axis: int, shape: tuple) -> 'NoiseLikelihood':
        """Return the likelihood of the noise of one axis, the other axes fixed at the shape; in units of the axis' own typical noise."""
        offset, bias, time = np.multiply(shape, (self.typical, self.typical, 1.0))
        others = np.arange(self._white.shape[1]) != axis
        processes = self.processes(bias, time)
        variance = self._white[:, others] + means_beside_middles(processes, self._durations)[:, None] + offset**2
        information = self._likelihood.of_axes(others).whitened(variance, processes)[1]
        return NoiseLikelihood(self._rows[:, [axis]], self._white[:, [axis]], self._times, sessions=self._sessions, information=information,
                               known=self.known, durations=self._durations)

    def processes(self, sd: float, time: float) -> tuple[BiasProcess, ...]:
        """Return the known processes plus one more (or the flicker processes) if its standard deviation is above zero."""
        times = FLICKER_TIMES if time == FLICKER else (time,)
        return (*self.known, *(BiasProcess(sd / float(np.sqrt(len(times))), each) for each in times)) if sd > 0 else self.known


def estimate_offsets(rows: np.ndarray, white: np.ndarray, times: np.ndarray, *, sessions: list[np.ndarray], information: np.ndarray,
                     known: tuple[BiasProcess, ...] = (), durations: np.ndarray | float = 0.0) -> dict:
    """
    Return the fields of `NoiseModel` that concern offsets: offset_sd, bias_processes, session_sd, session_variance.

    A short session does not determine the size of a bias process, and the sd of a bias depends on that size. So the
    variances are averaged over the likelihood (posterior means on a grid); only a significant process is set to its best estimate.
    With several recordings a bias per recording is included if the likelihood gains `SESSION_GAIN` over the best fit
    with offsets and process. Where bias processes are known, a further process must be significant.

    Parameters
    ----------
    rows, white, times, sessions, information, known, durations
        As in `NoiseLikelihood`.

    """
    search = _Search(NoiseLikelihood(rows, white, times, sessions=sessions, information=information, known=known,
                                     durations=durations))
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
    return {'offset_sd': offset * typical, 'bias_processes': search.likelihood.processes(bias * typical, time),
            'session_sd': session * typical, 'session_variance': (session * typical)**2 * factor}


class _Search:
    """The likelihood times the prior of correlation times, on a grid of shapes, for a given sd between recordings."""

    def __init__(self, likelihood):
        self.likelihood = likelihood
        self.biases = BIAS_GRID if likelihood.many else BIAS_GRID[:0]

    def cost(self, shape, session=0.0):
        """Return minus twice the log of likelihood times prior."""
        return self.likelihood.loss(shape, session=session) + (np.log(shape[2] / TYPICAL_TIME) / TIME_SPREAD)**2

    def grid(self, session):
        """Return the shapes tried, shape (k, 3), and their costs; shapes without bias process are first."""
        trials = [(offset, 0.0, TYPICAL_TIME) for offset in OFFSET_GRID]
        alone = np.array([self.cost(trial, session) for trial in trials])
        offsets = np.unique(np.concatenate([[0.0], OFFSET_GRID[alone < alone.min() + 20.0]]))
        moving = [(offset, bias, time) for bias in self.biases for time in TIME_GRID for offset in offsets]
        return np.array(trials + moving), np.concatenate([alone, [self.cost(trial, session) for trial in moving]])

    def best_session(self, shape):
        """Return the likeliest sd between recordings, over the best offsets and process, the offsets without process, and neither."""
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
        if costs[:len(OFFSET_GRID)].min() - costs[best] > CLEAR_GAIN:
            return self._best(trials[best], session)
        if self.likelihood.known:
            trials, costs = trials[:len(OFFSET_GRID)], costs[:len(OFFSET_GRID)]
            best = int(np.argmin(costs))
        return _posterior_mean(trials, costs - costs[best])

    def _best(self, start, session):
        """Return the best values near a grid point."""
        from scipy.optimize import minimize  # here, because its import is slow

        unit = self.likelihood.typical

        def shape(x):
            return np.exp(x[0]) / unit, np.exp(x[1]) / unit, np.exp(np.clip(x[2], 1.6, 8.0))

        found = minimize(lambda x: self.cost(shape(x), session), np.log([max(start[0], 0.1) * unit, start[1] * unit, start[2]]),
                         method='Nelder-Mead', options={'maxfev': 80, 'xatol': 0.03, 'fatol': 0.03})
        return tuple(float(value) for value in shape(found.x))


def _posterior_mean(trials, costs):
    """Return the roots of the mean variances, and the mean logarithm of the correlation time, over the likelihood."""
    weight = np.exp(-0.5 * costs) * np.where(trials[:, 1] == 0, 1.0, 1.0 / len(TIME_GRID))
    weight /= weight.sum()
    offset, bias = np.sqrt(weight @ trials[:, :2]**2)
    moving = weight * trials[:, 1]**2
    if moving.sum() <= 0:
        return float(offset), 0.0, TYPICAL_TIME
    return float(offset), float(bias), float(np.exp(moving @ np.log(trials[:, 2]) / moving.sum()))
