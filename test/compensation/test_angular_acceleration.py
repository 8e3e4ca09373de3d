"""The causal derivative: what it must be exactly, its noise, and how its window is chosen."""

import numpy as np
import pytest

from imu_calibration.compensation.angular_acceleration import CausalDerivative, choose_derivative


def slopes(derivative, values):
    """Derivative wherever the window is full, shape (n - taps + 1, 3)."""
    return np.stack(
        [np.convolve(column, derivative.weights, 'valid') for column in values.T], axis=1
    )


@pytest.mark.parametrize('taps', [2, 3, 8, 41])
def test_a_parabola_has_its_slope_of_half_a_window_ago(taps):
    derivative = CausalDerivative(taps, 0.002)
    time = np.arange(100) * 0.002
    rate = np.stack([3.0 + 2.0 * time, time**2, np.ones(100)], axis=1)
    slope = slopes(derivative, rate)[1:]
    late = time[taps:] - derivative.delay
    np.testing.assert_allclose(
        slope,
        np.stack([np.full(len(late), 2.0), 2 * late, np.zeros(len(late))], axis=1),
        atol=1e-10,
    )


@pytest.mark.parametrize('taps', [2, 5, 20])
def test_noise_is_as_predicted(taps):
    derivative = CausalDerivative(taps, 0.01)
    np.testing.assert_allclose(
        np.sqrt((derivative.weights**2).sum()), derivative.noise_sd(1.0), rtol=1e-12
    )
    slope = slopes(derivative, np.random.default_rng(2).normal(0.0, 0.3, (20_000, 3)))
    # 60 000 values, serially correlated over `taps`
    assert slope.std() == pytest.approx(derivative.noise_sd(0.3), rel=0.03)


def test_the_window_is_the_shortest_whose_noise_stays_below_a_third():
    chosen = choose_derivative(0.001, 0.002, 0.05, force_sd=0.02)
    assert chosen.noise_sd(0.002) * 0.05 <= 0.02 / 3
    assert CausalDerivative(chosen.taps - 1, 0.001).noise_sd(0.002) * 0.05 > 0.02 / 3


def test_the_window_does_not_grow_beyond_the_largest_delay():
    assert choose_derivative(0.001, 1.0, 10.0, force_sd=1e-3).delay == pytest.approx(0.02)
    assert choose_derivative(0.01, 1e-3, 0.0, force_sd=1e-3).taps == 2


def test_unknown_noise_gives_half_the_largest_delay():
    assert choose_derivative(0.001, 0.0, 0.1, force_sd=0.02).delay == pytest.approx(0.01)
    assert choose_derivative(0.001, 0.002, 0.1, force_sd=0.0).delay == pytest.approx(0.01)
