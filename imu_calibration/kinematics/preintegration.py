"""The rotation between two moments from measured rates, with its exact derivative by the gyroscope's parameters."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.kinematics.reference_motion import skew

MAGNUS_SECOND = 1.0 / 12.0
"""Weight of ``dt^2 rate_k x rate_{k+1}`` and of ``-dt^2 (slope_{k+1} - slope_k)`` in the rotation vector of a step."""


@dataclass(frozen=True, eq=False)
class Turn:
    """Rotation from the first sample of a stretch to its last one."""

    mat_ji: np.ndarray
    """Vector coordinates in the sensor at the first sample (i) to those at the last one (j), shape (3, 3)."""
    by_bias: np.ndarray
    """Derivative of psi by the bias, ``delta mat_ji = -[psi x] mat_ji``, shape (3, 3), s."""
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


def integrate_turn(time: np.ndarray, rate_measured: np.ndarray, *, bias: np.ndarray, matrix: np.ndarray,
                   further: tuple[np.ndarray, np.ndarray] | None = None) -> Turn:
    """
    Integrate ``rate = matrix^-1 (measured - bias - further effects)`` over one stretch of samples.

    The rotation vector of each step is the Magnus series to second order, ``h/2 (w0 + w1) - h^2/12 (w1' - w0') + h^2/12 w0 x w1``
    with slopes by central differences: fourth order in the step, third at the ends of the stretch. The steps are multiplied by
    a prefix product, log2(n) passes over the samples.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, rising; n >= 2.
    rate_measured : array, shape (n, 3)
        Gyroscope readings, rad/s.
    bias, matrix : arrays, shape (3,) and (3, 3)
        Forward model ``measured = bias + matrix @ rate + further effects``.
    further : tuple, optional
        Contribution of further effects to the readings, shape (n, 3), and its derivative by their p parameters, shape (n, 3, p).

    Returns
    -------
    Turn

    """
    inverse = np.linalg.inv(matrix)
    centred = rate_measured - bias if further is None else rate_measured - bias - further[0]
    rate = centred @ inverse.T
    step = np.diff(time)
    first, second = rate[:-1], rate[1:]
    slopes = _slope_weights(time)
    slope = slopes[1][:, None] * rate
    slope[1:] += slopes[0][1:, None] * rate[:-1]
    slope[:-1] += slopes[2][:-1, None] * rate[1:]
    commutator = np.cross(first, second) - np.diff(slope, axis=0)
    vectors = 0.5 * step[:, None] * (first + second) + MAGNUS_SECOND * (step**2)[:, None] * commutator
    forward = _prefix_product(_quaternion(vectors))
    mat_ki = _matrix_to_sensor(forward)
    to_last = mat_ki[-1] @ np.swapaxes(mat_ki, 1, 2)
    gain = to_last @ _right_jacobian(vectors)
    weight = _per_sample(gain, step, first, second, slopes)
    by_inverse = np.einsum('mir,mc->irc', weight, centred)
    by_matrix = -np.einsum('irc,rp,qc->ipq', by_inverse, inverse, inverse)
    by_further = np.zeros((3, 0)) if further is None else -np.einsum('mij,mjp->ip', weight @ inverse, further[1])
    path = float(np.sum(0.5 * step * np.linalg.norm(first + second, axis=1)))
    integral = 0.5 * np.sum(step[:, None] * (centred[:-1] + centred[1:]), axis=0)
    return Turn(mat_ki[-1], -weight.sum(0) @ inverse, by_matrix, by_further, integral, path, float(time[-1] - time[0]))


def small_rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of one rotation vector, to second order in its small length."""
    cross = skew(vector)
    return np.eye(3) + cross + 0.5 * cross @ cross


def _slope_weights(time):
    """Return weights of the sample before, the sample and the one after in its slope, shape (3, n), 1/s; one-sided at the ends."""
    step = np.diff(time)
    before, after = step[:-1], step[1:]
    weights = np.zeros((3, len(time)))
    weights[0, 1:-1], weights[2, 1:-1] = -after / (before * (before + after)), before / (after * (before + after))
    weights[0, -1], weights[2, 0] = -1 / step[-1], 1 / step[0]
    weights[1] = -weights[0] - weights[2]
    return weights


def _per_sample(gain, step, first, second, slopes):
    """Return H with ``psi = sum_m H_m @ delta rate_m``: each sample ends one step, begins the next, and enters its neighbours' slopes."""
    half, square = 0.5 * step[:, None, None] * np.eye(3), MAGNUS_SECOND * (step**2)[:, None, None]
    weight = np.zeros((len(step) + 1, 3, 3))
    weight[:-1] += gain @ (half - square * skew(second))
    weight[1:] += gain @ (half + square * skew(first))
    by_slope = np.zeros_like(weight)
    by_slope[:-1] += gain * square
    by_slope[1:] -= gain * square
    weight += slopes[1][:, None, None] * by_slope
    weight[:-1] += slopes[0][1:, None, None] * by_slope[1:]
    weight[1:] += slopes[2][:-1, None, None] * by_slope[:-1]
    return weight


def _quaternion(vectors):
    """Return unit quaternions of rotation vectors, rows w, x, y, z, shape (4, n)."""
    angle = np.linalg.norm(vectors, axis=1)
    return np.vstack([np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * vectors.T])


def _multiply(left, right):
    (a, b, c, d), (w, x, y, z) = left, right
    return np.stack([a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x,
                     a * z + b * y - c * x + d * w])


def _prefix_product(quaternions):
    """Return q_0, q_0 q_1, q_0 q_1 q_2, ...: doubling the reach in every pass."""
    product, reach = quaternions.copy(), 1
    while reach < product.shape[1]:
        product[:, reach:] = _multiply(product[:, :-reach], product[:, reach:])
        reach *= 2
    return product / np.linalg.norm(product, axis=0)


def _matrix_to_sensor(quaternions):
    """Return the matrices that transform coordinates from the first sensor frame to the turned one (the transposed attitude)."""
    cross = skew(quaternions[1:].T)
    return np.eye(3) - 2 * quaternions[0, :, None, None] * cross + 2 * cross @ cross


def _right_jacobian(vectors):
    """Return J with ``exp(v + d) = exp(v) exp(J d)`` to first order, shape (n, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=1)
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    one = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    two = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = skew(vectors)
    return np.eye(3) - one[:, None, None] * cross + two[:, None, None] * (cross @ cross)
