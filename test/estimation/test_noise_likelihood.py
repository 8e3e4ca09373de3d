"""
Whitening, its adjoint and the restricted likelihood in linear time against the dense covariance.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.estimation import scaled_solve
from imu_calibration.estimation.noise_likelihood import NoiseLikelihood, profile, whitened
from imu_calibration.estimation.rows import Rows
from imu_calibration.estimation.scaled_solve import triangular, triangular_of_band
from imu_calibration.estimation.sensor_noise import BiasProcess, dof_factor
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.references.rows.group_variances import scoring
from imu_calibration.references.turntable.estimation.window_means import predict_session_offsets

STEP = 1.3
"""Standard deviation of the bias from recording to recording."""


@pytest.fixture(params=[1, 2, 3], ids='{} processes'.format)
def processes(request):
    """Return bias processes that are far from and close to one another."""
    return (BiasProcess(0.7, 60.0), BiasProcess(1.1, 15.0), BiasProcess(0.4, 1000.0))[
        : request.param
    ]


@pytest.fixture
def rows():
    """
    Return rows of twenty windows in three recordings with their times, variances and recordings.
    """
    rng = np.random.default_rng(5)
    numbers = np.repeat([0, 1, 2], [9, 7, 4])
    times, variance = np.sort(rng.uniform(0, 500, 20)), rng.uniform(0.5, 2, (20, 3))
    return (
        rng.normal(size=(20, 3, 4)),
        times,
        variance,
        [np.flatnonzero(numbers == k) for k in range(3)],
    )


def as_rows(parts):
    """Return the same as `Rows`."""
    values, times, variance, sessions = parts
    session = np.repeat(np.arange(3), [len(index) for index in sessions])
    return Rows(equations=values, variance=variance, time=times, session=session)


def value(rows):
    """Return minus twice the restricted log likelihood."""
    logs, normal = whitened(rows)
    return logs + profile(normal)


def dense(times, variance, sessions, processes):
    """Return the covariance of each axis."""
    number = np.zeros(len(times))
    for k, index in enumerate(sessions):
        number[index] = k
    steps = np.abs(times[:, None] - times)
    kernel = (number[:, None] == number) * (
        sum(p.sd**2 * np.exp(-steps / p.time) for p in processes) + STEP**2
    )
    return [kernel + np.diag(variance[:, axis]) for axis in range(3)]


def test_whitening_inverts_the_covariance(rows, processes):
    """Products of whitened rows are products weighted with the inverse covariance (to rounding)."""
    values, times, variance, sessions = rows
    white = Whitening(variance, times, sessions, processes=processes, session_variance=STEP**2)(
        values
    )
    for axis, covariance in enumerate(dense(times, variance, sessions, processes)):
        expected = values[:, axis].T @ np.linalg.solve(covariance, values[:, axis])
        np.testing.assert_allclose(white[:, axis].T @ white[:, axis], expected, rtol=1e-10)


def test_a_row_is_whitened_with_earlier_rows_only(rows, processes):
    """What is locked away later in time cannot reach what was whitened before it."""
    values, times, variance, _ = rows
    whitening, spoilt = (
        Whitening(variance, times, [np.arange(20)], processes=processes),
        values.copy(),
    )
    spoilt[12:] += 100.0
    np.testing.assert_array_equal(whitening(spoilt)[:12], whitening(values)[:12])
    assert np.all(np.abs(whitening(spoilt)[12:] - whitening(values)[12:]).max(axis=(1, 2)) > 1.0)


def test_whitening_and_its_adjoint_are_the_inverse_covariance(rows, processes):
    values, times, variance, sessions = rows
    whitening = Whitening(variance, times, sessions, processes=processes, session_variance=STEP**2)
    found = whitening.adjoint(whitening(values))
    for axis, covariance in enumerate(dense(times, variance, sessions, processes)):
        np.testing.assert_allclose(
            found[:, axis], np.linalg.solve(covariance, values[:, axis]), rtol=1e-9, atol=1e-11
        )


def test_one_process_in_two_halves_is_the_same_process(rows):
    values, times, variance, sessions = rows
    one, two = (
        (BiasProcess(0.7, 60.0),),
        (BiasProcess(0.7 * 0.6, 60.0), BiasProcess(0.7 * 0.8, 60.0)),
    )
    np.testing.assert_allclose(
        Whitening(variance, times, sessions, processes=one)(values),
        Whitening(variance, times, sessions, processes=two)(values),
        rtol=1e-9,
    )


def test_likelihood_is_that_of_the_dense_covariance(rows, processes):
    """Log determinant and normal matrix in linear time equal the dense ones."""
    values, times, variance, sessions = rows
    wandering = replace(as_rows(rows), processes=processes, session_variance=STEP**2)
    logs, normal = whitened(wandering)
    matrices = dense(times, variance, sessions, processes)
    np.testing.assert_allclose(
        logs, sum(np.linalg.slogdet(matrix)[1] for matrix in matrices), rtol=1e-10
    )
    np.testing.assert_allclose(
        normal,
        sum(
            values[:, a].T @ np.linalg.solve(matrix, values[:, a])
            for a, matrix in enumerate(matrices)
        ),
        rtol=1e-9,
    )


def test_the_restricted_likelihood_is_that_of_contrasts_free_of_the_parameters(rows, processes):
    """
    Two noises differ as in the likelihood of all contrasts.

    They are contrasts that no parameter reaches (Harville 1974).
    """
    values, times, variance, sessions = rows
    wandering = replace(as_rows(rows), processes=processes, session_variance=STEP**2)
    found, expected = [], []
    design = values[:, :, :-1].transpose(1, 0, 2).reshape(60, 3)
    contrasts = np.linalg.svd(design)[0][:, 3:]
    for factor in (1.0, 3.0):
        found.append(value(replace(wandering, variance=factor * variance)))
        whole = np.zeros((60, 60))
        for axis, matrix in enumerate(dense(times, factor * variance, sessions, processes)):
            whole[20 * axis : 20 * axis + 20, 20 * axis : 20 * axis + 20] = matrix
        inner, rest = contrasts.T @ whole @ contrasts, contrasts.T @ values[:, :, -1].T.ravel()
        expected.append(np.linalg.slogdet(inner)[1] + rest @ np.linalg.solve(inner, rest))
    np.testing.assert_allclose(found[1] - found[0], expected[1] - expected[0], rtol=1e-8)


def test_offsets_of_sessions_are_conditional_means(rows, processes):
    """The prediction equals the regression of the offsets on the residuals."""
    values, times, variance, sessions = rows
    misfit = values[:, :, 0]
    of_misfit = replace(
        as_rows(rows),
        equations=misfit[:, :, None],
        processes=processes,
        session_variance=STEP**2,
    )
    found = predict_session_offsets(of_misfit)
    for axis, covariance in enumerate(dense(times, variance, sessions, processes)):
        weighted = np.linalg.solve(covariance, misfit[:, axis])
        np.testing.assert_allclose(
            found[:, axis], [STEP**2 * weighted[index].sum() for index in sessions], rtol=1e-9
        )


def test_fewer_parameters_are_fewer_columns_of_the_same_normal_matrix(rows):
    shape = (0.3, 0.5, 60.0)
    every = as_rows(rows)
    all_columns = NoiseLikelihood(every)
    few = NoiseLikelihood(every.of_parameters(np.array([True, False, True])))
    np.testing.assert_allclose(
        all_columns.loss(shape, np.array([0, 2])), few.loss(shape), rtol=1e-9
    )
    assert all_columns.loss(shape) < all_columns.loss(shape, np.array([0, 2])) + 20


def test_the_profile_is_what_least_squares_leaves_and_what_it_determines(rows):
    values = rows[0][:, 0]
    left = np.linalg.lstsq(values[:, :-1], values[:, -1], rcond=None)[1][0]
    determined = np.linalg.slogdet(values[:, :-1].T @ values[:, :-1])[1]
    np.testing.assert_allclose(profile(values.T @ values), left + determined, rtol=1e-9)


def test_a_variance_from_few_data_is_taken_larger():
    assert dof_factor(1e9) == pytest.approx(1.0)
    assert dof_factor(6) == pytest.approx(1.5)
    assert dof_factor(2) == dof_factor(1) == 3.0


def test_scoring_is_the_derivative_of_the_likelihood(rows):
    """
    The score against central differences, its covariance against the information.

    The covariance is over many draws, to the scatter of 4000 draws.
    """
    values = rows[0]
    group = np.arange(60) % 3
    members, noise = np.array([group == k for k in range(3)], float), np.full(60, 0.3)

    def with_variance(extra, equations=values):
        variance = (noise + extra[group]).reshape(20, 3)
        return replace(as_rows(rows), equations=equations, variance=variance)

    at, step = np.array([0.5, 1.0, 2.0]), 1e-5 * np.eye(3)
    score, information = scoring(with_variance(at), members)
    slopes = [
        -0.5 * (value(with_variance(at + h)) - value(with_variance(at - h))) / 2e-5 for h in step
    ]
    np.testing.assert_allclose(score, slopes, rtol=1e-5)
    rng, scores = np.random.default_rng(1), []
    for _ in range(4000):
        drawn = values.copy()
        drawn[:, :, -1] = rng.normal(size=(20, 3)) * np.sqrt(with_variance(at).variance)
        scores.append(scoring(with_variance(at, drawn), members)[0])
    np.testing.assert_allclose(
        np.cov(np.array(scores).T), information, rtol=0.12, atol=0.03 * information.max()
    )


def test_factor_along_a_band_is_that_of_all_rows():
    """
    Rows of a chain of poses, in any order, with common columns last and one pose without rows.

    The products agree, in small parts.
    """
    rng, n_poses, largest = np.random.default_rng(8), 40, []
    rows = np.zeros((n_poses, 12, 5 * n_poses + 7))
    for pose in range(n_poses - 1):
        rows[pose, :, 5 * pose : 5 * pose + 10] = rng.normal(size=(12, 10))
    rows[:, :, -7:] = rng.normal(size=(n_poses, 12, 7))
    rows[:, :, 30:35] = 0.0
    rows = rng.permutation(rows.reshape(-1, rows.shape[2]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            scaled_solve, 'triangular', lambda part: largest.append(part.size) or triangular(part)
        )
        factor = triangular_of_band(rows)
    np.testing.assert_allclose(factor.T @ factor, rows.T @ rows, rtol=1e-12, atol=1e-12 * n_poses)
    assert not np.tril(factor, -1).any()
    assert max(largest) < 0.05 * rows.size


def test_a_band_without_an_element_has_a_factor_of_zeros():
    # Without its first poses a session by hand has rows of zeros only in their columns.
    size = scaled_solve.BAND_COLUMNS
    rows = np.zeros((6 * size, 3 * size))
    rows[3 * size :, size:] = np.random.default_rng(9210).normal(size=(3 * size, 2 * size))
    factor = triangular_of_band(rows)
    np.testing.assert_allclose(factor.T @ factor, rows.T @ rows, rtol=1e-12, atol=1e-10)
