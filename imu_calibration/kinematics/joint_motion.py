"""
The joints' motion at given and shifted times, and errors of angle encoders.

The motion at given instants is angles and three derivatives.
"""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.core.samples import AlignedArrays


@dataclass(frozen=True, eq=False)
class JointMotion(AlignedArrays):
    """
    Angles of the joints and their first three derivatives.

    Columns in the order of the table's joints.
    """

    time: np.ndarray
    """Seconds, shape (n,)."""
    position: np.ndarray
    """Joint angles, rad, shape (n, n_joints)."""
    rate: np.ndarray
    """First derivative, rad/s, shape (n, n_joints)."""
    acceleration: np.ndarray
    """Second derivative, rad/s^2, shape (n, n_joints)."""
    jerk: np.ndarray
    """Third derivative, rad/s^3, shape (n, n_joints)."""
    thermal_branch: np.ndarray | None = None
    """Thermal branch at these instants (`kinematics.signal_history`), shape (n,); None: unknown."""
    vibration: np.ndarray | None = None
    """
    Variance of vibration (`kinematics.signal_history`), (m/s^2)^2, shape (n, 3); None: unknown.
    """
    temperature_rate: np.ndarray | None = None
    """Slope of the temperature (`kinematics.signal_history`), K/s, shape (n,); None: unknown."""


def with_encoder_harmonics(
    motion: JointMotion, order: int, cos_amplitude: np.ndarray, *, sin_amplitude: np.ndarray
) -> JointMotion:
    """
    Return the true motion for encoders with a harmonic error.

    The equation is ``q_true = q + c cos(k q) + s sin(k q)``.

    Rates, accelerations and jerks are the exact derivatives.

    Parameters
    ----------
    motion : JointMotion
        Motion measured by the encoders.
    order : int
        Periods per turn, k.
    cos_amplitude, sin_amplitude : array, shape (n_joints,)
        Amplitudes c and s, rad.

    """
    shape = motion.position.shape[1:]
    cos_amplitude = np.broadcast_to(np.asarray(cos_amplitude, float), shape)
    sin_amplitude = np.broadcast_to(np.asarray(sin_amplitude, float), shape)
    wrong = np.flatnonzero((cos_amplitude != 0) | (sin_amplitude != 0))
    if not len(wrong):
        return motion

    # The error e(q) and its derivatives with respect to q.
    phase = order * motion.position[:, wrong]
    cos = np.cos(phase)
    sin = np.sin(phase)
    error = cos_amplitude[wrong] * cos + sin_amplitude[wrong] * sin
    slope = order * (sin_amplitude[wrong] * cos - cos_amplitude[wrong] * sin)
    curvature = -(order**2) * error
    third = -(order**2) * slope

    # With e1, e2, e3 for these derivatives:
    # rate -> (1 + e1) rate
    # acceleration -> (1 + e1) acceleration + e2 rate^2
    # jerk -> (1 + e1) jerk + 3 e2 rate acceleration + e3 rate^3
    rate = motion.rate[:, wrong]
    acceleration = motion.acceleration[:, wrong]
    true_position = motion.position.copy()
    true_position[:, wrong] += error
    true_rate = motion.rate.copy()
    true_rate[:, wrong] *= 1 + slope
    true_acceleration = motion.acceleration.copy()
    true_acceleration[:, wrong] = acceleration * (1 + slope) + curvature * rate**2
    true_jerk = motion.jerk.copy()
    true_jerk[:, wrong] = (
        motion.jerk[:, wrong] * (1 + slope) + 3 * curvature * rate * acceleration + third * rate**3
    )
    return replace(
        motion,
        position=true_position,
        rate=true_rate,
        acceleration=true_acceleration,
        jerk=true_jerk,
    )


def encoder_step(position: np.ndarray) -> float:
    """
    Return the step of an encoder that is seen in its readings, rad, or 0.

    It is the size of isolated jumps: changes with equal readings before and after them. Most of the
    jumps must have that size. Readings that change by many steps from sample to sample have no
    isolated jumps; their quantisation is white noise.
    """
    change = np.diff(position)
    moved = change != 0
    is_isolated = moved[1:-1] & ~moved[:-2] & ~moved[2:]
    jumps = np.abs(change[1:-1][is_isolated])
    if not len(jumps):
        return 0.0
    step = np.median(jumps)
    share_of_step = np.mean(np.abs(jumps / step - 1) < 0.15)
    return float(step) if share_of_step > 0.8 else 0.0


LINKED = 0.1
"""Largest distance of stamps for interpolation, s; with more, a new window or rest begins."""

DERIVATIVE_BLOCK_ROWS = 4096
"""Rows per block, so that they fit in the processor's cache."""


def shifted(motion: JointMotion, delay: float | np.ndarray) -> JointMotion:
    """
    Return the motion at ``time - delay``, with unchanged `time`.

    It is the motion of an IMU with stamps that are `delay` late. Between two stamps the polynomial
    of degree seven that meets position, rate, acceleration and jerk at both (Hermite), so that the
    error does not grow with the delay: 1e-4 of the acceleration at a quarter of the stamps'
    frequency. Before the first of a run of stamps and after the last, the Taylor series from there,
    with the jerk as the last derivative.

    Parameters
    ----------
    motion : JointMotion
        Motion at the stamps.
    delay : float or array, shape (n,)
        Delay of all stamps, or of each, s; positive if the stamps of the IMU are late.

    """
    if not np.any(delay) or not len(motion):
        return motion
    delay = np.broadcast_to(np.asarray(delay, float), motion.time.shape)
    # Instants along the last axis: arithmetic along an axis of a few joints is several times
    # slower.
    derivatives = np.stack([motion.position.T, motion.rate.T, motion.acceleration.T, motion.jerk.T])
    step = np.diff(motion.time)
    if len(motion) < 2 or np.any(step <= 0):
        moved = _taylor(derivatives, -delay)
    else:
        target = motion.time - delay
        moved = np.empty_like(derivatives)
        for first in range(0, len(target), DERIVATIVE_BLOCK_ROWS):
            rows = slice(first, first + DERIVATIVE_BLOCK_ROWS)
            moved[:, :, rows] = _interpolated(
                motion.time, step, derivatives, target[rows], delay[rows] > 0
            )
    return replace(
        motion, position=moved[0].T, rate=moved[1].T, acceleration=moved[2].T, jerk=moved[3].T
    )


def _interpolated(
    time: np.ndarray,
    step: np.ndarray,
    derivatives: np.ndarray,
    target: np.ndarray,
    is_late: np.ndarray,
) -> np.ndarray:
    """
    Return position and its first three derivatives at m instants, shape (4, n_joints, m).

    Parameters
    ----------
    time, step : array, shapes (n,) and (n - 1,)
        Stamps and their differences, s.
    derivatives : array, shape (4, n_joints, n)
        Position and its first three derivatives at the stamps.
    target : array, shape (m,)
        Instants, s.
    is_late : array, shape (m,)
        True where the instant is before its stamp.

    """
    # Index of the stamp after each instant, clipped at both ends of the recording. Instants that
    # are not between it and the stamp before, or in a gap, are outside.
    after = np.clip(np.searchsorted(time, target, side='right'), 1, len(time) - 1)
    is_between = (target >= time[after - 1]) & (target <= time[after])
    inside = (step[after - 1] <= LINKED) & is_between
    start = after[inside] - 1
    left = derivatives.take(start, axis=2)
    right = derivatives.take(start + 1, axis=2)
    between = _hermite(left, right, step[start], target[inside] - time[start])
    if inside.all():
        return between
    moved = np.empty((*derivatives.shape[:2], len(target)))
    moved[:, :, inside] = between
    # Outside a run of stamps, the Taylor series from its end: an instant before its stamp is before
    # the first stamp of the run, an instant after it follows the last. An isolated stamp is a run.
    outside = np.flatnonzero(~inside)
    next_stamp = np.searchsorted(time, target[outside], side='left')
    last_stamp = np.searchsorted(time, target[outside], side='right') - 1
    base = np.clip(np.where(is_late[outside], next_stamp, last_stamp), 0, len(time) - 1)
    moved[:, :, outside] = _taylor(derivatives[:, :, base], target[outside] - time[base])
    return moved


def _taylor(derivatives: np.ndarray, by: np.ndarray | float) -> np.ndarray:
    """
    Return value and first three derivatives at a distance `by`, shape (4, n_joints, n).

    `derivatives`: the same at distance zero; the third derivative is constant.
    """
    position, rate, acceleration, jerk = derivatives
    return np.stack(
        [
            position + by * (rate + by / 2 * (acceleration + by / 3 * jerk)),
            rate + by * (acceleration + by / 2 * jerk),
            acceleration + by * jerk,
            jerk,
        ]
    )


_EXPONENTS = np.arange(4, 8)
_POWERS = np.array(
    [
        np.ones(4),
        _EXPONENTS,
        _EXPONENTS * (_EXPONENTS - 1),
        _EXPONENTS * (_EXPONENTS - 1) * (_EXPONENTS - 2),
    ]
)
"""Derivatives of order 0 ... 3 of u^4 ... u^7 at u = 1, shape (4, 4)."""
_FROM_ENDS = np.linalg.inv(_POWERS)
"""Derivatives at u = 1 to coefficients of u^4 ... u^7, shape (4, 4)."""


def _hermite(left: np.ndarray, right: np.ndarray, step: np.ndarray, by: np.ndarray) -> np.ndarray:
    """
    Return value and first three derivatives of Hermite polynomials of degree seven.

    With ``u = by / step`` the polynomial is ``sum_k c_k u^k``.

    Parameters
    ----------
    left, right : array, shape (4, n_joints, m)
        Value and first three derivatives at both ends of m intervals.
    step, by : array, shape (m,)
        Length of the intervals, and distance of the instant from the left end, s.

    Returns
    -------
    array, shape (4, n_joints, m)

    """
    # Derivatives by u in place of the time.
    scale = np.stack([step**0, step, step**2, step**3])[:, None]
    left = scale * left
    # The powers four to seven correct the error of the left-end cubic at the right end.
    upper = np.tensordot(_FROM_ENDS, scale * right - _taylor(left, 1.0), 1)
    coefficients = [left[0], left[1], left[2] / 2, left[3] / 6, *upper]
    u = by / step
    derivatives = np.empty_like(left)
    for order in range(4):
        # Horner's rule; the derivative of this order is sum_k coefficients[k] u^(k - order).
        total = derivatives[order]
        total[:] = coefficients[7]
        for power in range(6, order - 1, -1):
            total *= u
            total += coefficients[power]
        for power in range(order + 1, 8):
            coefficients[power] = (power - order) * coefficients[power]
    return derivatives / scale


def rest_at(position: np.ndarray) -> JointMotion:
    """Return rest at each of the positions, shape (n, n_joints), at time zero."""
    zero = np.zeros_like(position)
    return JointMotion(np.zeros(len(position)), position, zero, zero, zero)
