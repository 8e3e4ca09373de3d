"""
A third reference through the complete path: gather, rows, select, prove, document.

Poses of motion capture; the engine contains nothing for them.
"""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.estimation.rows import flat

from worlds.pose_topic import PoseBlocks, PoseRows, PoseState, calibrate

MATRIX = np.array([[1.02, 0.004, -0.002], [0.003, 0.97, 0.005], [-0.004, 0.001, 1.05]])
BIAS = np.array([0.02, -0.01, 0.005])


def walk(seed, quadratic=0.0, duration=25.0, rate_hz=50.0):
    """Return readings and poses of an irregular motion, exact but for white noise."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0.0, duration, 0.1 / rate_hz)
    rate = np.zeros((len(fine), 3))
    for axis in range(3):
        for _ in range(6):
            frequency, phase = rng.uniform(0.1, 1.0), rng.uniform(0.0, 2 * np.pi)
            rate[:, axis] += 0.7 * np.sin(2 * np.pi * frequency * fine + phase)
    # The middle of each fine step: second order in a step of a millisecond.
    middle = 0.5 * (rate[1:] + rate[:-1])
    steps = Rotation.from_rotvec(middle * np.diff(fine)[:, None]).as_matrix()
    attitude = np.empty((len(fine), 3, 3))
    attitude[0] = np.eye(3)
    for number, step in enumerate(steps):
        attitude[number + 1] = attitude[number] @ step
    some = slice(None, None, 10)
    readings = rate[some] @ MATRIX.T + BIAS + quadratic * rate[some] ** 2
    readings += rng.normal(0.0, 0.002, readings.shape)
    noise = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.05), (len(fine[some]), 3)))
    poses = Slerp(fine[some], Rotation.from_matrix(attitude[some]) * noise)
    return PoseBlocks(fine[some], readings, poses)


@pytest.fixture(scope='module')
def walking(recordings):
    with AnyReader([recordings / 'mocap_walk_raw']) as reader:
        found = {'/imu/data_raw': [], '/mocap/pose': []}
        wanted = [connection for connection in reader.connections if connection.topic in found]
        half = sum(each.msgcount for each in wanted if each.topic == '/imu/data_raw') // 2
        for connection, _, raw in reader.messages(wanted):
            found[connection.topic].append(reader.deserialize(raw, connection.msgtype))
            # The first half shows every axis, with the sd that the test of the scales requires.
            if len(found['/imu/data_raw']) == half:
                break
    imu, pose = found.values()
    stamps = [
        np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in some])
        for some in (imu, pose)
    ]
    time, known = (1e-9 * (some - stamps[0][0]) for some in stamps)
    kept = np.append(True, np.diff(known) > 0)
    attitudes = [[getattr(m.pose.orientation, axis) for axis in 'xyzw'] for m in pose]
    rate = np.array([[getattr(m.angular_velocity, axis) for axis in 'xyz'] for m in imu])
    return PoseBlocks(time, rate, Slerp(known[kept], Rotation.from_quat(np.array(attitudes)[kept])))


@pytest.mark.long
@pytest.mark.parametrize('quadratic', [0.0, 0.004])
def test_bias_matrix_and_a_hidden_effect_are_estimated(quadratic):
    calibration = calibrate(walk(90, quadratic)).calibration
    added = calibration.statistics.get('added', [])
    assert added == (['gyro_quadratic'] if quadratic else [])
    truth = np.concatenate([BIAS, MATRIX.ravel()])
    names = [f'gyroscope.bias.{axis}' for axis in 'xyz']
    names += [f'gyroscope.matrix.{row}{column}' for row in 'xyz' for column in 'xyz']
    at = [calibration.param_names.index(name) for name in names]
    z = (calibration.values[at] - truth) / calibration.sd[at]
    assert np.sqrt(np.mean(z**2)) < 1.6
    proof = calibration.proof['gyroscope']
    # Errors of 5 % over turns of a radian, and the noise of the poses at both ends.
    assert proof.before > 10 * proof.after
    assert proof.after == pytest.approx(np.radians(0.05) * np.sqrt(2), rel=0.2)


@pytest.mark.long
def test_scales_agree_with_those_of_an_independent_fit(walking):
    """
    Published with the recording, with the standard deviations of that fit; ours are of white noise.
    """
    calibration = calibrate(walking).calibration
    names = [f'gyroscope.matrix.{axis}{axis}' for axis in 'xyz']
    at = [calibration.param_names.index(name) for name in names]
    values, sd = calibration.values[at], calibration.sd[at]
    print(f'1 over scale {1 / values} +- {sd / values**2}')
    published = np.array([0.9444, 1.0956, 1.0173])
    assert np.all(
        np.abs(1 / values - published) < 3 * np.hypot(sd / values**2, [0.0004, 0.0009, 0.0003])
    )
    assert sd.max() < 3e-3
    assert calibration.proof['gyroscope'].after < 0.2 * calibration.proof['gyroscope'].before
    assert np.all(np.abs(1 / values - 1) > 10 * sd)


def test_rows_are_the_derivative_of_the_residual(walking):
    """Of some blocks, at the nominal values."""
    few = PoseBlocks(walking.time[:2000], walking.rate[:2000], walking.poses)
    reference = PoseRows(few, SensorModel(BASE, BASE))
    nominal = PoseState(reference.nominal)
    rows = reference.linearise(nominal)
    columns = flat(rows.equations)[:, :-1]
    for k in [0, *(1 + np.flatnonzero(~reference.fixed))]:
        step = 1e-6 * np.eye(columns.shape[1])[k]
        ahead, behind = (
            reference.linearise(reference.moved(nominal, sign * step)).residual for sign in (1, -1)
        )
        slope = (behind - ahead) / 2e-6
        # To first order in the residual, a tenth of a radian.
        assert np.abs(columns[:, k] - slope).max() < 0.1 * np.abs(slope).max(), k
