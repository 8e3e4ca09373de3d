"""Torn register reads whose errors are within the noise."""

import numpy as np
import pytest
from scipy.signal import lfilter

from imu_calibration.allan.reading_faults import FaultSearch
from imu_calibration.allan.torn_reads import excess_of_torn_reads

N_READINGS = 40_000


def counts(noise_steps, share, seed, smoothing=0.0):
    """
    Readings in steps near a change of the high byte, some of them torn, and true readings.

    `smoothing`: correlation of neighbours by a filter of the sensor.
    """
    rng = np.random.default_rng(seed)
    white = rng.normal(0, np.sqrt(1 - smoothing**2), N_READINGS + 1)
    noise = lfilter([1.0], [1.0, -smoothing], white)
    true = np.round(1024 + 0.3 * noise_steps + noise_steps * noise).astype(np.int64)
    torn = (true[:-1] & ~0xFF) | (true[1:] & 0xFF)
    return np.where(rng.random(N_READINGS) < share, torn, true[1:]), true[1:]


def sd_of_means(values, size=8):
    means = values[: len(values) // size * size].reshape(-1, size).mean(axis=1)
    return means.std()


@pytest.mark.parametrize('noise_steps', [250.0, 128.0, 85.0])
def test_the_excess_of_means_by_torn_reads_is_estimated(noise_steps):
    """Errors of 1, 2 and 3 sd, which are not in the tails of the readings."""
    read, true = counts(noise_steps, 0.06, seed=6)
    excess = excess_of_torn_reads(read * 0.0012, 0.0012)
    assert excess.sds > 4
    # Both means have the same noise; 0.01: chance of the errors in 5000 means.
    assert excess.ratio == pytest.approx(sd_of_means(read) / sd_of_means(true), abs=0.02)


def test_torn_reads_within_the_noise_are_named():
    """Noise of 100 steps: the white noise is 8 % too high, and no tail shows it."""
    columns = [counts(100.0, 0.05, seed)[0] for seed in range(5)]
    columns.append(counts(100.0, 0.0, 5)[0])
    values = np.column_stack(columns) * 0.0012
    search = FaultSearch()
    for part in np.array_split(values, 5):
        search.push(part, np.ones(len(part), bool))
    faults = search.result()
    assert faults.named.tolist() == [True] * 5 + [False]
    assert np.all(faults.tails[:5] > 1.05)


@pytest.mark.parametrize('smoothing', [0.0, 0.2, 0.5])
def test_a_filter_of_the_sensor_is_no_tearing(smoothing):
    for noise_steps in (250.0, 100.0):
        read, _ = counts(noise_steps, 0.0, seed=3, smoothing=smoothing)
        assert excess_of_torn_reads(read * 0.0012, 0.0012).sds < 3


def test_noise_within_a_page_and_unknown_steps_have_no_excess():
    read, _ = counts(5.0, 0.0, seed=1)
    assert excess_of_torn_reads((read + 100) * 0.0012, 0.0012).ratio == 1.0
    assert excess_of_torn_reads((read + 0.4) * 0.0012, 0.0012).ratio == 1.0
    assert excess_of_torn_reads(np.full(2000, 0.3), 0.0012).ratio == 1.0
