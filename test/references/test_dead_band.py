"""A gyroscope that gives rates below a threshold as zero: at rest its bias is hidden."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.core.samples import SampleBlock
from imu_calibration.preprocessing.dead_band import dead_bands

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY, simulate, unpack

BAND = 0.015
"""rad/s"""


@pytest.fixture(scope='module')
def found():
    """Return (calibration, truth) of a gyroscope with biases within its dead band."""
    imu, _, truth = simulate(8, n_poses=18, still=2.5, force_sd=0.005, rate_sd=5e-4)
    hidden = np.array([0.004, -0.006, 0.002])
    rate = imu.rate_s - unpack(truth)[2] + hidden
    banded = replace(imu, rate_s=np.where(np.abs(rate) < BAND, 0.0, rate))
    return (
        calibrate_recordings(SampleBlock(banded), gravity=GRAVITY, candidates=FEW).calibration,
        truth,
        hidden,
    )


def test_the_band_is_named_with_its_threshold(found):
    calibration = found[0]
    named = [each['check'] for each in calibration.statistics['preflight']]
    assert named.count('dead_band') == 1


def test_the_hidden_bias_is_within_its_sd_and_the_other_parameters_are_right(found):
    calibration, truth, hidden = found
    values, sd = calibration.values, calibration.sd
    bias = calibration.model.slices['gyroscope', 'bias']
    matrix = calibration.model.slices['gyroscope', 'matrix']
    assert np.all(np.abs(values[bias] - hidden) < 2 * sd[bias])
    assert 'determined' not in [calibration.status[k] for k in range(bias.start, bias.stop)]
    errors = values[matrix] - unpack(truth)[3].ravel()
    assert np.abs(errors / sd[matrix]).max() < 4.0
    acc = calibration.model.slices['accelerometer', 'bias']
    assert np.abs((values[acc] - truth[:3]) / sd[acc]).max() < 4.0


@pytest.mark.parametrize(
    'kind', ['fine', 'coarse steps', 'zeros for a time', 'one axis with a band']
)
def test_only_a_band_is_a_band(kind):
    """Coarse outputs read zero at rest as well, and a silent bus gives zeros for a time."""
    rng, n, step = np.random.default_rng(9), 12_000, 1e-6
    motion = np.abs(np.sin(np.arange(n) / 300.0))[:, None] ** 3 * [1.0, -0.7, 0.4]
    rate = motion + rng.normal(0.0, 4e-4, (n, 3))
    expected = np.zeros(3)
    if kind == 'coarse steps':
        step = 2e-3
    elif kind == 'zeros for a time':
        rate[4000:7000] = 0.0
    elif kind == 'one axis with a band':
        rate[:, 1] = np.where(np.abs(rate[:, 1]) < BAND, 0.0, rate[:, 1])
        expected[1] = BAND
    rate = np.round(rate / step) * step
    np.testing.assert_allclose(dead_bands(rate, np.full(3, step)), expected, rtol=0.1)


@pytest.mark.parametrize('seed', [32, 34])
def test_rounding_of_slow_rates_is_in_the_standard_deviation(seed):
    """
    Steps of 1 deg/s and noise of a fifth of a step: the mean of a rest is off by a tenth of a step.

    It is off by the same amount in every pose, and at the slow ends of every turn.
    """
    step = np.radians(1.0)
    imu, _, truth = simulate(seed, n_poses=14, still=2.0, force_sd=0.02, rate_sd=0.2 * step)
    coarse = replace(imu, rate_s=np.round(imu.rate_s / step) * step)
    found = calibrate_recordings(SampleBlock(coarse), gravity=GRAVITY, candidates=FEW).calibration
    bias = found.model.slices['gyroscope', 'bias']
    z = (found.values[bias] - unpack(truth)[2]) / found.sd[bias]
    assert np.sqrt(np.mean(z**2)) < 1.3  # 1.9 and 1.5 without the allowance
