"""Cleaning of one stream: what is dropped, why, and independence of the cuts."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from imu_calibration.core.samples import ImuSamples, JointSamples, TemperatureSamples
from imu_calibration.preprocessing.stream_cleaning import StreamCheck

from worlds.cleaning import clean_samples

S = 10**9
START = 1_700_000_000 * S


def imu(stamp_ns):
    stamp_ns = np.asarray(stamp_ns, np.int64)
    values = np.arange(3.0 * len(stamp_ns)).reshape(-1, 3)
    return ImuSamples(stamp_ns, values, -values)


def regular(n, period_ns=5_000_000, start=START):
    return start + period_ns * np.arange(n)


def test_clean_stream_passes_untouched():
    samples = imu(regular(100))
    (epoch,), statistics = clean_samples(samples)
    np.testing.assert_array_equal(epoch.stamp_ns, samples.stamp_ns)
    np.testing.assert_array_equal(epoch.force_s, samples.force_s)
    assert statistics.dropped == {}
    assert statistics.count == 100
    assert statistics.duration == pytest.approx(0.495)
    assert statistics.period == pytest.approx(0.005, rel=1e-12)
    assert statistics.rate == pytest.approx(200.0)
    assert (statistics.n_gaps, statistics.gap_total, statistics.stamp_step_ns) == (
        0,
        0.0,
        5_000_000,
    )


def test_not_finite_samples_are_dropped_and_counted():
    samples = imu(regular(100))
    samples.force_s[10:13, 1] = np.nan
    samples.rate_s[50, 2] = np.inf
    (epoch,), statistics = clean_samples(samples)
    assert statistics.dropped == {'not finite': 4}
    np.testing.assert_array_equal(epoch.stamp_ns, np.delete(samples.stamp_ns, [10, 11, 12, 50]))


def test_missing_joint_velocity_is_not_a_fault():
    joints = JointSamples(regular(10), np.zeros((10, 2)), np.full((10, 2), np.nan), ('a', 'b'))
    (epoch,), statistics = clean_samples(joints)
    assert len(epoch) == 10 and statistics.dropped == {} and epoch.names == ('a', 'b')


def test_first_of_repeated_stamps_stays():
    stamps = regular(100)
    stamps[41] = stamps[40]
    samples = imu(stamps)
    (epoch,), statistics = clean_samples(samples)
    assert statistics.dropped == {'repeated stamp': 1}
    np.testing.assert_array_equal(epoch.force_s, np.delete(samples.force_s, 41, axis=0))


def test_late_samples_are_dropped_in_place():
    order = np.arange(100)
    order[[20, 21, 22]] = [22, 20, 21]
    (epoch,), statistics = clean_samples(imu(regular(100)[order]))
    assert statistics.dropped == {'backward stamp': 2}
    assert np.all(np.diff(epoch.stamp_ns) > 0)


def test_clock_reset_starts_a_new_epoch_and_drops_nothing():
    stamps = np.concatenate([regular(100), regular(50, start=START - 5 * S)])
    epochs, statistics = clean_samples(imu(stamps))
    assert [len(epoch) for epoch in epochs] == [100, 50]
    assert statistics.dropped == {'clock reset': 1}
    assert statistics.longest_step == pytest.approx(0.005)


def test_clock_that_learns_the_date_starts_a_new_epoch():
    epochs, statistics = clean_samples(imu(np.concatenate([regular(50, start=0), regular(100)])))
    assert [len(epoch) for epoch in epochs] == [50, 100]
    assert statistics.duration == pytest.approx(0.245 + 0.495)


@pytest.mark.parametrize(
    'wrong, place',
    [(0, 0), (0, 50), (START + 7200 * S, 0), (START + 7200 * S, 50), (START - 10 * S, 50)],
)
def test_single_stray_stamp_is_no_reset(wrong, place):
    stamps = regular(100)
    stamps[place] = wrong
    epochs, statistics = clean_samples(imu(stamps))
    assert [len(epoch) for epoch in epochs] == [99]
    assert statistics.dropped == {'stray stamp': 1}


def test_gap_statistics():
    stamps = np.delete(regular(2000), np.r_[400:800, 1000:1040])
    (_,), statistics = clean_samples(imu(stamps))
    assert statistics.n_gaps == 2
    assert statistics.gap_total == pytest.approx((401 + 41) * 0.005)
    assert statistics.longest_step == pytest.approx(401 * 0.005)


def test_slow_stream_has_no_gaps_of_its_own():
    temperature = TemperatureSamples(regular(30, period_ns=2 * S), np.linspace(20, 30, 30))
    (epoch,), statistics = clean_samples(temperature)
    assert len(epoch) == 30 and statistics.n_gaps == 0 and statistics.dropped == {}


def test_millisecond_stamps_are_recognised():
    stamps = START + 1_000_000 * np.round(
        10 * np.arange(500) + np.random.default_rng(0).normal(0, 0.4, 500)
    ).astype(np.int64)
    _, statistics = clean_samples(imu(stamps))
    assert statistics.stamp_step_ns == 1_000_000


STEPS = st.sampled_from(
    [5_000_000] * 12 + [0, -5_000_000, -900_000_000, -3 * S, 2 * S, 4000 * S, -4000 * S]
)


@given(
    st.lists(STEPS, min_size=1, max_size=60),
    st.lists(st.integers(0, 60), max_size=12),
    st.lists(st.integers(0, 59), max_size=4),
)
@example([5_000_000, -3 * S, 2 * S], [1], [])  # no overflow: the period is not known
def test_outcome_does_not_depend_on_the_cuts(steps, cuts, holes):
    samples = imu(START + np.cumsum(steps))
    samples.rate_s[[hole for hole in holes if hole < len(steps)]] = np.nan
    whole, expected = clean_samples(samples)
    check, pieces = StreamCheck(), []
    bounds = sorted({0, len(steps), *(cut for cut in cuts if cut < len(steps))})
    for start, stop in zip(bounds[:-1], bounds[1:]):
        pieces += check.push(samples.select(slice(start, stop)))
    pieces += check.finish()
    for number, epoch in zip(sorted({n for n, part in pieces if len(part)}), whole, strict=True):
        joined = ImuSamples.concatenate([part for n, part in pieces if n == number])
        np.testing.assert_array_equal(joined.stamp_ns, epoch.stamp_ns)
        np.testing.assert_array_equal(joined.force_s, epoch.force_s)
        assert np.all(np.diff(joined.stamp_ns) > 0)
    statistics = check.statistics()
    assert statistics.dropped == expected.dropped
    assert (statistics.count, statistics.period, statistics.longest_step) == (
        expected.count,
        expected.period,
        expected.longest_step,
    )
    dropped = sum(
        number for reason, number in statistics.dropped.items() if reason != 'clock reset'
    )
    assert dropped + statistics.count == len(steps)
