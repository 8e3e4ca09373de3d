"""The shared linear solver: accuracy, covariance, and refusal by parameter name."""

import numpy as np
import pytest
from papers.linear_least_squares import (
    condition_numbers,
    null_directions,
    numerical_rank,
    predicted_sd,
    solve_linear,
    tolerance_scaled,
)
from refusal import refused

from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.references.turntable.observability import tolerance_scaled_singular_values

NAMES = ('bias', 'slope', 'curve')


def vandermonde(rng, n=12):
    x = rng.uniform(-1, 1, n)
    return np.column_stack([np.ones(n), x, x**2])


def test_exact_data_come_back_for_one_and_several_outputs():
    rng = np.random.default_rng(1)
    design, truth = vandermonde(rng), rng.normal(size=(3, 2))
    both = solve_linear(design, design @ truth, NAMES)
    one = solve_linear(design, design @ truth[:, 0], NAMES)
    np.testing.assert_allclose(both.values, truth, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.values, truth[:, 0], rtol=0, atol=1e-14)
    assert one.values.shape == one.unit_sd.shape == (3,)


def test_badly_scaled_columns_are_solved_where_normal_equations_fail():
    """
    Columns of norm 1e-6 to 1e6 and a Hilbert-like core: SVD with scaled columns keeps ten digits.
    """
    core = 1.0 / (np.arange(1, 15)[:, None] + np.arange(5))
    design = core * np.array([1e-6, 1e-3, 1, 1e3, 1e6])
    truth = np.array([1e6, 1e3, 1, 1e-3, 1e-6])
    solution = solve_linear(design, design @ truth, tuple('abcde'))
    normal = np.linalg.solve(design.T @ design, design.T @ (design @ truth))
    error, normal_error = (
        np.max(np.abs(solution.values / truth - 1)),
        np.max(np.abs(normal / truth - 1)),
    )
    print(f'scaled SVD relative error {error:.1e}, normal equations {normal_error:.1e}')
    assert error < 1e-10 < normal_error


def test_covariance_equals_the_inverse_normal_matrix_and_the_weights_enter():
    rng = np.random.default_rng(2)
    design, weights = vandermonde(rng), rng.uniform(0.5, 4, 12)
    solution = solve_linear(design, rng.normal(size=12), NAMES, weights=weights)
    np.testing.assert_allclose(
        solution.unit_covariance, np.linalg.inv(design.T @ (weights[:, None] * design)), rtol=1e-11
    )
    np.testing.assert_allclose(design.T @ (weights * solution.residuals), 0, atol=1e-12)
    np.testing.assert_allclose(predicted_sd(design, weights), solution.unit_sd, rtol=1e-12)


def test_reported_sd_is_the_scatter_over_many_draws():
    """With 4000 draws the sd ratio itself has sd 1.1 %; five of those are allowed."""
    rng = np.random.default_rng(3)
    design = vandermonde(rng)
    solution = solve_linear(design, rng.normal(scale=0.3, size=(12, 4000)), NAMES)
    ratio = np.std(solution.values, axis=1) / (0.3 * solution.unit_sd)
    np.testing.assert_allclose(ratio, 1, atol=0.055)


def test_units_of_a_parameter_do_not_change_eqcond_or_the_fit():
    rng = np.random.default_rng(4)
    design, outputs, units = vandermonde(rng), rng.normal(size=12), np.array([1, 1e5, 1e-7])
    plain, scaled = (
        solve_linear(design, outputs, NAMES),
        solve_linear(design * units, outputs, NAMES),
    )
    np.testing.assert_allclose(scaled.values * units, plain.values, rtol=1e-12)
    assert scaled.eqcond == pytest.approx(plain.eqcond, rel=1e-12)
    assert scaled.cond > 1e10 * plain.cond


@pytest.mark.parametrize(
    'column, expected',
    [
        (np.zeros(12), {'curve'}),
        (np.sin(np.pi * np.arange(12)), {'curve'}),
        (None, {'slope', 'curve'}),
    ],
)
def test_singular_design_is_refused_by_parameter_name(column, expected):
    rng = np.random.default_rng(5)
    design = vandermonde(rng)
    design[:, 2] = column if column is not None else 3 * design[:, 1]
    with refused(NotObservableError, 'rank', 2) as caught:
        solve_linear(design, np.ones(12), NAMES)
    text = str(caught.value).split('not determined:')[1].split('.  ')[0]
    assert all(name in text for name in expected) and 'bias' not in text
    (direction,) = null_directions(design, NAMES)
    assert set(direction) == expected
    if column is None:
        assert -direction['slope'] / direction['curve'] == pytest.approx(3)
    assert numerical_rank(design) == 2
    assert np.isinf(predicted_sd(design)).tolist() == [name in expected for name in NAMES]


def test_too_few_rows_and_an_empty_design_are_refused():
    with refused(NotObservableError, 'rank', 2, 'slope', 'curve'):
        solve_linear(np.array([[1.0, 0, 0], [1, 1, 1]]), np.ones(2), NAMES)
    with refused(NotObservableError, 'rank', 'bias', 'slope', 'curve'):
        solve_linear(np.zeros((4, 3)), np.ones(4), NAMES)
    assert null_directions(np.eye(3), NAMES) == []


@pytest.mark.parametrize(
    'design, outputs, weights',
    [
        (np.ones((3, 2)), np.ones(3), None),
        (np.eye(3), np.ones(4), None),
        (np.eye(3), np.ones(3), [1, -1, 1]),
        (np.diag([1, np.nan, 1]), np.ones(3), None),
    ],
)
def test_wrong_input_is_refused(design, outputs, weights):
    with pytest.raises(InputError):
        solve_linear(design, outputs, NAMES, weights=weights)


def test_tolerance_scaling_finds_the_weak_parameter_that_eqcond_misses():
    """
    Orthogonal columns have eqcond 1 whatever their size.

    Against tolerances the small one is out of reach.
    """
    design = np.kron(np.eye(3), np.ones((4, 1))) * np.array([1, 1, 1e-3])
    scaled = tolerance_scaled(design, np.full(3, 0.1), sigma=0.02)
    assert condition_numbers(design)[1] == pytest.approx(1)
    assert scaled.cond == pytest.approx(1e3)
    np.testing.assert_allclose(scaled.sd_over_tolerance, [0.1, 0.1, 100], rtol=1e-12)
    assert [set(direction) for direction in scaled.weak_directions(NAMES)] == [{'curve'}]


def test_tolerance_scaling_of_design_and_covariance_agree():
    rng = np.random.default_rng(6)
    design, tolerances = vandermonde(rng), np.array([0.1, 2.0, 0.5])
    covariance = 0.3**2 * solve_linear(design, np.ones(12), NAMES).unit_covariance
    by_design = tolerance_scaled(design, tolerances, 0.3)
    np.testing.assert_allclose(
        tolerance_scaled_singular_values(np.linalg.inv(covariance), tolerances),
        by_design.singular_values,
        rtol=1e-9,
    )
    np.testing.assert_allclose(
        np.sqrt(np.diag(covariance)) / tolerances, by_design.sd_over_tolerance, rtol=1e-10
    )
