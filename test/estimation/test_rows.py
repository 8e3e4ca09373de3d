"""Rows of any reference: their errors, their parts and their parameters."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.estimation.estimate import estimate
from imu_calibration.estimation.rows import Rows, flat, normal_of_rows, weights_of
from imu_calibration.estimation.scaled_solve import covariance_with_held
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.solution import total


@pytest.fixture
def rows():
    """Return five rows of two axes with a nuisance and three parameters."""
    rng = np.random.default_rng(11)
    return Rows(
        equations=rng.normal(size=(5, 2, 5)),
        variance=rng.uniform(0.5, 2.0, (5, 2)),
        n_nuisances=1,
        time=10.0 * np.arange(5),
        products=np.eye(5),
        component=np.array([0, 1, 1, -1, 0]),
    )


def test_some_rows_keep_the_products_of_all(rows):
    """Products and places belong to all rows: they are as long as the columns, not as the rows."""
    some = replace(rows, places=np.arange(5)).select(rows.time > 5.0)
    assert len(some) == 4 and some.component.tolist() == [1, 1, -1, 0]
    np.testing.assert_array_equal(some.products, np.eye(5))
    np.testing.assert_array_equal(some.places, np.arange(5))


def test_a_component_scatters_its_own_rows_alone(rows):
    added = rows.with_scatter(np.array([3.0, 7.0])).variance - rows.variance
    np.testing.assert_allclose(added, np.array([3.0, 7.0, 7.0, 0.0, 3.0])[:, None] * np.ones(2))


def test_a_bias_process_connects_rows_of_an_axis(rows):
    """The normal matrix is that of the dense covariance."""
    wandering = replace(rows, processes=(BiasProcess(0.8, 25.0),))
    steps = np.abs(rows.time[:, None] - rows.time)
    expected = np.zeros((5, 5))
    for axis in range(2):
        dense = 0.64 * np.exp(-steps / 25.0) + np.diag(rows.variance[:, axis])
        own = rows.equations[:, axis]
        expected += own.T @ np.linalg.solve(dense, own)
    np.testing.assert_allclose(normal_of_rows([wandering], 4), expected, rtol=1e-9)


def test_columns_of_some_parameters_have_their_places(rows):
    """Parameters 4, 0 and 2 of six act here, and others do not."""
    own = replace(
        rows, equations=rows.equations[:, :, 1:], places=np.array([4, 0, 2, 6]), n_nuisances=0
    )
    values = np.array([2.0, -1.0])
    expected = own.equations[:, :, -1] - own.equations[:, :, :2] @ np.array([-1.0, 2.0])
    np.testing.assert_allclose(own.residuals_at(weights_of([0, 4], values, 6)), expected)
    normal = normal_of_rows([own], 6)
    white = flat(own.white())
    np.testing.assert_allclose(normal[np.ix_(own.places, own.places)], white.T @ white)
    assert not normal[1].any() and not normal[5].any()


def test_a_prior_draws_the_parameters_to_its_mean(rows):
    """A certain one gives its mean, whatever the rows say; nuisances have no prior."""
    of_one_axis = rows.of_axes(np.array([0]))
    distance = np.array([0.3, -0.2, 0.1])
    certain = of_one_axis.with_prior(distance, 1e6 * np.eye(3))
    assert certain.component.tolist() == [0, 1, 1, -1, 0, -1, -1, -1]
    white = flat(replace(certain, component=None).white())
    change = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
    np.testing.assert_allclose(change[1:], distance, rtol=1e-6)


class Line:
    """Rows of a line through points, of which a third parameter is undetermined (`estimate`)."""

    adjustable = np.array([True, True, True])
    prior_sd = np.array([10.0, 10.0, 2.0])
    design = np.column_stack([np.ones(20), np.linspace(-1, 1, 20), np.zeros(20)])

    def __init__(self, misfit=()):
        self.misfit = misfit

    def fitted(self, state):
        return state

    def undetermined(self, state):
        return np.array([False, False, True])

    def holding(self, state, held):
        return (*state, held.tolist())

    def weighted(self, state):
        return self

    def not_believed(self, state, free, sd):
        return {number: 5.0 for number in self.misfit if free[number]}

    def scatter_term(self, own):
        return 0.25 * own


def test_an_estimate_holds_what_data_do_not_determine_and_what_is_misfit():
    """The covariance is the sum of its terms: of the free parameters, and of held priors."""
    found = estimate(Line(), ())
    assert found.held.tolist() == [False, False, True] and not found.not_believed
    own, of_held = covariance_with_held(Line.design, found.free, found.held, prior_sd=Line.prior_sd)
    np.testing.assert_allclose(total(found.terms), own + of_held)
    assert total(found.terms)[2, 2] == pytest.approx(4.0)

    found = estimate(Line(misfit=[1]), ())
    assert found.free.tolist() == [True, False, False] and found.not_believed == {1: 5.0}
    # The values were found once with each set of held parameters.
    assert found.state == ([False, False, True], [False, True, True])
    assert total(found.terms)[0, 0] == pytest.approx(1 / 20)
