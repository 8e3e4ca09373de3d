"""
What differs from session to session.

The unit, the sizes of what is hidden, the weather, and when things happen.
"""

from zlib import crc32

import numpy as np

from imu_calibration.core.samples import TemperatureSamples

from worlds.physics_sensor import Triad

G = 9.80665
MG = 1e-3 * G
DEG = np.pi / 180
ARCMIN = DEG / 60
EFFECTS = {
    'accel_quadratic': (1e-3 / G, (3,)),
    'accel_cubic': (2e-3 / G**2, (3,)),
    'accel_scale_asymmetry': (1e-3, (3,)),
    'accel_cross_product': (1e-3 / G, (3, 3)),
    'accel_size_effect': (8e-3, (3, 3)),
    'lever_arm': (10e-3, (3,)),
    'accel_thermal_bias': (0.3 * MG, (3,)),
    'accel_thermal_scale': (3e-4, (3,)),
    'accel_bias_drift': (2 * MG, None),
    'accel_bias_trend': (2 * MG / 300, (3,)),
    'gyro_bias_trend': (0.05 * DEG / 300, (3,)),
    'accel_saturation': (0.02, None),
    'accel_bandwidth': (4e-3, None),
    'accel_thermal_bias_2': (0.05 * MG, (3,)),
    'gyro_thermal_bias_2': (2e-3 * DEG, (3,)),
    'gyro_force_squared': (5e-3 * DEG / G**2, (3, 6)),
    'accel_thermal_hysteresis': (2 * MG, (3,)),
    'gyro_thermal_hysteresis': (0.05 * DEG, (3,)),
    'accel_delay': (4e-3, None),
    'gyro_delay': (4e-3, None),
    'accel_filter': (4e-3, None),
    'gyro_filter': (4e-3, None),
    'accel_vibration_rectification': (0.3, (3,)),
    'gyro_vibration_rectification': (4e-3, (3, 3)),
    'accel_cross_axis_lag': (2e-4, (3, 2)),
    'gyro_cross_axis_lag': (2e-4, (3, 2)),
    'axis_sag': (5 * ARCMIN, None),
    'axis_wobble': (3 * ARCMIN, None),
    'axis_offset': (5e-3, None),
    'load_compliance': (1 * ARCMIN / G, (3, 3)),
    'gyro_g_sensitivity': (0.02 * DEG / G, (3, 3)),
    'gyro_rate_product': (1e-3, (3, 3)),
    'gyro_quadratic': (1e-3, (3,)),
    'gyro_scale_asymmetry': (1e-3, (3,)),
    'gyro_thermal_bias': (0.01 * DEG, (3,)),
    'gyro_thermal_scale': (5e-4, (3,)),
    'gyro_bias_drift': (0.05 * DEG, None),
    'gyro_saturation': (0.02, None),
    'gyro_bandwidth': (4e-3, None),
    'table_tilt': (5 * ARCMIN, (2,)),
    'axis_non_orthogonality': (5 * ARCMIN, None),
    'encoder_zero': (5 * ARCMIN, None),
    'encoder_harmonic': (3 * ARCMIN, None),
    'time_offset': (2e-3, ()),
    'clock_rate': (2e-5, ()),
    'earth_rate': (1.0, None),
}
"""Effects that can be hidden: name -> (clearly visible size, shape of its value or None)."""
OUTSIDE = {
    'angle_bias_accel': 2 * MG,
    'angle_bias_gyro': 0.05 * DEG,
    'stop_bias': 2 * MG,
    'knock_step': 5 * MG,
    'fixture_slip': 10 * ARCMIN,
    'second_warm_up': 3 * MG,
}
"""Causes that no catalogue holds: name -> clearly visible size."""


POSITIVE = ('_saturation', '_bandwidth', '_delay', '_filter')
"""Endings of the names of what cannot be negative and has one value."""


def generator(seed, what):
    """Return the generator of one thing, so that what is drawn for another does not change it."""
    return np.random.default_rng([seed, crc32(what.encode())])


def draw_value(name, size, n_joints, rng):
    """Return the value of an effect: the given array, or a random one of the given magnitude."""
    if name not in EFFECTS and name not in OUTSIDE:
        raise KeyError(f'{name} is neither in EFFECTS nor in OUTSIDE')
    if size is not None and np.ndim(size):
        return np.asarray(size, float)
    if name in OUTSIDE:
        return float(OUTSIDE[name] if size is None else size)
    usual, shape = EFFECTS[name]
    size = float(usual if size is None else size)
    if name.endswith(POSITIVE) or name == 'earth_rate':
        return size
    if name.endswith('_bias_drift'):
        return np.append(size * _pattern((3,), rng), rng.uniform(40.0, 150.0))
    if name == 'encoder_harmonic':
        phase = rng.uniform(0.0, 2.0 * np.pi, (n_joints, 2))
        amplitude = size * rng.uniform(0.6, 1.4, (n_joints, 2)) * [1.0, 0.4]
        return np.stack([amplitude * np.cos(phase), amplitude * np.sin(phase)], axis=2)
    shape = {
        'axis_non_orthogonality': (n_joints - 1,),
        'encoder_zero': (n_joints - 2,),
        'axis_sag': (n_joints - 1,),
        'axis_wobble': (n_joints, 2, 2),
        'axis_offset': (n_joints - 1, 2),
    }.get(name, shape)
    return float(size * _pattern((), rng)) if shape == () else size * _pattern(shape, rng)


def _pattern(shape, rng):
    return rng.uniform(0.6, 1.4, shape) * rng.choice([-1.0, 1.0], shape)


def draw_imu(grade, values, arms, rng):
    """
    Return the accelerometer and the gyroscope of one random unit, with the hidden effects built in.
    """
    accel, gyro = (
        Triad(rng.normal(0.0, bias, 3), _matrix(grade, rng))
        for bias in (grade.accel_bias, grade.gyro_bias)
    )
    drawn_arms = rng.uniform(-1.0, 1.0, (3, 3)) * grade.arm
    if arms:
        accel.arms = drawn_arms
    accel.arms = accel.arms + values.get('accel_size_effect', 0.0) + values.get('lever_arm', 0.0)
    for triad, short in ((accel, 'accel'), (gyro, 'gyro')):
        triad.quadratic = values.get(short + '_quadratic', 0.0)
        triad.asymmetry = values.get(short + '_scale_asymmetry', 0.0)
        triad.thermal_bias = values.get(short + '_thermal_bias', 0.0)
        triad.thermal_bend = values.get(short + '_thermal_bias_2', 0.0)
        triad.hysteresis = values.get(short + '_thermal_hysteresis', 0.0)
        triad.rectifies = values.get(short + '_vibration_rectification', 0.0)
        triad.thermal_scale = values.get(short + '_thermal_scale', 0.0)
        triad.low_pass, triad.late = (
            float(values.get(short + '_bandwidth', 0.0)),
            float(values.get(short + '_delay', 0.0)),
        )
        triad.second_order, triad.crosstalk = (
            float(values.get(short + '_filter', 0.0)),
            values.get(short + '_cross_axis_lag'),
        )
        triad.trend = values.get(short + '_bias_trend', 0.0)
        if short + '_bias_drift' in values:
            triad.drift, triad.drift_constant = (
                values[short + '_bias_drift'][:3],
                values[short + '_bias_drift'][3],
            )
    accel.cubic = values.get('accel_cubic', 0.0)
    accel.products, gyro.products = (
        values.get('accel_cross_product'),
        values.get('gyro_rate_product'),
    )
    gyro.to_force, gyro.to_force_squared = (
        values.get('gyro_g_sensitivity'),
        values.get('gyro_force_squared'),
    )
    return accel, gyro


def _matrix(grade, rng):
    matrix = rng.normal(0.0, grade.misalignment, (3, 3))
    np.fill_diagonal(matrix, 1.0 + rng.normal(0.0, grade.scale, 3))
    return matrix


def draw_events(moves, rng):
    """
    Return the times and directions of things that may happen.

    They are always drawn so that the rest of the session does not depend on them.
    """
    length = moves.duration
    stops = moves.find('rest')[:, 0]
    return {
        'knock': rng.uniform(0.25, 0.75) * length,
        'slip': rng.uniform(0.3, 0.7) * length,
        'gap': rng.uniform(0.2, 0.8) * length,
        'second_start': rng.uniform(0.2, 0.5) * length,
        'second_constant': rng.uniform(0.1, 0.3) * length,
        'direction': _unit(rng.normal(size=3)),
        'turn': _unit(rng.normal(size=3)),
        'stops': stops,
        'stop_bias': rng.normal(size=(len(stops) + 1, 3)),
    }


def _unit(vector):
    return vector / np.linalg.norm(vector)


class Climate:
    """Temperature at the sensor: a warm-up, the room's control on top, and a heater when asked."""

    def __init__(self, kind, duration, rng):
        self.rise, self.constant = rng.uniform(6.0, 10.0), rng.uniform(0.2, 0.6) * duration
        self.period, self.phase = rng.uniform(0.5, 0.8) * duration, rng.uniform(0.0, 2.0 * np.pi)
        self.heater = 6.0 if kind == 'cycle' else 0.0
        self.duration = duration

    def at(self, time):
        """Return the temperature at `time`, degrees Celsius."""
        room = 0.7 * np.sin(2.0 * np.pi * time / self.period + self.phase)
        heater = 0.5 * self.heater * (1.0 - np.cos(4.0 * np.pi * time / self.duration))
        return 24.0 - self.rise * np.expm1(-time / self.constant) + room + heater

    def publish(self, start_ns, duration, rng, rate=1.0):
        """Return what the thermometer sends."""
        time = np.arange(0.0, duration, 1.0 / rate)
        return TemperatureSamples(
            start_ns + to_ns(time), np.round(self.at(time) + rng.normal(0.0, 0.01, len(time)), 2)
        )


def to_ns(time):
    """Return whole nanoseconds."""
    return np.round(np.asarray(time) * 1e9).astype(np.int64)
