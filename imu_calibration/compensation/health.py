"""Test of a calibration at every stop: the rate must be zero and the norm of specific force equal to gravity, within their sds."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from imu_calibration.compensation.bias_update import EARTH_RATE, MOST_MOVED, GyroBiasUpdate
from imu_calibration.compensation.compensate import Transfer
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.compensation.fitted import FittedErrors
from imu_calibration.compensation.stops import Stop
from imu_calibration.constants import DEG, STANDARD_GRAVITY
from imu_calibration.units import unit_of_rest

LIMIT = 4.0
"""Standard deviations; three axes exceed it by chance once in five thousand calibrations."""
LEAST = 2.0
"""Shortest stop that is tested, s."""
PLACE = 0.005
"""Share by which gravity differs between places."""
WORSE = 1.5
"""Times the error without calibration, from which a calibration does harm rather than too little."""


class HealthWord(StrEnum):
    """Whether a calibration still holds."""

    WAITING = 'waiting'
    """The robot has not stopped yet."""
    HOLDS = 'holds'
    MOVED = 'moved'
    """Something has moved by more than its standard deviation allows."""
    FOLLOWED = 'followed'
    """The bias of the gyroscope has moved, and an update corrects it."""
    HARMS = 'harms'
    """At rest, readings are farther from the truth with the calibration than without."""
    UNIT = 'unit'
    """The specific force at rest is that of another unit."""


WAITING, HOLDS, MOVED, FOLLOWED, HARMS, UNIT = HealthWord


@dataclass(frozen=True)
class HealthState:
    """Result of the last stop."""

    word: HealthWord
    """Whether the calibration holds."""
    message: str
    """One line of text."""
    values: dict = field(default_factory=dict)
    """Figures by name, with units."""


@dataclass(frozen=True)
class HealthOptions:
    """Site of the robot, and permitted corrections."""

    gravity: float = 0.0
    """Local gravity, m/s^2; 0: that of the calibration, within the variation between sites."""
    update: bool = False
    """Whether the bias of the gyroscope follows the stops."""
    bias_time: float = 600.0
    """Seconds in which an update loses its meaning."""


class _Judged(NamedTuple):
    """A stop with the state at its end; replaced as a whole, so that another thread may read it."""

    stop: Stop
    of_mean: np.ndarray
    """Variance of its mean, shape (6,)."""
    n_stops: int
    bias_update: tuple[np.ndarray, np.ndarray] | None
    """Corrected bias, and its variance, each shape (3,)."""


class CalibrationHealth:
    """
    Judges stops of a stream of corrected readings.

    Parameters
    ----------
    calibration : Calibration
    transfer : Transfer, optional
        Frame of the corrected readings.
    options : HealthOptions

    """

    def __init__(self, calibration: FittedErrors, transfer: Transfer | None, options: HealthOptions):
        self.options, self.n_stops = options, 0
        sensors = ('accelerometer', 'gyroscope')
        found = [calibration.noise(sensor) for sensor in sensors]
        turn = np.eye(3) if transfer is None else transfer.mat_ts
        self.noise_sd = np.concatenate([np.sqrt(turn**2 @ np.square(sd)) for sd, _ in found])
        wander = np.repeat([float(np.max(offset))**2 for _, offset in found], 3)
        parameters = Uncertainty(calibration, transfer).at().parameters
        self._known = parameters + np.diag(wander)
        given = options.gravity or calibration.conditions.get('gravity')
        self._gravity, self._place = float(given or STANDARD_GRAVITY), 0.1 * PLACE if options.gravity else PLACE
        self.update = GyroBiasUpdate(np.sqrt(np.diag(self._known)[3:]), options.bias_time) if options.update else None
        self._judged: float | None = None
        self._last: _Judged | None = None

    def judge(self, stop: Stop) -> None:
        """
        Process a growing stop.

        Parameters
        ----------
        stop : Stop
            Of corrected readings without any update; its `others` are the measured specific force and rate.

        """
        if stop.seconds < LEAST or np.linalg.norm(stop.mean[3:]) > MOST_MOVED:
            return   # too short, or a slow and steady turn
        if self._judged != stop.start:
            self._judged, self.n_stops = stop.start, self.n_stops + 1
        # A mean with a trend is not rest: motion that decays is an error of the mean of about its change.
        of_mean = np.maximum(stop.shake_sd, self.noise_sd)**2 / stop.n_samples + (2 * stop.change)**2
        if self.update is not None:
            self.update.measure(stop.start, stop.end, rate=stop.mean[3:], variance=of_mean[3:])
        self._last = _Judged(stop, of_mean, self.n_stops, None if self.update is None else self.update.predict(stop.end))

    @property
    def state(self) -> HealthState:
        """Result of the last stop, computed on request."""
        return HealthState(WAITING, 'no stop of two seconds yet') if self._last is None else self._told(*self._last)

    def _told(self, stop, of_mean, n_stops, bias_update):
        total = self._known + np.diag(of_mean)
        along = stop.mean[:3] / max(np.linalg.norm(stop.mean[:3]), 1e-9)
        rate_off = np.maximum(np.abs(stop.mean[3:]) - EARTH_RATE, 0) / np.sqrt(np.diag(total)[3:])
        gravity_sd = float(np.sqrt(along @ total[:3, :3] @ along))
        rate, length = stop.mean[3:], float(np.linalg.norm(stop.mean[:3]))
        force_off = max(abs(length - self._gravity) - self._place * self._gravity, 0) / gravity_sd
        axis = int(np.argmax(rate_off))
        values = {'stops': n_stops, 'seconds of the last stop': f'{stop.seconds:.1f}',
                  'rate at rest [deg/s]': ', '.join(f'{value / DEG:+.4f}' for value in rate), 'rate at rest [sd]': f'{rate_off.max():.1f}',
                  'gravity read [m/s^2]': f'{length:.4f}', 'gravity expected [m/s^2]': f'{self._gravity:.4f}',
                  'gravity off [sd]': f'{force_off:.1f}'}
        measured_length, measured_rate = (float(np.linalg.norm(stop.others[part])) for part in (slice(3), slice(3, 6)))
        if unit := unit_of_rest(measured_length):
            return HealthState(UNIT, f'the measured specific force at rest is {measured_length:.4g}: the unit is {unit}, it must be m/s^2; '
                                     'correct the driver', values)
        lines = []
        if rate_off[axis] > LIMIT:
            lines.append(f'the bias of the gyroscope has moved by {rate[axis] / DEG:+.3g} deg/s about {"xyz"[axis]}, '
                         f'{rate_off[axis]:.0f} times its sd')
        if force_off > LIMIT:
            lines.append(f'gravity reads {length:.3f} m/s^2 instead of {self._gravity:.3f}, {force_off:.0f} times its sd beyond what '
                         'places differ by')
        if bias_update is not None:
            bias, variance = bias_update
            values |= {'bias update [deg/s]': ', '.join(f'{value / DEG:+.4f}' for value in bias),
                       'bias update, sd [deg/s]': ', '.join(f'{value / DEG:.4f}' for value in np.sqrt(variance))}
        if not lines:
            off = f'{rate_off.max():.1f} and {force_off:.1f} sd'
            return HealthState(HOLDS, f'the calibration holds: at the last stop rate and gravity were off by {off}', values)
        harms = (rate_off[axis] > LIMIT and np.linalg.norm(rate) > WORSE * measured_rate) or (
            force_off > LIMIT and abs(length - self._gravity) > WORSE * abs(measured_length - self._gravity) + LIMIT * gravity_sd)
        if harms:
            return HealthState(HARMS, '; '.join(lines) + ': without the calibration it would be less; is it the right one? calibrate again',
                               values)
        if bias_update is not None and force_off <= LIMIT:
            return HealthState(FOLLOWED, '; '.join(lines) + ': corrected as long as stops confirm it', values)
        return HealthState(MOVED, '; '.join(lines) + ': calibrate again, unless it turned slowly and steadily there', values)
