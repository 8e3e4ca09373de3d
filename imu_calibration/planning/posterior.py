"""Information on parameters from planned motions, and a lower bound by relaxation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy.linalg

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import References, columns
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.coordinates import Coordinates
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.simulation.motion_builder import Profile, Segment

MAX_WEIGHT_STEPS = 600
"""
Steps of the multiplicative algorithm; the certificate is mostly within a few per cent after 200.
"""
MAX_REACHABLE_SECONDS = 1e7
"""Tolerances that are not met after this time for every motion are out of reach, s."""
CERTIFICATE_RATIO = 1.01
"""The search ends when the relaxed value is within this factor of the certificate."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """The relaxed plan and its certificate."""

    seconds: float
    """Lower bound on the time of every plan, s."""
    weights: np.ndarray
    """How much each parameter limits the relaxed plan, sum 1, shape (p,)."""


def relax(
    information: np.ndarray, seconds: np.ndarray, known: np.ndarray, *, asked: np.ndarray
) -> Relaxation:
    """
    Return the relaxed plan with the best certificate found; NaN where a tolerance is out of reach.

    Visits and weights are improved by turns with multiplicative steps: visits of motions that are
    worth more than they cost grow (the algorithm of A-optimal design), and so do the weights of
    parameters with the largest excess over tolerance.

    Parameters
    ----------
    information : ndarray, shape (k, n, n)
        Most that one visit adds.
    seconds : ndarray, shape (k,)
        Cost.
    known : ndarray, shape (n, n)
        Information to start with.
    asked : ndarray, shape (p, n)
        Rows e_i: parameters in tolerances.

    """
    weights = np.full(len(asked), 1.0 / len(asked))
    if _worst(known, asked) <= 1.0:
        return Relaxation(0.0, weights)
    per_second = np.sum(information / seconds[:, None, None], axis=0)
    if _worst(known + MAX_REACHABLE_SECONDS * per_second, asked) > 1.0:
        return Relaxation(np.nan, weights)
    flat = used = information.reshape(len(seconds), -1)
    kept = np.arange(len(seconds))
    root = np.linalg.cholesky(known)
    rows = scipy.linalg.solve_triangular(root, asked.T, lower=True).T
    share = 1.0 / len(seconds) / seconds
    best = Relaxation(0.0, weights)
    for number in range(MAX_WEIGHT_STEPS):
        direction = np.tensordot(share[kept], used, 1).reshape(known.shape)
        scale = _scale(direction, root, rows)
        # With C the covariance and w the weights: variance_p = e_p' C e_p, and the price matrix
        # C (sum_p w_p e_p e_p') C; worth of a visit: tr(information prices) per second.
        # Nearly singular in unreachable directions.
        covariance = inverse_normal(known + scale * direction)
        columns_asked = covariance @ asked.T
        variance = np.einsum('pn,np->p', asked, columns_asked)
        prices = (columns_asked * weights) @ columns_asked.T
        worth = np.zeros(len(seconds))
        worth[kept] = used @ prices.ravel() / seconds[kept]
        relaxed = scale * float(share @ seconds)
        if number % 25 == 0 or number == MAX_WEIGHT_STEPS - 1:
            # The certificate needs the worth of all motions, the steps only of the useful ones.
            worth = flat @ prices.ravel() / seconds
            factor = 1.0 / worth.max()
            bound = factor * (weights @ (2 * variance - 1) - np.sum(known * prices))
            if bound > best.seconds:
                best = Relaxation(float(bound), weights)
            if relaxed < CERTIFICATE_RATIO * best.seconds:
                break
            is_visited = share * seconds > 1e-4 * (share @ seconds)
            kept = np.flatnonzero((worth > 0.3 * worth.max()) | is_visited)
            used = flat[kept]
        spent = share[kept] * seconds[kept]
        mean_worth = worth[kept] @ spent / spent.sum()
        share[kept] *= np.sqrt(np.maximum(worth[kept], 1e-12) / mean_worth)
        share = np.where(np.isin(np.arange(len(share)), kept) | (number <= 50), share, 0.0)
        weights = weights * variance / variance.max()
        weights /= weights.sum()
    return best


def _worst(information, asked):
    return float(np.einsum('pn,pn->p', asked @ np.linalg.inv(information), asked).max())


def _scale(direction, root, rows):
    """
    Return how much of `direction` must be added to ``root @ root.T``.

    With this amount the worst parameter meets its tolerance.
    """
    inner = scipy.linalg.solve_triangular(
        root, scipy.linalg.solve_triangular(root, direction, lower=True).T, lower=True
    )
    values, vectors = scipy.linalg.eigh(0.5 * (inner + inner.T))
    squares = (rows @ vectors) ** 2
    low, high = -30.0, 60.0
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        enough = (squares / (1 + np.exp(middle) * np.maximum(values, 0.0))).sum(axis=1).max() <= 1.0
        low, high = (low, middle) if enough else (middle, high)
    return float(np.exp(high))


SAMPLING = 16.0
"""Instants per second at which columns are evaluated: a turn at 300 deg/s has 19."""
LEAST_INSTANTS = 4
"""
Instants of a rest, where columns are all one and the bias wanders, and of the shortest motion.
"""
BELIEF_BLOCK_ROWS = 8192
"""Instants whose columns are held in memory at a time."""
WINDOWS = {'rest': 'static', 'spin': 'spin'}
"""Segment -> window; all remaining segments are dynamic."""


@dataclass(frozen=True, eq=False)
class PlannedWindow:
    """One window of a planned motion, as the calibration will cut it."""

    kind: str
    """As the calibration will call it."""
    middle: float
    """Time since the motion began, s."""
    length: float
    """s, with the lost time before it."""
    samples: float
    """Number of samples in it."""
    means: dict[str, np.ndarray]
    """Sensor -> rows of the means, shape (3, n)."""
    variance: dict[str, np.ndarray]
    """
    Sensor -> variance of the means in addition to the bias in the middle of the window, shape (3,).
    """
    within: np.ndarray
    """Information of the samples about their means, of both sensors together, shape (n, n)."""


@dataclass(frozen=True, eq=False)
class _Cut:
    """Part of a planned motion that becomes one window."""

    motion: JointMotion
    """At some instants."""
    kind: str
    """As the calibration will call it."""
    middle: float
    """Time since the motion began, s."""
    length: float
    """s, with the lost time before it."""
    seconds: float
    """Seconds of data."""


WINDOW_SETTINGS = WindowSettings()
"""How the calibration will cut windows."""


class WindowPredictor:
    """
    Works out windows of planned motions from the columns of the model.

    Parameters
    ----------
    table : Table
    coordinates : Coordinates
        The model at its point of linearisation, with the units of its parameters.
    noise : dict
        Sensor -> NoiseModel of single samples.
    rate : float
        Samples per second.

    """

    def __init__(
        self, table: Table, coordinates: Coordinates, noise: dict[str, NoiseModel], *, rate: float
    ):
        self.table = table
        self.coordinates = coordinates
        self.noise = noise
        self.rate = rate

    def predict(self, motions: Sequence[tuple[Segment, ...]]) -> list[list[PlannedWindow]]:
        """Return the windows of each of several motions, a tuple of segments each."""
        cuts, n_cuts = [], []
        for segments in motions:
            cuts_of_motion = list(self._cut(segments))
            cuts += cuts_of_motion
            n_cuts.append(len(cuts_of_motion))

        # The columns of several windows at a time, which limits the memory.
        blocks = np.cumsum([len(cut.motion) for cut in cuts]) // BELIEF_BLOCK_ROWS
        # Many motions last equally long, at least a move and its way back.
        wander = cache(self._wander)
        windows = []
        for block in np.unique(blocks):
            windows += self._windows([cuts[k] for k in np.flatnonzero(blocks == block)], wander)

        ends = np.cumsum(n_cuts)
        return [windows[end - n : end] for end, n in zip(ends, n_cuts)]

    def _windows(self, cuts, wander):
        motion = JointMotion.concatenate(cut.motion for cut in cuts)
        ends = np.cumsum([len(cut.motion) for cut in cuts])
        model = self.coordinates.folded
        temperature = None
        if model.needs_temperature:
            temperature = np.full(len(motion), model.temperature_ref_c)
        references = References(model, self.table, motion, temperature_c=temperature)
        designs = {sensor: columns(references, sensor) for sensor in SENSORS}
        windows = []
        for cut, end in zip(cuts, ends):
            rows = slice(end - len(cut.motion), end)
            designs_of_cut = {sensor: designs[sensor][rows] for sensor in SENSORS}
            windows.append(self._window(cut, designs_of_cut, wander))
        return windows

    def _cut(self, segments) -> Iterator[_Cut]:
        """Yield the windows into which the calibration will cut a motion."""
        begin = 0.0
        for segment in segments:
            kind = WINDOWS.get(segment.kind, 'dynamic')
            lost = 0.0 if kind == 'dynamic' else WINDOW_SETTINGS.settling
            seconds = segment.duration - lost
            if seconds >= getattr(WINDOW_SETTINGS, f'{kind}_minimum'):
                count = LEAST_INSTANTS
                if kind != 'static':
                    count = max(int(np.ceil(seconds * SAMPLING)), LEAST_INSTANTS)
                time = lost + (np.arange(count) + 0.5) / count * seconds
                motion = Profile('', (segment,)).at(time)
                middle = begin + lost + seconds / 2
                yield _Cut(motion, kind, middle, segment.duration, seconds)
            begin += segment.duration

    def _wander(self, sensor, count, seconds):
        """
        Return (variances, directions) of the changes of the bias after the middle of a window.

        Given its value in the middle, the bias before is independent of the bias after, with the
        mirrored covariance.
        """
        half = count // 2
        after_middle = ((np.arange(count - half, count) + 0.5) / count - 0.5) * seconds
        return np.linalg.eigh(self.noise[sensor].wander_within(after_middle))

    def _window(self, cut, designs, wander_of):
        samples = cut.seconds * self.rate
        count = len(cut.motion)
        means, variance = {}, {}
        within = np.zeros((self.coordinates.size,) * 2)
        for sensor, design in designs.items():
            slope = self.coordinates.slopes[sensor]
            noise = self.noise[sensor]
            means[sensor] = np.empty((3, slope.shape[2]))
            variance[sensor] = np.empty(3)
            reference = noise.reference.variance([cut.kind], np.array([cut.seconds]))[0]
            # In the directions of the wander its values are independent, before and after the
            # middle: the rows are weighted by the sum of both variances.
            after, turned = wander_of(sensor, count, cut.seconds)
            wander = np.concatenate([after, np.zeros(count % 2), after])
            early, centre, late = np.split(
                np.column_stack([np.ones(count), design]), [len(after), count - len(after)]
            )
            # Without the copy numpy multiplies reversed rows without BLAS.
            rows = np.concatenate([turned.T @ early[::-1].copy(), centre, turned.T @ late])
            ones = rows[:, 0]
            rows = rows[:, 1:]
            for axis in range(3):
                weight = 1 / (noise.low_variance[axis] * count / samples + wander)
                variance[sensor][axis] = 1 / (weight @ ones**2)
                mean = variance[sensor][axis] * ((weight * ones) @ rows)
                centred = (rows - np.outer(ones, mean)) @ slope[:, axis]
                variance[sensor][axis] += reference
                means[sensor][axis] = mean @ slope[:, axis]
                within += centred.T @ (centred * weight[:, None])
        return PlannedWindow(cut.kind, cut.middle, cut.length, samples, means, variance, within)


class Posterior:
    """
    Covariance of the coordinates z and of every bias process of every axis.

    Between motions the processes decay, ``u <- exp(-dt / time) u + noise``, so that early
    observations of a bias contain little information on its present value: a dwell saturates, a
    return does not. They are constant within one motion.

    Parameters
    ----------
    information : ndarray, shape (n, n)
        Of z, the prior included.
    noise : dict
        Sensor -> NoiseModel.

    """

    def __init__(self, information: np.ndarray, noise: dict[str, NoiseModel]):
        self.size = len(information)
        self.noise = noise
        processes = []
        for sensor in SENSORS:
            for process in noise[sensor].bias_processes:
                processes += [process, process, process]  # one for each axis
        self._power = np.array([process.sd**2 for process in processes])
        self._times = np.array([process.time for process in processes])
        total = self.size + len(processes)
        self.covariance = np.zeros((total, total))
        self.covariance[: self.size, : self.size] = np.linalg.inv(information)
        self.covariance[self.size :, self.size :] = np.diag(self._power)
        self._last = 0.0

    @property
    def known(self) -> np.ndarray:
        """Covariance of z, shape (n, n)."""
        return self.covariance[: self.size, : self.size]

    def information_of(self, windows: Sequence[PlannedWindow]) -> np.ndarray:
        """
        Return the information about z and the biases in the windows of a motion, shape (m, m).
        """
        total = np.zeros_like(self.covariance)
        for window in windows:
            first = self.size
            total[: self.size, : self.size] += window.within
            for sensor in SENSORS:
                noise = self.noise[sensor]
                rows = np.zeros((3, len(total)))
                rows[:, : self.size] = window.means[sensor]
                for number in range(3 * len(noise.bias_processes)):
                    rows[number % 3, first + number] = 1.0
                first += 3 * len(noise.bias_processes)
                variance = window.variance[sensor] + noise.offset_sd**2
                total += rows.T @ (rows / variance[:, None])
        return total

    def after(self, information: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        """
        Return the covariances after each of several motions.

        Parameters
        ----------
        information : ndarray, shape (k, m, m)
            Of `information_of`.
        seconds : ndarray, shape (k,)
            Their lengths.

        Returns
        -------
        ndarray, shape (k, m, m)

        """
        # Many motions last equally long.
        steps, motion = np.unique(0.5 * (self._last + seconds), return_inverse=True)
        return np.linalg.inv(np.linalg.inv(self._forgotten(steps))[motion] + information)

    def take(self, information: np.ndarray, seconds: float) -> None:
        """Advance by a chosen motion."""
        self.covariance = self.after(information[None], np.array([seconds]))[0]
        self._last = seconds

    def _forgotten(self, steps):
        decay = np.ones((len(steps), len(self.covariance)))
        decay[:, self.size :] = np.exp(-steps[:, None] / self._times)
        spread = decay[:, :, None] * self.covariance * decay[:, None, :]
        at = np.arange(self.size, len(self.covariance))
        spread[:, at, at] += (1 - decay[:, at] ** 2) * self._power
        return spread


def exact_information(
    windows: Sequence[PlannedWindow],
    times: np.ndarray,
    noise: dict[str, NoiseModel],
    *,
    factor: float = 1.0,
) -> np.ndarray:
    """
    Return the information about z of the windows of a whole plan, as the calibration weighs them.

    Shape (n, n).

    Parameters
    ----------
    windows : sequence of PlannedWindow
    times : ndarray, shape (k,)
        Middles of the windows since the beginning, s.
    noise : dict
        Sensor -> NoiseModel.
    factor : float
        On the variance of the noise within windows.

    """
    total = np.sum([window.within for window in windows], axis=0) / factor
    for sensor in SENSORS:
        model = noise[sensor]
        variance = (
            factor * np.stack([window.variance[sensor] for window in windows]) + model.offset_sd**2
        )
        whitening = Whitening(
            variance, times, [np.arange(len(times))], processes=model.bias_processes
        )
        rows = whitening(np.stack([window.means[sensor] for window in windows])).reshape(
            -1, len(total)
        )
        total = total + rows.T @ rows
    return total


def additive_bound(
    window: PlannedWindow, noise: dict[str, NoiseModel], *, share: float = 1.0, factor: float = 1.0
) -> np.ndarray:
    """
    Return an information matrix that bounds from above what a window adds in any plan.

    Shape (n, n).

    For the given share of the covariance of the bias processes, the remainder is `common_variance`;
    `factor` as in `exact_information`.

    The covariance of the window means is ``diag(variance) + sum_j G_j`` with G_j that of an
    Ornstein-Uhlenbeck process seen at the middles of the windows, whose inverse is tridiagonal. Its
    rows in absolute value sum to at most ``coth(g / (2 time)) / sd^2`` with g the smaller distance
    to a neighbour, so (Gershgorin) ``G_j >= sd_j^2 diag(tanh(g / (2 time_j)))`` as matrices; and g
    is at least half the window's own length. A larger covariance is less information: with each G_j
    at its bound the means are independent, and information adds up.
    """
    total = window.within / factor
    for sensor in SENSORS:
        model = noise[sensor]
        floor = share * sum(
            process.sd**2 * np.tanh(window.length / (4 * process.time))
            for process in model.bias_processes
        )
        variance = factor * window.variance[sensor] + model.offset_sd**2 + floor
        rows = window.means[sensor]
        total += rows.T @ (rows / variance[:, None])
    return total


def common_variance(noise: NoiseModel, seconds: np.ndarray | float) -> np.ndarray | float:
    """
    Return c such that the bias covariance is at least ``c 1 1'``.

    It is the covariance of the bias processes seen at any instants within so many seconds.

    ``1' G^-1 1`` is the information about a constant with the process, at most ``(T + 2 time) / (2
    time sd^2)``, that of observing it all the time; of several processes the inverses add up.
    """
    return sum(
        process.sd**2 * 2 * process.time / (seconds + 2 * process.time)
        for process in noise.bias_processes
    )


def least_bias_variance(noise: NoiseModel, white: float, seconds: np.ndarray) -> np.ndarray:
    """
    Return the variance of a constant bias from continuous observation.

    With white noise and the bias processes, shape of `seconds`.

    For one process, ``integral(S exp(-|t - s| / time) h(s)) + white h(t) = 1`` is solved by ``h = a
    + b cosh(k (t - T / 2))`` with ``k^2 = 1 / time^2 + 2 S / (time white)``, and the variance is
    ``1 / integral(h)``. Of several processes the variances add up (parallel sums are concave), with
    the white noise added to any one of them.

    Parameters
    ----------
    white : float
        Variance of the mean over one second.
    seconds : ndarray

    """
    seconds = np.asarray(seconds, float)
    best = white / seconds
    for chosen in noise.bias_processes:
        k = np.sqrt(1 / chosen.time**2 + 2 * chosen.sd**2 / (chosen.time * white))
        level = 1 / (chosen.time * k) ** 2
        steep = np.tanh(k * seconds / 2)
        information = (
            level * seconds + 2 * (1 - level) * steep / (k * (1 + k * chosen.time * steep))
        ) / white
        others = tuple(process for process in noise.bias_processes if process is not chosen)
        rest = common_variance(replace(noise, bias_processes=others), seconds)
        best = np.maximum(best, 1 / information + rest)
    return best
