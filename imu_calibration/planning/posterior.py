"""Information on parameters from planned motions, and a lower bound by relaxation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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
    """Weight of each parameter in the certificate: how much it limits the plan, sum 1, (p,)."""


def relax(
    information: np.ndarray, seconds: np.ndarray, prior: np.ndarray, *, rows: np.ndarray
) -> Relaxation:
    """
    Return the relaxed plan with the best certificate found; NaN where a tolerance is out of reach.

    The relaxed plan minimises the time over real numbers of visits x_i >= 0 of motions with
    information M_i, such that every parameter meets its tolerance 1::

        min_x sum_i x_i seconds_i  with  e_p' C e_p <= 1,  C = (prior + sum_i x_i M_i)^-1

    Visits and weights are improved by turns with multiplicative steps: visits of motions that are
    worth more than they cost grow (the algorithm of A-optimal design), and so do the weights of
    parameters with the largest excess over tolerance. With weights w and the price matrix
    ``K = C (sum_p w_p e_p e_p') C``, the certificate (dual value) that no plan needs less is::

        (sum_p w_p (2 e_p' C e_p - 1) - tr(prior K)) / max_i (tr(M_i K) / seconds_i)

    Parameters
    ----------
    information : ndarray, shape (k, n, n)
        M_i, the most that one visit adds.
    seconds : ndarray, shape (k,)
        Time of one visit.
    prior : ndarray, shape (n, n)
        Information to start with.
    rows : ndarray, shape (p, n)
        Rows e_p: parameters in tolerances.

    """
    weights = np.full(len(rows), 1.0 / len(rows))
    if _largest_variance(prior, rows) <= 1.0:
        return Relaxation(0.0, weights)
    per_second = np.sum(information / seconds[:, None, None], axis=0)
    if _largest_variance(prior + MAX_REACHABLE_SECONDS * per_second, rows) > 1.0:
        return Relaxation(np.nan, weights)
    # M_i of all motions, and of those with the indexes `useful`; one row each.
    flat = information.reshape(len(seconds), -1)
    flat_useful = flat
    useful = np.arange(len(seconds))
    root = np.linalg.cholesky(prior)
    whitened_rows = scipy.linalg.solve_triangular(root, rows.T, lower=True).T
    # Visits up to a common factor, at first with equal times.
    visits = 1.0 / len(seconds) / seconds
    best = Relaxation(0.0, weights)
    for number in range(MAX_WEIGHT_STEPS):
        # 1. The visits, scaled until the worst parameter meets its tolerance, and the prices K.
        added = np.tensordot(visits[useful], flat_useful, 1).reshape(prior.shape)
        scale = _scale(added, root, whitened_rows)
        # Nearly singular in unreachable directions.
        covariance = inverse_normal(prior + scale * added)
        columns_of_rows = covariance @ rows.T  # C e_p
        variance = np.einsum('pn,np->p', rows, columns_of_rows)  # e_p' C e_p
        prices = (columns_of_rows * weights) @ columns_of_rows.T
        # Worth of a second of each motion: tr(M_i K) / seconds_i.
        worth = np.zeros(len(seconds))
        worth[useful] = flat_useful @ prices.ravel() / seconds[useful]
        plan_seconds = scale * float(visits @ seconds)
        # 2. Every 25 steps the certificate, the end of the search, and the choice of the useful
        #    motions, which need the worth of all.
        if number % 25 == 0 or number == MAX_WEIGHT_STEPS - 1:
            worth = flat @ prices.ravel() / seconds
            factor = 1.0 / worth.max()
            bound = factor * (weights @ (2 * variance - 1) - np.sum(prior * prices))
            if bound > best.seconds:
                best = Relaxation(float(bound), weights)
            if plan_seconds < CERTIFICATE_RATIO * best.seconds:
                break
            # Useful motions have a third of the largest worth, or a share of the time.
            is_visited = visits * seconds > 1e-4 * (visits @ seconds)
            useful = np.flatnonzero((worth > 0.3 * worth.max()) | is_visited)
            flat_useful = flat[useful]
        # 3. Step of the visits by the root of their worth relative to the mean worth of the time
        #    spent; then of the weights by the variances.
        spent = visits[useful] * seconds[useful]
        mean_worth = worth[useful] @ spent / spent.sum()
        visits[useful] *= np.sqrt(np.maximum(worth[useful], 1e-12) / mean_worth)
        # Early steps keep the visits of the other motions, which may become useful again.
        if number > 50:
            visits[np.setdiff1d(np.arange(len(visits)), useful)] = 0.0
        weights = weights * variance / variance.max()
        weights /= weights.sum()
    return best


def _largest_variance(information: np.ndarray, rows: np.ndarray) -> float:
    """Return the largest ``e_p' M^-1 e_p`` of information M, (n, n), and rows e_p, (p, n)."""
    return float(np.einsum('pn,pn->p', rows @ np.linalg.inv(information), rows).max())


def _scale(added: np.ndarray, root: np.ndarray, whitened_rows: np.ndarray) -> float:
    """
    Return the factor s of `added` information at which the worst parameter meets its tolerance.

    With prior information R R' (`root` R), added D, and rows e_p = R f_p (`whitened_rows` f_p), by
    the eigenvalues l_j and eigenvectors v_j of R^-1 D R'^-1::

        max_p e_p' (R R' + s D)^-1 e_p = max_p sum_j (f_p' v_j)^2 / (1 + s l_j) = 1

    It decreases with s, whose logarithm is found by bisection.
    """
    half_whitened = scipy.linalg.solve_triangular(root, added, lower=True)
    whitened = scipy.linalg.solve_triangular(root, half_whitened.T, lower=True)
    values, vectors = scipy.linalg.eigh(0.5 * (whitened + whitened.T))
    squares = (whitened_rows @ vectors) ** 2
    values = np.maximum(values, 0.0)
    low = -30.0  # logarithms of the factor
    high = 60.0
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        variance = (squares / (1 + np.exp(middle) * values)).sum(axis=1)
        if variance.max() <= 1.0:
            high = middle
        else:
            low = middle
    return float(np.exp(high))


SAMPLING = 16.0
"""Instants per second at which columns are evaluated: a turn at 300 deg/s has 19."""
LEAST_INSTANTS = 4
"""Instants of a rest, where only the bias changes, and of the shortest motion."""
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
WanderOf = Callable[[str, int, float], tuple[np.ndarray, np.ndarray]]
"""`WindowPredictor._bias_wander` with a cache."""


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
        cuts = []
        n_cuts = []
        for segments in motions:
            cuts_of_motion = list(self._cut(segments))
            cuts += cuts_of_motion
            n_cuts.append(len(cuts_of_motion))

        # The columns of several windows at a time, which limits the memory.
        blocks = np.cumsum([len(cut.motion) for cut in cuts]) // BELIEF_BLOCK_ROWS
        # Many motions last equally long, at least a move and its reverse.
        wander_of = cache(self._bias_wander)
        windows = []
        for block in np.unique(blocks):
            cuts_of_block = [cuts[k] for k in np.flatnonzero(blocks == block)]
            windows += self._windows(cuts_of_block, wander_of)

        # Windows of each motion.
        ends = np.cumsum(n_cuts)
        return [windows[end - n : end] for end, n in zip(ends, n_cuts)]

    def _windows(self, cuts: Sequence[_Cut], wander_of: WanderOf) -> list[PlannedWindow]:
        """Return the PlannedWindow of each cut, with the columns of all computed at once."""
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
            windows.append(self._window(cut, designs_of_cut, wander_of))
        return windows

    def _cut(self, segments: Sequence[Segment]) -> Iterator[_Cut]:
        """Yield the windows into which the calibration will cut a motion."""
        begin = 0.0
        for segment in segments:
            kind = WINDOWS.get(segment.kind, 'dynamic')
            # Rests and spins begin after the vibrations have decayed.
            lost = 0.0 if kind == 'dynamic' else WINDOW_SETTINGS.settling
            seconds = segment.duration - lost
            if seconds >= getattr(WINDOW_SETTINGS, f'{kind}_minimum'):
                n_instants = LEAST_INSTANTS
                if kind != 'static':
                    n_instants = max(int(np.ceil(seconds * SAMPLING)), LEAST_INSTANTS)
                time = lost + (np.arange(n_instants) + 0.5) / n_instants * seconds
                motion = Profile('', (segment,)).at(time)
                middle = begin + lost + seconds / 2
                yield _Cut(motion, kind, middle, segment.duration, seconds)
            begin += segment.duration

    def _bias_wander(
        self, sensor: str, count: int, seconds: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return (eigenvalues, eigenvectors) of the covariance of the bias in a half of a window.

        The covariance is that of the changes since the middle of a window of `seconds`, at the
        later half of `count` instants: shapes (count // 2,) and (count // 2, count // 2). Given the
        bias in the middle, the changes before it are independent of those after it, and have the
        mirrored covariance.
        """
        half = count // 2
        after_middle = ((np.arange(count - half, count) + 0.5) / count - 0.5) * seconds
        return np.linalg.eigh(self.noise[sensor].wander_within(after_middle))

    def _window(
        self, cut: _Cut, designs: dict[str, np.ndarray], wander_of: WanderOf
    ) -> PlannedWindow:
        """
        Return the means of a window and the information of its samples about them.

        `designs`: sensor -> columns of the model at the instants, (count, n_columns). The samples
        of an axis are ``1 bias + design @ slope @ z`` plus white noise and the wander of the bias
        since the middle, with weights W (inverse variances) in the directions of the wander::

            var(mean) = 1 / (1' W 1),  mean = var(mean) 1' W rows,
            within    = sum (rows - 1 mean)' W (rows - 1 mean)
        """
        n_samples = cut.seconds * self.rate
        count = len(cut.motion)
        means = {}
        variance = {}
        within = np.zeros((self.coordinates.size,) * 2)
        for sensor, design in designs.items():
            slope = self.coordinates.slopes[sensor]
            noise = self.noise[sensor]
            means[sensor] = np.empty((3, slope.shape[2]))
            variance[sensor] = np.empty(3)
            reference = noise.reference.variance([cut.kind], np.array([cut.seconds]))[0]
            # Each half is turned into the directions of the wander, where its values are
            # independent. The early half is reversed before, so that both begin at the middle. An
            # instant in the middle has no wander.
            half_wander, directions = wander_of(sensor, count, cut.seconds)
            half = len(half_wander)
            wander = np.concatenate([half_wander, np.zeros(count % 2), half_wander])
            early, centre, late = np.split(
                np.column_stack([np.ones(count), design]), [half, count - half]
            )
            reversed_early = early[
                ::-1
            ].copy()  # of rows in reversed order numpy makes no BLAS call
            rows = np.concatenate([directions.T @ reversed_early, centre, directions.T @ late])
            ones = rows[:, 0]
            rows = rows[:, 1:]
            for axis in range(3):
                # An instant has the white noise of the mean of its share of the samples.
                weight = 1 / (noise.low_variance[axis] * count / n_samples + wander)
                mean_variance = 1 / (weight @ ones**2)
                mean = mean_variance * ((weight * ones) @ rows)
                centred = (rows - np.outer(ones, mean)) @ slope[:, axis]
                variance[sensor][axis] = mean_variance + reference
                means[sensor][axis] = mean @ slope[:, axis]
                within += centred.T @ (centred * weight[:, None])
        return PlannedWindow(cut.kind, cut.middle, cut.length, n_samples, means, variance, within)


class Posterior:
    """
    Covariance of the coordinates z and of every bias process of every axis.

    Between motions the processes decay, ``u <- exp(-dt / time) u + noise``, so that early
    observations of a bias contain little information on its present value: a dwell saturates, a
    return does not. They are constant within one motion. The state has m elements: the n
    coordinates, then for each sensor and process the values of its three axes.

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
        self._variances = np.array([process.sd**2 for process in processes])
        """Stationary variance of each process and axis."""
        self._times = np.array([process.time for process in processes])
        """Correlation time of each process and axis, s."""
        n_state = self.size + len(processes)
        self.covariance = np.zeros((n_state, n_state))
        """Covariance of the state at the time of the last motion, shape (m, m)."""
        self.covariance[: self.size, : self.size] = np.linalg.inv(information)
        self.covariance[self.size :, self.size :] = np.diag(self._variances)
        self._last_seconds = 0.0
        """Length of the last motion, s."""

    @property
    def covariance_z(self) -> np.ndarray:
        """Covariance of z, shape (n, n)."""
        return self.covariance[: self.size, : self.size]

    def information_of(self, windows: Sequence[PlannedWindow]) -> np.ndarray:
        """
        Return the information about z and the biases in the windows of a motion, shape (m, m).
        """
        information = np.zeros_like(self.covariance)
        for window in windows:
            first_process = self.size
            information[: self.size, : self.size] += window.within
            for sensor in SENSORS:
                noise = self.noise[sensor]
                # The mean of an axis is linear in z and has the sum of the axis' processes.
                rows = np.zeros((3, len(information)))
                rows[:, : self.size] = window.means[sensor]
                n_processes = len(noise.bias_processes)
                next_sensor = first_process + 3 * n_processes
                rows[:, first_process:next_sensor] = np.tile(np.eye(3), n_processes)
                first_process = next_sensor
                variance = window.variance[sensor] + noise.offset_sd**2
                information += rows.T @ (rows / variance[:, None])
        return information

    def after(self, information: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        """
        Return the covariances of the state after each of several motions, of which one is next.

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
        # From middle to middle of the motions. Many of them last equally long.
        steps, step_of_motion = np.unique(0.5 * (self._last_seconds + seconds), return_inverse=True)
        prior = np.linalg.inv(self._predicted(steps))[step_of_motion]
        return np.linalg.inv(prior + information)

    def take(self, information: np.ndarray, seconds: float) -> None:
        """Advance by a chosen motion of this information and length, s."""
        self.covariance = self.after(information[None], np.array([seconds]))[0]
        self._last_seconds = seconds

    def _predicted(self, steps: np.ndarray) -> np.ndarray:
        """
        Return the covariances of the state after times without a motion, shape (k, m, m).

        The biases decay by ``d = exp(-step / time)`` and gain the variance ``(1 - d^2) sd^2``; z is
        constant. `steps`: times in s, shape (k,).
        """
        decay = np.ones((len(steps), len(self.covariance)))
        decay[:, self.size :] = np.exp(-steps[:, None] / self._times)
        predicted = decay[:, :, None] * self.covariance * decay[:, None, :]
        biases = np.arange(self.size, len(self.covariance))
        predicted[:, biases, biases] += (1 - decay[:, biases] ** 2) * self._variances
        return predicted


def exact_information(
    windows: Sequence[PlannedWindow],
    times: np.ndarray,
    noise: dict[str, NoiseModel],
    *,
    factor: float = 1.0,
) -> np.ndarray:
    """
    Return the information about z in all windows of a plan, shape (n, n).

    The windows have the weights of the calibration: the biases at their middles are correlated by
    the bias processes.

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
    information = np.sum([window.within for window in windows], axis=0) / factor
    for sensor in SENSORS:
        model = noise[sensor]
        variance = np.stack([window.variance[sensor] for window in windows])
        whitening = Whitening(
            factor * variance + model.offset_sd**2,
            times,
            [np.arange(len(times))],
            processes=model.bias_processes,
        )
        means = np.stack([window.means[sensor] for window in windows])
        rows = whitening(means).reshape(-1, len(information))
        information = information + rows.T @ rows
    return information


def additive_bound(
    window: PlannedWindow, noise: dict[str, NoiseModel], *, share: float = 1.0, factor: float = 1.0
) -> np.ndarray:
    """
    Return an upper bound of the information about z that a window adds in any plan, (n, n).

    The biases have a `share` of the covariance of their processes; the remainder is that of an
    offset common to the session (`common_variance`). `factor` as in `exact_information`.

    The covariance of the window means is ``diag(variance) + sum_j G_j`` with G_j that of an
    Ornstein-Uhlenbeck process seen at the middles of the windows, whose inverse is tridiagonal. Its
    rows in absolute value sum to at most ``coth(g / (2 time)) / sd^2`` with g the smaller distance
    to a neighbour, so (Gershgorin) ``G_j >= sd_j^2 diag(tanh(g / (2 time_j)))`` as matrices; and g
    is at least half the window's own length. A larger covariance is less information: with each G_j
    at its bound the means are independent, and information adds up.
    """
    information = window.within / factor
    for sensor in SENSORS:
        model = noise[sensor]
        least_variance = share * sum(
            process.sd**2 * np.tanh(window.length / (4 * process.time))
            for process in model.bias_processes
        )
        variance = factor * window.variance[sensor] + model.offset_sd**2 + least_variance
        rows = window.means[sensor]
        information += rows.T @ (rows / variance[:, None])
    return information


def common_variance(noise: NoiseModel, seconds: np.ndarray | float) -> np.ndarray | float:
    """
    Return c such that the covariance of the biases at any instants is at least ``c 1 1'``.

    The instants are within `seconds`; the wander thus contains a constant of variance c.

    ``1' G^-1 1`` is the information about a constant with the process, at most ``(T + 2 time) / (2
    time sd^2)``, that of observing it all the time; of several processes the inverses add up.
    """
    return sum(
        process.sd**2 * 2 * process.time / (seconds + 2 * process.time)
        for process in noise.bias_processes
    )


def least_bias_variance(noise: NoiseModel, white: float, seconds: np.ndarray) -> np.ndarray:
    """
    Return the least variance of a constant bias, estimated from continuous observation.

    The observation of length T, one for each of `seconds`, has white noise and the bias processes;
    the result has the shape (k,).

    For one process of the variance S, the weight h of an unbiased estimate of least variance solves
    ``integral(S exp(-|t - s| / time) h(s) ds) + white h(t) = 1``, and the variance is ``1 /
    integral(h)``::

        h     = level / white + b cosh(k (t - T / 2))
        k^2   = 1 / time^2 + 2 S / (time white)
        level = 1 / (time k)^2
        b     = (1 - level) / (white (cosh(k T / 2) + k time sinh(k T / 2)))
        r     = tanh(k T / 2)
        integral(h) = (level T + 2 (1 - level) r / (k (1 + k time r))) / white

    Of several processes the least variances add up to a bound, because the least variance is a
    concave function of the covariance. The white noise may belong to any one of them: the largest
    of these bounds counts.

    Parameters
    ----------
    white : float
        Variance of the mean over one second.
    seconds : ndarray, shape (k,)

    """
    seconds = np.asarray(seconds, float)
    least = white / seconds
    for process in noise.bias_processes:
        k = np.sqrt(1 / process.time**2 + 2 * process.sd**2 / (process.time * white))
        level = 1 / (process.time * k) ** 2
        r = np.tanh(k * seconds / 2)
        integral_of_h = (
            level * seconds + 2 * (1 - level) * r / (k * (1 + k * process.time * r))
        ) / white
        others = tuple(other for other in noise.bias_processes if other is not process)
        variance_of_others = common_variance(replace(noise, bias_processes=others), seconds)
        least = np.maximum(least, 1 / integral_of_h + variance_of_others)
    return least
