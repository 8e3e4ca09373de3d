"""Detection of stops in a stream of corrected samples, in blocks of a quarter of a second, and correction of the bias by them."""

import numpy as np

from imu_calibration.compensation.health import CalibrationHealth
from imu_calibration.compensation.stops import BLOCK, StopDetector

SIX = tuple[float, ...]
AS_STOPS = [0, 4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9]
"""Columns of a sample for the detection of stops: time, force, rate, measured force, measured rate."""


class StopWatch:
    """
    Follows a `CalibrationHealth` sample by sample; between two evaluations it costs an append.

    Parameters
    ----------
    health : CalibrationHealth

    """

    def __init__(self, health: CalibrationHealth):
        self.health, self._detector = health, StopDetector(health.noise_sd)
        self._waiting: list[SIX] = []
        self._first_ns = self._look = 0
        self._offset: tuple[float, float, float] | None = None

    def follow(self, stamp_ns: int, measured: SIX, corrected: SIX) -> SIX:
        """Process a sample (rate x, y, z, force x, y, z; measured and corrected); return the corrected one minus the bias update."""
        since = stamp_ns - self._first_ns
        self._waiting.append((since, *corrected, *measured))
        if since >= self._look or since < 0:
            self._take(stamp_ns)
        if self._offset is None:
            return corrected
        bx, by, bz = self._offset
        return (corrected[0] - bx, corrected[1] - by, corrected[2] - bz, *corrected[3:])

    @property
    def rate_cov(self) -> np.ndarray:
        """Covariance of the correction of the rate, shape (3, 3)."""
        if self._offset is None or self.health.update is None:
            return np.zeros((3, 3))
        return np.diag(self.health.update.predict(self._look * 1e-9)[1])

    def _take(self, stamp_ns):
        if stamp_ns < self._first_ns or not self._first_ns:   # the beginning, or a clock set back
            self._first_ns, self._look, self._waiting, self._detector = stamp_ns, 0, [], StopDetector(self.health.noise_sd)
            return
        samples = np.array(self._waiting)
        since = int(samples[-1, 0])
        self._waiting, self._look = [], since + round(1e9 * BLOCK)
        rows = samples[:, AS_STOPS]
        rows[:, 0] *= 1e-9
        stop = self._detector.push(rows)
        if stop is not None:
            self.health.judge(stop)
        if self.health.update is not None and self.health.update.n_stops:
            self._offset = tuple(self.health.update.predict(since * 1e-9)[0].tolist())
