"""
Residual power by band: a sine of known size in known noise, and its agreement with a held-out gain.
"""

import numpy as np
import pytest

from imu_calibration.calibration.diagnosis.traces import DistanceSums
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.preprocessing.window import Window, WindowKind

NOISE = {sensor: SensorNoise(np.full(3, 0.01**2), np.ones(3)) for sensor in SENSORS}


def window(kind, n, start):
    time = start + 0.01 * np.arange(n)
    still = np.zeros((n, 1))
    return Window(
        kind,
        np.arange(n),
        time,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
        JointMotion(time, still, still, still, still),
    )


@pytest.fixture(scope='module')
def distance():
    """
    Distances of 40 windows of 10 s at 100 Hz.

    Before, x has a sine of 0.02 at 3 Hz in motion and y an offset of 0.005; after, none.
    """
    sums, rng = DistanceSums(), np.random.default_rng(4)
    for k in range(40):
        kind = WindowKind.STATIC if k % 2 else WindowKind.DYNAMIC
        own = window(kind, 1000, 10.0 * k)
        after = {sensor: rng.normal(0, 0.01, (1000, 3)) for sensor in SENSORS}
        error = np.zeros((1000, 3))
        error[:, 0] = 0.02 * np.sin(2 * np.pi * 3 * own.time) if kind is WindowKind.DYNAMIC else 0.0
        error[:, 1] = 0.005
        sums.add(own, [{sensor: value + error for sensor, value in after.items()}, after], NOISE)
    return sums.distances()['gyroscope']


def test_the_power_of_a_sine_is_in_its_band(distance):
    """
    Half of the windows have an rms of 0.02 / sqrt(2): 0.01 over all.

    The sd of a band's noise power is some percent of it.
    """
    bands = {name: (rms, noise) for name, rms, noise in distance.bands()}
    rms, noise = bands['1 to 10 Hz']
    assert rms[0] == pytest.approx([0.01, 0.0, 0.0], abs=1.2e-3)
    assert rms[1] == pytest.approx([0.0, 0.0, 0.0], abs=1.2e-3)
    assert noise == pytest.approx(np.full(3, 0.01 * np.sqrt(9 / 50)), rel=0.05)
    assert bands['10 to 46.4 Hz'][0] == pytest.approx(np.zeros((2, 3)), abs=1.5e-3)


def test_no_band_reaches_the_nyquist_frequency(distance):
    """50 Hz here; a part of a band that the Nyquist frequency cuts would be a band too small."""
    highest = [float(name.split()[-2]) for name, _, _ in distance.bands()[1:]]
    assert max(highest) == pytest.approx(46.4, abs=0.05)


def test_an_offset_is_in_the_window_means(distance):
    name, rms, noise = distance.bands()[0]
    assert name == 'window means' and rms[0] == pytest.approx([0.0, 0.005, 0.0], abs=3e-4)
    assert noise == pytest.approx(np.full(3, 0.01 / np.sqrt(1000)), rel=1e-12)


def test_the_bands_and_the_means_have_all_of_the_power(distance):
    """Parseval: mean square of the residual of all samples."""
    total = distance.power[0].sum(axis=0) + distance.means[0]
    assert np.sqrt(total.mean()) == pytest.approx(
        distance.gains['samples'].heldout_rms_before, rel=1e-9
    )


def test_the_density_of_white_noise_is_flat(distance):
    frequency, residual, noise = distance.density()
    assert np.all((frequency > 0.08) & (frequency < 60))
    assert np.median(noise) == pytest.approx(0.01 / np.sqrt(50), rel=0.05)
    assert residual.shape == (2, len(frequency), 3)
