"""The column groups of the catalogue, and the coefficients with which their powers make functions along an input axis."""

import numpy as np

from imu_calibration.effects.base import AXES, SENSORS, SHORT
from imu_calibration.effects.column_group import ColumnGroup

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
TRIPLES = ((0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 0, 1), (0, 0, 2), (1, 1, 0), (1, 1, 2), (2, 2, 0), (2, 2, 1), (0, 1, 2))
WARMTH = 'temperature_c - temperature_ref_c'
INPUT = {'accelerometer': 'force', 'gyroscope': 'rate'}
_VECTOR = {'accelerometer': [f'f_{a}' for a in AXES], 'gyroscope': [f'w_{a}' for a in AXES]}


def _of_input(ending, texts):
    """Return {sensor: ColumnGroup} made of the components of its true input."""
    return {sensor: ColumnGroup(INPUT[sensor] + ending, tuple(texts(_VECTOR[sensor]))) for sensor in SENSORS}


ONE = ColumnGroup('one', ('1',))
TRUE_INPUT = _of_input('', lambda v: v)
SQUARES = _of_input('_squares', lambda v: [f'{v[j]} * {v[k]}' for j, k in PAIRS])
CUBES = _of_input('_cubes', lambda v: [f'{v[i]} * {v[j]} * {v[k]}' for i, j, k in TRIPLES])
SIGNED = _of_input('_signed', lambda v: [f'sign({vi}) * {vj}' for vi in v for vj in v])
"""Column 3 i + j: |u.v| for an input axis u close to axis i is sign(v_i) (u.v)."""
THERMAL = _of_input('_temperature', lambda v: [f'{vi} * ({WARMTH})' for vi in v])
TEMPERATURE = ColumnGroup('temperature', (WARMTH,))
TEMPERATURE_SQUARED = ColumnGroup('temperature_squared', (f'({WARMTH}) ** 2',))
VIBRATION = ColumnGroup('vibration', tuple(f'vibration_{a}' for a in AXES))
BRANCH = ColumnGroup('thermal_branch', ('thermal_branch',))
LEVER = ColumnGroup('lever', (
    '-(w_y * w_y + w_z * w_z)', 'w_x * w_y - alpha_z', 'w_x * w_z + alpha_y',
    'w_x * w_y + alpha_z', '-(w_x * w_x + w_z * w_z)', 'w_y * w_z - alpha_x',
    'w_x * w_z - alpha_y', 'w_y * w_z + alpha_x', '-(w_x * w_x + w_y * w_y)'))
"""Entries of ``[alpha x] + [omega x]^2`` by rows (Zhang 2017, eq. 11)."""
ATTITUDE = ColumnGroup('attitude', tuple(f'c_{a}{b}' for a in AXES for b in AXES))
LOAD = {'accelerometer': ColumnGroup('load_turns_force', tuple(f'f_{AXES[j]} * f_{AXES[k]}' for j, k in PAIRS)),
        'gyroscope': ColumnGroup('load_turns_rate', tuple(f'f_{a} * w_{b}' for a in AXES for b in AXES))}
"""Columns of a mount that bends with load: force and rate are measured in a frame that rotates with the force."""
CHANGE = {'accelerometer': ColumnGroup('force_change', ('f_y * w_z - f_z * w_y', 'f_z * w_x - f_x * w_z', 'f_x * w_y - f_y * w_x')),
          'gyroscope': ColumnGroup('rate_change', tuple(f'alpha_{a}' for a in AXES))}
"""The true input's derivative in time, of the force as gravity gives it to a sensor that turns."""
WARM_UP = {sensor: ColumnGroup(f'{short}_warm_up', ('-expm1(-time / tau)',), f'{short}_bias_drift') for sensor, short in SHORT.items()}


def square_coefficients(axes: np.ndarray) -> np.ndarray:
    """Return the coefficients of `SQUARES` that give (u_i . v)^2 for each row u_i of `axes`, shape (6, 3)."""
    return np.stack([axes[:, j] * axes[:, k] * (1.0 if j == k else 2.0) for j, k in PAIRS])


def cube_coefficients(axes: np.ndarray) -> np.ndarray:
    """Return the coefficients of `CUBES` that give (u_i . v)^3 for each row u_i of `axes`, shape (10, 3)."""
    count = [1 if i == j == k else 6 if len({i, j, k}) == 3 else 3 for i, j, k in TRIPLES]
    return np.stack([axes[:, i] * axes[:, j] * axes[:, k] * m for (i, j, k), m in zip(TRIPLES, count)])


def signed_coefficients(axes: np.ndarray) -> np.ndarray:
    """Return the coefficients of `SIGNED` that give |u_i . v| for each row u_i of `axes`, shape (9, 3)."""
    block = np.zeros((3, 3, 3), axes.dtype)
    block[np.arange(3), :, np.arange(3)] = axes
    return block.reshape(9, 3)
