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
        self._sessions = rows.sessions
        self._common = common
        self._reduced: dict[tuple[float, ...], tuple[float, np.ndarray]] = {}
        """(offset, bias, time, sd of the offset of each recording) -> result of `_eliminated`."""
        self._losses: dict[tuple, float] = {}
        """(the same, choice of parameters or None for all) -> result of `loss`."""
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

        Parameters
        ----------
        shape : sequence of float
            Offset, bias and time of a `NoiseShape`.
        used : sequence of int, optional
            Parameters, counted after the common ones; default: all.
        session : float
            Standard deviation of an offset of each recording, in units of the typical noise.

        """
        key = (*map(float, shape), float(session))
        choice = None if used is None else tuple(used)
        if (key, choice) not in self._losses:
            log_determinant, normal = self._eliminated(key)
            if choice is None:
                self._losses[key, choice] = log_determinant + profile(normal)
            elif choice not in self._choices:
                self._losses[key, choice] = log_determinant + profile(_chosen(normal, [choice])[0])
            else:
                # All choices of this size together: later calls ask for them at the same shape.
                same_size = [each for each in self._choices if len(each) == len(choice)]
                profiles = profile_each(_chosen(normal, same_size))
                for each, value in zip(same_size, profiles, strict=True):
                    self._losses[key, each] = log_determinant + float(value)
        return self._losses[key, choice]

    def _eliminated(self, key: tuple[float, ...]) -> tuple[float, np.ndarray]:
        """
        Return ``log|V| + log|A|`` and the normal matrix after the common parameters are eliminated.

        V is the covariance of the errors, A the block of the common parameters. The key is (offset,
        bias, time, sd of the offset of each recording) in units of the typical noise.
        """
        if key not in self._reduced:
            units = (self.typical, self.typical, 1.0, self.typical)
            offset, bias, time, session_sd = np.multiply(key, units)
            processes = self.processes(bias, time)
            rows = self._with_errors(self._rows, offset, processes, session_variance=session_sd**2)
            of_errors, normal = whitened(rows, self._sessions)
            of_common, normal = eliminate(normal, self._common)
            self._reduced[key] = of_errors + of_common, normal
        return self._reduced[key]

    @staticmethod
    def _with_errors(
        rows: Rows,
        offset: float,
        processes: tuple[BiasProcess, ...],
        *,
        session_variance: float = 0.0,
    ) -> Rows:
        """
        Return rows with bias processes, and with the variance of offsets added.

        Added is also the variance of the mean of a process about its value in the middle.
        """
        durations = np.zeros(len(rows)) if rows.duration is None else rows.duration
        about_middles = means_beside_middles(processes, durations)[:, None]
        variance = rows.variance + about_middles + offset**2
        return replace(
            rows, variance=variance, processes=processes, session_variance=session_variance
        )

    @property
    def known(self) -> tuple[BiasProcess, ...]:
        """Processes that are always included."""
        return self._rows.processes

    def of_axis(self, axis: int, shape: NoiseShape) -> 'NoiseLikelihood':
        """
        Return the likelihood of the noise of one axis, the other axes fixed at the shape.

        Its shapes are in units of the typical noise of the axis.
        """
        # The other axes enter as known products: information on the parameters.
        offset = shape.offset * self.typical
        bias = shape.bias * self.typical
        processes = self.processes(bias, shape.time)
        other_axes = self._rows.of_axes(np.arange(self._rows.variance.shape[1]) != axis)
        _, normal = whitened(self._with_errors(other_axes, offset, processes), self._sessions)
        rows_of_axis = replace(self._rows.of_axes(np.array([axis])), products=normal)
        return NoiseLikelihood(rows_of_axis, common=self._common)

    def processes(self, sd: float, time: float) -> tuple[BiasProcess, ...]:
        """
        Return the known processes and one more of a standard deviation and correlation time, s.

        Flicker (`FLICKER_MARK`) is a process at each of `FLICKER_TIMES`, with that standard
        deviation together. Without a standard deviation only the known ones are returned.
        """
        if sd <= 0:
            return self.known
        times = FLICKER_TIMES if time == FLICKER_MARK else (time,)
        sd_of_each = sd / float(np.sqrt(len(times)))
        return (*self.known, *(BiasProcess(sd_of_each, each) for each in times))


def _chosen(normal: np.ndarray, choices: Sequence[tuple[int, ...]]) -> np.ndarray:
    """
    Return the normal matrix of each of k choices of m parameters, shape (k, m + 1, m + 1).

    The last row and column are those of the residual.
    """
    places = np.array([[*choice, len(normal) - 1] for choice in choices])
    return normal[places[:, :, None], places[:, None, :]]


def whitened(rows: Rows, sessions: list[np.ndarray] | None = None) -> tuple[float, np.ndarray]:
    """
    Return log|V| and the normal matrix of ``[design | residual]`` of rows of the covariance V.

    The matrix is weighted with V^-1, and contains the products of the reduced rows. Minus twice the
    restricted log likelihood is log|V| plus the `profile` of the matrix. `sessions` are those of
    the rows, where they are known.
    """
    whitening = rows.whitening(sessions)
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
    # A = S L L' S with the roots S of its diagonal, so that the factor L is accurate.
    scale = np.sqrt(np.maximum(normal.diagonal()[:count], 1e-300))
    scaled = normal[:count, :count] / (scale[:, None] * scale)
    scaled.flat[:: count + 1] += JITTER
    factor = np.linalg.cholesky(scaled)
    solved = lapack.dtrtrs(factor, normal[:count, count:] / scale[:, None], lower=1)[0]
    logs = 2 * np.log(factor.diagonal()).sum() + 2 * np.log(scale).sum()
    return float(logs), normal[count:, count:] - solved.T @ solved


def profile(normal: np.ndarray) -> float:
    """Return ``y'y - b' A^-1 b + log|A|`` of the normal matrix ``[[A, b], [b', y'y]]``."""
    log_determinant, squares = eliminate(normal, len(normal) - 1)
    return log_determinant + float(squares[0, 0])


def profile_each(normal: np.ndarray) -> np.ndarray:
    """
    Return the `profile` of k normal matrices, shape (k, m + 1, m + 1), as an array (k,).

    With few parameters the calls for one matrix after the other would take most of the time.
    """
    # Each matrix A is scaled to a unit diagonal, as in `eliminate`.
    information = normal[:, :-1, :-1]
    right = normal[:, :-1, -1]
    scale = np.sqrt(np.maximum(np.einsum('kii->ki', information), 1e-300))
    scaled = information / (scale[:, :, None] * scale[:, None, :])
    np.einsum('kii->ki', scaled)[:] += JITTER
    factor = np.linalg.cholesky(scaled)
    solved = np.linalg.solve(factor, (right / scale)[:, :, None])[:, :, 0]
    logs = 2 * np.log(np.einsum('kii->ki', factor) * scale).sum(axis=1)
    return logs + normal[:, -1, -1] - (solved**2).sum(axis=1)
