"""Noise has the size, the correlation and the resolution that its model states."""

import numpy as np
import pytest

from imu_calibration.simulation.sensor_noise import (
    GRADES,
    ImuNoise,
    SimulatedNoise,
    gauss_markov_samples,
    jitter_stamps,
    quantise,
    read_encoders,
    realistic,
)


def test_white_noise_integrates_to_a_random_walk_of_its_density():
    model = SimulatedNoise(accel_density=2e-3, gyro_density=1e-4)
    force, rate = ImuNoise(model, sample_rate=200.0, rng=np.random.default_rng(1)).add(
        np.zeros((40000, 3)), np.zeros((40000, 3))
    )
    for noise, density in ((force, 2e-3), (rate, 1e-4)):
        # 1200 integrals over 0.5 s: 2 % sampling error of their sd.
        walk = noise.reshape(-1, 100, 3).sum(axis=1) / 200.0
        assert np.std(walk) == pytest.approx(density * np.sqrt(0.5), rel=0.08)


def test_bias_wander_is_stationary_with_its_correlation_time():
    wander = gauss_markov_samples(3.0, 5.0, 0.1, shape=(2000, 400), rng=np.random.default_rng(2))
    for row in (0, 500, 1999):
        # 400 independent paths: 3.5 % sampling error.
        assert np.std(wander[row]) == pytest.approx(3.0, rel=0.12)
    for lag in (10, 50):
        correlation = np.mean(wander[lag:] * wander[:-lag]) / 9.0
        assert correlation == pytest.approx(np.exp(-lag * 0.1 / 5.0), abs=0.02)


def test_bias_wander_continues_from_block_to_block():
    rng = np.random.default_rng(5)
    first = gauss_markov_samples(3.0, 5.0, 0.1, shape=(10, 4000), rng=rng)
    second = gauss_markov_samples(3.0, 5.0, 0.1, shape=(10, 4000), rng=rng, before=first[-1])
    # 4000 independent paths: 1.6 % sampling error.
    assert np.mean(second[0] * first[-1]) / 9.0 == pytest.approx(np.exp(-0.1 / 5.0), abs=0.06)
    assert np.std(second[0] - first[-1]) == pytest.approx(
        3.0 * np.sqrt(2 * -np.expm1(-0.1 / 5.0)), rel=0.06
    )


def test_no_noise_changes_nothing():
    force = np.random.default_rng(3).normal(size=(10, 3))
    for got in ImuNoise(SimulatedNoise(), sample_rate=100.0, rng=np.random.default_rng(4)).add(
        force, force
    ):
        np.testing.assert_array_equal(got, force)
    np.testing.assert_array_equal(
        read_encoders(force, SimulatedNoise(), np.random.default_rng(4)), force
    )


def test_resolution():
    values = quantise(np.linspace(-1, 1, 1000), 0.25)
    np.testing.assert_array_equal(np.unique(values), np.arange(-1, 1.1, 0.25))
    angles = read_encoders(
        np.linspace(0, 1, 500)[:, None],
        realistic(encoder_resolution=0.01),
        np.random.default_rng(5),
    )
    np.testing.assert_allclose(angles / 0.01, np.round(angles / 0.01), atol=1e-9)


def test_stamp_jitter():
    stamp_ns = np.arange(20000) * 10_000_000 + 1_700_000_000_000_000_000
    jittered = jitter_stamps(stamp_ns, 50e-6, np.random.default_rng(6))
    assert jittered.dtype == np.int64
    # 20000 samples: 0.5 % sampling error.
    assert np.std(jittered - stamp_ns) == pytest.approx(50_000, rel=0.02)


def test_grades_are_ordered_and_sourced():
    densities = [
        GRADES[name].noise.accel_density for name in ('consumer', 'industrial', 'navigation')
    ]
    assert densities == sorted(densities, reverse=True)
    assert all(grade.source and grade.noise.accel_instability > 0 for grade in GRADES.values())
