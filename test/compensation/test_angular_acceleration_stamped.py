"""The derivative of a stream with lost, late and doubled samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_angular_acceleration import slopes

from imu_calibration.compensation.angular_acceleration import (
    CausalDerivative,
    StampedDerivative,
    typical_period,
)
from imu_calibration.preprocessing.stamping import MIN_PERIOD_STEPS

PERIOD_NS = 5_000_000


def one_by_one(tracker, stamps, values):
    return np.array([tracker.push(int(s), *v) for s, v in zip(stamps, values.tolist())]).reshape(
        -1, 3
    )


def tracker(taps=4):
    return StampedDerivative(CausalDerivative(taps, PERIOD_NS * 1e-9))


def ramp(stamps, slope=(2.0, -3.0, 0.5)):
    return np.outer(stamps * 1e-9, slope) + [1.0, 2.0, 3.0]


STEPS = st.sampled_from([0, 1, 1, 1, 1, 1, 1, 1, 2, 4, 15, -3, -400, 1.2, 0.3])


@given(st.integers(2, 9), st.lists(STEPS, min_size=1, max_size=120), st.data())
def test_blocks_give_the_same_as_samples_however_the_stream_is_cut(taps, steps, data):
    stamps = 10**18 + np.cumsum(np.array(steps) * PERIOD_NS).astype(np.int64)
    values = np.random.default_rng(len(steps)).normal(size=(len(steps), 3))
    cut = data.draw(st.integers(0, len(steps)))
    blocks = tracker(taps)
    got = np.concatenate(
        [
            blocks.push_block(stamps[:cut], values[:cut]),
            blocks.push_block(stamps[cut:], values[cut:]),
        ]
    )
    # Values of 1 over 5 ms: rounding of 1e-13 x 200.
    np.testing.assert_allclose(got, one_by_one(tracker(taps), stamps, values), atol=1e-9)


@given(st.integers(2, 9), st.lists(st.sampled_from([1, 1, 1, 1, 2, 0]), min_size=20, max_size=60))
def test_a_ramp_has_its_slope_in_spite_of_lost_and_doubled_samples(taps, steps):
    stamps = 10**18 + np.cumsum(np.array(steps) * PERIOD_NS).astype(np.int64)
    alpha = one_by_one(tracker(taps), stamps, ramp(stamps - stamps[0]))
    reached = np.cumsum(np.array(steps) > 0) > taps
    np.testing.assert_allclose(
        alpha[reached], np.broadcast_to([2.0, -3.0, 0.5], alpha[reached].shape), atol=1e-9
    )


def test_the_full_window_is_the_plain_causal_derivative():
    stamps = 10**18 + PERIOD_NS * np.arange(50)
    values = np.random.default_rng(1).normal(size=(50, 3))
    np.testing.assert_allclose(
        tracker(5).push_block(stamps, values)[4:],
        slopes(CausalDerivative(5, PERIOD_NS * 1e-9), values),
        atol=1e-10,
    )


@pytest.mark.parametrize('step_ns', [8 * PERIOD_NS, -2_000_000_000])
def test_a_long_hole_and_a_clock_set_back_start_the_window_anew(step_ns):
    stamps = 10**18 + PERIOD_NS * np.arange(20)
    tracked = tracker(4)
    one_by_one(tracked, stamps, ramp(stamps - stamps[0]))
    later = stamps[-1] + step_ns + PERIOD_NS * np.arange(6)
    alpha = one_by_one(tracked, later, ramp(later - later[0]) + 1e3)
    assert np.all(alpha[0] == 0.0)
    np.testing.assert_allclose(alpha[3:], np.broadcast_to([2.0, -3.0, 0.5], (3, 3)), atol=1e-8)


def test_a_sample_that_came_late_changes_nothing():
    stamps = 10**18 + PERIOD_NS * np.arange(20)
    tracked = tracker(4)
    before = one_by_one(tracked, stamps, ramp(stamps - stamps[0]))[-1]
    assert tracked.push(int(stamps[-3]), 99.0, 99.0, 99.0) == tuple(before)
    after = stamps[-1] + PERIOD_NS
    np.testing.assert_allclose(
        tracked.push(int(after), *ramp(np.array([after - stamps[0]]))[0]),
        [2.0, -3.0, 0.5],
        atol=1e-9,
    )


def test_rounding_does_not_add_up():
    n = 20_000
    rng = np.random.default_rng(3)
    values = 30.0 + rng.normal(size=(n, 3))
    stamps = 10**18 + PERIOD_NS * np.arange(n)
    expected = slopes(CausalDerivative(8, PERIOD_NS * 1e-9), values)
    np.testing.assert_allclose(one_by_one(tracker(8), stamps, values)[-1], expected[-1], atol=1e-7)


def test_typical_period_is_the_median_step_ahead():
    stamps = np.cumsum([0, *[PERIOD_NS] * MIN_PERIOD_STEPS, 0, 7 * PERIOD_NS, -PERIOD_NS])
    assert typical_period(stamps) == pytest.approx(5e-3)
    assert typical_period([5]) is None
