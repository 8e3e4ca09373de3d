"""
Effects of the sensors themselves.

Accelerometer and gyroscope share the mechanisms, so each is declared for both at once.
"""

from functools import partial
from itertools import product

import numpy as np

from imu_calibration.core.units import DEG, MILLI_G, STANDARD_GRAVITY
from imu_calibration.effects import base
from imu_calibration.effects.base import (
    AXES,
    MATRIX,
    OTHERS,
    PREFIXES,
    PRODUCTS,
    UNITS,
    VECTOR,
    Effect,
    Role,
    along_axis_coefficients,
    amplitude_coefficients,
    cross_axis_coefficients,
    lever_coefficients,
    matrix_coefficients,
    product_coefficients,
)
from imu_calibration.kinematics.table import Table

VIBRATION_VARIANCE = 0.05
"""Variance of a distinct vibration, (m/s^2)^2."""


def _one_axis(table: Table) -> tuple[str, str] | None:
    """
    Return (why lags between axes cannot be tested, remedy) for a table with one turning axis.

    They are visible only in motions about several axes at once.
    """
    if len(table.joint_names.turning) > 1:
        return None
    return (
        'the table turns about one axis only',
        'record on a table that turns about two axes at once',
    )


def _common_effects(sensor: str) -> tuple[Effect, ...]:
    """Return the effects that both sensors have, for one of them."""
    accel = sensor == 'accelerometer'
    short = PREFIXES[sensor]
    kind = base.INPUT[sensor]
    unit = UNITS[sensor]
    # Tolerance of the readings, and the input at which it applies to a term that grows with it.
    small = MILLI_G if accel else 0.01 * DEG
    full = STANDARD_GRAVITY if accel else 100 * DEG
    # Motions that show a curved response.
    curved = ('static_dense', 'centrifuge') if accel else ('three_speeds',)

    return (
        Effect(
            name='bias',
            sensor=sensor,
            role=Role.OFFSET,
            unit=unit,
            explanation=f'The {sensor} has an offset.',
            tolerance=small,
            tolerance_reason=(
                '1 mg, which tilts a levelled attitude by 1 mrad'
                if accel
                else '0.01 deg/s, 0.6 deg of heading a minute'
            ),
            prior_sd=2.0 if accel else 0.2,
            plausible=('consumer', 1.0 if accel else 0.1, 'field catalogue 6.1, 6.2'),
            motion=('static_poses',),
            groups=(base.CONSTANT,),
            coefficients=amplitude_coefficients,
        ),
        Effect(
            name='matrix',
            sensor=sensor,
            role=Role.LINEAR,
            components=MATRIX,
            shape=(3, 3),
            unit='1',
            title='matrix (scale factors and axis directions)',
            explanation=f'The {sensor} scale factors and axis directions differ from nominal.',
            tolerance=1e-3,
            tolerance_reason=(
                '1 mg at 1 g, as much as the bias; 1 mrad of installation angle'
                if accel
                else '0.36 deg in one full turn'
            ),
            prior=tuple(np.eye(3).ravel()),
            prior_sd=0.1,
            motion=('static_poses',) if accel else ('spin_x', 'spin_y', 'spin_z'),
            groups=(base.TRUE_INPUT[sensor],),
            input_order=1,
            coefficients=matrix_coefficients,
        ),
        Effect(
            name=f'{short}_quadratic',
            sensor=sensor,
            unit=f'({unit})^-1',
            against=(kind,),
            explanation=(
                f'The {sensor} output bends with the square of its input (K2), '
                'so that equal inputs of opposite sign do not give opposite readings.'
            ),
            tolerance=small / full**2,
            tolerance_reason='1 mg at 1 g' if accel else '0.01 deg/s at 100 deg/s',
            prior_sd=100 * small / full**2,
            plausible=(
                'consumer',
                4e-4 / STANDARD_GRAVITY if accel else 0.5 * DEG / (100 * DEG) ** 2,
                'ADIS16460 data sheet: 0.1 % / 0.5 % of range',
            ),
            motion=curved,
            groups=(base.SQUARES[sensor],),
            input_order=0,
            coefficients=partial(
                along_axis_coefficients,
                function=partial(base.power_coefficients, products=base.PRODUCT_PAIRS),
            ),
        ),
        Effect(
            name=f'{short}_scale_asymmetry',
            sensor=sensor,
            unit='1',
            against=(kind,),
            explanation=f'The {sensor} scale factor differs between positive and negative input.',
            tolerance=1e-3,
            tolerance_reason='1 mg between +1 g and -1 g' if accel else 'as the matrix',
            prior_sd=0.05,
            plausible=('consumer', 2e-3, 'field catalogue 6.1: 100-200 ppm typical'),
            motion=curved,
            groups=(base.SIGNED[sensor],),
            input_order=0,
            coefficients=partial(along_axis_coefficients, function=base.signed_coefficients),
        ),
        Effect(
            name=f'{short}_thermal_bias',
            sensor=sensor,
            unit=f'{unit}/K',
            against=('temperature',),
            smooth=True,
            explanation=f'The {sensor} bias follows the temperature.',
            tolerance=0.1 * small,
            tolerance_reason='1 mg over 10 K' if accel else '0.01 deg/s over 10 K',
            prior_sd=10 * small,
            plausible=(
                'consumer',
                2 * MILLI_G if accel else 0.05 * DEG,
                'ADXL358, ADIS16460 data sheets, ten times typical',
            ),
            motion=('warm_up',),
            needs=('temperature',),
            groups=(base.TEMPERATURE,),
            coefficients=amplitude_coefficients,
        ),
        Effect(
            name=f'{short}_thermal_bias_2',
            sensor=sensor,
            unit=f'{unit}/K^2',
            against=('temperature',),
            smooth=True,
            title=f'{short} thermal bias, second order',
            explanation=f'The {sensor} bias bends with the temperature: it follows its square too.',
            tolerance=0.01 * small,
            tolerance_reason='1 mg over 10 K' if accel else '0.01 deg/s over 10 K',
            prior_sd=small,
            plausible=(
                'consumer',
                0.1 * MILLI_G if accel else 2.5e-3 * DEG,
                'as much as the first order over 20 K',
            ),
            motion=('warm_up',),
            needs=('temperature',),
            lower_order=f'{short}_thermal_bias',
            groups=(base.TEMPERATURE_SQUARED,),
            coefficients=amplitude_coefficients,
        ),
        Effect(
            name=f'{short}_thermal_hysteresis',
            sensor=sensor,
            unit=unit,
            against=('temperature',),
            smooth=True,
            explanation=(
                f'The {sensor} bias depends on the thermal branch: the branches of cooling and'
                ' warming differ by twice this.'
            ),
            tolerance=small,
            tolerance_reason='as the bias',
            prior_sd=20 * small,
            plausible=(
                'consumer',
                5 * MILLI_G if accel else 0.1 * DEG,
                'as much as the thermal bias over some kelvins',
            ),
            motion=('warm_and_cool',),
            needs=('temperature', 'cooling'),
            groups=(base.BRANCH,),
            coefficients=amplitude_coefficients,
        ),
        Effect(
            name=f'{short}_vibration_rectification',
            sensor=sensor,
            components=VECTOR if accel else MATRIX,
            shape=(3,) if accel else (3, 3),
            unit=f'{unit}/(m/s^2)^2',
            against=('time',),
            explanation=(
                f'The {sensor} bias shifts with vibration: even terms of its response rectify it, '
            )
            + ('along the axis of each' if accel else 'of each direction')
            + ', by this for each variance that is left in the band.',
            tolerance=small / VIBRATION_VARIANCE,
            prior_sd=100 * small / VIBRATION_VARIANCE,
            tolerance_reason=(
                f'as the bias, at a vibration of {np.sqrt(VIBRATION_VARIANCE):.2g} m/s^2 rms'
            ),
            plausible=(
                'consumer',
                2.0 if accel else 0.1,
                ('2 mg/g^2 (ADXL358 data sheet)' if accel else '0.05 deg/s/g^2')
                + ', where a hundredth of the amplitude is left in the band',
            ),
            motion=('shake',),
            needs=('vibration',),
            groups=(base.VIBRATION,),
            input_order=0,
            coefficients=partial(amplitude_coefficients, own_axis=accel),
        ),
        Effect(
            name=f'{short}_thermal_scale',
            sensor=sensor,
            unit='1/K',
            against=('temperature',),
            explanation=f'The {sensor} scale factor follows the temperature.',
            tolerance=1e-4,
            tolerance_reason='1e-3 over 10 K',
            prior_sd=0.01,
            plausible=('consumer', 1e-3, 'ADXL358, ADIS16460 data sheets'),
            motion=('warm_up',),
            needs=('temperature',) if accel else ('temperature', 'rotation'),
            groups=(base.THERMAL[sensor],),
            input_order=0,
            coefficients=matrix_coefficients,
        ),
        Effect(
            name=f'{short}_cross_axis_lag',
            sensor=sensor,
            components=OTHERS,
            shape=(3, 2),
            unit='s',
            against=('rate',),
            explanation=(
                f'Each {sensor} axis has crosstalk of the remaining axes with a different lag: '
                'its output contains their rate of change.'
            ),
            tolerance=1e-5,
            tolerance_reason='1 mrad of cross coupling through a lag of 10 ms',
            prior_sd=1e-3,
            plausible=('consumer', 5e-4, '10 mrad of cross coupling through a lag of 50 ms'),
            motion=('oscillate_fast', 'two_axis'),
            needs=('rotation',),
            moot=_one_axis,
            groups=(base.CHANGE_COLUMNS[sensor],),
            input_order=1,
            input_places=base.OTHER_AXES,
            coefficients=cross_axis_coefficients,
        ),
        Effect(
            name=f'{short}_bias_drift',
            sensor=sensor,
            components=VECTOR + ('time_constant',),
            shape=(4,),
            unit=(unit, unit, unit, 's'),
            time_constant=True,
            smooth=True,
            against=('time',),
            explanation=(
                f'The {sensor} bias settles after turn-on like 1 - exp(-t / time constant), with no'
                ' temperature to explain it.'
            ),
            tolerance=small,
            tolerance_reason='as the bias',
            prior=(0.0, 0.0, 0.0, 300.0),
            prior_sd=(50 * small, 50 * small, 50 * small, 1000.0),
            plausible=(
                'consumer',
                20 * MILLI_G if accel else 1 * DEG,
                'field catalogue 6.1: warm-up of up to some mg over 1-15 min',
            ),
            motion=('warm_up',),
            compensation='none',
            groups=(base.WARM_UP[sensor],),
            coefficients=amplitude_coefficients,
        ),
        Effect(
            name=f'{short}_bias_trend',
            sensor=sensor,
            unit=f'{unit}/s',
            smooth=True,
            against=('time',),
            explanation=f'The {sensor} bias changes linearly with time.',
            tolerance=small / 600,
            tolerance_reason='as the bias, over 10 min',
            prior_sd=50 * small / 600,
            plausible=(
                'consumer',
                (20 * MILLI_G if accel else 1 * DEG) / 60,
                'as the drift after turn-on, within 1 min',
            ),
            motion=('warm_up',),
            compensation='none',
            groups=(base.TIME,),
            coefficients=amplitude_coefficients,
        ),
        Effect(
            name=f'{short}_saturation',
            sensor=sensor,
            role=Role.LIMIT,
            components=('level',),
            shape=(),
            unit=unit,
            explanation=(
                f'The {sensor} output is clipped: it cannot follow inputs beyond its range.'
            ),
            tolerance=0.01 * full,
            tolerance_reason='10 mg of the range' if accel else '1 deg/s of the range',
            prior=np.inf,
            prior_sd=100 * full,
            nonnegative=True,
            motion=('fast_spin',),
            compensation='flagged',
        ),
    )


ACCELEROMETER = _common_effects('accelerometer') + (
    Effect(
        name='accel_cubic',
        sensor='accelerometer',
        unit='(m/s^2)^-2',
        against=('force',),
        explanation=(
            'The accelerometer output bends with the cube of its input (K3), so that its scale'
            ' factor changes with the input.'
        ),
        tolerance=MILLI_G / STANDARD_GRAVITY**3,
        tolerance_reason='1 mg at 1 g',
        prior_sd=100 * MILLI_G / STANDARD_GRAVITY**3,
        plausible=('consumer', 1e-4 / STANDARD_GRAVITY**2, 'field catalogue 6.1: some 10 ug/g^3'),
        motion=('centrifuge',),
        groups=(base.CUBES['accelerometer'],),
        input_order=0,
        coefficients=partial(
            along_axis_coefficients,
            function=partial(base.power_coefficients, products=base.TRIPLES),
        ),
    ),
    Effect(
        name='accel_cross_product',
        sensor='accelerometer',
        components=PRODUCTS,
        shape=(3, 3),
        unit='(m/s^2)^-1',
        against=('force',),
        explanation=(
            'The accelerometers are pendulums that give way: '
            'products of specific-force components enter the output (Avrutov 2017, eq. 4).'
        ),
        tolerance=MILLI_G / STANDARD_GRAVITY**2,
        tolerance_reason='1 mg for 1 g on two axes',
        prior_sd=100 * MILLI_G / STANDARD_GRAVITY**2,
        plausible=('consumer', 1e-3 / STANDARD_GRAVITY, 'Avrutov 2017, sample 2: 1 mV/g^2'),
        motion=('static_dense',),
        groups=(base.SQUARES['accelerometer'],),
        input_order=2,
        input_places=base.MIXED_PRODUCTS,
        coefficients=product_coefficients,
    ),
    Effect(
        name='accel_size_effect',
        sensor='accelerometer',
        role=Role.ARMS,
        components=MATRIX,
        shape=(3, 3),
        unit='m',
        title='size effect: origin to the sensitive point of each axis',
        explanation=(
            'The three accelerometers sit at different points: each has a lever arm of its own'
            ' (Zhang 2017, eq. 11-17).'
        ),
        tolerance=1e-3,
        tolerance_reason='1 mm, 0.1 m/s^2 at 10 rad/s',
        prior_sd=0.03,
        plausible=('consumer', 0.03, 'field catalogue 6.1: 1-30 mm'),
        motion=('oscillate_x', 'oscillate_y', 'oscillate_z'),
        needs=('rotation',),
        groups=(base.LEVER,),
        coefficients=lever_coefficients,
    ),
    Effect(
        name='lever_arm',
        sensor='accelerometer',
        role=Role.ARM,
        unit='m',
        title='lever arm of the triad (nuisance parameter)',
        in_reference=True,
        nuisance=True,
        contained_in='accel_size_effect',
        explanation=(
            'The whole accelerometer triad is displaced from its assumed point: one common lever'
            ' arm.'
        ),
        tolerance=1e-3,
        tolerance_reason='the same arm, for the whole triad',
        prior_sd=0.5,
        plausible=('consumer', 1.0, 'field catalogue 6.1: cm to dm'),
        motion=('oscillate_x', 'oscillate_y', 'oscillate_z'),
        compensation='none',
        needs=('rotation',),
        groups=(base.LEVER,),
        coefficients=lever_coefficients,
    ),
)

GYROSCOPE = _common_effects('gyroscope') + (
    Effect(
        name='gyro_g_sensitivity',
        sensor='gyroscope',
        role=Role.CROSS,
        components=MATRIX,
        shape=(3, 3),
        unit='(rad/s)/(m/s^2)',
        against=('force',),
        explanation=(
            'The gyroscopes respond to specific force: their bias changes with attitude'
            ' (g-sensitivity).'
        ),
        tolerance=0.01 * DEG / STANDARD_GRAVITY,
        tolerance_reason='0.01 deg/s at 1 g',
        prior_sd=1.0 * DEG / STANDARD_GRAVITY,
        plausible=('consumer', 0.1 * DEG / STANDARD_GRAVITY, 'ADIS16460 data sheet: 0.01 deg/s/g'),
        motion=('static_poses',),
        groups=(base.TRUE_INPUT['accelerometer'],),
        input_order=1,
        coefficients=amplitude_coefficients,
    ),
    Effect(
        name='gyro_force_squared',
        sensor='gyroscope',
        components=tuple(
            f'{a}_{pair}' for a, pair in product(AXES, ('xx', 'yy', 'zz', 'xy', 'yz', 'xz'))
        ),
        shape=(3, 6),
        unit='(rad/s)/(m/s^2)^2',
        against=('force',),
        title='response to the square of specific force',
        explanation=(
            'The gyroscopes respond to squares and products of specific force: '
            'their elements yield more along one axis than along another.'
        ),
        tolerance=0.01 * DEG / STANDARD_GRAVITY**2,
        tolerance_reason='0.01 deg/s at 1 g',
        prior_sd=0.2 * DEG / STANDARD_GRAVITY**2,
        plausible=(
            'consumer',
            0.05 * DEG / STANDARD_GRAVITY**2,
            'half of the g-sensitivity at 1 g',
        ),
        zero_sums=((0, 1, 2), (6, 7, 8), (12, 13, 14)),
        motion=('static_dense', 'centrifuge'),
        groups=(base.SQUARES['accelerometer'],),
        input_order=2,
        coefficients=amplitude_coefficients,
    ),
    Effect(
        name='gyro_rate_product',
        sensor='gyroscope',
        components=PRODUCTS,
        shape=(3, 3),
        unit='(rad/s)^-1',
        against=('rate',),
        explanation=(
            'Products of rate components enter the gyroscope output (Avrutov 2017, eq. 10).'
        ),
        tolerance=1e-3,
        tolerance_reason='as the matrix at 1 rad/s',
        prior_sd=0.3,
        plausible=(
            'consumer',
            0.06,
            'Avrutov 2017, sample 4: 1e-3 V/(deg/s)^2 at 0.1 V/(deg/s) is 0.6',
        ),
        motion=('two_axis',),
        needs=('rotation',),
        groups=(base.SQUARES['gyroscope'],),
        input_order=2,
        input_places=base.MIXED_PRODUCTS,
        coefficients=product_coefficients,
    ),
)
