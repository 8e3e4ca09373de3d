"""The unit of live readings, checked before the first output."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import SensorUnit
from imu_calibration.core.scales import USUAL, scale_range
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.preprocessing.value_checks import force_error

WINDOW_S = 1.0
"""s; readings are collected over it before they are judged."""
LEAST_READINGS = 10
"""Number of readings in a window, at least."""
MOST_READINGS = 10_000
"""Number of readings in a window, at most: the stamps of a driver may stand still."""
REST_SPREAD = 0.05
"""Largest standard deviation of the length at rest, relative to its median."""
MOST_IN_MOTION = 16 * STANDARD_GRAVITY
"""Median of the length that a motion reaches at most, m/s^2: the range of usual sensors."""


class UnitGate:
    """
    Withholds the output while the specific force is not in the stated unit.

    The gate opens with a first reading of usual length, or the first window of readings that can be
    gravity, and then stays open: a later motion or another publisher does not stop the output.

    Parameters
    ----------
    stated : SensorUnit
        Unit of the accelerometer's readings.

    """

    def __init__(self, stated: SensorUnit):
        self._stated = stated
        self._start_ns: int | None = None
        self._lengths: list[float] = []
        self._judged = False
        self.is_open = False
        self.error: InputError | None = None
        """Why the readings at rest are not in the stated unit; None: not known to be wrong."""

    def passes(self, stamp_ns: int, force: Sequence[float]) -> bool:
        """
        Return whether a reading may be corrected and published.

        Parameters
        ----------
        stamp_ns : int
        force : three floats
            Specific force after the conversion from the stated unit, m/s^2.

        """
        if self.is_open:
            return True
        length = float(np.linalg.norm(force))
        # A driver without an accelerometer fills zeros, which are no measurement of gravity.
        if length == 0.0 or not np.isfinite(length):
            return True
        if self._start_ns is None or stamp_ns < self._start_ns:
            self._start_ns, self._lengths = stamp_ns, []
            # Only the very first reading opens by itself, where its length is usual: a shaken IMU
            # in g reaches any length.
            if not self._judged and scale_range(length / STANDARD_GRAVITY) is USUAL:
                self._open()
                return True
        self._lengths.append(length)
        is_long = stamp_ns - self._start_ns >= WINDOW_S * 1e9
        is_complete = is_long and len(self._lengths) >= LEAST_READINGS
        if not is_complete and len(self._lengths) < MOST_READINGS:
            return False
        self._judge(1e-9 * (stamp_ns - self._start_ns))
        return self.is_open

    def _judge(self, seconds):
        """Open, or set the error of a window at rest; begin the next window."""
        median = float(np.median(self._lengths))
        per_second = (len(self._lengths) - 1) / seconds if seconds > 0 else 0.0
        error = force_error(median, 'at rest', self._stated, per_second=per_second)
        moves = np.std(self._lengths) > REST_SPREAD * median
        # A motion may exceed gravity, as no reading in g does; a motion must not stop the output.
        if error is None or (moves and STANDARD_GRAVITY < median < MOST_IN_MOTION):
            self._open()
        elif not moves or error.code in ('without_gravity', 'increments'):
            self.error = error
        self._start_ns, self._lengths, self._judged = None, [], True

    def _open(self):
        self.is_open, self.error = True, None
