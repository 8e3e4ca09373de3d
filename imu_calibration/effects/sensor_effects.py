"""Effects of the sensors themselves; accelerometer and gyroscope share the mechanisms, so each is declared for both at once."""

import numpy as np

from imu_calibration.constants import DEG, MILLI_G, STANDARD_GRAVITY
from imu_calibration.effects.base import MATRIX, PRODUCTS, VECTOR, Effect
from imu_calibration.effects.regressors import cube_coefficients, signed_coefficients, square_coefficients

INPUT = {'accelerometer': 'force', 'gyroscope': 'rate'}
UNIT = {'accelerometer': 'm/s^2', 'gyroscope': 'rad/s'}


def input_axes(values):
    """Return the unit vectors along which the three sensing elements sense: rows of the matrix, normalised."""
    matrix = values['matrix'].reshape(3, 3)
    return matrix / np.sqrt((matrix**2).sum(axis=1))[:, None]


def _bias(values, point):
    return {'one': values['bias'][None, :]}


def _matrix(group):
    return lambda values, point: {group: values['matrix'].reshape(3, 3).T}


def _arms(values, arms):
    """Coefficients of W_jk for output i: m_ij r_ik (Zhang 2017, eq. 11-17 with the true inverse)."""
    matrix = values['matrix'].reshape(3, 3)
    return {'lever': (matrix[:, :, None] * arms[:, None, :]).reshape(3, 9).T}


def _size_effect(values, point):
    return _arms(values, values['accel_size_effect'].reshape(3, 3))


def _lever_arm(values, point):
    return _arms(values, np.broadcast_to(values['lever_arm'], (3, 3)))


def _products(name, group):
    def coefficients(values, point):
        block = values[name].reshape(3, 3).T
        return {group: np.concatenate([np.zeros((3, 3), block.dtype), block])}
    return coefficients


def _along_axis(name, group, shape):
    """Coefficients of a function of the input along each element's own axis, times one value per element."""
    return lambda values, point: {group: shape(input_axes(values)) * values[name][None, :]}


def _linear(name, group):
    """Coefficients of a vector group with a full 3 x 3 value."""
    return lambda values, point: {group: values[name].reshape(3, 3).T}


def _thermal_bias(name):
    return lambda values, point: {'temperature': values[name][None, :]}


def _thermal_scale(name, group):
    def coefficients(values, point):
        return {group: (values['matrix'].reshape(3, 3) * values[name][:, None]).T}
    return coefficients


def _drift(name, group):
    def coefficients(values, point):
        amplitude, constant = values[name][:3], values[name][3]
        return {group: np.stack([amplitude, amplitude * (constant - point[name][3])])}
    return coefficients


def _pair(sensor):
    """Return the effects that both sensors have, for one of them."""
    short, group, unit = {'accelerometer': 'accel', 'gyroscope': 'gyro'}[sensor], INPUT[sensor], UNIT[sensor]
    accel = sensor == 'accelerometer'
    what = 'accelerometer' if accel else 'gyroscope'
    small = MILLI_G if accel else 0.01 * DEG
    full = STANDARD_GRAVITY if accel else 100 * DEG
    poses, fast = ('static_dense', 'centrifuge') if accel else ('three_speeds', 'three_speeds')
    return (
        Effect('bias', sensor, VECTOR, (3,), unit, small, 2.0 if accel else 0.2, f'The {what} has an offset.', ('static_poses',), 'exact',
               groups=('one',), coefficients=_bias, plausible=(('consumer', 1.0 if accel else 0.1, 'field catalogue 6.1, 6.2'),)),
        Effect('matrix', sensor, MATRIX, (3, 3), '1', 1e-3, 0.1, f'The {what} scale factors and axis directions differ from nominal.',
               ('static_poses',) if accel else ('spin_x', 'spin_y', 'spin_z'), 'exact', groups=(group,), coefficients=_matrix(group)),
        Effect(f'{short}_quadratic', sensor, VECTOR, (3,), f'({unit})^-1', small / full**2, 100 * small / full**2,
               f'The {what} output bends with the square of its input (K2), so that equal inputs of opposite sign do not give opposite readings.',
               (poses, fast), 'exact', groups=(group + '_squares',),
               coefficients=_along_axis(f'{short}_quadratic', group + '_squares', square_coefficients),
               plausible=(('consumer', 4e-4 / STANDARD_GRAVITY if accel else 0.5 * DEG / (100 * DEG)**2, 'ADIS16460 data sheet: 0.1 % / 0.5 % of range'),)),
        Effect(f'{short}_scale_asymmetry', sensor, VECTOR, (3,), '1', 1e-3 if not accel else 1e-3, 0.05,
               f'The {what} scale factor differs between positive and negative input.', (poses, fast), 'exact', groups=(group + '_signed',),
               coefficients=_along_axis(f'{short}_scale_asymmetry', group + '_signed', signed_coefficients),
               plausible=(('consumer', 2e-3, 'field catalogue 6.1: 100-200 ppm typical'),)),
        Effect(f'{short}_thermal_bias', sensor, VECTOR, (3,), f'{unit}/K', 0.1 * small, 10 * small, f'The {what} bias follows the temperature.',
               ('warm_up',), 'exact', groups=('temperature',), coefficients=_thermal_bias(f'{short}_thermal_bias'), needs=('temperature',),
               plausible=(('consumer', 2 * MILLI_G if accel else 0.05 * DEG, 'ADXL358, ADIS16460 data sheets, ten times typical'),)),
        Effect(f'{short}_thermal_scale', sensor, VECTOR, (3,), '1/K', 1e-4, 0.01, f'The {what} scale factor follows the temperature.', ('warm_up',),
               'exact', groups=(group + '_temperature',), coefficients=_thermal_scale(f'{short}_thermal_scale', group + '_temperature'),
               needs=('temperature',) if accel else ('temperature', 'rotation'), plausible=(('consumer', 1e-3, 'ADXL358, ADIS16460 data sheets'),)),
        Effect(f'{short}_bias_drift', sensor, VECTOR + ('time_constant',), (4,), (unit, unit, unit, 's'), small, 50 * small,
               f'The {what} bias settles after turn-on like 1 - exp(-t / time constant), with no temperature to explain it.', ('warm_up',), 'none',
               groups=(f'{short}_warm_up',), coefficients=_drift(f'{short}_bias_drift', f'{short}_warm_up'),
               plausible=(('consumer', 20 * MILLI_G if accel else 1 * DEG, 'field catalogue 6.1: warm-up of up to some mg over 1-15 min'),)),
        Effect(f'{short}_saturation', sensor, ('level',), (), unit, 0.01 * full, 100 * full,
               f'The {what} output is clipped: it cannot follow inputs beyond its range.', ('fast_spin',), 'flagged', prior=np.inf),
    )


ACCELEROMETER = _pair('accelerometer') + (
    Effect('accel_cubic', 'accelerometer', VECTOR, (3,), '(m/s^2)^-2', MILLI_G / STANDARD_GRAVITY**3, 100 * MILLI_G / STANDARD_GRAVITY**3,
           'The accelerometer output bends with the cube of its input (K3), so that its scale factor changes with the input.',
           ('centrifuge',), 'exact', groups=('force_cubes',), coefficients=_along_axis('accel_cubic', 'force_cubes', cube_coefficients),
           plausible=(('consumer', 1e-4 / STANDARD_GRAVITY**2, 'field catalogue 6.1: some 10 ug/g^3'),)),
    Effect('accel_cross_product', 'accelerometer', PRODUCTS, (3, 3), '(m/s^2)^-1', MILLI_G / STANDARD_GRAVITY**2, 100 * MILLI_G / STANDARD_GRAVITY**2,
           'The accelerometers are pendulums that give way: products of specific-force components enter the output (Avrutov 2017, eq. 4).',
           ('static_dense',), 'exact', groups=('force_squares',), coefficients=_products('accel_cross_product', 'force_squares'),
           plausible=(('consumer', 1e-3 / STANDARD_GRAVITY, 'Avrutov 2017, sample 2: 1 mV/g^2'),)),
    Effect('accel_size_effect', 'accelerometer', MATRIX, (3, 3), 'm', 1e-3, 0.03,
           'The three accelerometers sit at different points: each has a lever arm of its own (Zhang 2017, eq. 11-17).',
           ('oscillate_x', 'oscillate_y', 'oscillate_z'), 'exact', groups=('lever',), coefficients=_size_effect, needs=('rotation',),
           plausible=(('consumer', 0.03, 'field catalogue 6.1: 1-30 mm'),)),
    Effect('lever_arm', 'accelerometer', VECTOR, (3,), 'm', 1e-3, 0.5, 'The whole accelerometer triad sits beside the point where it was thought to be: one common lever arm.',
           ('oscillate_x', 'oscillate_y', 'oscillate_z'), 'none', groups=('lever',), coefficients=_lever_arm, needs=('rotation',),
           plausible=(('consumer', 1.0, 'field catalogue 6.1: cm to dm'),)),
)

GYROSCOPE = _pair('gyroscope') + (
    Effect('gyro_g_sensitivity', 'gyroscope', MATRIX, (3, 3), '(rad/s)/(m/s^2)', 0.01 * DEG / STANDARD_GRAVITY, 1.0 * DEG / STANDARD_GRAVITY,
           'The gyroscopes respond to specific force: their bias changes with attitude (g-sensitivity).', ('static_poses',), 'exact',
           groups=('force',), coefficients=_linear('gyro_g_sensitivity', 'force'),
           plausible=(('consumer', 0.1 * DEG / STANDARD_GRAVITY, 'ADIS16460 data sheet: 0.01 deg/s/g'),)),
    Effect('gyro_rate_product', 'gyroscope', PRODUCTS, (3, 3), '(rad/s)^-1', 1e-3, 0.3,
           'Products of rate components enter the gyroscope output (Avrutov 2017, eq. 10).', ('two_axis',), 'exact',
           groups=('rate_squares',), coefficients=_products('gyro_rate_product', 'rate_squares'), needs=('rotation',),
           plausible=(('consumer', 0.06, 'Avrutov 2017, sample 4: 1e-3 V/(deg/s)^2 at 0.1 V/(deg/s) is 0.6'),)),
)
