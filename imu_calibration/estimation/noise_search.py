"""How large the offsets of windows, the wander of the bias and its steps from recording to recording are: restricted likelihood."""

import numpy as np

from imu_calibration.estimation.restricted_likelihood import OffsetLikelihood

TYPICAL_TIME, TIME_SPREAD = 100.0, 0.8
"""Correlation times of MEMS biases: around 100 s, log-normal; a short session cannot tell them (field catalogue, section 6)."""
CLEAR_GAIN = 30.0
"""Fall of minus twice the log likelihood beyond which a wander's size is plain and its best estimate is taken."""
SESSION_GAIN = 6.6
"""The same for biases that differ from recording to recording: chi-square, one degree of freedom on its boundary, 0.5 %."""
OFFSET_GRID = np.array([0.0, 0.3, 0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0])
WANDER_GRID = np.array([0.0, 0.15, 0.25, 0.4, 0.63, 1.0, 1.6, 2.5, 4.0, 6.3, 10.0, 25.0, 60.0])
TIME_GRID = np.array([40.0, 100.0, 250.0])
"""Offset and wander in units of the typical noise of a window mean; correlation times in s."""
SESSION_GRID = 4.0 ** np.arange(-3, 8)
"""Steps from recording to recording in the same units; the best of them is refined by factors of two and of the root of two."""
UNCERTAINTY_MOST = 3.0
"""Largest factor by which few recordings widen the variance of their biases."""


def estimate_offsets(rows, white, times, sessions, information):
    """
    Return the fields of `WindowNoise` that concern offsets: offset_sd, wander_sd, wander_time, session_sd, session_variance.

    A short session leaves open how large a wander is, and a bias is only as certain as its wander is small. So the
    variances are averaged over the likelihood (posterior means on a grid); only a wander that is plain gets its best value.
    With several recordings the bias may differ from one to the next; it does when the likelihood gains `SESSION_GAIN`
    over the best that offsets and wander alone can do.

    Parameters
    ----------
    rows : ndarray, shape (n, 3, q + 1)
        Mean rows ``[design | residual]`` of the linearised model, one layer per axis.
    white : ndarray, shape (n, 3)
        Variance of the means by the noise within windows.
    times : ndarray, shape (n,)
        Middle of each window, s.
    sessions : list of ndarray
        Indices of each recording's windows in order of time.
    information : ndarray, shape (q + 1, q + 1)
        Gram matrix of everything else that is known of the parameters.

    """
    search = _Search(rows, white, times, sessions, information)
    trials, costs = search.grid(0.0)
    session = search.best_session(trials[np.argmin(costs)]) if len(sessions) > 1 else 0.0
    if session > 0:
        apart = search.grid(session)
        if costs.min() - apart[1].min() > SESSION_GAIN:
            trials, costs = apart
        else:
            session = 0.0
    offset_sd, wander_sd, wander_time = search.conclusion(trials, costs, session)
    return {'offset_sd': offset_sd, 'wander_sd': wander_sd, 'wander_time': wander_time, 'session_sd': session,
            'session_variance': session**2 * _uncertainty(len(sessions))}


def _uncertainty(n_sessions):
    """Return dof / (dof - 2), the variance of the t distribution, for three axes of `n_sessions` biases about their mean."""
    dof = 3 * (n_sessions - 1)
    return min(dof / max(dof - 2, 1e-9), UNCERTAINTY_MOST) if dof else 1.0


class _Search:
    """The likelihood on a grid of shapes (offset sd, wander sd, correlation time), for a given sd from recording to recording."""

    def __init__(self, rows, white, times, sessions, information):
        self.typical = float(np.sqrt(np.median(white)))
        self.likelihood = OffsetLikelihood(rows, white, times, sessions, information)
        self.wanders = WANDER_GRID[WANDER_GRID > 0] * self.typical if len(rows) >= 12 else WANDER_GRID[:0]

    def cost(self, shape, session=0.0):
        """Return minus twice the log of likelihood times what is known of correlation times."""
        return self.likelihood(*shape, session) + (np.log(shape[2] / TYPICAL_TIME) / TIME_SPREAD)**2

    def grid(self, session):
        """Return the shapes tried, shape (k, 3), and their costs; those without wander come first."""
        trials = [(offset, 0.0, TYPICAL_TIME) for offset in OFFSET_GRID * self.typical]
        alone = np.array([self.cost(trial, session) for trial in trials])
        offsets = np.unique(np.concatenate([[0.0], OFFSET_GRID[alone < alone.min() + 20.0]])) * self.typical
        wandering = [(offset, wander, time) for wander in self.wanders for time in TIME_GRID for offset in offsets]
        return np.array(trials + wandering), np.concatenate([alone, [self.cost(trial, session) for trial in wandering]])

    def best_session(self, shape):
        """Return the likeliest sd from recording to recording, beside the best offsets and wander without it and beside none."""
        shapes = [tuple(shape), (shape[0], 0.0, TYPICAL_TIME), (0.0, 0.0, TYPICAL_TIME)]
        shapes += [(0.0, wander, TYPICAL_TIME) for wander in self.wanders[::4]]

        def cost(session):
            return min(self.cost(candidate, session) for candidate in shapes)

        best = min(SESSION_GRID * self.typical, key=cost)
        for factor in (2.0, np.sqrt(2.0)):
            best = min((best, best / factor, best * factor), key=cost)
        return float(best)

    def conclusion(self, trials, costs, session):
        """Return offset sd, wander sd and correlation time."""
        best = int(np.argmin(costs))
        if costs[:len(OFFSET_GRID)].min() - costs[best] > CLEAR_GAIN:
            return self._best_wander(trials[best], session)
        return _posterior_mean(trials, costs - costs[best])

    def _best_wander(self, start, session):
        """Return the best values near a grid point."""
        from scipy.optimize import minimize  # here, because it takes long to import

        def shape(x):
            return np.exp(x[0]), np.exp(x[1]), np.exp(np.clip(x[2], 1.6, 8.0))

        found = minimize(lambda x: self.cost(shape(x), session), np.log([max(start[0], 0.1 * self.typical), *start[1:]]),
                         method='Nelder-Mead', options={'maxfev': 80, 'xatol': 0.03, 'fatol': 0.03})
        return tuple(float(value) for value in shape(found.x))


def _posterior_mean(trials, costs):
    """Return the roots of the mean variances, and the mean logarithm of the correlation time, over the likelihood."""
    weight = np.exp(-0.5 * costs) * np.where(trials[:, 1] == 0, 1.0, 1.0 / len(TIME_GRID))
    weight /= weight.sum()
    offset, wander = np.sqrt(weight @ trials[:, :2]**2)
    wandering = weight * trials[:, 1]**2
    if wandering.sum() <= 0:
        return float(offset), 0.0, TYPICAL_TIME
    return float(offset), float(wander), float(np.exp(wandering @ np.log(trials[:, 2]) / wandering.sum()))
