"""Readings that wrap around at the end of the range of the converter."""

import numpy as np
import pytest

from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.recording_evidence import WARNING
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner, StreamCheck

RATE = 160.0
RANGE = np.radians(500.0)
"""Of a converter with 32768 counts for +-500 deg/s."""


def turns(peaks, noise=2e-3):
    """True and read samples: a turn of one second about y for each peak, rests between them."""
    rng = np.random.default_rng(6)
    n = int(3 * RATE * len(peaks))
    time = np.arange(n) / RATE
    rate = np.zeros((n, 3))
    for k, peak in enumerate(peaks):
        phase = np.clip(time - 3 * k - 1, 0, 1)
        rate[:, 1] += peak * RANGE * 0.5 * (1 - np.cos(2 * np.pi * phase))
    angle = np.cumsum(rate[:, 1]) / RATE
    force = 9.81 * np.column_stack([-np.sin(angle), np.zeros(n), np.cos(angle)])
    force += rng.normal(0, 0.02, force.shape)
    true = rate + rng.normal(0, noise, rate.shape)
    count = np.round(true / RANGE * 32768).astype(np.int64)
    read = ((count + 32768) % 65536 - 32768) * RANGE / 32768
    stamps = 10**18 + np.round(time * 1e9).astype(np.int64)
    return true, ImuSamples(stamps, force, read, 'imu')


def cleaned(samples, sizes):
    """The accepted samples of a stream that arrives in pieces of these sizes."""
    check, parts, start = StreamCheck(), [], 0
    while start < len(samples):
        size = sizes[len(parts) % len(sizes)]
        parts.append(samples.select(slice(start, start + size)))
        start += size
    accepted = []
    for part in parts:
        accepted += [passed for _, passed in check.push(part)]
    accepted += [passed for _, passed in check.finish()]
    return check, ImuSamples.concatenate([part for part in accepted if len(part)])


@pytest.mark.parametrize('sizes', ((10_000,), (200,), (7, 64, 3)))
def test_motions_that_wrap_are_removed_and_the_others_are_kept(sizes):
    true, samples = turns([0.9, 1.3, -1.15, -0.95])
    wrapped = np.abs(samples.rate_s - true).max(axis=1) > RANGE
    check, kept = cleaned(samples, sizes)
    assert not np.isin(kept.stamp_ns, samples.stamp_ns[wrapped]).any()
    # Two motions wrap; each hole is a gap (0.1 s), and is shorter than half a turn.
    step = np.diff(kept.stamp_ns) * 1e-9
    assert np.sum(step > 0.1) == 2
    assert step.max() < 0.7
    assert check.counts['wrapped'] == len(samples) - len(kept) > wrapped.sum()
    _, whole = cleaned(samples, (10_000,))
    assert np.array_equal(kept.stamp_ns, whole.stamp_ns)


def test_fast_motion_and_clipping_do_not_wrap():
    _, samples = turns([0.99, -0.99, 0.6])
    check, kept = cleaned(samples, (500,))
    assert len(kept) == len(samples) and not check.counts['wrapped']
    true, samples = turns([1.4, -1.2])
    clipped = ImuSamples(
        samples.stamp_ns, samples.force_s, np.clip(true, -RANGE, RANGE), samples.frame_id
    )
    check, kept = cleaned(clipped, (500,))
    assert len(kept) == len(samples) and not check.counts['wrapped']


def test_a_table_that_reverses_between_two_slow_samples_does_not_wrap():
    """At 20 Hz the rate changes from 120 to -120 deg/s within a step: 84 rad/s^2."""
    time = np.arange(400) / 20.0
    rate = np.zeros((400, 3))
    rate[:, 2] = np.where(time % 4 < 2, 2.1, -2.1)
    stamps = 10**18 + np.round(time * 1e9).astype(np.int64)
    samples = ImuSamples(stamps, np.tile([0.0, 0.0, 9.81], (400, 1)), rate, 'imu')
    check, kept = cleaned(samples, (50,))
    assert len(kept) == 400 and not check.counts['wrapped']


def test_a_sensor_that_is_shaken_does_not_wrap():
    """Slow samples of an oscillation change sign in one step, far within the range."""
    rng = np.random.default_rng(4)
    n, step = 6000, 0.016
    # A sum of oscillations between 5 and 25 Hz, sampled at 62.5 Hz.
    phase = 2 * np.pi * np.outer(np.arange(n) * step, rng.uniform(5, 25, 12))
    values = np.sqrt(2 / 12) * np.sin(phase[:, :, None] + rng.uniform(0, 6, (12, 6))).sum(axis=1)
    values *= [25.0] * 3 + [6.0] * 3
    stamps = 10**18 + np.round(np.arange(n) * step * 1e9).astype(np.int64)
    check, kept = cleaned(ImuSamples(stamps, values[:, :3], values[:, 3:], 'imu'), (900,))
    assert not check.counts['wrapped']


def test_wraps_of_two_axes_do_not_depend_on_the_pieces():
    """Motions about x that begin while one about y is wrapped, in pieces of random sizes."""
    _, about_y = turns([1.3, -1.2, 1.25, 1.1, -1.3])
    _, about_x = turns([1.2, 1.2, -1.3, -1.1, 1.3])
    rate = about_y.rate_s.copy()
    late = int(0.2 * RATE)
    rate[late:, 0] = about_x.rate_s[:-late, 1]
    samples = ImuSamples(about_y.stamp_ns, about_y.force_s, rate, 'imu')
    _, whole = cleaned(samples, (10_000,))
    assert np.sum(np.diff(whole.stamp_ns) > 10**8) == 5
    rng = np.random.default_rng(7)
    for _ in range(6):
        check, kept = cleaned(samples, tuple(rng.integers(1, 60, 50)))
        assert np.array_equal(kept.stamp_ns, whole.stamp_ns)
        assert check.counts['wrapped'] == len(samples) - len(whole)


def test_wrapped_motions_are_named():
    _, samples = turns([1.2, 0.5, -1.2, 0.8])
    preflight = Preflight(strict=False)
    cleaner = BlockCleaner(watchers=[preflight])
    for _ in cleaner.all_of([SampleBlock(samples)]):
        pass
    count = cleaner.counts['imu wrapped']
    (finding,) = [
        finding
        for finding in preflight.findings
        if finding.check == 'stamps' and str(count) in finding.text
    ]
    assert finding.severity == WARNING
