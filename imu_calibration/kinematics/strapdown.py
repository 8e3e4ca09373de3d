"""
Strapdown dead reckoning near one place.

The rotation between two instants with its derivative is included.

Attitude, velocity and position in the level frame ``n``; the table is at rest, so Coriolis terms
and the change of gravity with position are left out: over 50 s they are below 1e-3 of the errors
that are compared. All sums over samples are array operations.
"""

from dataclasses import dataclass

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.kinematics.rotations import (
    Reference,
    cross,
    quaternions_from_vectors,
    rotations_from_quaternions,
    skew,
)

MAGNUS_SECOND = 1.0 / 12.0
"""
Weight of ``dt^2 rate_k x rate_{k+1}`` and of ``-dt^2 (slope_{k+1} - slope_k)`` in the rotation
vector of a step.
"""


@dataclass(frozen=True, eq=False)
class Turn:
    """Rotation from the first sample of a stretch to its last one."""

    mat_ji: np.ndarray
    """
    Turns vectors from the sensor frame at the first sample (i) into that at the last one (j), shape
    (3, 3).
    """
    by_bias: np.ndarray
    """
    Derivative by the bias of the small rotation psi, ``delta mat_ji = -[psi x] mat_ji``, shape (3,
    3), s.
    """
    by_matrix: np.ndarray
    """Derivative of psi by the entries [row, column] of the forward matrix, shape (3, 3, 3)."""
    by_further: np.ndarray
    """Derivative of psi by the parameters of further effects, shape (3, p)."""
    integral: np.ndarray
    """Integral of ``measured - bias - further effects``, shape (3,), rad."""
    angle: float
    """Path of the rotation: integral of the rate's length, rad."""
    duration: float
    """Seconds from first to last sample."""


def integrate_turn(
    time: np.ndarray,
    rate_measured: np.ndarray,
    *,
    bias: np.ndarray,
    matrix: np.ndarray,
    further: tuple[np.ndarray, np.ndarray] | None = None,
) -> Turn:
    """
    Integrate ``rate = matrix^-1 (measured - bias - further effects)`` over one stretch of samples.

    The rotation vector of each step is the Magnus series to second order, ``h/2 (w0 + w1) - h^2/12
    (w1' - w0') + h^2/12 w0 x w1`` with slopes by central differences: fourth order in the step,
    third at the ends of the stretch. The steps are multiplied by a prefix product. All arrays have
    the samples along their last axis.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, rising; n >= 2.
    rate_measured : array, shape (n, 3)
        Gyroscope readings, rad/s.
    bias, matrix : arrays, shape (3,) and (3, 3)
        Forward model ``measured = bias + matrix @ rate + further effects``.
    further : tuple, optional
        Contribution of further effects to the readings, shape (n, 3), and its derivative by their p
        parameters, shape (n, 3, p).

    Returns
    -------
    Turn

    """
    inverse = np.linalg.inv(matrix)
    corrected = rate_measured - bias
    if further is not None:
        corrected = corrected - further[0]
    centred = corrected.T.copy()
    rate = inverse @ centred
    step = np.diff(time)
    slopes = _slope_weights(time)
    vectors = _rotation_vectors(rate, step, slopes)
    # Rotations into the sensor frame at the first sample (i), and at the last one (j), from that at
    # the end of each step k.
    mat_ik = rotations_from_quaternions(_prefix_product(vectors).T)
    mat_ji = mat_ik[-1].T.copy()
    to_last = (mat_ji @ mat_ik.transpose(1, 2, 0).reshape(3, -1)).reshape(3, 3, -1)
    # psi = sum over samples of weight @ delta rate, with rate = inverse @ centred.
    weight = _per_sample(_times_jacobian(to_last, vectors), step, rate, slopes)
    # by_inverse[i, r, c] is the derivative of psi_i by inverse[r, c], whose own derivative is
    # ``-inverse @ (change of matrix) @ inverse``. by_reading: of psi by a reading, (3, 3, n).
    by_inverse = (weight.reshape(9, -1) @ centred.T).reshape(3, 3, 3)
    by_matrix = -np.einsum('irc,rp,qc->ipq', by_inverse, inverse, inverse)
    by_reading = inverse.T @ weight
    by_further = np.zeros((3, 0))
    if further is not None:
        by_further = -np.tensordot(by_reading, further[1], ((1, 2), (1, 0)))
    path = float(np.sum(0.5 * step * np.linalg.norm(rate[:, :-1] + rate[:, 1:], axis=0)))
    integral = 0.5 * (centred[:, :-1] + centred[:, 1:]) @ step
    return Turn(
        mat_ji=mat_ji,
        by_bias=-by_reading.sum(axis=2),
        by_matrix=by_matrix,
        by_further=by_further,
        integral=integral,
        angle=path,
        duration=float(time[-1] - time[0]),
    )


def total_rotation(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """
    Return the rotation `Turn.mat_ji` of true rates, without its derivatives, shape (3, 3).

    `time`, `rate`: s, rad/s, shapes (n,) and (n, 3).
    """
    vectors = _rotation_vectors(rate.T.copy(), np.diff(time), _slope_weights(time))
    return rotations_from_quaternions(_prefix_product(vectors)[:, -1]).T


def _rotation_vectors(rate: np.ndarray, step: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """
    Return the rotation vector of each step (`integrate_turn`), rad, shape (3, n - 1).

    `rate`: shape (3, n); `step`: s, shape (n - 1,); `slopes`: `_slope_weights`.
    """
    first = rate[:, :-1]
    second = rate[:, 1:]
    # Of each sample, by the rates of the sample itself, the one before and the one after.
    slope = slopes[1] * rate
    slope[:, 1:] += slopes[0][1:] * first
    slope[:, :-1] += slopes[2][:-1] * second
    return 0.5 * step * (first + second) + MAGNUS_SECOND * step**2 * (
        cross(first, second) - np.diff(slope)
    )


def small_rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of one rotation vector, to second order in its small length."""
    turn = skew(vector)
    return np.eye(3) + turn + 0.5 * turn @ turn


def _slope_weights(time: np.ndarray) -> np.ndarray:
    """
    Return the weights w of the slope at each sample, 1/s, shape (3, n).

    ``slope_k = w_0k x_(k-1) + w_1k x_k + w_2k x_(k+1)``, one-sided at the ends.
    """
    step = np.diff(time)
    before = step[:-1]
    after = step[1:]
    weights = np.zeros((3, len(time)))
    weights[0, 1:-1] = -after / (before * (before + after))
    weights[2, 1:-1] = before / (after * (before + after))
    weights[0, -1] = -1 / step[-1]
    weights[2, 0] = 1 / step[0]
    weights[1] = -weights[0] - weights[2]
    return weights


def _per_sample(
    gain: np.ndarray, step: np.ndarray, rate: np.ndarray, slopes: np.ndarray
) -> np.ndarray:
    """
    Return H with ``psi = sum_m H_m @ delta rate_m``, shape (3, 3, n).

    Each sample ends one step, begins the next, and enters its neighbours' slopes. `gain` is the
    derivative of psi by the rotation vector of each step, shape (3, 3, n - 1). Its rows r are
    multiplied from the right by a cross-product matrix: ``r^T [w x] = (r x w)^T``.
    """
    # The vector of a step from w0 to w1 is h/2 (w0 + w1) + h^2/12 (w0 x w1 - (w1' - w0')): first
    # its derivative by w0 (sample m) and w1 (m + 1), then by the slopes, which are weighted sums of
    # the rates of the sample, the one before and the one after.
    half = 0.5 * step * gain
    by_vector = MAGNUS_SECOND * step**2 * gain
    weight, by_slope = np.zeros((2, 3, 3, len(step) + 1))
    weight[..., :-1] = half - cross(by_vector, rate[:, 1:])
    weight[..., 1:] += half + cross(by_vector, rate[:, :-1])
    by_slope[..., :-1] = by_vector
    by_slope[..., 1:] -= by_vector
    weight += slopes[1] * by_slope
    weight[..., :-1] += slopes[0][1:] * by_slope[..., 1:]
    weight[..., 1:] += slopes[2][:-1] * by_slope[..., :-1]
    return weight


def _multiply(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """
    Return the products of quaternions as pairs of complex numbers, shape (2, n).

    With ``q = u + v j``, ``u = w + x i`` and ``v = y + z i`` (Cayley and Dickson)::

        (a + b j) (c + d j) = (a c - b conj(d)) + (a d + b conj(c)) j

    as ``j c = conj(c) j``. These are 8 operations on arrays; the four components need 28.
    """
    a, b = left
    c, d = right
    product = np.empty((2, len(a)), complex)
    product[0] = a * c - b * d.conj()
    product[1] = a * d + b * c.conj()
    return product


def _prefix_product(vectors: np.ndarray) -> np.ndarray:
    """
    Return the quaternions q_0, q_0 q_1, q_0 q_1 q_2, ... as rows x, y, z, w, shape (4, n).

    q_k is that of the rotation vector k; `vectors`: rad, shape (3, n).
    """
    x, y, z, w = quaternions_from_vectors(vectors.T).T
    u, v = _running_quaternion(np.stack([w + 1j * x, y + 1j * z]))
    return np.stack([u.imag, v.real, v.imag, u.real])


def _running_quaternion(factors: np.ndarray) -> np.ndarray:
    """
    Return the product of the first k factors for each k (`_multiply`), shape (2, n).

    Recursive: with the products of neighbouring pairs as n / 2 factors, the products of the first
    2, 4, ... factors; the remaining products need one more factor. 2 n multiplications in total.
    """
    if factors.shape[1] < 2:
        return factors
    # Column k of `pairs` is the product up to factor 2 k + 1; times factor 2 k + 2 it is the next.
    pairs = _running_quaternion(_multiply(factors[:, :-1:2], factors[:, 1::2]))
    product = factors.copy()  # the first one is complete
    product[:, 1::2] = pairs
    product[:, 2::2] = _multiply(pairs[:, : (factors.shape[1] - 1) // 2], factors[:, 2::2])
    return product


def _times_jacobian(rows: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """
    Return ``rows J`` with ``exp(v + d) = exp(v) exp(J d)`` to first order in d, shape (3, 3, n).

    With the angle a = |v|: ``J = 1 - (1 - cos a)/a^2 [v x] + (a - sin a)/a^3 [v x]^2``. `rows`: one
    matrix for each vector, shape (3, 3, n); `vectors`: rad, shape (3, n).
    """
    angle = np.linalg.norm(vectors, axis=0)
    # Series where the quotients lose digits.
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    first_order = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second_order = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    across = cross(rows, vectors)
    return rows - first_order * across + second_order * cross(across, vectors)


def integrate_attitude(
    time: np.ndarray, rate_s: np.ndarray, mat_ns0: np.ndarray | None = None
) -> np.ndarray:
    """
    Integrate the rate into the attitude, sensor frame to level frame, shape (n, 3, 3).

    Each step turns by the mean of two neighbouring rates times the step, with the two-sample coning
    term ``rate_k x rate_(k+1) dt^2/12``.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds.
    rate_s : array, shape (n, 3)
        Rate relative to the level frame, rad/s, sensor frame.
    mat_ns0 : array, shape (3, 3), optional
        Attitude at the first sample, identity if not given.

    """
    time, rate_s = _checked(time, rate_s)
    step = np.diff(time)[:, None]
    turns = (
        0.5 * (rate_s[1:] + rate_s[:-1]) * step + np.cross(rate_s[:-1], rate_s[1:]) * step**2 / 12
    )
    start = np.eye(3) if mat_ns0 is None else mat_ns0
    from_start = rotations_from_quaternions(_prefix_product(turns.T).T)
    return np.concatenate([start[None], start @ from_start])


def dead_reckon(
    time: np.ndarray, force_n: np.ndarray, gravity: float
) -> tuple[np.ndarray, np.ndarray]:
    """
    Integrate specific force in the level frame (z up) twice by the trapezoid rule.

    Returns
    -------
    velocity_n, position_n : arrays, shape (n, 3)
        m/s and m, zero at the start; extra leading axes of `force_n` are kept.

    """
    acceleration = np.asarray(force_n, float) - np.array([0.0, 0.0, gravity])
    velocity = _running_integral(time, acceleration)
    return velocity, _running_integral(time, velocity)


def strapdown(
    time: np.ndarray,
    force_s: np.ndarray,
    rate_s: np.ndarray,
    *,
    gravity: float,
    mat_ns0: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return velocity and position in the level frame n, m/s and m, each shape (n, 3).

    They are integrated from accelerometers and gyroscopes only, from rest at the origin.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds.
    force_s, rate_s : arrays, shape (n, 3)
        Specific force, m/s^2, and rate relative to the level frame, rad/s, sensor frame.
    gravity : float
        Local gravity, m/s^2.
    mat_ns0
        As in `integrate_attitude`.

    """
    mat_ns = integrate_attitude(time, rate_s, mat_ns0)
    return dead_reckon(time, np.einsum('nij,nj->ni', mat_ns, force_s), gravity)


def dead_reckoning_errors(
    reference: Reference, force_s: np.ndarray, rate_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the errors of velocity and position from measured samples, m/s and m, each shape (n, 3).

    Navigation starts at rest from the true attitude. The reference's own samples are integrated by
    the same rule and subtracted, so that only sensor errors remain.

    Parameters
    ----------
    reference : Reference
        True motion at the same stamps.
    force_s, rate_s : arrays, shape (n, 3)
        Measured or compensated samples, m/s^2 and rad/s.

    """
    time = reference.time
    gravity = reference.gravity
    mat_ns0 = reference.mat_sn[0].T
    velocity, position = strapdown(time, force_s, rate_s, gravity=gravity, mat_ns0=mat_ns0)
    true_velocity, true_position = strapdown(
        time, reference.force_s, reference.rate_s, gravity=gravity, mat_ns0=mat_ns0
    )
    return velocity - true_velocity, position - true_position


def _checked(time: np.ndarray, rate_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and rates as arrays; raises an InputError if they do not fit each other."""
    time = np.asarray(time, float)
    rate_s = np.asarray(rate_s, float)
    if rate_s.shape != (len(time), 3) or np.any(np.diff(time) <= 0):
        raise InputError(
            f'rates must have shape ({len(time)}, 3) at increasing times, got {rate_s.shape}; sort'
            ' the samples',
            code='shape_and_times',
        )
    return time, rate_s


def _running_integral(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the integral from the first sample by the trapezoid rule, shape (..., n, 3)."""
    areas = 0.5 * (values[..., 1:, :] + values[..., :-1, :]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros_like(values[..., :1, :]), np.cumsum(areas, axis=-2)], axis=-2)
