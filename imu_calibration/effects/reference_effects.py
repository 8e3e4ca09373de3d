"""Effects of the reference: table, encoders, clock, and the lags of the sensors."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import permutations, product
from typing import Any

import numpy as np

from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.effects.base import (
    ATTITUDE,
    LOAD,
    MATRIX,
    PREFIXES,
    PRODUCT_PAIRS,
    SENSORS,
    Effect,
    Lag,
    Role,
    Values,
)
from imu_calibration.kinematics.chain import (
    WOBBLES,
    tilt,
    with_axis_angles,
    with_axis_places,
    with_sag,
    with_wobble,
)
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.joint_motion import JointMotion, with_encoder_harmonics
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.table import Table


def _late_stamps(_component: str, delay: float, sd: float) -> str:
    """Return how a delay of the IMU's stamps, s, is reported."""
    side = 'behind' if delay > 0 else 'ahead of'
    return (
        f'both streams must share one clock, the stamps of the IMU are {1e3 * abs(delay):.3g}'
        f' +- {1e3 * sd:.2g} ms {side} those of the joints; set both clocks by one source, or let'
        ' calibrate estimate the delay'
    )


def _wrong_zero(joint: str, zero: float, sd: float) -> str:
    """Return how the zero of a joint, rad, is reported."""
    return (
        f'zeros of the joints must be those of the table description, {joint} reads'
        f' {np.degrees(-zero):.3g} +- {np.degrees(sd):.2g} deg too much; correct the zero in its'
        ' driver, or let calibrate estimate it'
    )


FIRST_ORDER = tuple(zip(*reversed(np.polynomial.laguerre.laggauss(5))))
"""
(weight, delay) pairs that make an exponential lag a weighted mean of delays: int e^-x f(t - tau x)
dx.
"""


def _second_order() -> tuple[tuple[float, float], ...]:
    """
    Return (weight, delay) pairs of the maximally flat second-order filter, in units of its delay.

    ``1 / (1 + d s + d^2 s^2 / 2)`` has the impulse response ``2 e^-x sin x``, x = t / d, whose
    moments of order k over k! follow from the denominator. The weights match the first five: the
    error is 6e-5 where frequency times delay is 0.3 rad, and joints' noise is not amplified.

    With the moments m_k and delays x_j up to 3.5, ``sum_j weight_j x_j^k = m_k`` for k = 0 ... 4.
    The series of the response is ``sum_k m_k (-d s)^k / k!``; its product with the denominator is
    1, so that ``m_k = k m_(k-1) - k (k - 1) / 2 m_(k-2)``.
    """
    moments = [1.0, 1.0]
    for order in range(2, 5):
        moments.append(order * moments[-1] - 0.5 * order * (order - 1) * moments[-2])
    nodes = np.linspace(0.0, 3.5, len(moments))
    return tuple(zip(np.linalg.solve(np.vander(nodes, increasing=True).T, moments), nodes))


SECOND_ORDER = _second_order()
_LAG_FORMS = {
    'bandwidth': (
        'time_constant',
        FIRST_ORDER,
        (
            'has a first-order low-pass filter: '
            'its output has a lag and a smaller amplitude at high frequency'
        ),
    ),
    'delay': (
        'delay',
        ((1.0, 1.0),),
        'sends its output late, and the other sensor does not: a pure delay of its own',
    ),
    'filter': (
        'delay',
        SECOND_ORDER,
        (
            'has a second-order (Butterworth) low-pass filter: its output has a lag, '
            'and an unchanged amplitude up to near its edge'
        ),
    ),
}
"""
Ending of the name -> (component, (weight, delay) pairs, description). All have the same first
derivative.
"""


def _lag_effect(sensor: str, ending: str) -> Effect:
    """Return a lag of a sensor; `ending` is a key of `_LAG_FORMS`."""
    component, pairs, description = _LAG_FORMS[ending]
    return Effect(
        name=lag_name(sensor, ending),
        sensor=sensor,
        components=(component,),
        shape=(),
        unit='s',
        nonnegative=True,
        in_reference=True,
        explanation=f'The {sensor} {description}.',
        tolerance=1e-4,
        prior_sd=0.1,
        plausible=('consumer', 0.05, 'field catalogue 6.3: 5-250 Hz'),
        tolerance_reason=(
            '1 mg while the specific force changes by 100 m/s^3'
            if sensor == 'accelerometer'
            else '0.1 deg/s while the rate changes by 1000 deg/s^2'
        ),
        motion=('oscillate_fast',),
        compensation='none',
        warp=Lag(pairs),
        acts_on=(sensor,),
        needs=('joints', 'dynamic'),
        step=2e-4,
    )


def lag_name(sensor: str, ending: str) -> str:
    """Return the name of the lag of a sensor: of 'bandwidth', 'delay' or 'filter'."""
    return f'{PREFIXES[sensor]}_{ending}'


LAGS = tuple(_lag_effect(sensor, ending) for ending, sensor in product(_LAG_FORMS, SENSORS))
"""
First-order filter, pure delay and second-order filter of each sensor; collinear where small,
separable where large.
"""

CLOCK = 'time_offset'
"""Common lag of both sensors: an offset of the clocks."""
CLOCKS = frozenset({'clock_rate', 'clock_step'})
"""Lags of both sensors that change with time."""
FAMILY = frozenset({CLOCK, *(effect.name for effect in LAGS)})
"""Names of the lags, which have the same first derivative."""


def total_lags(
    names: Sequence[str], values: np.ndarray, covariance: np.ndarray
) -> dict[str, tuple[float, float]]:
    """
    Return sensor -> (total lag of its output, standard deviation), s, of sensors with a lag.

    All lags have the same first derivative: recordings agree on their sum, but not on the shares.

    Parameters
    ----------
    names : sequence of str
        Parameters, ``sensor.effect.component``.
    values, covariance : array, shape (n,) and (n, n)

    """
    total_lag = {}
    for sensor in SENSORS:
        # weights @ values is the sum of the lags of this sensor.
        weights = np.zeros(len(names))
        for index, name in enumerate(names):
            section, effect, *_ = name.split('.')
            if effect in FAMILY and section in (sensor, 'reference'):
                weights[index] = 1.0
        if weights.any():
            sd = float(np.sqrt(weights @ covariance @ weights))
            total_lag[sensor] = (float(weights @ values), sd)
    return total_lag


EVEN_AND_ODD = [(i, j, k, 1.0 if (j - i) % 3 == 1 else -1.0) for i, j, k in permutations(range(3))]
"""Axes i, j, k of a cross product with their sign."""
_PAIR = {pair: index for index, pair in enumerate(PRODUCT_PAIRS)}
"""Axes of a product of two components -> its index in `PRODUCT_PAIRS`."""
ENCODER_ORDERS = (1, 2)
"""Harmonics per revolution of the encoder error."""


@lru_cache(maxsize=512)
def _changed_table(
    change: Callable[[Table, np.ndarray], Table], table: Table, values: tuple[float, ...]
) -> Table:
    """
    Return ``change(table, values)``, cached: each window of a recording needs the same few hundred.
    """
    return change(table, np.array(values))


def _warp_of_table(
    change: Callable[[Table, np.ndarray], Table],
    table: Table,
    motion: JointMotion,
    values: np.ndarray,
) -> tuple[Table, JointMotion]:
    """Return (table, motion) after a warp that changes only the table, by `change`."""
    return _changed_table(change, table, tuple(values)), motion


def _tilt_derivative(ref: Reference) -> np.ndarray:
    """Return the derivative of ``mat_sn @ (up + theta x up) g`` by (theta_x, theta_y), (n, 6)."""
    return ref.gravity * np.concatenate([-ref.mat_sn[:, :, 1], ref.mat_sn[:, :, 0]], axis=1)


def _shift_zeros(
    table: Table, motion: JointMotion, values: np.ndarray
) -> tuple[Table, JointMotion]:
    """
    Add errors of the zeros, rad, to the joints between the first and the last.

    The first one's zero is the azimuth, the last one's belongs to the mount.
    """
    offset = np.zeros(motion.position.shape[1])
    offset[_columns(table, table.joint_names.zeros)] = values
    return table, replace(motion, position=motion.position + offset)


def _columns(table: Table, names: Sequence[str]) -> list[int]:
    """Return the columns of joints in the positions of a motion."""
    return [table.joint_names.index(name) for name in names]


def _harmonics(table: Table, motion: JointMotion, values: np.ndarray) -> tuple[Table, JointMotion]:
    """Add the periodic errors of encoders: `values` are (joint, order, cos and sin), rad."""
    amplitudes = np.zeros((motion.position.shape[1], len(ENCODER_ORDERS), 2))
    turning = _columns(table, table.joint_names.turning)
    amplitudes[turning] = np.reshape(values, (-1, len(ENCODER_ORDERS), 2))
    for index, order in enumerate(ENCODER_ORDERS):
        motion = with_encoder_harmonics(
            motion, order, amplitudes[:, index, 0], sin_amplitude=amplitudes[:, index, 1]
        )
    return table, motion


def _growing(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the factor of a delay that grows with time: a clock with another rate."""
    return time


def _after_step(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the factor of a delay that begins at the time ``values[1]``: 0, then 1."""
    return time >= values[1]


def _earth_rate_coefficients(effect: Effect, values: Values, point: dict[str, Any]) -> Values:
    """Return the coefficients M_ij earth_k of the attitude columns C_jk in output i."""
    matrix = values['matrix'].reshape(3, 3)
    block = matrix[:, :, None] * values['earth_rate'][None, None, :]
    return {ATTITUDE.name: block.reshape(3, 9).T}


def _moot_earth_rate(table: Table) -> tuple[str, str] | None:
    """
    Return (why the Earth's rate is not estimated, remedy) if the reference includes it, or None.

    Without latitude or azimuth its three components in the level frame are unknowns.
    """
    earth_rate = table.earth_rate_n
    if earth_rate is None:
        return None
    return (
        'the reference holds the rotation of the Earth already, from latitude and azimuth',
        'omit the azimuth in the table description',
    )


def _load_coefficients(effect: Effect, values: Values, point: dict[str, Any]) -> Values:
    """
    Return the coefficients of a mount that turns by theta = K f with the force f, to first order.

    The frame of the sensor turns, so that ``f' = f + f x theta`` and ``w' = w + w x theta + d theta
    / dt`` with df/dt = f x w where gravity is the load.
    """
    matrix = values['matrix'].reshape(3, 3)
    compliance = values['load_compliance'].reshape(3, 3)
    force = np.zeros((6, 3), compliance.dtype)  # rows f_j f_m
    rate = np.zeros((9, 3), compliance.dtype)  # rows f_m w_j
    for i, j, k, sign in EVEN_AND_ODD:
        for m in range(3):
            # (f x theta)_i = f_j theta_k and theta_k = K_km f_m.
            force[_PAIR[min(j, m), max(j, m)], i] += sign * compliance[k, m]
            # (w x theta)_i = w_j theta_k.
            rate[3 * m + j, i] += sign * compliance[k, m]
            # K (f x w): (f x w)_i = f_j w_k.
            rate[3 * j + k, m] += sign * compliance[m, i]
    return {LOAD['accelerometer'].name: force @ matrix.T, LOAD['gyroscope'].name: rate @ matrix.T}


def reference_effects(joint_names: JointNames) -> tuple[Effect, ...]:
    """
    Return the effects of a table with these joints.

    They are the effects of its joints (JointNames), of its clock, and of the sensors' lags.
    """
    names = JointNames.of(joint_names)
    of_table: dict[str, Any] = {
        'sensor': 'reference',
        'unit': 'rad',
        'tolerance': 1e-4,
        'compensation': 'none',
        'nuisance': True,
        'against': ('angle',),
    }
    return (
        Effect(
            **of_table,
            name='table_tilt',
            sudden=True,
            role=Role.TILT,
            components=('x', 'y'),
            shape=(2,),
            explanation=(
                'The table is not level: its vertical is rotated by a small angle about the base'
                ' axes.'
            ),
            tolerance_reason='0.1 mg at 1 g, a tenth of the accelerometer bias',
            prior_sd=2e-3,
            plausible=('bench', 0.02, 'field catalogue 6.3: 1 arcsec to some arcmin'),
            motion=('turn_about_vertical',),
            warp=partial(_warp_of_table, tilt),
            derivative=_tilt_derivative,
            acts_on=('accelerometer',),
            needs=('joints',),
        ),
        Effect(
            **of_table,
            name='axis_non_orthogonality',
            components=names.angles,
            shape=(len(names.angles),),
            explanation='The angles between the axes of the table differ from its description.',
            tolerance_reason='as the tilt',
            prior_sd=names.angle_sd or 0.01,
            plausible=('bench', 0.01, 'field catalogue 6.3: 3 arcsec to arcmin'),
            motion=('two_axis', 'static_dense'),
            warp=partial(_warp_of_table, with_axis_angles),
            needs=('joints', 'two_joints'),
        ),
        Effect(
            **of_table,
            name='encoder_zero',
            sudden=True,
            set_up_fault=_wrong_zero,
            components=names.zeros,
            shape=(len(names.zeros),),
            explanation='The zero of an inner joint angle differs from the table description.',
            tolerance_reason='as the tilt',
            prior_sd=names.angle_sd or 0.01,
            plausible=('bench', 0.02, 'field catalogue 6.3: encoder zero, up to degrees'),
            motion=('static_dense',),
            warp=_shift_zeros,
            needs=('joints', 'three_joints'),
        ),
        Effect(
            **of_table | {'unit': 'm'},
            name='axis_offset',
            components=names.places,
            shape=(len(names.places),),
            explanation='The axes do not pass through the points of the description.',
            tolerance_reason='0.1 mm, 0.01 m/s^2 at 10 rad/s',
            prior_sd=names.place_sd or 1e-3,
            plausible=('arm', 0.01, 'lengths of arms: 0.1-1 mm after a calibration of their own'),
            motion=('two_axis', 'three_speeds'),
            warp=partial(_warp_of_table, with_axis_places),
            acts_on=('accelerometer',),
            needs=('joints', 'two_joints', 'dynamic'),
        ),
        Effect(
            **of_table,
            name='encoder_harmonic',
            shape=(len(names.turning), len(ENCODER_ORDERS), 2),
            components=tuple(
                f'{name}_{kind}{order}'
                for name, order, kind in product(names.turning, ENCODER_ORDERS, ('cos', 'sin'))
            ),
            explanation=(
                'The encoder reads an angle that is wrong by harmonics of the turn (eccentricity of'
                ' its disc).'
            ),
            tolerance_reason='as the tilt',
            prior_sd=0.01,
            plausible=('bench', 0.01, 'field catalogue 6.3: 10 um on 50 mm is 41 arcsec'),
            motion=('slow_turn',),
            warp=_harmonics,
            needs=('joints',),
        ),
        Effect(
            **of_table,
            name='axis_sag',
            components=names.turning[1:],
            shape=(len(names.turning[1:]),),
            explanation=(
                'The axes sag: each bends towards the ground by an angle proportional to its'
                ' horizontal component, like a loaded shaft.'
            ),
            tolerance_reason='as the tilt',
            prior_sd=2e-3,
            plausible=(
                'bench',
                3e-3,
                'field catalogue 6.3: arcsec to 10 arcmin of a slender shaft',
            ),
            motion=('static_dense', 'two_axis'),
            warp=partial(_warp_of_table, with_sag),
            needs=('joints', 'two_joints'),
        ),
        Effect(
            **of_table,
            name='axis_wobble',
            shape=(len(names.turning), len(WOBBLES), 2),
            components=tuple(
                f'{name}_{kind}{order:+d}'
                for name, order, kind in product(names.turning, WOBBLES, ('cos', 'sin'))
            ),
            explanation=(
                'An axis wobbles: it leans another way at every angle of its turn, as a bearing out'
                ' of round makes it.'
            ),
            tolerance_reason='as the tilt',
            prior_sd=2e-3,
            plausible=('bench', 3e-3, 'field catalogue 6.3: arcsec; 10 arcmin of a worn bearing'),
            motion=('slow_turn', 'two_axis'),
            warp=partial(_warp_of_table, with_wobble),
            needs=('joints',),
        ),
        Effect(
            **of_table
            | {
                'unit': 'rad/(m/s^2)',
                'against': ('force',),
                'tolerance': 1e-4 / STANDARD_GRAVITY,
            },
            name='load_compliance',
            components=MATRIX,
            shape=(3, 3),
            zero_sums=((0, 4, 8),),
            explanation=(
                'The mount bends with the load: the sensor turns a little with the force that it'
                ' carries, which both sensors see.'
            ),
            tolerance_reason='0.1 mrad at 1 g',
            prior_sd=1e-3 / STANDARD_GRAVITY,
            plausible=('bench', 3e-3 / STANDARD_GRAVITY, '10 arcmin per g of a slender bracket'),
            motion=('static_dense', 'two_axis'),
            groups=tuple(LOAD.values()),
            group_sensors=tuple(LOAD),
            coefficients=_load_coefficients,
            needs=('joints',),
        ),
        Effect(
            name='time_offset',
            sudden=True,
            set_up_fault=_late_stamps,
            sensor='reference',
            role=Role.DELAY,
            components=('offset',),
            shape=(),
            unit='s',
            nuisance=True,
            explanation='The IMU stamps are late against the joint stamps.',
            tolerance=1e-4,
            tolerance_reason='0.1 mrad at 1 rad/s',
            prior_sd=0.1,
            plausible=('bench', 0.05, 'field catalogue 6.3: 1-20 ms on serial paths'),
            motion=('oscillate_fast', 'two_axis'),
            compensation='none',
            warp=Lag(),
            needs=('joints', 'dynamic'),
            step=2e-4,
        ),
        Effect(
            name='clock_rate',
            sensor='reference',
            components=('rate',),
            shape=(),
            unit='s/s',
            nuisance=True,
            against=('time',),
            explanation=(
                'The clock of the IMU stamps runs at another rate than that of the joint stamps:'
                ' the lag grows linearly with time.'
            ),
            tolerance=1e-6,
            tolerance_reason='0.6 ms in 10 min',
            prior_sd=1e-3,
            plausible=('bench', 5e-4, 'crystal oscillators: 10-100 ppm over temperature'),
            motion=('oscillate_fast', 'two_axis'),
            compensation='none',
            warp=Lag(factor=_growing),
            needs=('joints', 'dynamic'),
            step=1e-6,
        ),
        Effect(
            name='clock_step',
            sensor='reference',
            components=('step', 'time'),
            shape=(2,),
            unit='s',
            nuisance=True,
            against=('time',),
            explanation=(
                'The clock of the IMU stamps is set at one moment: the lag changes by a step.'
            ),
            tolerance=1e-4,
            tolerance_reason='as the time offset',
            prior=(0.0, 60.0),
            prior_sd=(0.1, 1.0),
            plausible=('bench', 0.05, 'as the time offset'),
            located=True,
            motion=('oscillate_fast', 'two_axis'),
            compensation='none',
            warp=Lag(factor=_after_step),
            needs=('joints', 'dynamic'),
            step=2e-4,
        ),
        Effect(
            name='earth_rate',
            sensor='reference',
            components=('x', 'y', 'z'),
            shape=(3,),
            unit='rad/s',
            nuisance=True,
            title='Earth rate in the level frame',
            known_size=True,
            moot=_moot_earth_rate,
            explanation="The gyroscopes measure the Earth's rotation, which the model omits.",
            tolerance=2e-6,
            tolerance_reason="3 % of the Earth's rotation",
            prior_sd=1e-4,
            plausible=('Earth', 7.3e-5, 'WGS 84: 7.292115e-5 rad/s'),
            motion=('turn_about_vertical', 'static_poses'),
            compensation='none',
            groups=(ATTITUDE,),
            coefficients=_earth_rate_coefficients,
            acts_on=('gyroscope',),
            needs=('joints',),
        ),
        *LAGS,
    )
