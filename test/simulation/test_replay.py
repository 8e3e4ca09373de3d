"""A replay has the stamps and joints of its recording and the readings of its model."""

from dataclasses import replace

import numpy as np
import pytest
from refusal import refused

from imu_calibration.api import simulate as use_case
from imu_calibration.api.resources import config_file
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.signal_history import BandVariance
from imu_calibration.simulation.profiles import make_profile
from imu_calibration.simulation.replay import ReplayNoise, simulate_on_recording
from imu_calibration.simulation.sensor_noise import SimulatedNoise
from imu_calibration.simulation.session import SimulationOptions, random_values, simulate_session

MODEL = SensorModel(
    ('bias', 'matrix', 'accel_size_effect', 'accel_thermal_bias'),
    ('bias', 'matrix', 'gyro_g_sensitivity'),
)
QUIET = {sensor: ReplayNoise(np.zeros(3), np.zeros(3)) for sensor in ('accelerometer', 'gyroscope')}


@pytest.fixture(scope='module')
def session():
    """(samples without noise that jitter in time, table, values of the IMU)."""
    table = files.read_table(config_file('table_simulated.yaml'))
    values = random_values(MODEL, 'industrial', 3)
    values[MODEL.slices['gyroscope', 'gyro_g_sensitivity']] = 1e-4 * np.arange(9)
    values[MODEL.slices['accelerometer', 'accel_thermal_bias']] = (1e-3, -2e-3, 3e-3)
    options = SimulationOptions(noise=SimulatedNoise(stamp_jitter=1e-6), temperature_start_c=25.0)
    return (
        SampleBlock(
            *simulate_session(
                MODEL,
                values,
                table,
                profile=make_profile('quick', 3, table),
                options=options,
                seed=3,
            )
        ),
        table,
        values,
    )


def test_without_noise_the_replay_of_a_simulation_repeats_its_readings(session):
    """
    The joints of the replay are read at 100 Hz and interpolated.

    The readings agree to the error of the joints' curve.
    """
    samples, table, values = session
    made, lost = simulate_on_recording([samples], table, MODEL, values=values, noise=QUIET)
    assert len(made.imu) + lost == len(samples.imu) and lost < 20
    kept = np.isin(samples.imu.stamp_ns, made.imu.stamp_ns)
    np.testing.assert_array_equal(made.imu.stamp_ns, samples.imu.stamp_ns[kept])
    assert np.sqrt(np.mean((made.imu.rate_s - samples.imu.rate_s[kept]) ** 2)) < 2e-4
    assert np.sqrt(np.mean((made.imu.force_s - samples.imu.force_s[kept]) ** 2)) < 2e-3
    assert made.joints.stamp_ns is not None and len(made.temperature) == len(samples.temperature)


def test_the_noise_of_a_replay_is_the_identified_one(session):
    samples, table, values = session
    sd = np.array([1.0, 2.0, 3.0])
    noise = {
        'accelerometer': ReplayNoise(1e-2 * sd, np.zeros(3)),
        'gyroscope': ReplayNoise(np.zeros(3), 1e-3 * sd, 1.0),
    }
    quiet, noisy = (
        simulate_on_recording([samples], table, MODEL, values=values, noise=each, seed=1)[0].imu
        for each in (QUIET, noise)
    )
    np.testing.assert_allclose((noisy.force_s - quiet.force_s).std(axis=0), 1e-2 * sd, rtol=0.03)
    bias = noisy.rate_s - quiet.rate_s
    np.testing.assert_allclose(bias.std(axis=0), 1e-3 * sd, rtol=0.3)
    assert np.all([np.corrcoef(b[:-100], b[100:])[0, 1] < 0.7 for b in bias.T]) and np.all(
        [np.corrcoef(b[:-1], b[1:])[0, 1] > 0.95 for b in bias.T]
    )


def test_without_noise_in_the_calibration_that_at_rest_is_taken(session):
    samples, table, values = session
    rng = np.random.default_rng(0)
    noisy = replace(
        samples,
        imu=replace(
            samples.imu, rate_s=samples.imu.rate_s + rng.normal(0, 1e-3, samples.imu.rate_s.shape)
        ),
    )
    quiet, made = (
        simulate_on_recording([noisy], table, MODEL, values=values, noise=noise)[0].imu
        for noise in (QUIET, None)
    )
    np.testing.assert_allclose((made.rate_s - quiet.rate_s).std(axis=0), 1e-3, rtol=0.05)


def test_a_replay_vibrates_as_its_recording(session):
    """
    Biases follow the vibration of the readings.

    Gears of 11 s and half a second of memory, smoothed twice.
    """
    table, model = session[1], MODEL.with_effect('accelerometer', 'accel_vibration_rectification')
    values = model.start_from(MODEL, session[2])
    options = SimulationOptions(noise=SimulatedNoise(), temperature_start_c=25.0)
    samples = SampleBlock(
        *simulate_session(
            model, values, table, profile=make_profile('quick', 3, table), options=options, seed=3
        )
    )
    made = simulate_on_recording([samples], table, model, values=values, noise=QUIET)[0].imu
    recorded, replayed = (
        BandVariance().of(0.01, each.force_s)[500:]
        for each in (samples.imu.select(np.isin(samples.imu.stamp_ns, made.stamp_ns)), made)
    )
    np.testing.assert_allclose(replayed.mean(axis=0), recorded.mean(axis=0), rtol=0.03)
    assert min(np.corrcoef(a, b)[0, 1] for a, b in zip(recorded.T, replayed.T)) > 0.97


def test_what_a_replay_requires(session):
    samples, table, values = session
    with refused(InputError, 'temperature_missing'):
        simulate_on_recording([replace(samples, temperature=None)], table, MODEL, values=values)
    with refused(InputError, 'no_motion'):
        simulate_on_recording([replace(samples, joints=None)], table, MODEL, values=values)
    with refused(InputError, 'replay_by_hand'):
        use_case.replay(samples, 'nowhere.yaml', None)
