"""
The noise model.

What means of windows scatter by, what rests tell, and misfit that lies along the columns.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.core.samples import rounding_variance
from imu_calibration.estimation.sensor_noise import (
    BiasProcess,
    dof_factor,
    means_beside_middles,
)
from imu_calibration.references.turntable.estimation.session_noise import (
    least_misfit,
    misfit_along,
    white_noise,
)
from imu_calibration.references.turntable.noise_model import (
    MovingFactors,
    NoiseModel,
    ReferenceNoise,
)
from imu_calibration.references.turntable.selection.saturation import sample_sd_at_rest
from imu_calibration.simulation.sensor_noise import gauss_markov_samples


def rest(variance, inflation=1.0, count=1000):
    """Statistics of a static window."""
    sensor = SimpleNamespace(
        noise_variance=np.full(3, variance), inflation=np.full(3, inflation), mean=np.ones(6)
    )
    return SimpleNamespace(kind='static', sensors={'gyroscope': sensor}, count=count)


def test_means_scatter_by_the_noise_at_low_frequency_over_their_number():
    """Var(mean) = white * inflation / n, times what moving windows scatter beyond."""
    noise = NoiseModel(
        np.full(3, 4.0),
        np.full(3, 2.5),
        moving={'spin': MovingFactors(*[np.ones(3)] * 2, means=np.full(3, 3.0))},
    )
    np.testing.assert_allclose(
        noise.mean_variance(['static', 'spin'], np.array([100, 50])), [[0.1] * 3, [0.6] * 3]
    )
    np.testing.assert_allclose(noise.row_variance('static'), 10.0)


def test_a_knocked_rest_does_not_enter_the_noise():
    white, inflation = white_noise([rest(1.0), rest(1.1), rest(0.9), rest(50.0, 40.0)], 'gyroscope')
    np.testing.assert_allclose(white, 1.0)
    np.testing.assert_allclose(inflation, 1.0)


def test_a_code_that_is_constant_at_rest_has_the_noise_of_rounding():
    """
    Steps of 0.08 show in motion only.

    The variance at rest is step^2 / 12, not zero, which made ratios to the noise at rest 3e5.
    """
    moving = rest(rounding_variance(0.08 * np.round(np.linspace([0.0], [5.0], 400) / 0.08))[0])
    moving.kind = 'dynamic'
    white, _ = white_noise([rest(0.0), rest(0.0), moving], 'gyroscope')
    np.testing.assert_allclose(white, 0.08**2 / 12, rtol=1e-9)
    np.testing.assert_array_equal(rounding_variance(np.ones((5, 2))), 0.0)
    still, turning = (
        SimpleNamespace(kind=kind, time=np.arange(len(rate)), rate_s=rate)
        for kind, rate in (
            ('static', np.ones((20, 3))),
            ('dynamic', 0.08 * np.repeat(np.arange(30.0)[:, None], 3, axis=1)),
        )
    )
    np.testing.assert_allclose(sample_sd_at_rest([still, turning], 'gyroscope'), 0.08 / np.sqrt(12))


def test_a_variance_from_few_data_is_taken_larger():
    """By the variance of the t distribution, dof / (dof - 2), within reason."""
    np.testing.assert_allclose(dof_factor([2.5, 4.0, 12.0, 1e6]), [3.0, 2.0, 1.2, 1.0], rtol=1e-5)


@pytest.mark.parametrize(('smooth', 'least', 'most'), ((False, 0.7, 1.3), (True, 20.0, 300.0)))
def test_misfit_along_the_columns_shows_how_correlated_it_is(smooth, least, most):
    """
    White misfit leaves its variance per dimension of the columns.

    One that moves with them as many times more as there are samples.
    """
    rng, products = np.random.default_rng(4), []
    for _ in range(60):
        time = np.linspace(0, 1, 200)
        design = np.column_stack([np.cos(np.pi * k * time) for k in range(4)])
        misfit = (
            np.cos(np.pi * rng.uniform(0, 3) * time + rng.uniform(0, 6)) * np.sqrt(2)
            if smooth
            else rng.normal(size=200)
        )
        rows = np.column_stack([design, misfit])
        products.append(rows.T @ rows)
    squares, dimensions = misfit_along(np.array(products))
    assert dimensions == 240
    assert least < squares / dimensions < most


def test_a_column_of_which_rounding_left_less_than_nothing_says_nothing():
    """
    Products about the mean of a window can come out below zero.

    Such a column made the misfit along the others 1e95 times larger.
    """
    rng = np.random.default_rng(5)
    rows = np.column_stack([rng.normal(size=(200, 3)), np.full(200, 1e-7), rng.normal(size=200)])
    products = rows.T @ rows
    products[3, 3] = -1e-22
    whole, kept = np.delete(np.delete(products, 3, 0), 3, 1), products[None]
    np.testing.assert_allclose(misfit_along(kept), misfit_along(whole[None]), rtol=1e-12)
    np.testing.assert_allclose(least_misfit(products), least_misfit(whole), rtol=1e-12)


def test_a_mean_over_a_window_differs_from_the_bias_in_its_middle_by_what_it_wanders():
    """
    Against Gauss-Markov processes drawn step by step.

    Windows of 4 and 16 s of one that forgets in 100 s.
    """
    process, rng = BiasProcess(1.0, 100.0), np.random.default_rng(6)
    bias = gauss_markov_samples(process.sd, process.time, 0.1, shape=(161, 4000), rng=rng)
    for count in (41, 161):
        drawn = (bias[:count].mean(axis=0) - bias[count // 2]).var()
        np.testing.assert_allclose(means_beside_middles((process,), 0.1 * count), drawn, rtol=0.1)


def test_angles_that_are_read_in_steps_tilt_gravity_at_rest_and_not_in_motion():
    """Attitudes about axes in all directions, each read to the next step of 1 mrad."""
    rng = np.random.default_rng(7)
    axes, gravity = rng.normal(size=(2, 20000, 3))
    axes, gravity = (rows / np.linalg.norm(rows, axis=1)[:, None] for rows in (axes, gravity))
    seen = 9.80665 * np.cross(rng.uniform(-0.5e-3, 0.5e-3, 20000)[:, None] * axes, gravity)
    still, moving = ReferenceNoise.of_steps(1e-3, 'accelerometer').variance(
        ['static', 'spin'], np.full(2, 5.0)
    )
    # all directions are alike here; a joint's axis across gravity, as tables have them, turns half
    # as much again into two components
    assert seen.var() < still < 4 * seen.var() and moving == 0.0
    assert (
        not ReferenceNoise.of_steps(0.0, 'gyroscope')
        .variance(['static', 'spin'], np.full(2, 5.0))
        .any()
    )
