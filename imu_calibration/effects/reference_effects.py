"""Effects of the table, the clock and a sensor's own lag: they change the motion that the sensor is thought to have felt."""

from dataclasses import replace

import numpy as np

from imu_calibration.effects.base import Effect
from imu_calibration.reference.axis_angles import with_axis_angles
from imu_calibration.reference.encoder import with_encoder_harmonics
from imu_calibration.reference.joint import JointNames
from imu_calibration.reference.joint_delay import shifted
from imu_calibration.reference.levelling import tilt

LAGUERRE = np.polynomial.laguerre.laggauss(5)
"""Nodes and weights that turn an exponential lag into a weighted mean of delays: int e^-x f(t - tau x) dx."""
ORDERS = (1, 2)
"""Harmonics per revolution of the encoder error."""


def _tilt(table, motion, values):
    return [(1.0, tilt(table, values), motion)]


def _tilt_derivative(ref):
    """Derivative of ``mat_sn @ (up + theta x up) g`` with respect to (theta_x, theta_y)."""
    return ref.gravity * np.concatenate([-ref.mat_sn[:, :, 1], ref.mat_sn[:, :, 0]], axis=1)


def _axes(table, motion, values):
    """Turn each axis against the axis before it."""
    return [(1.0, with_axis_angles(table, values), motion)]


def _zero(table, motion, values):
    """Shift the joints between the first and the last: the first one's zero is the azimuth, the last one's belongs to the mount."""
    offset = np.zeros(motion.position.shape[1])
    offset[_columns(table, table.joint_names.zeros)] = values
    return [(1.0, table, replace(motion, position=motion.position + offset))]


def _columns(table, names):
    return [table.joint_names.index(name) for name in names]


def _harmonics(table, motion, values):
    amplitudes = np.zeros((motion.position.shape[1], len(ORDERS), 2))
    amplitudes[_columns(table, table.joint_names.turning)] = np.reshape(values, (-1, len(ORDERS), 2))
    for index, order in enumerate(ORDERS):
        motion = with_encoder_harmonics(motion, order, amplitudes[:, index, 0], amplitudes[:, index, 1])
    return [(1.0, table, motion)]


def _late(table, motion, values):
    return [(1.0, table, shifted(motion, values[0]))]


def _lag(table, motion, values):
    """First-order low-pass of time constant tau: y = int e^-x u(t - tau x) dx, by Gauss-Laguerre quadrature."""
    return [(weight, table, shifted(motion, values[0] * node)) for node, weight in zip(*LAGUERRE)]


def _earth(values, point):
    """Coefficients of the attitude columns: matrix_ij C_jk earth_k."""
    matrix = values['matrix'].reshape(3, 3)
    return {'attitude': (matrix[:, :, None] * values['earth_rate'][None, None, :]).reshape(3, 9).T}


def _lag_effect(sensor):
    short = {'accelerometer': 'accel', 'gyroscope': 'gyro'}[sensor]
    return Effect(f'{short}_bandwidth', sensor, ('time_constant',), (), 's', 1e-4, 0.1,
                  f'The {sensor} answers through a first-order low-pass filter: its output lags and loses amplitude at speed.',
                  ('oscillate_fast',), 'none', warp=_lag, acts_on=(sensor,), needs=('joints', 'dynamic'), step=2e-4,
                  plausible=(('consumer', 0.05, 'field catalogue 6.3: 5-250 Hz'),))


def reference_effects(joint_names):
    """Return the effects of a table with these joints (JointNames), of its clock, and of the sensors' lags."""
    names = JointNames.of(joint_names)
    return (
        Effect('table_tilt', 'reference', ('x', 'y'), (2,), 'rad', 1e-4, 2e-3,
               'The table does not stand level: its vertical is turned by a small angle about the base axes.', ('turn_about_vertical',), 'none',
               warp=_tilt, derivative=_tilt_derivative, acts_on=('accelerometer',), needs=('joints',), step=1e-4, plausible=(('bench', 0.02, 'field catalogue 6.3: 1 arcsec to some arcmin'),)),
        Effect('axis_non_orthogonality', 'reference', names.angles, (len(names.angles),), 'rad',
               1e-4, 0.01, 'The axes of the table do not stand at the angles to one another that its description says.', ('two_axis', 'static_dense'), 'none',
               warp=_axes, needs=('joints', 'two_joints'), step=1e-4, plausible=(('bench', 0.01, 'field catalogue 6.3: 3 arcsec to arcmin'),)),
        Effect('encoder_zero', 'reference', names.zeros, (len(names.zeros),), 'rad', 1e-4, 0.01,
               'The zero of an inner joint angle is not where the table description says.', ('static_dense',), 'none',
               warp=_zero, needs=('joints', 'three_joints'), step=1e-4, plausible=(('bench', 0.02, 'field catalogue 6.3: encoder zero, up to degrees'),)),
        Effect('encoder_harmonic', 'reference', tuple(f'{name}_{kind}{order}' for name in names.turning for order in ORDERS for kind in ('cos', 'sin')),
               (len(names.turning), len(ORDERS), 2), 'rad', 1e-4, 0.01,
               'The encoder reads an angle that is wrong by harmonics of the turn (eccentricity of its disc).', ('slow_turn',), 'none',
               warp=_harmonics, needs=('joints',), step=1e-4, plausible=(('bench', 0.01, 'field catalogue 6.3: 10 um on 50 mm is 41 arcsec'),)),
        Effect('time_offset', 'reference', ('offset',), (), 's', 1e-4, 0.1, 'The IMU stamps are late against the joint stamps.',
               ('oscillate_fast', 'two_axis'), 'none', warp=_late, needs=('joints', 'dynamic'), step=2e-4,
               plausible=(('bench', 0.05, 'field catalogue 6.3: 1-20 ms on serial paths'),)),
        Effect('earth_rate', 'reference', ('x', 'y', 'z'), (3,), 'rad/s', 2e-6, 1e-4, "The gyroscopes feel the Earth's rotation, which the model leaves out.",
               ('turn_about_vertical', 'static_poses'), 'none', groups=('attitude',), coefficients=_earth, acts_on=('gyroscope',), needs=('joints',),
               plausible=(('Earth', 7.3e-5, 'WGS 84: 7.292115e-5 rad/s'),)),
        _lag_effect('accelerometer'),
        _lag_effect('gyroscope'),
    )
