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
    The length of the corrected specific force at rest, ``|matrix^-1 (reading - bias)|``.

    It must be that of gravity: a calibration of readings at half scale doubles readings in another
    unit or range, whose length may be usual.
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
        if _scale_of(lengths) is not IMPOSSIBLE:
            return None
        return InputError(
            _scale_text(lengths),
            key='accelerometer_unit',
            code='corrected_scale',
        )

    def question(self, lengths: np.ndarray) -> str:
        """Return a text on `lengths` at rest whose median is a doubtful gravity, '' for others."""
        median = np.median(lengths)
        at_rest = np.median(np.abs(lengths - median)) < REST_SPREAD * median
        return _scale_text(lengths) if at_rest and _scale_of(lengths) is DOUBTFUL else ''


def _scale_of(lengths: np.ndarray) -> ScaleRange:
    """Return the range of the median of lengths, m/s^2, relative to gravity."""
    return scale_range(float(np.median(lengths)) / STANDARD_GRAVITY)


def _scale_text(lengths: np.ndarray) -> str:
    """Return the text of an error for corrected lengths that are not gravity, m/s^2."""
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
        self._readings = readings
        self._scale = scale
        self._is_increments = bool(
            readings.accelerometer.per_second or readings.gyroscope.per_second
        )
        # The readings of the present window.
        self._stamps: list[int] = []
        """Stamps, ns."""
        self._lengths: list[float] = []
        """Lengths of the specific force in the stated unit, converted to m/s^2."""
        self._corrected_lengths: list[float] = []
        """Lengths after the correction by the calibration, m/s^2."""
        self._had_window = False
        """Whether a window was complete, without opening the gate."""
        self.is_open = False
        """Whether the output is published from now on."""
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
            self._begin_window()
            # One reading of usual length opens the gate only before the first window: a shaken IMU
            # in g reaches any length later.
            is_usual = scale_range(length / STANDARD_GRAVITY) is USUAL
            is_usual &= scale_range(corrected / STANDARD_GRAVITY) is USUAL
            if is_usual and not self._had_window and not self._is_increments:
                self._open()
                return True
        self._stamps.append(stamp_ns)
        self._lengths.append(length)
        self._corrected_lengths.append(corrected)
        is_long = stamp_ns - self._stamps[0] >= WINDOW_S * 1e9
        is_complete = is_long and len(self._lengths) >= LEAST_WINDOW_READINGS
        if not is_complete and len(self._lengths) < MOST_READINGS:
            return False
        self._judge_window()
        return self.is_open

    def _begin_window(self) -> None:
        """Begin a window with the next reading."""
        self._stamps = []
        self._lengths = []
        self._corrected_lengths = []

    def _judge_window(self) -> None:
        """Open the gate or set `error`, by the lengths of a complete window; begin the next one."""
        # Errors of the median length and of the sampling rate; None without an error.
        median = float(np.median(self._lengths))
        per_second = samples_per_second(np.array(self._stamps))
        length_error = force_error(
            median, 'at rest', self._readings.accelerometer, per_second=per_second
        )
        if length_error is None and self._scale is not None:
            length_error = self._scale.error(np.array(self._corrected_lengths))
        rate_error = increments_error(per_second, self._readings) if per_second else None

        # A median above gravity may be a motion in m/s^2, which must not withhold the output;
        # readings in g are never as large.
        is_moving = np.std(self._lengths) > REST_SPREAD * median
        may_be_motion = is_moving and STANDARD_GRAVITY < median < MOST_IN_MOTION
        if rate_error is not None:
            self.error = rate_error
        elif length_error is None or may_be_motion:
            self._open()
        # These two errors are certain in motion too.
        elif not is_moving or length_error.code in ('without_gravity', 'increments'):
            self.error = length_error
        self._begin_window()
        self._had_window = True

    def _open(self) -> None:
        """Publish the output from now on."""
        self.is_open = True
        self.error = None
