"""Samples and flags over them."""

import numpy as np
import pytest

from imu_calibration.core.samples import ImuSamples, JoinedParts, any_within, runs_of


@pytest.mark.parametrize('seed', range(5))
def test_runs_are_all_that_is_true_and_apart(seed):
    flags = np.random.default_rng(seed).random(200) < 0.6
    runs = runs_of(flags)
    assert np.flatnonzero(flags).tolist() == [k for start, stop in runs for k in range(start, stop)]
    assert np.all(runs[1:, 0] > runs[:-1, 1])


@pytest.mark.parametrize(
    ('flags', 'runs'),
    [([], []), ([False], []), ([True, True], [[0, 2]]), ([True, False, True], [[0, 1], [2, 3]])],
)
def test_runs_reach_to_both_ends(flags, runs):
    assert runs_of(flags).tolist() == runs and runs_of(flags).shape == (len(runs), 2)


def test_joined_parts_are_their_concatenation():
    """
    Parts of any length, also empty ones, while the arrays grow.

    They are not those of the first part.
    """
    rng = np.random.default_rng(0)
    parts = [
        ImuSamples(
            rng.integers(0, 9, n),
            rng.standard_normal((n, 3)),
            rng.standard_normal((n, 3)),
            f'frame {n}',
        )
        for n in (3, 0, 1, 500, 7, 2000)
    ]
    joined, whole = JoinedParts(), ImuSamples.concatenate(parts)
    for part in parts:
        joined.add(part)
    assert len(joined) == len(whole) == 2511
    found, first = joined.samples(), parts[0].stamp_ns.copy()
    assert found.frame_id == 'frame 3' and found.corrected is None
    for name in ('stamp_ns', 'force_s', 'rate_s'):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    found.stamp_ns[:] = -1
    np.testing.assert_array_equal(parts[0].stamp_ns, first)


@pytest.mark.parametrize('before, after', [(0, 0), (1, 1), (4, 0), (0, 3), (50, 50)])
def test_any_within_is_the_largest_flag_of_each_span(before, after):
    flags = np.random.default_rng(3).random(40) < 0.1
    expected = [flags[max(i - before, 0) : i + after + 1].any() for i in range(len(flags))]
    np.testing.assert_array_equal(any_within(flags, before, after), expected)
    assert len(any_within(flags[:0], before, after)) == 0
