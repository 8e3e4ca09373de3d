"""
The noise of one sensor in windows on a table.

Noise within windows, offsets of windows, excess variance of moving windows, steps of the encoders.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.estimation.sensor_noise import BiasProcess, SensorNoise
from imu_calibration.estimation.solution import Solution

SAME_VARIANCE = 0.05
"""Relative change of variance up to which two noise models weigh rows alike."""


@dataclass(frozen=True)
class ReferenceNoise:
    """Variance of window means due to the quantisation of the joint readings."""

    turn: float = 0.0
    """
    Standard deviation of the turn from the first to the last reading of a moving window, rad. That
    of the mean rate is ``turn / duration``.
    """
    level: float = 0.0
    """Standard deviation of gravity's components in a window at rest, m/s^2."""

    @classmethod
    def of_steps(cls, step: float, sensor: str) -> 'ReferenceNoise':
        """
        Return the reference noise of a sensor for encoders with a step, rad.

        The error of a reading is ``step / sqrt(12)``, of a turn ``step / sqrt(6)``. An error of the
        attitude about one axis affects two of the three components of gravity.
        """
        if sensor == 'gyroscope':
            return cls(turn=step / np.sqrt(6))
        return cls(level=STANDARD_GRAVITY * step / np.sqrt(12) * np.sqrt(2 / 3))

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

    centred: np.ndarray
    """Factor on the variance of the centred rows."""
    slow: np.ndarray
    """
    Factor on the variance of the slow part of the centred rows, where that is smaller; otherwise
    equal to `centred`.
    """
    means: np.ndarray = field(default_factory=lambda: np.ones(3))
    """Factor on the variance of window means due to the noise within windows."""
    correlation: float = 1.0
    """
    Factor contained in `centred` for misfit along the columns of the model, which is correlated in
    time; at least 1.
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
    """Bias processes that were measured separately, on a recording at rest."""
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
    """
    Square of `session_sd`, increased for few recordings; used in weights and standard deviations.
    """
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
        if not self.bias_processes:
            return None
        return max(self.bias_processes, key=lambda process: process.sd).time

    def mean_variance(
        self,
        kinds: Sequence[str] | np.ndarray,
        counts: np.ndarray,
        durations: np.ndarray | None = None,
        *,
        keys: Sequence[tuple[int, float]] = (),
    ) -> np.ndarray:
        """
        Return the variance of the means of k windows from noise in them and the reference, (k, 3).

        Parameters
        ----------
        kinds : sequence of str
        counts : array, shape (k,)
            Numbers of samples.
        durations : array, shape (k,), optional
            s; without them the reference has no errors.
        keys : sequence of (int, float), optional
            (recording, middle in s) of the windows. The variance of a vibrating window is at least
            the one in `shaken`.

        """
        no_excess = np.ones(3)
        factors = [self.moving[kind].means if kind in self.moving else no_excess for kind in kinds]
        variance = self.low_variance * np.stack(factors) / np.asarray(counts, float)[:, None]
        if self.shaken and keys:
            variance = np.maximum(variance, [self.shaken.get(key, np.zeros(3)) for key in keys])
        if durations is None:
            return variance
        return variance + self.reference.variance(kinds, durations)[:, None]

    def wander_within(self, offsets: np.ndarray) -> np.ndarray:
        """
        Return the covariance of the bias at n instants, given its value in the middle, (n, n).

        For instants s, t relative to the middle (`offsets`, s), summed over the processes:
        ``sd^2 (exp(-|s - t| / time) - exp(-(|s| + |t|) / time))``.
        """
        to_middle = np.abs(offsets)
        distance = np.abs(np.subtract.outer(offsets, offsets))
        by_middle = np.add.outer(to_middle, to_middle)
        covariance = np.zeros(distance.shape)
        for process in self.bias_processes:
            correlation = np.exp(-distance / process.time) - np.exp(-by_middle / process.time)
            covariance = covariance + process.sd**2 * correlation
        return covariance

    def row_variance(self, kind: str) -> np.ndarray:
        """Return the variance per centred row of windows of `kind`, shape (3,)."""
        if kind in self.moving:
            return self.low_variance * self.moving[kind].centred
        return self.low_variance

    def slow_weight(self, kind: str) -> np.ndarray:
        """
        Return the additional weight w of the slow part of centred rows, shape (3,).

        ``w^2 = (1/slow - 1/centred) / low_variance``: all rows have the weight ``1/centred``, so
        that the slow part has ``1/slow`` in total.
        """
        if kind not in self.moving:
            return np.zeros(3)
        factors = self.moving[kind]
        return np.sqrt(np.maximum(1 / factors.slow - 1 / factors.centred, 0.0) / self.low_variance)

    def without_misfit(self, *processes: BiasProcess) -> 'NoiseModel':
        """
        Return the noise without errors of the model: offsets of windows and misfit along columns.

        The excess of moving windows by vibration remains. The bias processes are the given ones.
        """
        moving = {}
        for kind, factors in self.moving.items():
            centred = factors.centred / factors.correlation
            # The means of moving windows have at least the noise at rest.
            means = np.minimum(factors.means, np.maximum(centred, 1.0))
            moving[kind] = replace(factors, centred=centred, means=means)
        return replace(self, moving=moving, offset_sd=0.0, bias_processes=processes)

    def weighs_alike(self, other: 'NoiseModel') -> bool:
        """
        Return whether the weights of moving windows are those of `other` within `SAME_VARIANCE`.

        A kind of window with one weight for its slow and fast parts is not compared: its weight
        changes little with the values of the parameters, and one round of estimation suffices.
        """
        variance_ratio = self.low_variance / other.low_variance
        for kind, factors in self.moving.items():
            if np.all(factors.slow == factors.centred):
                continue
            if kind not in other.moving:
                return False
            other_factors = other.moving[kind]
            change_of_centred = variance_ratio * factors.centred / other_factors.centred - 1
            change_of_slow = variance_ratio * factors.slow / other_factors.slow - 1
            if np.any(np.abs(change_of_centred) > SAME_VARIANCE):
                return False
            if np.any(np.abs(change_of_slow) > SAME_VARIANCE):
                return False
        return True


def noise_of_windows(solution: Solution) -> dict[str, NoiseModel]:
    """Return the noise of a solution on a table: sensor -> NoiseModel."""
    return cast(dict[str, NoiseModel], solution.noise)
