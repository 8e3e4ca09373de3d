"""Samples and flags over them."""

import numpy as np
import pytest

from imu_calibration.core.samples import runs_of


@pytest.mark.parametrize('seed', range(5))
def test_runs_are_all_that_is_true_and_apart(seed):
    flags = np.random.default_rng(seed).random(200) < 0.6
    runs = runs_of(flags)
    assert np.flatnonzero(flags).tolist() == [k for start, stop in runs for k in range(start, stop)]
    assert np.all(runs[1:, 0] > runs[:-1, 1])


@pytest.mark.parametrize(('flags', 'runs'), [([], []), ([False], []), ([True, True], [[0, 2]]), ([True, False, True], [[0, 1], [2, 3]])])
def test_runs_reach_to_both_ends(flags, runs):
    assert runs_of(flags).tolist() == runs and runs_of(flags).shape == (len(runs), 2)
