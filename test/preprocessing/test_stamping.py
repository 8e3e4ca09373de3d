"""
Regular times drawn through the stamps that drivers make, for calibration, streams and checks alike.
"""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_rate_slope import PERIOD_NS, START, stamps_of

from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.stamping import (
    COUNTED,
    IRREGULAR,
    REGULAR,
    SampleTimes,
    describe_stamps,
)
from imu_calibration.preprocessing.stream_cleaning import BlockCleaner

N = 3000
TRUE = START + PERIOD_NS * np.arange(N)


def samples(stamp_ns, keep=slice(None)):
    """Samples of a lively motion; reading x of the rate counts them."""
    number = np.arange(len(stamp_ns), dtype=float)
    force = np.column_stack([np.sin(number / 30), np.cos(number / 50), np.full(len(number), 9.8)])
    rate = np.column_stack([number, np.cos(number / 20), np.sin(number / 20)])
    return ImuSamples(np.asarray(stamp_ns)[keep], force[keep], rate[keep], 'imu_link')


def timed(imu, cuts=()):
    """(numbers of the samples, their times) as SampleTimes gives them."""
    times, bounds = SampleTimes(), [0, *cuts, len(imu)]
    parts = [times.push(imu.select(slice(a, b))) for a, b in zip(bounds, bounds[1:]) if b > a] + [
        times.finish()
    ]
    whole = ImuSamples.concatenate([part for part in parts if part is not None])
    return whole.rate_s[:, 0].astype(int), whole.stamp_ns, times


@pytest.mark.parametrize(
    ('kind', 'off_ms'),
    (
        ('regular', 0.0),
        ('milliseconds', 1.0),
        ('usb packets', 1.0),
        ('arrival', 2.5),
        ('jitter', 2.0),
    ),
)
def test_times_are_those_of_the_sampling(kind, off_ms):
    """
    Up to a constant, and to a share of the scatter that one block of 64 cannot average out.

    8 samples at once are off by 35 ms as they come.
    """
    rng = np.random.default_rng(3)
    number, times, state = timed(samples(stamps_of(kind, TRUE, rng)))
    assert np.array_equal(number, np.arange(N))
    off = (times - TRUE).astype(float)[100:]
    assert np.quantile(np.abs(off - np.median(off)), 0.99) <= 1e6 * off_ms
    assert (
        state.n_rebuilt > 0.9 * N
        if kind == 'usb packets'
        else kind == 'jitter' or not state.n_rebuilt
    )


@pytest.mark.parametrize('lost', (8, 16, 80))
def test_packets_that_are_lost_leave_a_gap_of_their_length(lost):
    keep = np.delete(np.arange(N), np.arange(1600, 1600 + lost))
    number, times, _ = timed(samples(stamps_of('usb packets', TRUE, None), keep))
    assert np.array_equal(number, keep)
    off = (times - TRUE[keep]).astype(float)[100:]
    assert np.quantile(np.abs(off - np.median(off)), 0.99) < 0.2 * PERIOD_NS


@given(
    st.sampled_from(('regular', 'usb packets', 'arrival', 'jitter', 'runaway', 'zeros')),
    st.lists(st.integers(1, 900), max_size=6),
)
def test_the_outcome_does_not_depend_on_how_the_stream_is_cut(kind, cuts):
    imu = samples(stamps_of(kind, TRUE[:900], np.random.default_rng(1)))
    whole, cut = timed(imu), timed(imu, sorted(cuts))
    np.testing.assert_array_equal(whole[0], cut[0])
    np.testing.assert_array_equal(whole[1], cut[1])


def test_stamps_that_follow_no_clock_stay_as_they_are():
    rng = np.random.default_rng(4)
    stamps = stamps_of('runaway', TRUE, rng)
    assert describe_stamps(stamps).word == IRREGULAR
    number, times, _ = timed(samples(stamps))
    # By chance 256 of them may look like those of a clock.
    assert np.mean(times == stamps[number]) > 0.75


@pytest.mark.parametrize('factor', (0.5, 0.8, 2.0))
def test_a_rate_that_changes_is_followed(factor):
    true_ns = START + np.cumsum(np.repeat([PERIOD_NS, round(factor * PERIOD_NS)], N)).astype(
        np.int64
    )
    _, times, _ = timed(samples(stamps_of('usb packets', true_ns, None)))
    step = np.diff(times)
    assert np.median(step[: N - 200]) == pytest.approx(PERIOD_NS, rel=0.01) and np.median(
        step[N + 600 :]
    ) == pytest.approx(factor * PERIOD_NS, rel=0.01)


def test_lost_repeated_and_swapped_samples_are_no_fault_of_the_stamps():
    rng = np.random.default_rng(5)
    keep = np.sort(rng.choice(N, N // 2, replace=False))
    assert describe_stamps(TRUE[keep]).word == REGULAR and describe_stamps(
        TRUE[keep]
    ).period_ns == pytest.approx(PERIOD_NS, rel=1e-6)
    swapped = TRUE.copy()
    swapped[10:1000:40], swapped[11:1000:40] = TRUE[11:1000:40], TRUE[10:1000:40]
    assert describe_stamps(swapped).word == REGULAR
    assert describe_stamps(TRUE[:10]) is None


def findings(imu, notes=None):
    """Return the findings of the checks before a calibration, of a stream."""
    check = Preflight(strict=False)
    cleaner = BlockCleaner(watchers=[check])
    for start in range(0, len(imu), 500):
        cleaner.push(
            SampleBlock(imu.select(slice(start, start + 500)), notes=notes if not start else None)
        )
    cleaner.finish()
    return check.findings


def test_inspect_sees_the_same():
    counted = findings(samples(stamps_of('usb packets', TRUE, None)))
    assert any(f.check == 'jitter' and {'8'} <= set(re.findall(r'\d+', f.text)) for f in counted)
    assert not any((f.check, f.severity) == ('sampling', 'warning') for f in counted)
    irregular = findings(samples(stamps_of('runaway', TRUE, np.random.default_rng(4))))
    assert ('jitter', 'warning') in [(f.check, f.severity) for f in irregular]
    assert not any(f.check == 'jitter' for f in findings(samples(TRUE)))
    zero = findings(samples(TRUE), {'Imu zero stamp': 400})
    assert [
        f.severity
        for f in zero
        if f.check == 'stamps' and {'400', str(N)} <= set(re.findall(r'\d+', f.text))
    ] == ['warning']
    assert describe_stamps(stamps_of('usb packets', TRUE, None)).word == COUNTED


@pytest.mark.parametrize(('rate', 'draw'), [(100, 'normal'), (200, 'normal'), (200, 'uniform')])
def test_symmetric_jitter_in_order_is_no_lateness(rate, draw):
    """
    Times went through the earliest stamps, 3 to 7 ms early.

    Where jitter was wider than the period and no stamp overtook another.
    """
    for seed in range(4):
        rng, true_ns = (
            np.random.default_rng(seed),
            START + np.round(1e9 / rate * np.arange(N)).astype(np.int64),
        )
        jitter = rng.normal(0, 3e6, N) if draw == 'normal' else rng.uniform(-3e6, 3e6, N)
        stamps = np.maximum.accumulate(true_ns + jitter.astype(np.int64)) + np.arange(N)
        number, times, state = timed(samples(stamps))
        assert np.array_equal(number, np.arange(N)) and state.n_rebuilt > 0.9 * N
        off = 1e-6 * (times - true_ns)
        # The mean of 64 scatters by 0.37 ms; values that keep the order are late by 0.3 ms at 200
        # Hz.
        assert abs(off.mean()) < 0.6 and off.std() < 0.7


def lossy_and_late(seed, *, rate_hz, lateness, share, burst, seconds=100.0):
    """
    Return (samples, errors of their stamps in ns): losses in bursts, lateness grows with the rate.

    Stamps are strictly increasing.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate_hz)) / rate_hz
    turning = np.abs(np.sin(2 * np.pi * time / 7)) * (np.sin(2 * np.pi * time / 40) > -0.3)
    late = lateness * turning * rng.exponential(1.0, len(time)) + 1e-4 * rng.random(len(time))
    stamp = np.maximum.accumulate(time + late) + 1e-9 * np.arange(len(time))
    keep, at = np.ones(len(time), bool), 0
    while at < len(time):
        at += int(rng.exponential(burst / share))
        lost = 1 + int(rng.exponential(burst))
        keep[at : at + lost] = False
        at += lost
    imu = samples(START + np.rint(1e9 * stamp).astype(np.int64), keep)
    return imu, START + np.rint(1e9 * time).astype(np.int64)


@pytest.mark.parametrize(
    ('rate_hz', 'lateness', 'share', 'burst'),
    (
        (200.0, 4e-3, 0.1, 8),
        (200.0, 4e-3, 0.2, 20),
        (100.0, 8e-3, 0.1, 8),
        # about half of the samples are lost, so that the mean step is twice the period
        (100.0, 2e-3, 1.0, 30),
        (50.0, 4e-3, 1.5, 20),
    ),
)
def test_computed_times_across_bursts_of_losses_are_no_worse_than_the_stamps(
    rate_hz, lateness, share, burst
):
    imu, true = lossy_and_late(4, rate_hz=rate_hz, lateness=lateness, share=share, burst=burst)
    cleaner = BlockCleaner()
    kept = [imu for cleaned in cleaner.all_of([SampleBlock(imu)]) for _, imu in cleaned.imu]
    found = ImuSamples.concatenate(kept)
    computed = found.stamp_ns - true[found.rate_s[:, 0].astype(int)]
    recorded = imu.stamp_ns - true[imu.rate_s[:, 0].astype(int)]
    assert computed.std() < 1.1 * recorded.std()
    assert np.abs(computed).max() < 1.2 * np.abs(recorded).max()
    assert len(imu) - len(found) < 0.002 * len(imu)


@pytest.mark.parametrize(
    ('seed', 'rate_hz', 'share', 'burst'),
    (
        # Two samples without a clock of their own were up to 0.48 s wrong, on the line before them.
        (9430, 50.0, 1.5, 20),
        (9446, 50.0, 1.5, 20),
        # Parts of 18 to 43 samples were 17 to 29 ms off their clock, within the scatter of a block.
        (9805, 100.0, 0.5, 20),
        (9807, 100.0, 1.0, 30),
    ),
)
def test_parts_between_bursts_of_losses_keep_their_clock(seed, rate_hz, share, burst):
    imu, true = lossy_and_late(seed, rate_hz=rate_hz, lateness=4e-3, share=share, burst=burst)
    kept = [imu for part in BlockCleaner().all_of([SampleBlock(imu)]) for _, imu in part.imu]
    found = ImuSamples.concatenate(kept)
    computed = found.stamp_ns - true[found.rate_s[:, 0].astype(int)]
    recorded = imu.stamp_ns - true[imu.rate_s[:, 0].astype(int)]
    assert computed.std() < 1.1 * recorded.std()


def test_computed_times_are_in_the_order_of_the_stamps():
    imu, _ = lossy_and_late(17, rate_hz=200.0, lateness=4e-3, share=0.5, burst=20)
    assert np.all(np.diff(imu.stamp_ns) > 0)
    number, times, state = timed(imu)
    assert state.n_rebuilt > 0 and len(number) == len(imu)
    assert np.all(np.diff(times) > 0)
