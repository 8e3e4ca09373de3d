"""Restricted likelihood of mean rows as a function of the shape of their noise."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from imu_calibration.estimation.sensor_noise import BiasProcess, means_beside_middles
from imu_calibration.estimation.whitening import (
    RestrictedLikelihood,
    eliminate,
    profile,
    profile_each,
)

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
    Restricted likelihood of mean rows over shapes of the noise (`NoiseShape`).

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
    choices : sequence of sequences of int, optional
        Choices of parameters that are compared, counted after the common ones: of a new shape all
        choices of one size are computed together.

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
        choices: Sequence[Sequence[int]] = (),
    ):
        self.typical = float(np.sqrt(np.median(white)))
        """Noise of a typical window mean, in the unit of the rows."""
        self.many = len(rows) >= MIN_PROCESS_WINDOWS
        """Whether the windows are enough for the estimate of a bias process."""
        self.known = known
        self._common, self._durations = common, np.broadcast_to(durations, len(rows))
        self._rows, self._white, self._times, self._sessions = rows, white, times, sessions
        self._likelihood = RestrictedLikelihood(rows, times, sessions, information=information)
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
            variance = self._white + self._scatter_in_windows(processes) + offset**2
            logs, normal = self._likelihood.whitened(variance, processes, step**2)
            of_common, normal = eliminate(normal, self._common)
            self._whitened[key] = logs + of_common, normal
        return self._whitened[key]

    def _scatter_in_windows(self, processes: tuple[BiasProcess, ...]) -> np.ndarray:
        """Return the variance of a mean about the process in the middle, shape (n, 1)."""
        return means_beside_middles(processes, self._durations)[:, None]

    def of_axis(self, axis: int, shape: NoiseShape) -> 'NoiseLikelihood':
        """
        Return the likelihood of the noise of one axis, the other axes fixed at the shape.

        In units of the axis' own typical noise.
        """
        # The other axes are the information on the parameters, with which this axis begins.
        offset, bias = shape.offset * self.typical, shape.bias * self.typical
        processes = self.processes(bias, shape.time)
        other_axes = np.arange(self._white.shape[1]) != axis
        variance = self._white[:, other_axes] + self._scatter_in_windows(processes) + offset**2
        _, information = self._likelihood.of_axes(other_axes).whitened(variance, processes)
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
