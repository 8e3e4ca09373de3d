"""For how long one must record until a figure is determined: the fit's own covariance for recordings that have not been made."""

import numpy as np

from imu_calibration.allan.deviation import averaging_factors
from imu_calibration.allan.moment_fit import Moments, Whitener
from imu_calibration.allan.processes import NoiseProcess
from imu_calibration.allan.scale_covariance import ScaleCovariance

LENGTHS = 60.0 * np.array([10, 15, 20, 30, 45, 60, 90, 120, 180, 240, 360, 480, 720, 1080, 1440, 2160, 2880], float)
"""Recordings that are thought of, s: from ten minutes to two days."""
RELATIVE_SD = 0.24
"""Standard deviation of a coefficient over the coefficient at which the 95 % interval of its root has a ratio of 1.6."""
SCALES_FROM = 0.1
"""s; shorter averaging times determine the white noise only, at any length of recording."""


class RecordingTimes:
    """
    Predicts relative standard deviations of coefficients.

    Parameters
    ----------
    period : float
        Time between samples, s.

    """

    def __init__(self, period: float):
        self._period = period
        self._scales: dict[float, ScaleCovariance] = {}

    def needed(self, processes: tuple[NoiseProcess, ...], coefficients: np.ndarray, index: int) -> float | None:
        """Return the shortest of `LENGTHS` in which coefficient `index` of a model is determined, s; None when none is long enough."""
        for length in LENGTHS:
            if self.relative_sd(length, processes, coefficients, index=index) <= RELATIVE_SD:
                return float(length)
        return None

    def relative_sd(self, seconds: float, processes: tuple[NoiseProcess, ...], coefficients: np.ndarray, *, index: int) -> float:
        """Return the standard deviation of a coefficient over the coefficient, from one recording at rest of this length."""
        moments = self._moments(seconds)
        design, tensor = moments.design(processes), moments.tensor(processes)
        columns = Whitener(np.einsum('p,q,pqij->ij', coefficients, coefficients, tensor))(design * coefficients)
        information = columns.T @ columns
        size = np.sqrt(np.diag(information))
        inverse = np.linalg.pinv(information / np.outer(size, size), rcond=1e-12, hermitian=True)
        return float(np.sqrt(inverse[index, index]) / size[index])

    def _moments(self, seconds):
        if seconds not in self._scales:
            n = int(seconds / self._period)
            factors = averaging_factors(n, per_octave=1)
            factors = factors[factors * self._period >= SCALES_FROM]
            self._scales[seconds] = ScaleCovariance(factors, [n], self._period)
        scales = self._scales[seconds]
        return Moments(scales, np.ones(len(scales.factors)), np.ones(len(scales.factors), bool))
