"""
The catalogue's forward equations reproduce what the physics made.

One convention for signs, units and order of every parameter.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.forward_equations import predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.signal_history import BandVariance, ThermalBranch
from imu_calibration.kinematics.table import Table

from worlds.hiding import options_of
from worlds.physics import encoder_reading, make_session
from worlds.physics_draw import EFFECTS

OPTIONS = {'profile': 'random_short', 'duration': 180.0, 'imu_rate': 50.0, 'joint_rate': 50.0}
LEFT = {
    'load_compliance': 3e-3,
    'axis_wobble': 3e-3,
    'accel_scale_asymmetry': 5e-3,
    'gyro_scale_asymmetry': 5e-3,
    'accel_bandwidth': 0.02,
    'gyro_bandwidth': 0.02,
    'accel_cross_axis_lag': 0.03,
    'gyro_cross_axis_lag': 0.03,
    'time_offset': 2e-3,
    'clock_rate': 2e-3,
    'accel_thermal_hysteresis': 0.1,
    'gyro_thermal_hysteresis': 0.1,
    'accel_vibration_rectification': 0.3,
    'gyro_vibration_rectification': 0.3,
}
"""
Share of the effect that may remain: the catalogue's signs near zero input, its quadrature and
Taylor series; the mount's turn to first order; the world's differences in time; what a neighbour
feels along its own crooked axis; the branches of a thermal hysteresis are one play, not grains of
unlike friction; a variance above 5 Hz of lines at 15 Hz is not all of it; else 1 ns stamps.
"""


@lru_cache(maxsize=1)
def plain():
    return make_session(11, None, 'none', **OPTIONS)


def told_motion(session):
    """Return the joints as their encoders tell them, at the IMU's stamps."""
    profile, value = session.truth['profile'], session.truth['values'].get('encoder_harmonic')
    time = (session.imu.stamp_ns - session.truth['start_ns']) * 1e-9
    motion = profile.at(time)
    if value is None:
        return motion
    step = 2e-3
    readings = [
        encoder_reading(profile.at(time + k * step).position, value)[0] for k in (-2, -1, 0, 1, 2)
    ]
    rate = (8 * (readings[3] - readings[1]) - (readings[4] - readings[0])) / (12 * step)
    acceleration = (
        -readings[0] + 16 * readings[1] - 30 * readings[2] + 16 * readings[3] - readings[4]
    ) / (12 * step**2)
    return JointMotion(time, readings[2], rate, acceleration, motion.jerk)


def predicted(session, name=None):
    triads = session.truth['accelerometer'], session.truth['gyroscope']
    model = SensorModel(joint_names=tuple(joint['name'] for joint in session.table['joints']))
    parts = {
        ('accelerometer', 'bias'): triads[0].bias,
        ('accelerometer', 'matrix'): triads[0].matrix,
        ('gyroscope', 'bias'): triads[1].bias,
        ('gyroscope', 'matrix'): triads[1].matrix,
    }
    if name is not None:
        sensor = CATALOGUE.owner_of(name)
        model = model.with_effect(sensor, name)
        parts[sensor, name] = session.truth['values'][name]
    values = model.start()
    for key, value in parts.items():
        values[model.slices[key]] = np.ravel(value)
    table = Table.from_mapping(session.table | {'gravity': session.truth['gravity']})
    vibration = BandVariance().of(1.0 / OPTIONS['imu_rate'], session.imu.force_s)
    motion = replace(told_motion(session), thermal_branch=branch_of(session), vibration=vibration)
    return predict(
        model, values, table, motion=motion, temperature_c=session.truth['temperature_c']
    )


def over_two_seconds(values):
    return values[: len(values) // 100 * 100].reshape(-1, 100, 3).mean(axis=1)


def branch_of(session):
    """Return which way the temperature came to the IMU's stamps, as the thermometer shows it."""
    published, start_ns = session.temperature, session.truth['start_ns']
    return np.interp(
        session.imu.stamp_ns - start_ns,
        published.stamp_ns - start_ns,
        ThermalBranch().of(published.temperature_c),
    )


@pytest.mark.parametrize('name', EFFECTS)
def test_forward_equation_reproduces_the_physics(name):
    session = make_session(11, {name: None}, 'none', **OPTIONS, **options_of(name))
    without, with_effect = predicted(session), predicted(session, name)
    measured = session.imu.force_s, session.imu.rate_s
    if 'machine' in options_of(name):
        # What comes through as it is is no part of the equation: beside the same machine without
        # the effect
        bare = make_session(11, None, 'none', **OPTIONS, **options_of(name))
        measured = tuple(
            got - alone + guess
            for got, alone, guess in zip(measured, (bare.imu.force_s, bare.imu.rate_s), without)
        )
        measured, without, with_effect = (
            [over_two_seconds(values) for values in pair]
            for pair in (measured, without, with_effect)
        )
    acts = 0
    for got, before, after in zip(measured, without, with_effect):
        change, rest = (np.sqrt(np.mean((got - guess) ** 2)) for guess in (before, after))
        if change > 1e-5:
            acts += 1
            assert rest < LEFT.get(name, 1e-3) * change + 2e-7
    assert acts
