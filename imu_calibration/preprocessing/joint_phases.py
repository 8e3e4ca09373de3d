"""Phases of the joints (rest, steady turn, changing rate) from noisy or quantised readings, and a smooth curve through them."""

from enum import IntEnum

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d
from scipy.special import ndtri

from imu_calibration.kinematics.joint_curve import fit_joint_curve
from imu_calibration.kinematics.joint_motion import JointMotion, encoder_step
from imu_calibration.preprocessing.window import WindowSettings


class Phase(IntEnum):
    """Phase of the joints at a reading."""

    STILL = 0
    """All of them rest."""
    STEADY = 1
    """All rates are constant, and one joint turns."""
    MOVING = 2
    """Any other motion."""
    LOST = 3
    """Unknown."""


STILL, STEADY, MOVING, LOST = Phase
RATE_SPAN = 0.2
"""Rates are slopes over this time, s: long enough for encoders, short against `settling`."""
LONGEST_SPAN = 1.0
"""A rest or a steady turn must show over this time (or the shortest window, if that is less), s."""
REACH = RATE_SPAN / 2 + LONGEST_SPAN
"""Readings at a larger distance do not change a phase, s."""


def joint_phases(time: np.ndarray, position: np.ndarray, settings: WindowSettings, *,
                 noise_rad: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the phase of each joint reading of a stretch without gaps.

    At rest: every slope over 0.2 s, and at least one slope over a second that contains the reading, is below `static_rate` plus errors of
    noise and encoder steps (four standard deviations; 1.5 steps over the span). Steady: within at least one second that
    contains the reading the rates over 0.2 s change by less than `spin_rate_variation` of their middle, or by less than `static_rate`,
    and the readings show no ripple about them.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, increasing.
    position : array, shape (n, n_joints)
        Joint angles without jumps by whole turns, rad.
    settings : WindowSettings
    noise_rad : float, optional
        Known noise or resolution of the encoders, rad.

    Returns
    -------
    phase : array of int8, shape (n,)
        STILL, STEADY or MOVING.
    level : array, shape (n, n_joints)
        Positions averaged over 0.2 s, rad.

    """
    period = np.median(np.diff(time)) if len(time) > 1 else 1.0
    rows = np.ascontiguousarray(position.T)
    step, noise = (values[:, None] for values in _resolution(rows, noise_rad))
    half = _half_width(RATE_SPAN, period, 2)
    rate, level, ripple = _slopes(time, rows, half)
    still = _slow(rate, settings.static_rate, half, period, step, noise)
    if still.any():
        long_half = _half_width(min(LONGEST_SPAN, settings.static_minimum), period, half)
        long_rate, _, _ = _slopes(time, rows, long_half)
        still &= _widened(_slow(long_rate, settings.static_rate, long_half, period, step, noise), long_half)
    if still.all():
        return np.full(len(time), STILL, np.int8), level.T
    noise = np.maximum(np.maximum(noise, step / np.sqrt(12)), _white_noise(rows, 0.5, ~still)[:, None])
    steady_half = _half_width(min(LONGEST_SPAN, settings.spin_minimum), period, half)
    steady = _steady(rate, settings, steady_half, 4 * noise * _slope_gain(half, period), ripple, half, 3 * noise)
    return np.where(still, STILL, np.where(steady, STEADY, MOVING)).astype(np.int8), level.T


def _resolution(rows, noise_rad):
    """Return the step of the encoders and the noise of the readings, both (n_joints,), rad."""
    step = np.array([encoder_step(row) for row in rows])
    # the lower quartile: if a quarter of the readings are at rest, it contains neither jitter nor jerk
    return step, np.maximum(noise_rad or 0.0, _white_noise(rows, 0.25))


def _white_noise(rows, quantile, chosen=None):
    """Return the noise of the readings from a quantile of their fourth differences, (n_joints,); smooth motion drops out."""
    fourth = np.abs(np.diff(rows, 4, axis=1))
    fourth = fourth if chosen is None else fourth[:, chosen[2:-2]]
    if fourth.shape[1] < 12:
        return np.zeros(len(rows))
    return np.quantile(fourth, quantile, axis=1) / (ndtri((1 + quantile) / 2) * np.sqrt(70))


def _half_width(span, period, least):
    return max(least, int(round(span / period / 2)))


def _slope_gain(half, period):
    """Return the standard deviation of a slope over ``2 half + 1`` readings for noise of one."""
    n = 2 * half + 1
    return np.sqrt(12 / n) / (n * period)


def _slow(rate, static_rate, half, period, step, noise):
    allowed = static_rate + 4 * noise * _slope_gain(half, period) + 1.5 * step / ((2 * half + 1) * period)
    return np.all(np.abs(rate) <= allowed, axis=0)


def _steady(rate, settings, half, allowance, ripple, ripple_half, noise):
    size = 2 * half + 1
    high, low = (f(rate, size, axis=1, mode='nearest') for f in (maximum_filter1d, minimum_filter1d))
    change = np.maximum(settings.spin_rate_variation * np.abs(high + low) / 2, settings.static_rate)
    # a rate that swings by `change` within the span moves the readings by this
    swing = change * RATE_SPAN / (2 * np.pi)
    rough = np.sqrt(np.maximum(uniform_filter1d(ripple ** 2, 2 * ripple_half + 1, axis=1, mode='nearest'), 0.0))
    even = maximum_filter1d(rough - swing, size, axis=1, mode='nearest') <= noise
    return _widened(np.all((high - low <= change + 2 * allowance) & even, axis=0), half)


def _widened(mask, half):
    return maximum_filter1d(mask.view(np.int8), 2 * half + 1, mode='constant').astype(bool)


def _slopes(time, rows, half):
    """Return least-squares slopes and means over ``2 half + 1`` readings, fewer at the ends, and the residuals of the readings."""
    n = len(time)
    half = min(half, n - 1)
    place = np.arange(n)
    count = np.minimum(place + half + 1, n) - np.maximum(place - half, 0)
    middle = rows.mean(axis=1, keepdims=True)
    t, p = time - time.mean(), rows - middle
    sum_t, sum_tt = _window_sums(np.stack([t, t * t]), half)
    sum_p, sum_tp = _window_sums(p, half), _window_sums(p * t, half)
    spread = np.maximum(sum_tt - sum_t ** 2 / count, 1e-18)
    slope = (sum_tp - sum_t * sum_p / count) / spread
    return slope, sum_p / count + middle, p - sum_p / count - slope * (t - sum_t / count)


def _window_sums(rows, half):
    n = rows.shape[1]
    sums = np.empty((len(rows), n + 2 * half + 1))
    sums[:, :half + 1] = 0.0
    np.cumsum(rows, axis=1, out=sums[:, half + 1:half + 1 + n])
    sums[:, half + 1 + n:] = sums[:, half + n, None]
    return sums[:, 2 * half + 1:] - sums[:, :n]


LEAST_READINGS = 4
"""Fewest readings for an estimate of the motion."""


class JointRun:
    """Joint readings without gaps."""

    def __init__(self, time: np.ndarray, position: np.ndarray, velocity: np.ndarray, *, settings: WindowSettings, noise_rad: float | None):
        self.time, self.position, self.velocity = time, position, velocity
        self.phase, self.level = joint_phases(time, position, settings, noise_rad=noise_rad)
        self._moving = time[self.phase != STILL]
        self.step = np.array([encoder_step(column) for column in position.T])

    def covered(self, time: np.ndarray, before: bool, after: bool) -> np.ndarray:
        """Return a mask of the instants between the readings or, where the joints rest, within two periods of the first or last."""
        reach = 2 * np.median(np.diff(self.time))
        low = self.time[0] - (reach if before and self.phase[0] == STILL else 0.0)
        high = self.time[-1] + (reach if after and self.phase[-1] == STILL else 0.0)
        return (time >= low) & (time <= high)

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the phase (if equal at both neighbours, otherwise moving) and the level at instants."""
        right = np.minimum(np.searchsorted(self.time, time), len(self.time) - 1)
        left = np.maximum(right - 1, 0)
        phase = np.where(self.phase[left] == self.phase[right], self.phase[right], MOVING)
        level = np.stack([np.interp(time, self.time, column) for column in self.level.T], axis=1)
        return phase.astype(np.int8), level

    def near_motion(self, time: np.ndarray, distance: float) -> np.ndarray:
        """Return a mask of the instants between the readings that are within `distance` of one with moving joints."""
        if not len(self._moving):
            return np.zeros(len(time), bool)
        right = np.searchsorted(self._moving, time)
        ahead = self._moving[np.minimum(right, len(self._moving) - 1)]
        behind = self._moving[np.maximum(right - 1, 0)]
        near = np.minimum(np.abs(ahead - time), np.abs(time - behind)) <= distance
        return near & (time >= self.time[0]) & (time <= self.time[-1])

    def curve(self, time: np.ndarray, overlap: float, noise_rad: float | None) -> JointMotion:
        """Return the `JointMotion` of a smooth curve at instants."""
        first, stop = np.searchsorted(self.time, [time[0] - overlap, time[-1] + overlap])
        first, stop = max(0, min(first, len(self.time) - LEAST_READINGS)), min(len(self.time), max(stop, LEAST_READINGS))
        piece = slice(first, stop)
        velocity = None if np.isnan(self.velocity[piece]).all() else self.velocity[piece]
        return fit_joint_curve(self.time[piece], self.position[piece], velocity, noise_sd=noise_rad).at(time)
