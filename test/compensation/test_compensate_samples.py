"""
Compensation undoes the forward equations.

For every effect that can be inverted, and moves readings to another point.
"""

import numpy as np
import pytest
from refusal import refused
from scipy.spatial.transform import Rotation

from imu_calibration.compensation.compensate import (
    Transfer,
    compensated_samples,
    invertible,
    outside_conditions,
)
from imu_calibration.compensation.kernel import make_kernel
from imu_calibration.compensation.stream import (
    CompensationStream,
    derivative_for,
    refuse_corrected,
    requested_transfer,
)
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.forward_equations import predict, sensor_output
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.table import Table
from imu_calibration.simulation.profiles import make_profile

from worlds.compensation_cases import FURTHER, random_calibration, random_motion
from worlds.tables import Z_Y_X

ALL = FURTHER['accelerometer'], FURTHER['gyroscope']
EACH = [((name,), ()) for name in ALL[0]] + [((), (name,)) for name in ALL[1]]
PERIOD_NS = 5_000_000


def measured(calibration, force, rate, alpha, temperature):
    ref = Reference(
        np.zeros(len(force)),
        np.broadcast_to(np.eye(3), (len(force), 3, 3)),
        force,
        rate,
        alpha,
        9.8,
        temperature,
    )
    return tuple(
        sensor_output(calibration.model, sensor, calibration.values, ref=ref)
        for sensor in ('accelerometer', 'gyroscope')
    )


@pytest.mark.parametrize(
    'effects',
    [((), ()), *EACH, ALL],
    ids=lambda e: '+'.join(e[0] + e[1]) if len(e[0] + e[1]) < 2 else 'all',
)
def test_compensation_undoes_the_forward_equations(effects):
    calibration = random_calibration(3, *effects)
    force, rate, alpha, temperature = random_motion()
    corrected = compensated_samples(
        calibration,
        *measured(calibration, force, rate, alpha, temperature),
        alpha_s=alpha,
        temperature_c=temperature,
    )
    # 12 digits of readings up to 30 m/s^2.
    np.testing.assert_allclose(corrected.force, force, atol=1e-12 * 30)
    np.testing.assert_allclose(corrected.rate, rate, atol=1e-12 * 10)
    assert not corrected.flagged.any()


def test_the_whole_way_from_a_table_through_prediction_and_back():
    table = Table.from_mapping(
        {
            'joints': Z_Y_X,
            'gravity': 9.81,
            'mount': {'xyz': [0.1, 0.05, -0.02]},
        }
    )
    calibration = random_calibration(
        4, ('accel_size_effect', 'accel_cross_product'), ('gyro_g_sensitivity',)
    )
    motion = make_profile('random_short', 1, table).at(np.linspace(1.0, 160.0, 500))
    reference = reference_motion(table, motion)
    force, rate = predict(calibration.model, calibration.values, table, motion=motion)
    corrected = compensated_samples(calibration, force, rate, alpha_s=reference.alpha_s)
    np.testing.assert_allclose(corrected.force, reference.force_s, atol=1e-11)
    np.testing.assert_allclose(corrected.rate, reference.rate_s, atol=1e-11)


def test_what_belongs_to_the_table_or_the_session_is_left_alone():
    model = SensorModel(
        ('bias', 'matrix', 'lever_arm', 'accel_bias_drift'),
        ('bias', 'matrix'),
        ('table_tilt', 'time_offset'),
    )
    assert [e.name for e in invertible(model).effects] == ['bias', 'matrix', 'bias', 'matrix']


def test_transfer_there_and_back_is_the_identity():
    force, rate, alpha, _ = random_motion(20)
    plain = random_calibration(0, (), (), matrix_spread=0.0)
    plain = Calibration(plain.model, plain.model.start(), plain.covariance, plain.status)
    there = Transfer.from_pose('base', (0.3, -0.2, 0.5), (0.2, -0.4, 2.0))
    mat_ts = there.mat_ts
    back = Transfer('imu', mat_ts.T, -mat_ts.T @ there.arm_t)
    moved = compensated_samples(plain, force, rate, alpha_s=alpha, transfer=there)
    again = compensated_samples(
        plain, moved.force, moved.rate, alpha_s=alpha @ mat_ts.T, transfer=back
    )
    # Centripetal terms of 30 m/s^2 come and go.
    np.testing.assert_allclose(again.force, force, atol=1e-13 * 100)
    np.testing.assert_allclose(again.rate, rate, atol=1e-14)


def test_transfer_of_a_steady_turn_takes_the_centripetal_force_out():
    plain = random_calibration(0, (), (), matrix_spread=0.0)
    plain = Calibration(plain.model, plain.model.start(), plain.covariance, plain.status)
    # The sensor sits 0.5 m ahead of the axis, x outwards; in the target frame it looks backwards
    # (yaw of 180 degrees).
    transfer = Transfer.from_pose('base', (0.5, 0.0, 0.0), (0.0, 0.0, np.pi))
    moved = compensated_samples(
        plain,
        np.array([[2.0**2 * 0.5, 0.0, 9.8]]),
        np.array([[0.0, 0.0, 2.0]]),
        alpha_s=np.zeros((1, 3)),
        transfer=transfer,
    )
    np.testing.assert_allclose(moved.force, [[0.0, 0.0, 9.8]], atol=1e-14)
    np.testing.assert_allclose(moved.rate, [[0.0, 0.0, 2.0]], atol=1e-14)


def test_pose_follows_roll_pitch_yaw_about_fixed_axes():
    expected = Rotation.from_euler('ZYX', [0.3, 0.2, 0.1]).as_matrix()
    np.testing.assert_allclose(
        Transfer.from_pose('b', (0, 0, 0), (0.1, 0.2, 0.3)).mat_ts, expected, atol=1e-15
    )
    with refused(InputError, 'pose_numbers'):
        Transfer.from_pose('b', (0, 0), (0, 0, 0))
    with refused(InputError, 'frame_name_missing'):
        requested_transfer('', (0, 0, 1.0), (0, 0, 0))
    assert requested_transfer('', (0.0,) * 3, (0.0,) * 3) is None


def test_saturated_readings_are_flagged():
    calibration = random_calibration(1, ('accel_saturation',))
    values = calibration.values.copy()
    values[calibration.model.slices['accelerometer', 'accel_saturation']] = 19.6
    calibration = Calibration(calibration.model, values, calibration.covariance, calibration.status)
    force = np.array([[0.0, 0.0, 9.8], [19.6, 0.0, 0.0], [0.0, -19.6, 0.0], [19.5, 0.0, 0.0]])
    corrected = compensated_samples(calibration, force, np.zeros((4, 3)), alpha_s=np.zeros((4, 3)))
    assert corrected.flagged.tolist() == [False, True, True, False]
    np.testing.assert_allclose(
        corrected.marks, [[0, 0], [19.6**2, 0], [19.6**2, 0], [0, 0]], rtol=1e-5
    )


def test_readings_beyond_what_can_be_inverted_are_flagged():
    calibration = random_calibration(1, ('accel_quadratic',))
    values = calibration.values.copy()
    values[calibration.model.slices['accelerometer', 'accel_quadratic']] = 0.05
    calibration = Calibration(calibration.model, values, calibration.covariance, calibration.status)
    force = np.array([[0.0, 0.0, 0.1], [-100.0, 0.0, 0.0]])  # x + 0.05 x^2 never reaches -100
    corrected = compensated_samples(calibration, force, np.zeros((2, 3)), alpha_s=np.zeros((2, 3)))
    assert corrected.flagged.tolist() == [False, True]
    assert np.isfinite(corrected.force[0]).all() and np.isnan(corrected.force[1]).all()
    assert all(np.isnan(x) for x in make_kernel(calibration)(*force[1].tolist(), *[0.0] * 7))


def test_thermal_effects_ask_for_temperatures():
    calibration = random_calibration(1, ('accel_thermal_bias',))
    force, rate, alpha, _ = random_motion(5)
    with refused(InputError, 'temperature_missing'):
        compensated_samples(calibration, force, rate, alpha_s=alpha)
    with refused(InputError, 'temperature_missing', 'imu/temperature'):
        CompensationStream(calibration)


def moving_imu(n=4000):
    time = np.arange(n) * PERIOD_NS * 1e-9
    rate = np.stack([np.sin(2 * time), 1.5 * np.cos(1.3 * time), 0.5 * np.sin(3 * time)], axis=1)
    alpha = np.stack(
        [2 * np.cos(2 * time), -1.95 * np.sin(1.3 * time), 1.5 * np.cos(3 * time)], axis=1
    )
    force = 9.8 * np.stack([np.sin(time), np.zeros(n), np.cos(time)], axis=1)
    return 10**18 + PERIOD_NS * np.arange(n), force, rate, alpha


def test_a_stream_may_be_cut_anywhere_and_follows_the_truth():
    calibration = random_calibration(5, ('accel_size_effect', 'accel_thermal_bias'))
    stamps, force, rate, alpha = moving_imu()
    temperature = TemperatureSamples(stamps[::100], np.linspace(20.0, 30.0, len(stamps[::100])))
    at_samples = np.interp(
        stamps - stamps[0], temperature.stamp_ns - stamps[0], temperature.temperature_c
    )
    imu = ImuSamples(stamps, *measured(calibration, force, rate, alpha, at_samples), 'imu_link')
    whole = CompensationStream(calibration, temperature=temperature)
    at_once = whole.correct(imu)
    cut = CompensationStream(calibration, temperature=temperature)
    parts = [
        cut.correct(imu.select(slice(a, b))) for a, b in ((0, 1000), (1000, 1001), (1001, 4000))
    ]
    np.testing.assert_allclose(np.concatenate([p.force for p in parts]), at_once.force, atol=1e-11)
    # The derivative is late by its delay: alpha changes by up to 5 rad/s^3 and the arms are 20 mm.
    late = 5.0 * whole.slope.derivative.delay * 0.05 + 1e-3
    assert np.abs(at_once.force - force)[50:].max() < late
    np.testing.assert_allclose(at_once.rate, rate, atol=1e-11)
    assert whole.warnings() == []


def test_readings_that_are_not_finite_leave_their_neighbours_alone():
    calibration = random_calibration(5)
    stamps, force, rate, alpha = moving_imu(500)
    clean = CompensationStream(calibration).correct(ImuSamples(stamps, force, rate, 'imu_link'))
    broken = rate.copy()
    broken[200:203] = np.nan
    corrected = CompensationStream(calibration).correct(
        ImuSamples(stamps, force, broken, 'imu_link')
    )
    assert np.isnan(corrected.rate[200:203]).all()
    assert np.isfinite(corrected.force).all() and np.isfinite(corrected.rate[203:]).all()
    np.testing.assert_allclose(corrected.force[240:], clean.force[240:], atol=1e-11)


def test_conditions_of_the_calibration_are_watched():
    calibration = random_calibration(
        1, conditions={'largest_rate': 2.0, 'temperature_range_c': [20.0, 30.0]}
    )
    assert outside_conditions(calibration, 1.0, [22.0]) == []
    fast, hot = outside_conditions(calibration, 4.0, [50.0])
    assert 'the rate reaches 4.00' in fast and '50.0 C' in hot


def test_the_derivative_gets_longer_with_the_arm():
    calibration = random_calibration(1)
    near = derivative_for(calibration, 0.001)
    far = derivative_for(calibration, 0.001, Transfer.from_pose('base', (0.1, 0, 0)))
    assert 2 <= near.taps < far.taps
    assert far.noise_sd(0.0022) * 0.1 <= 0.018 / 3 or far.delay >= 0.0195


@pytest.mark.parametrize('topic', ['/imu/data_corrected', 'corrected', '/a/imu/corrected/'])
def test_a_corrected_topic_is_refused(topic):
    with refused(InputError, 'corrected_already'):
        refuse_corrected(topic)
    refuse_corrected('/imu/data_raw')
