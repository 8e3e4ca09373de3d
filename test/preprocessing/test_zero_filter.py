"""A bus that gives zeros for a moment: no readings, and no rest of the gyroscope."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.preprocessing.zero_filter import ZeroFilter

from worlds.hand_sessions import GRAVITY, simulate, unpack

PERIOD_NS = 5_000_000
LONG = (1000, 1400)
"""Two seconds of zeros: found as a frozen sensor, and not by the filter."""
SHORT = ((100, 101), (300, 380), (700, 890), (1400 + 50, 1400 + 60), (1990, 2000))


def stream(absent_force=False):
    """Return samples with zeros in some spans, and the flags of the short ones."""
    rng, n = np.random.default_rng(3), 2000
    force = rng.normal(0.0, 0.02, (n, 3)) + [0.0, 0.0, GRAVITY]
    rate = rng.normal(0.0, 1e-3, (n, 3))
    short = np.zeros(n, bool)
    for start, stop in SHORT:
        short[start:stop] = True
    zero = short.copy()
    zero[slice(*LONG)] = True
    zero[:20] = True  # not known yet whether there is an accelerometer
    force[zero], rate[zero] = 0.0, 0.0
    if absent_force:
        force[:] = 0.0
    stamps = 10**18 + PERIOD_NS * np.arange(n, dtype=np.int64)
    return ImuSamples(stamps, force, rate, 'imu_link'), short


@pytest.mark.parametrize('size', [1, 7, 150, 2000])
def test_short_runs_are_dropped_whatever_the_pieces(size):
    imu, short = stream()
    zeros = ZeroFilter()
    passed = [zeros.push(imu.select(slice(k, k + size))) for k in range(0, len(imu), size)]
    zeros.finish()
    stamps = np.concatenate([part.stamp_ns for part in passed])
    assert np.array_equal(stamps, imu.stamp_ns[~short])
    assert zeros.n_dropped == np.count_nonzero(short)


def test_zeros_of_a_gyroscope_without_an_accelerometer_pass():
    imu, _ = stream(absent_force=True)
    zeros = ZeroFilter()
    assert len(zeros.push(imu)) == len(imu) and zeros.finish() == 0


def test_zeros_in_turns_do_not_reach_the_matrix():
    """Each run lies in a turn: 0.2 to 0.5 s of its rate would be lost (1 to 20 % of its angle)."""
    imu, ranges, truth = simulate(12, n_poses=16, still=2.0, force_sd=0.004, rate_sd=4e-4)
    force, rate, rng = imu.force_s.copy(), imu.rate_s.copy(), np.random.default_rng(4)
    n_zero = 0
    for before in ranges[2:14:3]:
        start, stop = before.stop + 5, before.stop + 5 + int(rng.integers(10, 25))
        force[start:stop], rate[start:stop] = 0.0, 0.0
        n_zero += stop - start
    broken = replace(imu, force_s=force, rate_s=rate)
    found = calibrate_recordings(
        SampleBlock(broken), gravity=GRAVITY, model_as_asked=True
    ).calibration
    assert found.statistics['dropped']['imu zero'] == n_zero
    matrix = found.model.slices['gyroscope', 'matrix']
    errors = found.values[matrix] - unpack(truth)[3].ravel()
    assert np.abs(errors / found.sd[matrix]).max() < 4.0
    assert found.sd[matrix].max() < 3e-3
