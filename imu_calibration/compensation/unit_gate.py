"""The unit of readings, and their scale after a correction, checked before the first output."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.compensation.compensate import FittedErrors
from imu_calibration.core.errors import InputError
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.scales import DOUBTFUL, IMPOSSIBLE, USUAL, ScaleRange, scale_range
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.effects.base import Role
from imu_calibration.preprocessing.value_checks import (
    force_error,
    increments_error,
    samples_per_second,
)

WINDOW_S = 1.0
"""s; readings are collected over it before they are judged."""
LEAST_WINDOW_READINGS = 10
"""Number of readings in a window, at least."""
MOST_READINGS = 10_000
"""Number of readings in a window, at most: the stamps of a driver may stand still."""
REST_SPREAD = 0.05
"""Largest standard deviation of the length at rest, relative to its median."""
OTHER_CALIBRATION = (
    'give a calibration of this sensor at its present full-scale range, or state the unit of the'
    ' readings'
)
"""Remedy where the correction does not lead to readings at the true scale."""
MOST_IN_MOTION = 16 * STANDARD_GRAVITY
"""Median of the length that a motion reaches at most, m/s^2: the range of usual sensors."""


class GravityScale:
    """
    The length of gravity after the correction by a calibration, which is that of gravity.

    A calibration of readings at half scale doubles readings in another unit or range, which may
    be usual ones: ``|matrix^-1 (reading - bias)|``.
    """

    def __init__(self, calibration: FittedErrors):
        matrix = calibration.of('accelerometer', Role.LINEAR)
        bias = calibration.of('accelerometer', Role.OFFSET)
        self._inverse = np.eye(3) if matrix is None else np.linalg.inv(matrix)
        self._bias = np.zeros(3) if bias is None else np.asarray(bias)

    def lengths(self, force: np.ndarray) -> np.ndarray:
        """Return the lengths after the correction, m/s^2, shape (n,), of forces, shape (n, 3)."""
        return np.linalg.norm((np.asarray(force) - self._bias) @ self._inverse.T, axis=-1)

    def error(self, lengths: np.ndarray) -> InputError | None:
        """Return the error for `lengths` whose median is not that of gravity; None for others."""
        if _range_of(lengths) is not IMPOSSIBLE:
            return None
        return InputError(
            _said(lengths),
            key='accelerometer_unit',
            code='corrected_scale',
        )

    def question(self, lengths: np.ndarray) -> str:
        """Return the doubt about `lengths` at rest whose median may be gravity, or ''."""
        median = np.median(lengths)
        at_rest = np.median(np.abs(lengths - median)) < REST_SPREAD * median
        return _said(lengths) if at_rest and _range_of(lengths) is DOUBTFUL else ''


def _range_of(lengths: np.ndarray) -> ScaleRange:
    return scale_range(float(np.median(lengths)) / STANDARD_GRAVITY)


def _said(lengths: np.ndarray) -> str:
    return (
        'the corrected specific force must have the length of gravity,'
        f' {STANDARD_GRAVITY:.4g} m/s^2, with this calibration it is {np.median(lengths):.4g};'
        f' {OTHER_CALIBRATION}'
    )


def corrected_rates_text(ratio: float) -> str:
    """Return that corrected rates are `ratio` times the rotation of the measured gravity."""
    return (
        f'the corrected rates must be those that turn gravity, with this calibration they are'
        f' {ratio:.2g} times as large; {OTHER_CALIBRATION}'
    )


class UnitGate:
    """
    Withholds the output while the readings are not in the stated units.

    The gate opens with a first reading of usual length, or the first window of readings that can be
    gravity, and then stays open: a later motion or another publisher does not stop the output.
    Increments of either sensor have to arrive at the stated rate, which needs a window.

    Parameters
    ----------
    readings : RawReadings
        Units of both sensors.
    scale : GravityScale, optional
        Of the calibration that corrects the readings.

    """

    def __init__(self, readings: RawReadings, scale: GravityScale | None = None):
        self._readings, self._scale = readings, scale
        self._is_increments = bool(
            readings.accelerometer.per_second or readings.gyroscope.per_second
        )
        self._stamps: list[int] = []
        self._lengths: list[float] = []
        self._corrected: list[float] = []
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
        corrected = length if self._scale is None else float(self._scale.lengths(np.array(force)))
        # A driver without an accelerometer fills zeros, which are no measurement of gravity.
        if length == 0.0 or not np.isfinite(length):
            return True
        if not self._stamps or stamp_ns < self._stamps[0]:
            self._begin()
            # Only the very first reading opens by itself, where its length is usual: a shaken IMU
            # in g reaches any length.
            lengths = np.array([length, corrected])
            is_usual = all(scale_range(each) is USUAL for each in lengths / STANDARD_GRAVITY)
            if not self._judged and is_usual and not self._is_increments:
                self._open()
                return True
        self._stamps.append(stamp_ns)
        self._lengths.append(length)
        self._corrected.append(corrected)
        is_long = stamp_ns - self._stamps[0] >= WINDOW_S * 1e9
        is_complete = is_long and len(self._lengths) >= LEAST_WINDOW_READINGS
        if not is_complete and len(self._lengths) < MOST_READINGS:
            return False
        self._judge()
        return self.is_open

    def _begin(self) -> None:
        """Begin a window with the next reading."""
        self._stamps = []
        self._lengths = []
        self._corrected = []

    def _judge(self) -> None:
        """Open, or set the error of a window at rest; begin the next window."""
        median = float(np.median(self._lengths))
        per_second = samples_per_second(np.array(self._stamps))
        error = force_error(median, 'at rest', self._readings.accelerometer, per_second=per_second)
        if error is None and self._scale is not None:
            error = self._scale.error(np.array(self._corrected))
        moves = np.std(self._lengths) > REST_SPREAD * median
        wrong_rate = increments_error(per_second, self._readings) if per_second else None
        # A motion may exceed gravity, as no reading in g does; a motion must not stop the output.
        if wrong_rate is not None:
            self.error = wrong_rate
        elif error is None or (moves and STANDARD_GRAVITY < median < MOST_IN_MOTION):
            self._open()
        elif not moves or error.code in ('without_gravity', 'increments'):
            self.error = error
        self._begin()
        self._judged = True

    def _open(self) -> None:
        self.is_open, self.error = True, None
