"""The noise of one sensor where the other one is absent, or its readings cannot be used."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.allan.document import noise_from_text, noise_to_text
from imu_calibration.api.noise import identify_recording
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock

from worlds.noise_worlds import identifying

HZ, SECONDS = 50.0, 200.0
FORCE_SD, RATE_SD = 0.02, 0.0015
"""Standard deviations of a reading, SI."""


def still(seed):
    """Return (stamps, force, rate) of an IMU at rest with white noise."""
    generator, n = np.random.default_rng(seed), int(HZ * SECONDS)
    force = np.array([0.3, -0.2, 9.79]) + FORCE_SD * generator.standard_normal((n, 3))
    rate = np.array([0.01, -0.02, 0.005]) + RATE_SD * generator.standard_normal((n, 3))
    return 10**18 + np.arange(n) * int(1e9 / HZ), force, rate


def identified(stamps, force, rate):
    with identifying(0):  # one sensor is left, and its x axis is compared
        return identify_recording(SampleBlock(ImuSamples(stamps, force, rate, 'imu_link')))


def contains(axis, density):
    """Return whether the interval of the white noise, widened by half, contains the density."""
    low, high = axis.terms['white_noise'].interval
    return low - (high - low) / 4 <= density <= high + (high - low) / 4


@pytest.mark.parametrize('dead', ['nan', 'zero', 'one axis'])
def test_an_accelerometer_with_an_unusable_gyroscope_has_its_noise(dead):
    stamps, force, rate = still(71)
    if dead == 'one axis':
        rate[:, 1] = 0.02
    else:
        rate[:] = {'nan': np.nan, 'zero': 0.0}[dead]
    found = identified(stamps, force, rate)
    assert found.figures.sensors == ('accelerometer',)
    assert contains(found.figures.accelerometer[0], FORCE_SD / np.sqrt(HZ))
    # A sensor that is not there is no fault, one that measures nothing is.
    faulty = dead != 'nan'
    assert list(found.figures.recording.get('unusable', {})) == ['gyroscope'] * faulty
    assert any('gyroscope' in reason for reason in found.reasons) == faulty
    read = noise_from_text(noise_to_text(found.figures))
    assert read.sensors == ('accelerometer',)
    assert read.accelerometer[0].white == pytest.approx(found.figures.accelerometer[0].white)
    assert 'gyroscope sample' not in found.report


def test_coarse_steps_of_one_sensor_do_not_refuse_the_other():
    stamps, force, rate = still(72)
    coarse = np.zeros_like(rate)
    coarse[::500] = 0.01  # changes now and then, so that no axis is frozen
    found = identified(stamps, np.round(force / 5.0) * 5.0 + coarse, rate)
    assert found.figures.sensors == ('gyroscope',)
    assert contains(found.figures.gyroscope[0], RATE_SD / np.sqrt(HZ))


def test_a_gyroscope_without_an_accelerometer_has_its_noise():
    stamps, force, rate = still(73)
    found = identified(stamps, np.full_like(force, np.nan), rate)
    assert found.figures.sensors == ('gyroscope',)
    assert contains(found.figures.gyroscope[0], RATE_SD / np.sqrt(HZ))


def test_two_unusable_sensors_are_refused():
    stamps, force, rate = still(74)
    with refused(InputError, 'frozen'):
        identified(stamps, np.tile([0.0, 0.0, 9.8], (len(stamps), 1)), np.zeros_like(rate))
