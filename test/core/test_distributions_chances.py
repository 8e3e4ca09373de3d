"""
The tails of distributions are those of scipy.stats, to the last bit.

What is significant does not depend on which of them is asked.
"""

import numpy as np
import pytest
from scipy import stats

from imu_calibration.core.distributions import binom_sf, chi2_isf, chi2_sf, f_sf, norm_sf

RNG = np.random.default_rng(1)
VALUES = np.concatenate(
    [
        RNG.exponential(10.0, 300),
        RNG.normal(0.0, 3.0, 200),
        [0.0, 1e-300, 1e300, np.inf, -np.inf, np.nan],
    ]
)
CHANCES = RNG.uniform(1e-12, 1.0, 200)
DOFS = (0.5, 1, 2, 7, 120, 1e5, 0, -1)


@pytest.mark.parametrize('dof', DOFS)
def test_chi_square_and_f_have_the_tails_of_scipy_stats(dof):
    np.testing.assert_array_equal(chi2_sf(VALUES, dof), stats.chi2.sf(VALUES, dof))
    assert chi2_sf(3.0, dof) == stats.chi2.sf(3.0, dof) or dof <= 0
    for below in DOFS:
        np.testing.assert_array_equal(f_sf(VALUES, dof, below), stats.f.sf(VALUES, dof, below))
    if dof > 0:
        np.testing.assert_array_equal(chi2_isf(CHANCES, dof), stats.chi2.isf(CHANCES, dof))


def test_binomial_numbers_have_the_tail_of_scipy_stats():
    x, trials = np.arange(-1, 31)[:, None], np.array([1, 7, 30])
    x = np.minimum(x, trials)
    np.testing.assert_allclose(
        binom_sf(x, trials, 0.3), stats.binom.sf(x, trials, 0.3), rtol=1e-12, atol=1e-300
    )


def test_gaussian_numbers_have_the_tails_of_scipy_stats():
    np.testing.assert_array_equal(norm_sf(VALUES), stats.norm.sf(VALUES))


def test_each_value_has_its_own_degrees_of_freedom():
    dof = RNG.integers(0, 9, len(VALUES))
    np.testing.assert_array_equal(chi2_sf(VALUES, dof), stats.chi2.sf(VALUES, dof))
    np.testing.assert_array_equal(f_sf(VALUES, 2, dof), stats.f.sf(VALUES, 2, dof))
