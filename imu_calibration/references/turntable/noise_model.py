"""
The noise of one sensor in windows on a table.

Noise within windows, offsets of windows, excess variance of moving windows, steps of the encoders.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.estimation.sensor_noise import BiasProcess, SensorNoise, means_beside_middles
from imu_calibration.estimation.solution import Solution

SAME_VARIANCE = 0.05
"""Relative change of variance up to which two noise models weigh rows alike."""


@dataclass(frozen=True)
class ReferenceNoise:
    """
    Contribution of the reference to the variance of window means.

    Quantisation of the joint readings.
    """

    turn: float = 0.0
    """
    Standard deviation of the turn between two readings, rad; divided by the window length, of the
    mean rate.
    """
    level: float = 0.0
    """Standard deviation of gravity's components at rest, m/s^2."""

    @classmethod
    def of_steps(cls, step: float, sensor: str) -> 'ReferenceNoise':
        """
        Return the reference noise of a sensor for encoders with a step, rad.

        The error of a reading is ``step / sqrt(12)``, of a turn ``step / sqrt(6)``. An error of the
        attitude about one axis affects two of the three components of gravity.
        """
        return (
            cls(turn=step / np.sqrt(6))
            if sensor == 'gyroscope'
            else cls(level=STANDARD_GRAVITY * step / np.sqrt(12) * np.sqrt(2 / 3))
        )

    def variance(self, kinds: Sequence[str] | np.ndarray, durations: np.ndarray) -> np.ndarray:
        """Return the variance of the means of windows of these kinds and lengths, s, shape (k,)."""
        still = np.array([kind == 'static' for kind in kinds])
        return np.where(still, self.level**2, (self.turn / np.maximum(durations, 1e-3)) ** 2)


@dataclass(frozen=True, eq=False)
class MovingFactors:
    """
    Excess variance of moving windows of one kind over the noise at rest.

    Factors on ``white_variance * inflation``, each shape (3,).
    """

    every: np.ndarray
    """On the variance of the centred rows."""
    slow: np.ndarray
    """
    On the variance of their slow part, where it fits better than the fast one; otherwise as
    `every`.
    """
    means: np.ndarray = field(default_factory=lambda: np.ones(3))
    """On the variance of the window means due to the noise within windows."""
    along: float = 1.0
    """
    Part of `every` due to misfit along the columns of the model, correlated in time; at least 1.
    """


@dataclass(frozen=True, eq=False)
class NoiseModel(SensorNoise):
    """
    Noise of one sensor in windows.

    The mean of window k has variance ``white_variance * inflation / n_k + offset_sd^2`` and, with
    its neighbours in the same recording, the covariance ``sum(sd^2 exp(-|t_k - t_l| / time)) +
    session_variance`` over the bias processes, evaluated at the middles of the windows. The change
    of the bias within a window adds the variance `means_beside_middles` to its mean.
    """

    known: tuple[BiasProcess, ...] = ()
    """The ones that were measured separately, on a recording at rest."""
    middle_wander: float = 0.0
    """
    Standard deviation of the bias process on the middle one of the axes, where it is large enough
    for a test per axis.
    """
    moving: dict[str, MovingFactors] = field(default_factory=dict)
    """Kind of window -> excess variance over the noise at rest."""
    session_sd: float = 0.0
    """
    Standard deviation of the bias from recording to recording; zero when the recordings agree or
    there is one.
    """
    session_variance: float = 0.0
    """Its square, increased for few recordings; used in weights and standard deviations."""
    reference: ReferenceNoise = ReferenceNoise()
    """Contribution of the reference to the window means."""
    shaken: dict[tuple[int, float], np.ndarray] = field(default_factory=dict)
    """
    (recording, middle in s) of rests that vibrate -> variance of their means from their samples,
    shape (3,).
    """
    left_out: frozenset[tuple[int, float]] = frozenset()
    """(recording, middle in s) of outlying windows: their means have no weight."""

    @property
    def bias_time(self) -> float | None:
        """Correlation time of the largest bias process, s; None when there is none."""
        return (
            max(self.bias_processes, key=lambda process: process.sd).time
            if self.bias_processes
            else None
        )

    def mean_variance(
        self,
        kinds: Sequence[str] | np.ndarray,
        counts: np.ndarray,
        durations: np.ndarray | None = None,
        *,
        keys: Sequence[tuple[int, float]] = (),
    ) -> np.ndarray:
        """
        Return the variance of means of windows of these kinds and lengths, (k, 3).

        The lengths are in samples and in s. The variance is due to the noise within the windows and
        to the reference.

        The variance of vibrating windows with `keys` (recording, middle in s) is at least the one
        estimated from their samples.
        """
        factors = {kind: moving.means for kind, moving in self.moving.items()}
        white = (
            self.low_variance
            * np.stack([factors.get(kind, np.ones(3)) for kind in kinds])
            / np.asarray(counts, float)[:, None]
        )
        if self.shaken and keys:
            white = np.maximum(white, [self.shaken.get(key, np.zeros(3)) for key in keys])
        return (
            white
            if durations is None
            else white + self.reference.variance(kinds, durations)[:, None]
        )

    def variance_beside_bias(
        self,
        kinds: Sequence[str] | np.ndarray,
        counts: np.ndarray,
        durations: np.ndarray,
        *,
        keys: Sequence[tuple[int, float]] = (),
    ) -> np.ndarray:
        """
        Return the same relative to the bias in the middle of each window.

        With its change within the window, shape (k, 3).
        """
        return (
            self.mean_variance(kinds, counts, durations, keys=keys)
            + means_beside_middles(self.bias_processes, durations)[:, None]
        )

    def wander_within(self, offsets: np.ndarray) -> np.ndarray:
        """
        Return the covariance of the bias at instants, given its value in the middle.

        The instants are about the middle of a window, in s, and the result has shape (n, n).
        """
        away = np.abs(offsets)
        apart = np.abs(np.subtract.outer(offsets, offsets))
        return sum(
            (
                process.sd**2
                * (np.exp(-apart / process.time) - np.exp(-np.add.outer(away, away) / process.time))
                for process in self.bias_processes
            ),
            np.zeros(apart.shape),
        )

    def row_variance(self, kind: str) -> np.ndarray:
        """Return the variance per centred row of windows of `kind`, shape (3,)."""
        return (
            self.low_variance * self.moving[kind].every
            if kind in self.moving
            else self.low_variance
        )

    def slow_weight(self, kind: str) -> np.ndarray:
        """
        Return the additional weight w of the slow part of centred rows, ``w^2 = 1/slow - 1/every``.

        Shape (3,).

        The sum of squares is then ``fast / every + slow / slow``, without a difference of factors.
        """
        if kind not in self.moving:
            return np.zeros(3)
        factors = self.moving[kind]
        return np.sqrt(np.maximum(1 / factors.slow - 1 / factors.every, 0.0) / self.low_variance)

    def at_rest_only(self, *processes: BiasProcess) -> 'NoiseModel':
        """
        Return the model of noise only.

        No offsets, no misfit along the columns, and only the given bias processes.
        """
        moving = {
            kind: replace(factors, every=factors.every / factors.along)
            for kind, factors in self.moving.items()
        }
        moving = {
            kind: replace(factors, means=np.minimum(factors.means, np.maximum(factors.every, 1.0)))
            for kind, factors in moving.items()
        }
        return replace(self, moving=moving, offset_sd=0.0, bias_processes=processes)

    def weighs_alike(self, other: 'NoiseModel') -> bool:
        """
        Return whether slow parts count no more than fast ones, or the weights are equal.

        Weights are equal if they agree with the weights of `other` within `SAME_VARIANCE`.
        """
        for kind, mine in self.moving.items():
            if np.all(mine.slow == mine.every):
                continue
            if kind not in other.moving:
                return False
            its = other.moving[kind]
            unit = self.low_variance / other.low_variance
            if any(
                np.any(np.abs(unit * a / b - 1) > SAME_VARIANCE)
                for a, b in ((mine.every, its.every), (mine.slow, its.slow))
            ):
                return False
        return True


def noise_of_windows(solution: Solution) -> dict[str, NoiseModel]:
    """Return the noise of a solution on a table: sensor -> NoiseModel."""
    return cast(dict[str, NoiseModel], solution.noise)
