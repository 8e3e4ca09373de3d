"""A rest in which the IMU is tilted slowly."""

import numpy as np
import pytest
from refusal import refused

from imu_calibration.allan.identify import identify_noise
from imu_calibration.allan.moved_at_rest import tilt_at_rest
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import ImuSamples, SampleBlock

RATE = 50.0


def readings(seconds, amplitude, *, gyroscope=1.0, warm_up=0.0):
    """Time and readings at rest that tilt by a sine of 40 s; rates times `gyroscope`."""
    rng = np.random.default_rng(6)
    time = np.arange(int(seconds * RATE)) / RATE
    frequency = 2 * np.pi / 40
    angle = amplitude * np.sin(frequency * time)
    force = 9.81 * np.column_stack([0 * time, np.sin(angle), np.cos(angle)])
    rate = np.zeros_like(force)
    rate[:, 0] = gyroscope * amplitude * frequency * np.cos(frequency * time)
    settling = warm_up * np.exp(-time / 60)[:, None]
    force += 0.1 * settling + rng.normal(0, 0.01, force.shape)
    rate += 1e-4 * settling + 0.003 + rng.normal(0, 1e-3, rate.shape)
    return time, np.hstack([force, rate])


def means(time, values, size=12):
    n = len(time) // size * size
    return time[:n].reshape(-1, size).mean(axis=1), values[:n].reshape(-1, size, 6).mean(axis=1)


@pytest.mark.parametrize(('seconds', 'amplitude'), [(200, 0.02), (150, 0.0015), (900, 0.0015)])
def test_a_slow_tilt_is_measured(seconds, amplitude):
    """The small ones are below the noise of the accelerometer, and of the sum of the rates."""
    found = tilt_at_rest(*means(*readings(seconds, amplitude)))
    assert found == pytest.approx(amplitude / 2**0.5, rel=0.1)


@pytest.mark.parametrize(
    'rest',
    [
        readings(200, 0.0),
        readings(200, 0.0, warm_up=1.0),
        readings(200, 0.02, gyroscope=0.0),  # the bias of the accelerometer oscillates
        readings(200, 2e-4),
    ],
)
def test_drift_and_noise_are_no_tilt(rest):
    assert tilt_at_rest(*means(*rest)) == 0.0


def test_noise_of_a_tilted_rest_is_refused():
    time, values = readings(200, 0.02)
    imu = ImuSamples(
        10**18 + np.round(time * 1e9).astype(np.int64), values[:, :3], values[:, 3:], 'imu'
    )
    with refused(InputError, 'moved_at_rest') as caught:
        identify_noise([SampleBlock(imu)])
    assert caught.value.key == 'exclude'
