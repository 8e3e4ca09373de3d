"""Column groups: functions of the reference motion that effects multiply with their coefficients."""

import numpy as np

from imu_calibration.reference.reference_motion import lever_matrix

SQUARES = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
CUBES = ((0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 0, 1), (0, 0, 2), (1, 1, 0), (1, 1, 2), (2, 2, 0), (2, 2, 1), (0, 1, 2))


def _squares(vector):
    return np.stack([vector[:, j] * vector[:, k] for j, k in SQUARES], axis=1)


def _cubes(vector):
    return np.stack([vector[:, i] * vector[:, j] * vector[:, k] for i, j, k in CUBES], axis=1)


def _signed(vector):
    """Return sign(v_i) v_j, column 3 i + j: |u.v| for an input axis u close to axis i is sign(v_i) (u.v)."""
    return (np.sign(vector)[:, :, None] * vector[:, None, :]).reshape(len(vector), 9)


def _temperature(ref, point):
    return (ref.temperature_c - point.get('temperature_ref_c', 25.0))[:, None]


def _warm_up(sensor):
    def columns(ref, point):
        constant = point[sensor + '_bias_drift'][3]
        decay = np.exp(-ref.time / constant)
        return np.stack([1 - decay, -decay * ref.time / constant**2], axis=1)
    return columns


GROUPS = {
    'one': lambda ref, point: np.ones((len(ref), 1)),
    'force': lambda ref, point: ref.force_s,
    'force_squares': lambda ref, point: _squares(ref.force_s),
    'force_cubes': lambda ref, point: _cubes(ref.force_s),
    'force_signed': lambda ref, point: _signed(ref.force_s),
    'force_temperature': lambda ref, point: ref.force_s * _temperature(ref, point),
    'lever': lambda ref, point: lever_matrix(ref.rate_s, ref.alpha_s).reshape(len(ref), 9),
    'rate': lambda ref, point: ref.rate_s,
    'rate_squares': lambda ref, point: _squares(ref.rate_s),
    'rate_signed': lambda ref, point: _signed(ref.rate_s),
    'rate_temperature': lambda ref, point: ref.rate_s * _temperature(ref, point),
    'temperature': _temperature,
    'attitude': lambda ref, point: ref.mat_sn.reshape(len(ref), 9),
    'accel_warm_up': _warm_up('accel'),
    'gyro_warm_up': _warm_up('gyro'),
}
WIDTH = {'one': 1, 'force': 3, 'force_squares': 6, 'force_cubes': 10, 'force_signed': 9, 'force_temperature': 3, 'lever': 9, 'rate': 3,
         'rate_squares': 6, 'rate_signed': 9, 'rate_temperature': 3, 'temperature': 1, 'attitude': 9, 'accel_warm_up': 2, 'gyro_warm_up': 2}


def square_coefficients(axes):
    """Return the coefficients of `_squares` that give (u_i . v)^2 for each row u_i of `axes`, shape (6, 3)."""
    return np.stack([axes[:, j] * axes[:, k] * (1.0 if j == k else 2.0) for j, k in SQUARES])


def cube_coefficients(axes):
    """Return the coefficients of `_cubes` that give (u_i . v)^3 for each row u_i of `axes`, shape (10, 3)."""
    count = [1 if i == j == k else 6 if len({i, j, k}) == 3 else 3 for i, j, k in CUBES]
    return np.stack([axes[:, i] * axes[:, j] * axes[:, k] * m for (i, j, k), m in zip(CUBES, count)])


def signed_coefficients(axes):
    """Return the coefficients of `_signed` that give |u_i . v| for each row u_i of `axes`, shape (9, 3)."""
    block = np.zeros((3, 3, 3), axes.dtype)
    block[np.arange(3), :, np.arange(3)] = axes
    return block.reshape(9, 3)
