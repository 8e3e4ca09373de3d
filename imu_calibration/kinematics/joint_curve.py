"""
Joints brought to the IMU's stamps.

A smooth curve through the readings, its motion, and small errors of it.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.joint_motion import JointMotion, encoder_step
from imu_calibration.kinematics.smoothing import (
    Knots,
    PenalisedSpline,
    Smooth,
    design_matrix,
    design_values,
    evaluate_pieces,
    normal_bands,
    piece_coefficients,
    smooth,
)

VELOCITY_SCALE = 2e-3
"""
Joint velocities are used when their scale agrees with the positions to this; filtered velocities
distort the reference.
"""
VELOCITY_LAG = 2e-4
"""
Largest lag of used velocities behind the positions, s; late ones imitate a time offset of the IMU.
"""


def _with_velocity(
    spline: PenalisedSpline,
    fit: Smooth,
    position: np.ndarray,
    velocity: np.ndarray,
    *,
    knots: Knots,
    time: np.ndarray,
    trend: 'Trend',
) -> Smooth:
    """
    Return the fit to positions and velocities of one joint.

    If the velocities disagree with the positions or are much noisier, `fit` is returned.

    Parameters
    ----------
    spline : PenalisedSpline
        Of the positions.
    fit : Smooth
        To the positions.
    position, velocity : array, shape (n,)
        rad, rad/s; NaN where there is no velocity.
    knots : Knots
    time : array, shape (n,)
    trend : Trend
        Of the joint, subtracted from the positions before the fit.

    """
    from scipy.sparse import vstack  # here, because its import is slow

    pieces = piece_coefficients(fit.coefficients[:, None])
    trend.add_to(pieces, knots)
    _, rate, acceleration = evaluate_pieces(knots, pieces, time, derivatives=2)[:, :, 0]
    trusted, velocity_sd = check_velocity(velocity, rate, acceleration, dof=fit.dof)
    # At the edge of the band the noise of the positions is this noise of rates. Velocities with
    # more than three times as much add little information.
    if not trusted or fit.noise_sd * fit.bandwidth / knots.step < 0.3 * velocity_sd:
        return fit
    weight = np.where(np.isfinite(velocity), fit.noise_sd / velocity_sd, 0.0)
    # The rows of the positions, then of the velocities, in units of the position noise.
    position_rows = position - trend.at(time)[:, 0]
    velocity_rows = weight * (np.nan_to_num(velocity) - trend.at(time, 1)[:, 0])
    interval, values = design_values(knots, time, 1)
    both = PenalisedSpline(
        vstack([spline.design, design_matrix(knots, interval, values * weight)], format='csr'),
        spline.bands + normal_bands(knots, interval, values * weight),
        n_kinds=2,
    )
    rows = np.concatenate([position_rows, velocity_rows])
    (joint_fit,) = smooth(both, rows[:, None], [fit.noise_sd])
    return joint_fit


@dataclass(frozen=True, eq=False)
class Trend:
    """
    Parabola of each joint, ``f_0 + f_1 t + f_2 t^2``, with t relative to a centre.

    It is subtracted from the positions before the fit, to reduce rounding; the penalty does not
    constrain it.
    """

    centre: float
    """Origin of their time, s."""
    factors: np.ndarray
    """Coefficients of the powers of time, shape (3, n_joints)."""

    @classmethod
    def through(cls, time: np.ndarray, position: np.ndarray, still: np.ndarray) -> 'Trend':
        """
        Return the parabolas of least squares, of lower degree for one or two stamps.

        `still`: True for joints at rest, which have a constant, shape (n_joints,).
        """
        centre = 0.5 * (time[0] + time[-1])
        degree = min(2, len(np.unique(time)) - 1)
        # Powers of a time between -1 and 1, against rounding.
        scale = max(time[-1] - centre, 1e-9) ** np.arange(degree + 1)
        powers = np.vander(time - centre, degree + 1, increasing=True) / scale
        factors = np.zeros((3, position.shape[1]))
        factors[: degree + 1] = (
            np.linalg.solve(powers.T @ powers, powers.T @ position) / scale[:, None]
        )
        factors[:, still] = 0.0
        factors[0, still] = position[0, still]
        return cls(centre, factors)

    def column(self, joint: int) -> 'Trend':
        """Return the parabola of one joint."""
        return Trend(self.centre, self.factors[:, joint : joint + 1])

    def at(self, time: np.ndarray, derivative: int = 0) -> np.ndarray:
        """Return values (`derivative` 0) or rates (1) at instants, shape (n, n_joints)."""
        time = (time - self.centre)[:, None]
        if derivative:
            return self.factors[1] + 2 * time * self.factors[2]
        return self.factors[0] + time * (self.factors[1] + time * self.factors[2])

    def add_to(self, pieces: np.ndarray, knots: Knots) -> None:
        """Add the parabolas to the polynomials between the knots, in place."""
        # With u in steps from the begin t of an interval, and the step h:
        # f(t + h u) = f(t) + h f'(t) u + h^2 f_2 u^2.
        starts = knots.start + knots.step * np.arange(knots.n_intervals)
        pieces[0] += self.at(starts)
        pieces[1] += knots.step * self.at(starts, 1)
        pieces[2] += knots.step**2 * self.factors[2]


def check_velocity(
    velocity: np.ndarray, rate: np.ndarray, acceleration: np.ndarray, *, dof: float
) -> tuple[bool, float]:
    """
    Compare a joint's velocities with the derivative of its positions.

    The equation is ``velocity = offset + scale rate - lag acceleration + noise``.

    Parameters
    ----------
    velocity : array, shape (n,)
        Velocities of the joint states, rad/s; NaN where there is none.
    rate, acceleration : array, shape (n,)
        Derivatives of the smooth curve through the positions at the same stamps.
    dof : float
        Effective number of parameters of that curve, and so of its independent values.

    Returns
    -------
    trusted : bool
        Whether scale, lag and offset agree; false if the motion is too weak for the test.
    noise_sd : float
        Scatter of the velocities, rad/s, that of the curve included.

    """
    good = np.isfinite(velocity)
    if good.mean() < 0.9 or not np.any(velocity[good]):
        return False, np.inf
    # Least squares for (offset, scale, lag), with columns of unit rms.
    columns = np.stack([np.ones(good.sum()), rate[good], -acceleration[good]], axis=1)
    rms = np.sqrt(np.mean(columns**2, axis=0))
    if rms.min() < 1e-12:
        return False, np.inf
    scaled = columns / rms
    # Of two arrays: the product of one with itself is computed otherwise, and rounded otherwise.
    inverse = np.linalg.pinv(scaled.T @ (columns / rms))
    estimate = inverse @ (scaled.T @ velocity[good]) / rms
    noise_sd = np.sqrt(np.mean((velocity[good] - columns @ estimate) ** 2))
    # Their sd: of the samples only `dof` are independent, at least four.
    estimate_sd = noise_sd * np.sqrt(np.diag(inverse) * good.sum() / max(dof, 4.0)) / rms
    # They differ from 0, 1 and 0 by less than the limits, at two sds too. The offset is compared
    # with the rms rate.
    limit = np.array([VELOCITY_SCALE * rms[1], VELOCITY_SCALE, VELOCITY_LAG])
    trusted = bool(np.all(np.abs(estimate - [0.0, 1.0, 0.0]) + 2 * estimate_sd < limit))
    return trusted, float(noise_sd)


_MINIMUM_SAMPLES = 8
"""Least number of stamps for a spline; fewer are fitted with a parabola."""
_MARGIN = 3
"""Knots before the first and after the last reading."""
_LONGEST_HOLE = 300
"""Longest hole in the readings that is interpolated, periods."""


@dataclass(frozen=True, eq=False)
class JointCurve:
    """Smooth motion of the joints over a stretch of time."""

    knots: Knots
    """Knots of the quintic spline."""
    pieces: np.ndarray
    """Polynomials between the knots, shape (6, n_intervals, n_joints)."""
    noise_sd: np.ndarray
    """
    Noise of the positions, rad, shape (n_joints,): estimated from the residuals, at least the known
    noise of the encoder.
    """
    bandwidth: np.ndarray
    """
    Frequency that passes at half its amplitude, Hz, shape (n_joints,); zero for a joint at rest.
    """

    def at(self, time: np.ndarray, derivatives: int = 3) -> JointMotion:
        """
        Return the `JointMotion` at `time`, shape (n,).

        NaN more than three periods before the first or after the last reading. Derivatives of
        higher order than `derivatives` are zero.
        """
        time = np.asarray(time, float)
        values = np.zeros((4, len(time), self.pieces.shape[2]))
        values[: derivatives + 1] = evaluate_pieces(
            self.knots, self.pieces, time, derivatives=derivatives
        )
        end = self.knots.start + self.knots.step * self.knots.n_intervals
        outside = (time < self.knots.start) | (time > end)
        if outside.any():
            values[:, outside] = np.nan
        return JointMotion(time, *values)


def fit_joint_curve(
    time: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray | None = None,
    *,
    noise_sd: np.ndarray | float | None = None,
) -> JointCurve:
    """
    Return the smooth curve through readings of the joints.

    A penalised quintic spline per joint, one knot per reading; the penalty follows from the data
    (`smoothing.smooth`), so that readings without noise are interpolated, and a coarse encoder does
    not cause large accelerations. Velocities that agree with the positions in scale and lag are
    used.

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

    Returns
    -------
    JointCurve

    Raises
    ------
    InputError
        When there are no readings, a position is not finite, time runs backwards or has a hole of
        many periods.

    """
    time = np.asarray(time, float)
    position = np.asarray(position, float)
    _check(time, position)
    # 1. Positions without jumps, and knots. Repeated stamps have one knot.
    if np.any(np.abs(np.diff(position, axis=0)) > np.pi):
        position = np.unwrap(position, axis=0)
    stamps = time[np.concatenate([[True], np.diff(time) > 0])]
    knots = _place_knots(stamps)

    # 2. What the fit leaves unchanged: a trend, which is the constant of a joint at rest, and the
    #    least noise.
    still = np.all(position == position[0], axis=0)
    floor = _noise_floor(position, noise_sd)
    trend = Trend.through(time, position, still)

    # 3. A spline through the positions of each moving joint minus the trend, then with velocities.
    #    Fewer than `_MINIMUM_SAMPLES` stamps have the trend only.
    coefficients = np.zeros((knots.n_coefficients, position.shape[1]))
    bandwidth = np.zeros(position.shape[1])
    noise = floor.copy()
    moving = np.flatnonzero(~still).tolist()
    if len(stamps) >= _MINIMUM_SAMPLES and len(moving):
        interval, values = design_values(knots, time)
        spline = PenalisedSpline(
            design_matrix(knots, interval, values), normal_bands(knots, interval, values)
        )
        fits = smooth(spline, position[:, moving] - trend.at(time)[:, moving], floor[moving])
        for joint, fit in zip(moving, fits, strict=True):
            noise[joint] = max(floor[joint], fit.noise_sd)
            if velocity is not None:
                fit = _with_velocity(
                    spline,
                    fit,
                    position[:, joint],
                    velocity[:, joint],
                    knots=knots,
                    time=time,
                    trend=trend.column(joint),
                )
            coefficients[:, joint] = fit.coefficients
            bandwidth[joint] = fit.bandwidth / (2 * np.pi * knots.step)

    # 4. The polynomial of each interval, with the trend.
    pieces = piece_coefficients(coefficients)
    trend.add_to(pieces, knots)
    return JointCurve(knots, pieces, noise, bandwidth)


def _check(time: np.ndarray, position: np.ndarray) -> None:
    """Raise an InputError unless positions are finite and stamps do not decrease."""
    if not len(time) or not np.isfinite(position).all():
        raise InputError(
            f'joint positions must be finite, got {len(time)} readings with gaps or none; remove'
            ' non-finite values',
            code='not_finite',
        )
    if np.any(np.diff(time) < 0):
        raise InputError(
            'joint stamps must not run backwards, got a backward step; sort the readings or drop'
            ' those',
            code='stamps_backwards',
        )


def _place_knots(time: np.ndarray) -> Knots:
    """
    Return knots at the usual distance of increasing stamps, with a margin on both sides.

    The usual distance is the median over spans of eight stamps, which jitter affects less.
    """
    stride = min(8, len(time) - 1)
    step = float(np.median(time[stride:] - time[:-stride]) / stride) if stride else 1e-6
    hole = np.max(np.diff(time), initial=0.0)
    if hole > _LONGEST_HOLE * step:
        raise InputError(
            f'joint readings must follow each other within {_LONGEST_HOLE} periods, got a hole of'
            f' {hole:.3g} s; split them there',
            code='gap',
        )
    return Knots(
        start=float(time[0] - _MARGIN * step),
        step=step,
        n_intervals=int(np.ceil((time[-1] - time[0]) / step)) + 2 * _MARGIN,
    )


def _noise_floor(position: np.ndarray, noise_sd: np.ndarray | float | None) -> np.ndarray:
    """
    Return the least noise of the readings, rad, shape (n_joints,).

    The largest of the given noise, the rounding of floating-point numbers and the quantisation by
    encoder steps, ``step / sqrt(12)``.
    """
    rounding = 4 * np.finfo(float).eps * np.abs(position).max(axis=0)
    steps = np.array([encoder_step(column) for column in position.T])
    given = np.broadcast_to(0.0 if noise_sd is None else noise_sd, rounding.shape)
    return np.maximum.reduce([rounding, steps / np.sqrt(12), given])
