"""Means at rest against the attitude: a dependence is significant, a drift and noise are not."""

import numpy as np
import pytest

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint_motion import rest_at
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.window_statistics import reduce_window

GRAVITY, NOISE, LENGTH = 9.81, 1e-3, 200
TABLE = Table.from_mapping(
    {
        'joints': [{'name': 'yaw', 'axis': [0, 0, 1]}, {'name': 'roll', 'axis': [1, 0, 0]}]
        + [{'name': 'pitch', 'axis': [0, 1, 0]}],
        'up': [0, 0, 1],
        'gravity': GRAVITY,
        'latitude': None,
    }
)
MODEL = SensorModel(joint_names=('yaw', 'roll', 'pitch'))


def rests(rate_of, *, n_rests=24, seed=0):
    """Return rests at random attitudes; the gyroscope reads `rate_of(force, time)` and noise."""
    rng = np.random.default_rng(seed)
    windows = []
    for number in range(n_rests):
        time = 20.0 * number + 0.01 * np.arange(LENGTH)
        _, roll, pitch = angles = rng.uniform(-np.pi, np.pi, 3)
        # Gravity in the link after Rx(roll) Ry(pitch): Ry' Rx' z.
        level = np.array([0.0, np.sin(roll), np.cos(roll)])
        sine, cosine = np.sin(pitch), np.cos(pitch)
        up = np.array([-sine * level[2], level[1], cosine * level[2]])
        force = GRAVITY * up + rng.normal(0, NOISE, (LENGTH, 3))
        rate = rate_of(GRAVITY * up, time.mean()) + rng.normal(0, NOISE, (LENGTH, 3))
        motion = rest_at(np.tile(angles, (LENGTH, 1)))
        windows.append(
            Window('static', (time * 1e9).astype(np.int64), time, force, rate, motion, None)
        )
    return windows


def dependence(windows, sensor):
    accumulator = Accumulator()
    for window in windows:
        accumulator.add(reduce_window(window, MODEL, TABLE))
    return solve(accumulator, MODEL).attitude[sensor]


def test_a_rate_in_proportion_to_gravity_is_a_dependence():
    """1e-3 rad/s at 1 g is 14 sd of a mean of 200 samples."""
    found = dependence(rests(lambda force, time: 1e-4 * force[[1, 2, 0]]), 'gyroscope')
    assert found.p_value < 1e-9 and found.ratio > 20.0


@pytest.mark.parametrize('seed', range(4))
def test_a_drift_and_noise_are_none(seed):
    """The drift is as large as that dependence, from the first to the last rest."""
    windows = rests(lambda force, time: np.full(3, 2e-3 * time / 480.0), seed=seed)
    for sensor in ('accelerometer', 'gyroscope'):
        found = dependence(windows, sensor)
        assert found.p_value > 1e-3 and found.ratio < 2.0


def test_too_few_rests_show_none():
    windows = rests(lambda force, time: 1e-4 * force, n_rests=5)
    accumulator = Accumulator()
    for window in windows:
        accumulator.add(reduce_window(window, MODEL, TABLE))
    assert 'gyroscope' not in solve(accumulator, MODEL).attitude
