"""Gauss-Newton steps on functions of one variable, of which the minimum is known."""

import numpy as np
import pytest

from imu_calibration.estimation.gauss_newton import after_one_step, gauss_newton, halved
from imu_calibration.estimation.held_parameters import undetermined_parameters


class Arctangent:
    """The square of arctan(x): complete steps from beyond 1.39 lead further and further away."""

    def __init__(self, n_halvings):
        self.n_halvings, self.n_steps = n_halvings, 0

    def step(self, state):
        self.n_steps += 1
        return -np.arctan(state) * (1 + state**2)

    def moved(self, state, step):
        return halved(self, state, step, n_halvings=self.n_halvings)

    def after(self, state, step, share):
        return state + share * step

    def cost(self, state):
        return np.arctan(state) ** 2

    def is_last(self, state, step):
        return abs(step) < 1e-6


def test_steps_are_halved_until_they_do_not_raise_the_cost():
    problem = Arctangent(n_halvings=5)
    assert gauss_newton(problem, 3.0, n_steps=20) == pytest.approx(0.0, abs=1e-12)
    # The end is found by the length of a step, long before the largest number of steps.
    assert problem.n_steps < 10


def test_a_state_is_kept_where_each_share_of_a_step_raises_the_cost():
    assert gauss_newton(Arctangent(n_halvings=0), 3.0, n_steps=1) == 3.0


def test_one_step_solves_linear_rows_and_moves_free_parameters_only():
    design = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 3.0], [2.0, 0.0, 1.0]])
    values = np.array([1.0, 1.0, 1.0])
    change = np.array([0.5, 0.0, -0.25])
    free = change != 0
    moved = after_one_step(values, design[:, free], design @ change, free=free)
    np.testing.assert_allclose(moved, values + change, rtol=1e-12)
    assert moved[1] == 1.0


@pytest.mark.parametrize(('tie', 'held'), ((1.0, [False, True]), (0.99, [True, False])))
def test_of_two_parameters_of_which_the_sum_is_known_one_is_held(tie, held):
    """The second one is weaker by 0.1 %: where that is a tie the first one is held."""
    rows = np.array([[100.0, 99.9], [1.0, 0.0], [0.0, 1.0]])
    free, none = np.ones(2, bool), np.zeros(2, bool)
    found = undetermined_parameters(rows, np.ones(2), free=free, held=none, tie=tie)
    assert found.tolist() == held
