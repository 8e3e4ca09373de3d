"""Joints brought to the IMU's stamps: a smooth curve through the readings, its motion, and small errors of it."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.errors import InputError
from imu_calibration.reference.encoder import encoder_step
from imu_calibration.reference.joint_fit import JointRows, JointSettings, Trend, fit_with_velocity
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.reference.quintic_spline import Knots, evaluate_pieces, piece_coefficients
from imu_calibration.reference.smoothing import smooth

_MINIMUM_SAMPLES = 8  # fewer stamps are fitted with a parabola
_MARGIN = 3  # knots beyond the readings
_LONGEST_HOLE = 300  # periods; a longer one cannot be bridged by anything sensible


@dataclass(frozen=True, eq=False)
class JointCurve:
    """Smooth motion of the joints over a stretch of time."""

    knots: Knots
    """Knots of the quintic spline."""
    pieces: np.ndarray
    """Polynomials between the knots, shape (6, n_intervals, n_joints)."""
    noise_sd: np.ndarray
    """Noise of the positions, rad, shape (n_joints,): estimated from the residuals, at least the known noise of the encoder."""
    velocity_trusted: np.ndarray
    """Whether the velocities agree with the positions, shape (n_joints,)."""
    bandwidth: np.ndarray
    """Frequency that passes at half its amplitude, Hz, shape (n_joints,); zero for a joint at rest."""

    def at(self, time: np.ndarray, derivatives: int = 3) -> JointMotion:
        """
        Return the `JointMotion` at `time`, shape (n,); NaN outside the readings by more than three of their periods.

        Derivatives above `derivatives` are left out as zero.
        """
        time = np.asarray(time, float)
        values = np.zeros((4, len(time), self.pieces.shape[2]))
        values[:derivatives + 1] = evaluate_pieces(self.knots, self.pieces, time, derivatives=derivatives)
        outside = (time < self.knots.start) | (time > self.knots.start + self.knots.step * self.knots.n_intervals)
        if outside.any():
            values[:, outside] = np.nan
        return JointMotion(time, *values)


def fit_joint_curve(time: np.ndarray, position: np.ndarray, velocity: np.ndarray | None = None, *,
                    noise_sd: np.ndarray | float | None = None,
                    settings: JointSettings = JointSettings()) -> JointCurve:
    """
    Return the smooth curve through readings of the joints.

    A penalised quintic spline per joint, one knot per reading; the penalty follows from the data (`smoothing.smooth`), so
    that readings without noise are interpolated and those of a coarse encoder give sane accelerations. Velocities that
    agree with the positions in scale and lag are used.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, not decreasing; repeats, jitter and small gaps are fine.
    position : array, shape (n, n_joints)
        Joint angles, rad; jumps by whole turns are undone.
    velocity : array, shape (n, n_joints), optional
        Joint rates, rad/s; NaN where there is none.
    noise_sd : float or array, shape (n_joints,), optional
        Noise that the positions have at least, rad.
    settings : JointSettings, optional
        Adjustable numbers.

    Returns
    -------
    JointCurve

    Raises
    ------
    InputError
        When there are no readings, a position is not finite, time runs backwards or has a hole of many periods.

    """
    time, position = np.asarray(time, float), np.asarray(position, float)
    _check(time, position)
    position = _unwrapped(position)
    stamps = time[np.concatenate([[True], np.diff(time) > 0])]
    knots = _place_knots(stamps)
    still = np.all(position == position[0], axis=0)
    floor = _noise_floor(position, noise_sd)
    trend = Trend.through(time, position, still)
    coefficients = np.zeros((knots.n_coefficients, position.shape[1]))
    bandwidth, trusted = np.zeros(position.shape[1]), np.zeros(position.shape[1], bool)
    noise = floor.copy()
    moving = np.flatnonzero(~still).tolist()
    if len(stamps) >= _MINIMUM_SAMPLES and len(moving):
        rows = JointRows(knots, time)
        fits = smooth(rows.positions(), position[:, moving] - trend.at(time)[:, moving], floor[moving], robustness=settings.robustness)
        for joint, fit in zip(moving, fits, strict=True):
            noise[joint] = max(floor[joint], fit.noise_sd)
            if velocity is not None:
                trusted[joint], fit = fit_with_velocity(rows, fit, position[:, joint], velocity=velocity[:, joint],
                                                        trend=trend.column(joint), settings=settings)
            coefficients[:, joint], bandwidth[joint] = fit.coefficients, fit.bandwidth / (2 * np.pi * knots.step)
    pieces = piece_coefficients(coefficients)
    trend.add_to(pieces, knots)
    return JointCurve(knots, pieces, noise, trusted, bandwidth)


def _check(time, position):
    if not len(time) or not np.isfinite(position).all():
        raise InputError(f'joint positions must be finite, got {len(time)} readings with gaps or none; remove non-finite values',
                         code='not_finite')
    if np.any(np.diff(time) < 0):
        raise InputError('joint stamps must not run backwards, got a backward step; sort the readings or drop those',
                         code='stamps_backwards')


def _unwrapped(position):
    return np.unwrap(position, axis=0) if np.any(np.abs(np.diff(position, axis=0)) > np.pi) else position


def _place_knots(time):
    """Return knots at the usual distance of the stamps (increasing), with a margin on both sides."""
    stride = min(8, len(time) - 1)
    step = float(np.median(time[stride:] - time[:-stride]) / stride) if stride else 1e-6
    hole = np.max(np.diff(time), initial=0.0)
    if hole > _LONGEST_HOLE * step:
        raise InputError(f'joint readings must follow each other within {_LONGEST_HOLE} periods, got a hole of {hole:.3g} s; '
                         'split them there', code='gap')
    return Knots(float(time[0] - _MARGIN * step), step, int(np.ceil((time[-1] - time[0]) / step)) + 2 * _MARGIN)


def _noise_floor(position, noise_sd):
    """Return the lower limit of the noise of the readings: the given value, rounding, coarse steps."""
    floor = 4 * np.finfo(float).eps * np.abs(position).max(axis=0)
    steps = np.array([encoder_step(column) for column in position.T])
    return np.maximum.reduce([floor, steps / np.sqrt(12), np.broadcast_to(0.0 if noise_sd is None else noise_sd, floor.shape)])
