"""Covariances of corrected samples agree with the scatter of corrected samples."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.compensation.angular_acceleration import CausalDerivative
from imu_calibration.compensation.compensate import Transfer
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.compensation.kernel import make_kernel

from worlds.compensation_cases import FURTHER, random_calibration

DERIVATIVE = CausalDerivative(5, 0.005)
FORCE, RATE, SLOPE, DT = (
    np.array([1.0, -2.0, 9.0]),
    np.array([1.5, -0.8, 2.0]),
    np.array([4.0, -6.0, 3.0]),
    4.0,
)
FORCE_COV = np.array([[4e-4, 1e-4, 0], [1e-4, 9e-4, -2e-4], [0, -2e-4, 5e-4]])
RATE_COV = 1e-2 * FORCE_COV[::-1, ::-1]
TRANSFER = Transfer.from_pose('base', (0.4, -0.3, 0.2), (0.3, 1.0, -2.0))
EFFECTS = {
    'usual': (('accel_size_effect',), ()),
    'all': (FURTHER['accelerometer'], FURTHER['gyroscope']),
}
N_DRAWS = 4000
N_COLUMNS = 30
"""Of the root of a covariance: each moves all parameters."""


def with_derivative(calibration, transfer=None):
    uncertainty = Uncertainty(calibration, transfer)
    uncertainty.use(DERIVATIVE)
    return uncertainty


def agree(sampled, predicted):
    """Sample covariances of N draws scatter by about sqrt(2 / N) = 2 %; five times that."""
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((sampled - predicted) / scale).max() < 0.11


@pytest.mark.parametrize('transfer', [None, TRANSFER], ids=['in place', 'transfer'])
@pytest.mark.parametrize('effects', EFFECTS)
def test_noise_agrees_with_monte_carlo(effects, transfer):
    calibration = random_calibration(1, *EFFECTS[effects])
    rng = np.random.default_rng(5)
    kernel = make_kernel(calibration, transfer)
    force = FORCE + rng.multivariate_normal(np.zeros(3), FORCE_COV, N_DRAWS)
    # Newest first, as the weights.
    rates = rng.multivariate_normal(np.zeros(3), RATE_COV, (N_DRAWS, DERIVATIVE.taps))
    slope = SLOPE + np.einsum('k,nki->ni', DERIVATIVE.weights, rates)
    rows = np.column_stack([force, RATE + rates[:, 0], slope, np.full(N_DRAWS, DT)])
    out = np.array([kernel(*row) for row in rows.tolist()])
    at = with_derivative(calibration, transfer).at
    sensitivity = at(FORCE, RATE, SLOPE, warming=DT)
    for got, predicted in zip(
        (out[:, :3], out[:, 3:]),
        sensitivity.covariances(FORCE_COV, RATE_COV, with_parameters=False),
    ):
        agree(np.cov(got.T), predicted)


@pytest.mark.parametrize('transfer', [None, TRANSFER], ids=['in place', 'transfer'])
@pytest.mark.parametrize('effects', EFFECTS)
def test_parameters_agree_with_kernels_of_displaced_parameters(effects, transfer):
    """
    Add the outer products of the changes of the output by the columns of a root of the covariance.

    With ``cov = L L^T`` the covariance of a linear output is ``sum_k d_k d_k^T``, where ``d_k`` is
    the change by column ``k`` of ``L``. No draw of parameters is needed, and a root of few columns
    moves all parameters in each of them.
    """
    calibration = random_calibration(1, *EFFECTS[effects])
    root = np.random.default_rng(6).normal(0, 2e-6, (len(calibration.values), N_COLUMNS))
    calibration = replace(calibration, covariance=root @ root.T)
    sample = [*np.concatenate([FORCE, RATE, SLOPE]).tolist(), DT]

    def output(values):
        return np.array(make_kernel(replace(calibration, values=values), transfer)(*sample))

    undisturbed = output(calibration.values)
    changes = [output(calibration.values + column) - undisturbed for column in root.T]
    expected = np.transpose(changes) @ changes
    at = with_derivative(calibration, transfer).at
    predicted = at(FORCE, RATE, SLOPE, warming=DT).parameters
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    # In place the changes are linear to 1 %. In a transfer the derivative of the inverse gyroscope
    # matrix in the tangential term is left out: a quarter of the variance of the usual model.
    assert np.abs((expected - predicted) / scale).max() < (0.35 if transfer else 0.03)


def test_what_is_published_has_the_share_of_the_parameters():
    """It is there, and grows with their variance: by a hundred from 1e-4 to 1e-3."""
    shares = []
    for sd in (1e-4, 1e-3):
        at = with_derivative(random_calibration(1, sd=sd)).at
        sensitivity = at(FORCE, RATE, SLOPE, warming=DT)
        whole, noise_only = (
            sensitivity.covariances(FORCE_COV, RATE_COV, flag) for flag in (True, False)
        )
        shares.append([np.trace(a - b) for a, b in zip(whole, noise_only)])
    assert np.all(np.array(shares) > 0)
    np.testing.assert_allclose(np.divide(*shares[::-1]), 100.0, rtol=1e-6)


def test_an_ideal_sensor_passes_its_noise_on_unchanged():
    calibration = random_calibration(0, (), (), sd=0.0, matrix_spread=0.0)
    force_cov, rate_cov = Uncertainty(calibration).at().covariances(FORCE_COV, RATE_COV)
    np.testing.assert_allclose(force_cov, FORCE_COV, atol=1e-12)
    np.testing.assert_allclose(rate_cov, RATE_COV, atol=1e-14)


def test_unknown_noise_is_that_of_the_calibration():
    force, rate = Uncertainty(random_calibration(0)).noise
    np.testing.assert_allclose(np.sqrt(np.diag(force)), [0.02, 0.022, 0.018])
    np.testing.assert_allclose(np.sqrt(np.diag(rate)), [0.002, 0.0022, 0.0018])
