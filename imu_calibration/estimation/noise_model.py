"""The noise of one sensor: white noise within windows, offsets of windows, bias processes, what moving windows scatter beyond."""

from dataclasses import dataclass, field, replace
from typing import Sequence

import numpy as np

from imu_calibration.constants import STANDARD_GRAVITY

HOUR = 3600.0
"""s; sessions are hardly longer, and what a bias does over days does not move within one."""
DOF_FACTOR_MOST = 3.0
"""Largest factor by which a variance grows because it was itself estimated."""


@dataclass(frozen=True)
class BiasProcess:
    """First-order Gauss-Markov process of the bias: covariance ``sd^2 exp(-|dt| / time)``, the same on all axes, each on its own."""

    sd: float
    """Standard deviation, m/s^2 or rad/s."""
    time: float
    """Correlation time, s; long against the session it is a random walk, several of them in a row of times make flicker noise."""

    def within(self, duration: float) -> float:
        """
        Return the standard deviation about its mean over a time, s: what a session sees of it.

        ``sd^2 (1 - 2 r (1 - r (1 - exp(-1 / r))))`` with r the correlation time over the duration.
        """
        ratio = self.time / duration
        return self.sd * float(np.sqrt(1 + 2 * ratio * (ratio * -np.expm1(-1 / ratio) - 1))) if ratio > 1e-6 else self.sd


@dataclass(frozen=True)
class ReferenceNoise:
    """What the reference itself adds to means of windows: joints that are read in steps."""

    turn: float = 0.0
    """Standard deviation of the turn between two readings, rad; over the length of a window it is one of the mean rate."""
    level: float = 0.0
    """Standard deviation of gravity's components at rest, m/s^2."""

    @classmethod
    def of_steps(cls, step: float, sensor: str) -> 'ReferenceNoise':
        """
        Return that of a sensor beside encoders with a step, rad.

        A reading errs by ``step / sqrt(12)``, a turn by ``step / sqrt(6)``. An attitude that errs about one axis shows in two components
        of gravity's three.
        """
        return cls(turn=step / np.sqrt(6)) if sensor == 'gyroscope' else cls(level=STANDARD_GRAVITY * step / np.sqrt(12) * np.sqrt(2 / 3))

    def variance(self, kinds: Sequence[str] | np.ndarray, durations: np.ndarray) -> np.ndarray:
        """Return the variance of the means of windows of these kinds and lengths, s, shape (k,)."""
        still = np.array([kind == 'static' for kind in kinds])
        return np.where(still, self.level**2, (self.turn / np.maximum(durations, 1e-3))**2)


@dataclass(frozen=True, eq=False)
class MovingFactors:
    """What moving windows of one kind scatter beyond the noise at rest, as factors on ``white_variance * inflation``, each shape (3,)."""

    every: np.ndarray
    """On the variance of the centred rows."""
    slow: np.ndarray
    """On that of their slow part, where it fits better than the fast one; else as `every`."""
    means: np.ndarray = field(default_factory=lambda: np.ones(3))
    """On the variance of the windows' means by the noise within."""
    along: float = 1.0
    """Part of `every` that comes from misfit along the columns of the model, correlated in time; at least 1."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """
    Noise of one sensor.

    The mean of window k has variance ``white_variance * inflation / n_k + offset_sd^2`` and, with its neighbours in the same recording,
    the covariance ``sum(sd^2 exp(-|t_k - t_l| / time)) + session_variance`` over the bias processes, seen at the middles of the windows;
    beside these middles means scatter by what biases wander within (`means_beside_middles`).
    """

    white_variance: np.ndarray
    """Variance of single samples at rest, shape (3,)."""
    inflation: np.ndarray
    """Factor by which the noise at low frequency exceeds white noise of that variance, shape (3,)."""
    offset_sd: float = 0.0
    """Standard deviation of an independent offset per window."""
    bias_processes: tuple[BiasProcess, ...] = ()
    """How the bias moves from window to window."""
    known: tuple[BiasProcess, ...] = ()
    """Those of them that were measured apart, on a recording at rest."""
    middle_wander: float = 0.0
    """Standard deviation of the bias process on the middle one of the axes, where it is so large that this was asked."""
    moving: dict[str, MovingFactors] = field(default_factory=dict)
    """Kind of window -> what it scatters beyond the noise at rest."""
    session_sd: float = 0.0
    """Standard deviation of the bias from recording to recording; zero when the recordings agree or there is one."""
    session_variance: float = 0.0
    """Its square, larger when few recordings leave it uncertain: what weights and standard deviations are made with."""
    reference: ReferenceNoise = ReferenceNoise()
    """What the reference adds to the means of windows."""
    shaken: dict[tuple[int, float], np.ndarray] = field(default_factory=dict)
    """(recording, middle in s) of rests that vibrate -> variance of their means as they show it themselves, shape (3,)."""
    left_out: frozenset[tuple[int, float]] = frozenset()
    """(recording, middle in s) of windows that the others contradict: their means count for nothing."""

    @property
    def white_sd(self) -> np.ndarray:
        """Standard deviation of single samples at rest, shape (3,)."""
        return np.sqrt(self.white_variance)

    @property
    def low_variance(self) -> np.ndarray:
        """Variance of white noise that would scatter the means of samples as much, shape (3,)."""
        return self.white_variance * self.inflation

    @property
    def bias_variance(self) -> float:
        """Variance of all bias processes together, of slow ones within an hour."""
        return sum(process.sd**2 * min(1.0, HOUR / process.time) for process in self.bias_processes)

    @property
    def bias_time(self) -> float | None:
        """Correlation time of the largest bias process, s; None when there is none."""
        return max(self.bias_processes, key=lambda process: process.sd).time if self.bias_processes else None

    def mean_variance(self, kinds: Sequence[str] | np.ndarray, counts: np.ndarray, durations: np.ndarray | None = None, *,
                      keys: Sequence[tuple[int, float]] = ()) -> np.ndarray:
        """
        Return the variance of means of windows of these kinds and lengths (samples; s) by the noise within and the reference, (k, 3).

        Of windows with `keys` (recording, middle in s) that vibrate at least what they show themselves.
        """
        factors = {kind: moving.means for kind, moving in self.moving.items()}
        white = self.low_variance * np.stack([factors.get(kind, np.ones(3)) for kind in kinds]) / np.asarray(counts, float)[:, None]
        if self.shaken and keys:
            white = np.maximum(white, [self.shaken.get(key, np.zeros(3)) for key in keys])
        return white if durations is None else white + self.reference.variance(kinds, durations)[:, None]

    def variance_beside_bias(self, kinds: Sequence[str] | np.ndarray, counts: np.ndarray, durations: np.ndarray, *,
                             keys: Sequence[tuple[int, float]] = ()) -> np.ndarray:
        """Return the same beside the bias as it is in the middle of each window: with what it wanders within, shape (k, 3)."""
        return self.mean_variance(kinds, counts, durations, keys=keys) + means_beside_middles(self.bias_processes, durations)[:, None]

    def wander_within(self, offsets: np.ndarray) -> np.ndarray:
        """Return the covariance of the bias at instants about the middle of a window, s, beside its value there, shape (n, n)."""
        away, apart = np.abs(offsets), np.abs(np.subtract.outer(offsets, offsets))
        return sum((process.sd**2 * (np.exp(-apart / process.time) - np.exp(-np.add.outer(away, away) / process.time))
                    for process in self.bias_processes), np.zeros(apart.shape))

    def row_variance(self, kind: str) -> np.ndarray:
        """Return the variance per centred row of windows of `kind`, shape (3,)."""
        return self.low_variance * self.moving[kind].every if kind in self.moving else self.low_variance

    def slow_weight(self, kind: str) -> np.ndarray:
        """
        Return the weight w of the slow part of centred rows beside all of them at `row_variance`, ``w^2 = 1/slow - 1/every``, shape (3,).

        The sum of squares is then ``fast / every + slow / slow``, without a difference of factors.
        """
        if kind not in self.moving:
            return np.zeros(3)
        factors = self.moving[kind]
        return np.sqrt(np.maximum(1 / factors.slow - 1 / factors.every, 0.0) / self.low_variance)

    def at_rest_only(self, *processes: BiasProcess) -> 'NoiseModel':
        """Return what noise alone would be: no offsets, no misfit along the columns, and only the bias processes that are given."""
        moving = {kind: replace(factors, every=factors.every / factors.along) for kind, factors in self.moving.items()}
        moving = {kind: replace(factors, means=np.minimum(factors.means, np.maximum(factors.every, 1.0))) for kind,
                  factors in moving.items()}
        return replace(self, moving=moving, offset_sd=0.0, bias_processes=processes)

    def weighs_alike(self, other: 'NoiseModel', change: float = 0.05) -> bool:
        """Return whether slow parts count no more than fast ones, or both as with `other`, to a relative change of their variances."""
        for kind, mine in self.moving.items():
            if np.all(mine.slow == mine.every):
                continue
            if kind not in other.moving:
                return False
            its, unit = other.moving[kind], self.low_variance / other.low_variance
            if any(np.any(np.abs(unit * a / b - 1) > change) for a, b in ((mine.every, its.every), (mine.slow, its.slow))):
                return False
        return True


def means_beside_middles(processes: Sequence[BiasProcess], durations: np.ndarray | float) -> np.ndarray:
    """
    Return the variance of the mean of a wandering bias over windows of these lengths (s) beside its value in their middles.

    Of a random walk with ``2 sd^2 / time`` per second it is ``sd^2 T / (6 time)``. It fades in windows longer than a bias remembers,
    whose means its value in the middle overstates already.
    """
    total = np.zeros(np.shape(durations))
    for process in processes:
        step = np.asarray(durations, float) / (6 * process.time)
        total = total + process.sd**2 * step / (1 + (3 * step)**2)
    return total


def dof_factor(dof: np.ndarray | float) -> np.ndarray:
    """Return dof / (dof - 2), the variance of the t distribution, at most DOF_FACTOR_MOST: by it a variance from few data grows."""
    return np.minimum(dof / np.maximum(np.subtract(dof, 2), 1e-9), DOF_FACTOR_MOST)


def sessions_of(rows: Sequence) -> list[np.ndarray]:
    """Return the index arrays of the rows of each recording, in order of time."""
    numbers = np.array([row.session for row in rows])
    times = np.array([row.time for row in rows])
    return [np.flatnonzero(numbers == number)[np.argsort(times[numbers == number], kind='stable')] for number in np.unique(numbers)]
