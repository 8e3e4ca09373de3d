"""Two IMUs in one stream: found by two clusters, refused; one IMU is never mistaken for two."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner, StreamCheck
from imu_calibration.preprocessing.two_sources import TwoSourceSearch

PERIOD_NS = 8_000_000
BIAS = np.array([0.21, -0.13, 0.07, 0.011, 0.004, -0.006])
"""Difference of the second sensor, m/s^2 and rad/s."""
NOISE = np.array([0.011, 0.012, 0.013, 0.0012, 0.0011, 0.0010])


def still(generator, n):
    """Outputs of one sensor at rest, shape (n, 6)."""
    return np.array([0.4, -0.3, 9.79, 0, 0, 0]) + NOISE * generator.standard_normal((n, 6))


def samples_of(outputs, stamp_ns=None):
    stamps = 10**18 + PERIOD_NS * np.arange(len(outputs)) if stamp_ns is None else stamp_ns
    return ImuSamples(stamps, outputs[:, :3], outputs[:, 3:])


def searched(outputs, stamp_ns=None):
    search = TwoSourceSearch()
    search.push(samples_of(outputs, stamp_ns))
    return search


@pytest.mark.parametrize('order', ['alternate', 'drivers of different rates'])
def test_two_sensors_are_found(order):
    generator = np.random.default_rng(61)
    outputs = still(generator, 2400)
    second = np.arange(2400) % 2 == 1
    if order != 'alternate':
        second = generator.random(2400) < 0.4
    outputs[second] += BIAS
    assert searched(outputs).found


def test_cuts_of_the_stream_do_not_matter():
    outputs = still(np.random.default_rng(62), 1000)
    outputs[::2] += BIAS
    pieces, complete = TwoSourceSearch(), searched(outputs)
    for start in range(0, 1000, 37):
        pieces.push(samples_of(outputs).select(slice(start, start + 37)))
    assert (pieces.n_runs, pieces.n_double) == (complete.n_runs, complete.n_double)
    assert complete.n_double == complete.n_runs == 41


def test_one_sensor_is_not_two():
    generator = np.random.default_rng(63)
    outputs = still(generator, 4800)
    assert not searched(outputs).found
    # Steps of the converter that are coarser than the noise, and torn readings on one axis.
    coarse = np.round(outputs / 0.05) * 0.05
    assert not searched(coarse).found
    torn = outputs.copy()
    torn[generator.random(4800) < 0.3, 1] += 0.5
    assert not searched(torn).found
    # Vibration on all axes near half the sampling rate, and turns from face to face.
    phase = 2 * np.pi * 0.48 * np.arange(4800)
    vibrating = outputs + np.sin(phase)[:, None] * 50 * NOISE
    assert not searched(vibrating).found
    stepping = outputs + 9.0 * np.sin(2 * np.pi * np.arange(4800) / 90)[:, None] * (NOISE > 0)
    assert not searched(stepping).found


def test_every_reader_refuses_two_sensors():
    generator = np.random.default_rng(64)
    outputs = np.repeat(still(generator, 1200), 2, axis=0)
    outputs += NOISE * generator.standard_normal(outputs.shape)
    outputs[1::2] += BIAS
    stamp_ns = 10**18 + PERIOD_NS * np.repeat(np.arange(1200), 2)
    preflight = Preflight()
    cleaner = BlockCleaner(watchers=[preflight])
    with refused(InputError, 'one_source', '50 %') as caught:
        list(cleaner.all_of([SampleBlock(samples_of(outputs, stamp_ns))]))
    assert caught.value.key == 'imu_topic'


def test_the_live_pass_refuses_two_sensors():
    outputs = still(np.random.default_rng(65), 1200)
    check = StreamCheck()
    check.push(samples_of(outputs))
    check.sources.require_one()
    outputs[::2] += BIAS
    mixed = StreamCheck()
    mixed.push(samples_of(outputs))
    with refused(InputError, 'one_source') as caught:
        mixed.sources.require_one()
    assert caught.value.key == 'imu_topic'
