"""The noise model: what means of windows scatter by, what rests tell, and misfit that lies along the columns."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.estimation.band_misfit import least_misfit, misfit_along
from imu_calibration.estimation.noise_model import MovingFactors, NoiseModel, dof_factor, white_noise


def rest(variance, inflation=1.0, count=1000):
    """Statistics of a static window."""
    sensor = SimpleNamespace(noise_variance=np.full(3, variance), inflation=np.full(3, inflation), mean=np.ones(6))
    return SimpleNamespace(kind='static', sensors={'gyroscope': sensor}, count=count)


def test_means_scatter_by_the_noise_at_low_frequency_over_their_number():
    """Var(mean) = white * inflation / n, times what moving windows scatter beyond."""
    noise = NoiseModel(np.full(3, 4.0), np.full(3, 2.5), moving={'spin': MovingFactors(*[np.ones(3)] * 2, means=np.full(3, 3.0))})
    np.testing.assert_allclose(noise.mean_variance(['static', 'spin'], np.array([100, 50])), [[0.1] * 3, [0.6] * 3])
    np.testing.assert_allclose(noise.row_variance('static'), 10.0)


def test_a_knocked_rest_does_not_enter_the_noise():
    white, inflation = white_noise([rest(1.0), rest(1.1), rest(0.9), rest(50.0, 40.0)], 'gyroscope')
    np.testing.assert_allclose(white, 1.0)
    np.testing.assert_allclose(inflation, 1.0)


def test_a_variance_from_few_data_is_taken_larger():
    """By the variance of the t distribution, dof / (dof - 2), within reason."""
    np.testing.assert_allclose(dof_factor([2.5, 4.0, 12.0, 1e6]), [3.0, 2.0, 1.2, 1.0], rtol=1e-5)


@pytest.mark.parametrize(('smooth', 'least', 'most'), ((False, 0.7, 1.3), (True, 20.0, 300.0)))
def test_misfit_along_the_columns_shows_how_correlated_it_is(smooth, least, most):
    """White misfit leaves its variance per dimension of the columns; one that moves with them as many times more as there are samples."""
    rng, products = np.random.default_rng(4), []
    for _ in range(60):
        time = np.linspace(0, 1, 200)
        design = np.column_stack([np.cos(np.pi * k * time) for k in range(4)])
        misfit = np.cos(np.pi * rng.uniform(0, 3) * time + rng.uniform(0, 6)) * np.sqrt(2) if smooth else rng.normal(size=200)
        rows = np.column_stack([design, misfit])
        products.append(rows.T @ rows)
    squares, dimensions = misfit_along(np.array(products))
    assert dimensions == 240
    assert least < squares / dimensions < most


def test_a_column_of_which_rounding_left_less_than_nothing_says_nothing():
    """Products about the mean of a window can come out below zero: such a column made the misfit along the others 1e95 times larger."""
    rng = np.random.default_rng(5)
    rows = np.column_stack([rng.normal(size=(200, 3)), np.full(200, 1e-7), rng.normal(size=200)])
    products = rows.T @ rows
    products[3, 3] = -1e-22
    whole, kept = np.delete(np.delete(products, 3, 0), 3, 1), products[None]
    np.testing.assert_allclose(misfit_along(kept), misfit_along(whole[None]), rtol=1e-12)
    np.testing.assert_allclose(least_misfit(products), least_misfit(whole), rtol=1e-12)
