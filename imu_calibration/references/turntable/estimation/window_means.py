"""Windows as arrays, and the errors of their means."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.sensor_noise import means_beside_middles
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.window_statistics import WindowStatistics

EXCLUDED_MEAN_SD_FACTOR = 1e3
"""Sd factor of an excluded mean over the largest sd of all means."""


class WindowMeans:
    """Windows in order of time, each with a row of least squares for its mean."""

    windows: Sequence[WindowStatistics]
    """The windows, k of them."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors with readings."""
        return tuple(self.windows[0].sensors) if self.windows else SENSORS

    @cached_property
    def kind(self) -> np.ndarray:
        """Kind of each window, shape (k,)."""
        return np.array([window.kind for window in self.windows])

    @cached_property
    def moving(self) -> np.ndarray:
        """Whether each window has centred rows, shape (k,)."""
        return self.kind != 'static'

    @cached_property
    def time(self) -> np.ndarray:
        """Middle of each window, s, shape (k,)."""
        return np.array([window.time for window in self.windows], float)

    @cached_property
    def count(self) -> np.ndarray:
        """Samples of each window, shape (k,)."""
        return np.array([window.count for window in self.windows], float)

    @cached_property
    def duration(self) -> np.ndarray:
        """Length of each window, s, shape (k,)."""
        return np.array([window.duration for window in self.windows], float)

    @cached_property
    def session(self) -> np.ndarray:
        """Recording of each window, shape (k,)."""
        return np.array([window.session for window in self.windows])

    @cached_property
    def keys(self) -> list[tuple[int, float]]:
        """(Recording, middle in s) of each window."""
        return [(window.session, window.time) for window in self.windows]

    @property
    def encoder_step(self) -> float:
        """Largest step of the encoders that shows in the readings, rad; 0 where none does."""
        return max((window.encoder_step for window in self.windows), default=0.0)

    def mean_variance(self, noise: NoiseModel, beside_bias: bool = True) -> np.ndarray:
        """
        Return the variance of the means, very large for excluded windows, shape (k, 3).

        With `beside_bias` it is the variance relative to the bias in the middle of each window,
        otherwise only that of the noise within windows and of the reference.
        """
        variance = noise.mean_variance(self.kind, self.count, self.duration, keys=self.keys)
        if beside_bias:
            variance = variance + means_beside_middles(noise.bias_processes, self.duration)[:, None]
        if noise.left_out:
            left_out = np.array([key in noise.left_out for key in self.keys])
            largest = variance.max(axis=0) + noise.offset_sd**2 + noise.bias_variance
            variance[left_out] = EXCLUDED_MEAN_SD_FACTOR**2 * largest
        return variance

    def mean_rows(
        self, equations: np.ndarray, noise: NoiseModel, products: np.ndarray | None = None
    ) -> Rows:
        """
        Return equations of the means, shape (k, 3, q), with their errors by a noise model.

        Offsets of the windows are a part of the errors. `products` are those of further rows
        (`Rows.products`).
        """
        return Rows(
            equations=equations,
            variance=self.mean_variance(noise) + noise.offset_sd**2,
            processes=noise.bias_processes,
            session_variance=noise.session_variance,
            time=self.time,
            duration=self.duration,
            session=self.session,
            products=products,
        )

    def without_offsets(self, rows: Rows, noise: NoiseModel) -> Rows:
        """Return the rows with errors by noise within windows and known bias processes only."""
        variance = self.mean_variance(noise, beside_bias=False)
        return replace(rows, variance=variance, processes=noise.known, session_variance=0.0)


def predict_session_offsets(rows: Rows) -> np.ndarray:
    """
    Return the offset of each recording, shape (n_sessions, n_axes).

    With the whitened ones u and residuals r of the rows of a recording, and the variance s^2 of
    the offsets, it is the best linear prediction ``u'r / (u'u + 1 / s^2)``.
    """
    # Ones and residuals, whitened without the offsets that are predicted.
    ones = np.ones_like(rows.equations[:, :, -1])
    columns = np.stack([ones, rows.equations[:, :, -1]], axis=2)
    white = replace(rows, session_variance=0.0).whitening()(columns)
    offsets = []
    for index in rows.sessions:
        one = white[index, :, 0]
        residual = white[index, :, 1]
        information = (one**2).sum(axis=0) + 1 / rows.session_variance
        offsets.append((one * residual).sum(axis=0) / information)
    return np.array(offsets)
