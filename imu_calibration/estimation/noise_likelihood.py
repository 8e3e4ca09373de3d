"""Restricted likelihood of rows as a function of the shape of their noise."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.estimation.scaled_solve import JITTER
from imu_calibration.estimation.sensor_noise import BiasProcess, means_beside_middles

FLICKER_MARK, FLICKER_TIMES = 0.0, (1.0, 5.0, 25.0, 125.0, 625.0)
"""
Correlation time that denotes flicker: equal variance at spaced times, s, from the length of a
window to the length of a session.
"""
MIN_PROCESS_WINDOWS = 12
"""Fewest windows for the estimate of a bias process."""


class NoiseShape(NamedTuple):
    """Noise of means of windows, in units of the noise of a typical mean."""

    offset: float
    """Standard deviation of independent offsets of the windows."""
    bias: float
    """Standard deviation of a bias process; 0: there is none."""
    time: float
    """Its correlation time, s, or `FLICKER_MARK`."""


class NoiseLikelihood:
    """
    Restricted likelihood of rows over shapes of the noise (`NoiseShape`).

    Parameters
    ----------
    rows : Rows
        With the variance by the noise within windows; their processes are always included.
    common : int
        The first parameters, which are part of every choice: eliminated once per shape.
    choices : sequence of sequences of int, optional
        Choices of parameters that are compared, counted after the common ones: of a new shape all
        choices of one size are computed together.

    """

    def __init__(
        self,
        rows: Rows,
        *,
        common: int = 0,
        choices: Sequence[Sequence[int]] = (),
    ):
        self.typical = float(np.sqrt(np.median(rows.variance)))
        """Noise of a typical window mean, in the unit of the rows."""
        self.many = len(rows) >= MIN_PROCESS_WINDOWS
        """Whether the windows are enough for the estimate of a bias process."""
        self._rows = rows
        self._common = common
        self._whitened: dict[tuple[float, ...], tuple[float, np.ndarray]] = {}
        self._profiles: dict[tuple, float] = {}
        self._choices = [tuple(choice) for choice in choices]

    def loss(
        self,
        shape: Sequence[float],
        used: Sequence[int] | np.ndarray | None = None,
        *,
        session: float = 0.0,
    ) -> float:
        """
        Return minus twice the restricted log likelihood with the parameters `used`.

        The parameters are counted after the common ones and are all parameters by default.
        """
        key = (*map(float, shape), float(session))
        choice = None if used is None else tuple(used)
        if (key, choice) not in self._profiles:
            logs, normal = self._eliminated(key)
            if choice is None:
                self._profiles[key, choice] = logs + profile(normal)
            elif choice not in self._choices:
                self._profiles[key, choice] = logs + profile(_chosen(normal, [choice])[0])
            else:
                alike = [each for each in self._choices if len(each) == len(choice)]
                for each, value in zip(alike, profile_each(_chosen(normal, alike)), strict=True):
                    self._profiles[key, each] = logs + float(value)
        return self._profiles[key, choice]

    def _eliminated(self, key: tuple[float, ...]) -> tuple[float, np.ndarray]:
        """Return (log determinants, normal equations without the common parameters), kept."""
        if key not in self._whitened:
            units = (self.typical, self.typical, 1.0, self.typical)
            offset, bias, time, step = np.multiply(key, units)
            processes = self.processes(bias, time)
            rows = self._with_errors(self._rows, offset, processes)
            logs, normal = whitened(replace(rows, session_variance=step**2))
            of_common, normal = eliminate(normal, self._common)
            self._whitened[key] = logs + of_common, normal
        return self._whitened[key]

    @staticmethod
    def _with_errors(rows: Rows, offset: float, processes: tuple[BiasProcess, ...]) -> Rows:
        """Return rows with the variance of offsets, and of means about the processes, added."""
        durations = np.zeros(len(rows)) if rows.duration is None else rows.duration
        about_middles = means_beside_middles(processes, durations)[:, None]
        variance = rows.variance + about_middles + offset**2
        return replace(rows, variance=variance, processes=processes, session_variance=0.0)

    @property
    def known(self) -> tuple[BiasProcess, ...]:
        """Processes that are always included."""
        return self._rows.processes

    def of_axis(self, axis: int, shape: NoiseShape) -> 'NoiseLikelihood':
        """
        Return the likelihood of the noise of one axis, the other axes fixed at the shape.

        In units of the axis' own typical noise.
        """
        # The other axes are the information on the parameters, with which this axis begins.
        offset = shape.offset * self.typical
        bias = shape.bias * self.typical
        processes = self.processes(bias, shape.time)
        others = self._rows.of_axes(np.arange(self._rows.variance.shape[1]) != axis)
        _, normal = whitened(self._with_errors(others, offset, processes))
        own = replace(self._rows.of_axes(np.array([axis])), products=normal)
        return NoiseLikelihood(own, common=self._common)

    def processes(self, sd: float, time: float) -> tuple[BiasProcess, ...]:
        """
        Return the known processes and one more (or the flicker processes) of a given sd.

        The further one is omitted if its standard deviation is zero.
        """
        if sd <= 0:
            return self.known
        times = FLICKER_TIMES if time == FLICKER_MARK else (time,)
        share = sd / float(np.sqrt(len(times)))
        return (*self.known, *(BiasProcess(share, each) for each in times))


def _chosen(normal: np.ndarray, choices: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Return the normal equations of each choice of the same size, shape (k, m + 1, m + 1)."""
    at = np.array([[*choice, len(normal) - 1] for choice in choices])
    return normal[at[:, :, None], at[:, None, :]]


def whitened(rows: Rows) -> tuple[float, np.ndarray]:
    """
    Return log|V| and the normal matrix of ``[design | residual]`` of rows of the covariance V.

    The matrix is weighted with V^-1, and contains the products of the reduced rows. Minus twice the
    restricted log likelihood is log|V| plus the `profile` of the matrix.
    """
    whitening = rows.whitening()
    white = flat(whitening(rows.equations))
    normal = white.T @ white
    if rows.products is not None:
        normal = rows.products + normal
    return whitening.log_determinant, normal


def eliminate(normal: np.ndarray, count: int) -> tuple[float, np.ndarray]:
    """
    Return ``log|A|`` and the Schur complement ``C - B' A^-1 B``.

    They are of a normal matrix ``[[A, B], [B', C]]``, A its first `count` rows.
    """
    if not count:
        return 0.0, normal
    scale = np.sqrt(np.maximum(normal.diagonal()[:count], 1e-300))
    scaled = normal[:count, :count] / (scale[:, None] * scale)
    scaled.flat[:: count + 1] += JITTER
    factor = np.linalg.cholesky(scaled)
    solved = lapack.dtrtrs(factor, normal[:count, count:] / scale[:, None], lower=1)[0]
    logs = 2 * np.log(factor.diagonal()).sum() + 2 * np.log(scale).sum()
    return float(logs), normal[count:, count:] - solved.T @ solved


def profile(normal: np.ndarray) -> float:
    """Return ``y'y - b' A^-1 b + log|A|`` of the normal matrix ``[[A, b], [b', y'y]]``."""
    logs, left = eliminate(normal, len(normal) - 1)
    return logs + float(left[0, 0])


def profile_each(normal: np.ndarray) -> np.ndarray:
    """
    Return the `profile` of several small normal matrices, shape (k, m + 1, m + 1).

    Of few parameters each, the calls for one after the other would take most of the time.
    """
    information = normal[:, :-1, :-1]
    right = normal[:, :-1, -1]
    scale = np.sqrt(np.maximum(np.einsum('kii->ki', information), 1e-300))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    np.einsum('kii->ki', scaled)[:] += JITTER
    factor = np.linalg.cholesky(scaled)
    solved = np.linalg.solve(factor, (right / scale)[:, :, None])[:, :, 0]
    logs = 2 * np.log(np.einsum('kii->ki', factor) * scale).sum(axis=1)
    return logs + normal[:, -1, -1] - (solved**2).sum(axis=1)
