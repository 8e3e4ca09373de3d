"""Noise that differs from rest to rest is no better known than the number of rests allows."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.allan.curve import AllanSums, averaging_factors
from imu_calibration.allan.moment_fit import Moments
from imu_calibration.allan.processes import ScaleCovariance
from imu_calibration.allan.terms import identify_axis, predicted, scatter_of
from imu_calibration.allan.trends import Parts

PERIOD, LENGTH, PARTS = 0.01, 2000, 12
FACTORS = averaging_factors(LENGTH)
SCALES = ScaleCovariance(FACTORS, PARTS * [LENGTH], PERIOD)


def rests(scatter, seed):
    """
    Moments of twelve rests of white noise of density 1.

    The variance of each rest is drawn with a relative standard deviation.
    """
    rng = np.random.default_rng(seed)
    sums = AllanSums(FACTORS, 1)
    for level in np.maximum(1.0 + scatter * rng.standard_normal(PARTS), 0.0):
        sums.push(np.sqrt(level / PERIOD) * rng.standard_normal((LENGTH, 1)))
        sums.end_stretch()
    variance, terms = sums.by_stretch()
    whole = sums.variance()[:, 0]
    return Moments(SCALES, whole, whole > 0, parts=Parts(variance[:, :, 0], terms))


def test_the_variances_of_the_parts_make_those_of_the_whole():
    moments = rests(0.2, 1)
    parts = moments.parts
    np.testing.assert_allclose(
        (parts.terms * parts.variance).sum(axis=0) / parts.terms.sum(axis=0),
        moments.variance,
        rtol=1e-12,
    )
    np.testing.assert_allclose(parts.share(), 1 / PARTS)


@pytest.mark.parametrize('scatter', [0.0, 0.1, 0.4])
def test_the_scatter_between_rests_is_found(scatter):
    """
    Twelve rests give a variance to 43 %, forty draws of them to 7 %.

    Chance between rests of 2000 samples is 4 % and must not count.
    """
    found = np.array([scatter_of(rests(scatter, seed)) for seed in range(40)])
    assert np.sqrt(np.mean(found**2)) == pytest.approx(scatter, rel=0.2, abs=0.02)


def test_intervals_are_those_of_twelve_rests_not_of_their_samples():
    even, uneven = (identify_axis(rests(scatter, 3)) for scatter in (0.0, 0.3))
    narrow, wide = (
        np.subtract(*axis.terms['white_noise'].interval[::-1]) for axis in (even, uneven)
    )
    # the root of a variance that is known to scatter / sqrt(12), four standard deviations from end
    # to end
    assert (
        wide == pytest.approx(4 * 0.5 * uneven.scatter / np.sqrt(PARTS), rel=0.3)
        and narrow < 0.3 * wide
    )
    lower, upper = uneven.terms['white_noise'].interval
    assert lower < 1.0 < upper and even.scatter < 0.04 < uneven.scatter


def test_another_recording_is_predicted_as_unevenly_as_the_first():
    moments = rests(0.3, 3)
    axis = identify_axis(moments)
    sure, unsure = (
        2.0 / predicted(moments, replace(axis, scatter=scatter))[1]
        for scatter in (0.0, axis.scatter)
    )
    np.testing.assert_allclose(unsure - sure, axis.scatter**2 / PARTS, rtol=1e-9)


def test_one_rest_says_nothing_of_others():
    parts = rests(0.3, 3).parts
    alone = Parts(parts.variance[:1], parts.terms[:1])
    assert alone.scatter(np.ones(len(FACTORS), bool), np.full(len(FACTORS), 1e-3)) == 0.0
