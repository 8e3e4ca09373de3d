"""The lower bound: below every plan, whatever the plan, and proved by its own certificate."""

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.estimation.solution import tolerances_of
from imu_calibration.kinematics.motion_limits import limits_of
from imu_calibration.planning.coordinates import Coordinates
from imu_calibration.planning.motion_library import MotionLibrary
from imu_calibration.planning.planner import make_planner
from imu_calibration.planning.planning_problem import PlanningProblem, noise_of_grade
from imu_calibration.planning.posterior import (
    additive_bound,
    exact_information,
    least_bias_variance,
    relax,
)
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.simulation.sensor_noise import GRADES

from worlds.random_tables import random_table
from worlds.stands import quarter_tolerances, stand


def problem(seed=3, grade='tactical', share=0.2):
    """A situation on a random table, tolerances a share of the usual ones."""
    table = random_table(np.random.default_rng(seed))
    model = choose_model(CalibrationOptions(), table)
    coordinates = Coordinates(model, share * tolerances_of(model))
    return PlanningProblem(
        MotionLibrary(table, limits_of(table)),
        coordinates,
        noise_of_grade(GRADES[grade].noise, 100.0),
    )


@pytest.fixture(scope='module')
def made():
    """A situation, which the tests do not change."""
    return problem()


@pytest.fixture(scope='module')
def bound(made):
    """Its lower bound."""
    return made.lower_bound()


def test_windows_together_never_say_more_than_the_sum_of_their_bounds(made):
    rng = np.random.default_rng(8)
    windows, times, _ = made.timed(rng.permutation(len(made.motions))[:30], 0)
    slack = sum(additive_bound(window, made.noise) for window in windows) - exact_information(
        windows, times, made.noise
    )
    values = np.linalg.eigvalsh(slack)
    assert values.min() > -1e-9 * values.max()
    # the biases must be seen at all in the comparison: without their wander the two are the same
    assert values.max() > 1e-3


def test_the_bound_would_be_wrong_if_the_floor_were_larger(made):
    number = next(k for k, motion in enumerate(made.motions) if motion.kind == 'pose')
    moves = [k for k, motion in enumerate(made.motions) if motion.kind == 'move'][:2]
    windows, times, _ = made.timed([number, *moves] * 20, 0)
    exact = exact_information(windows, times, made.noise)
    tight = sum(additive_bound(window, made.noise, share=40.0) for window in windows)
    assert np.linalg.eigvalsh(tight - exact).min() < -1e-6 * np.linalg.eigvalsh(exact).max()


@pytest.mark.parametrize('seed', range(2))
def test_no_random_plan_that_meets_the_tolerances_is_shorter_than_the_bound(made, bound, seed):
    rng = np.random.default_rng(seed)
    sequence, place = [], 0
    while made.coordinates.excess(made.covariance_after(sequence, place)[0]).max() > 1.0:
        sequence += list(rng.permutation(len(made.motions))[:2])
    assert made.covariance_after(sequence, place)[1] > bound > 0


def test_the_certificate_of_a_problem_with_a_known_answer():
    # two motions, each showing one parameter: 4 visits of 2 s and 9 of 3 s, less what is known
    information = (
        np.array([np.diag([1.0, 0.0]), np.diag([0.0, 1.0])]) / np.array([4.0, 9.0])[:, None, None]
    )
    found = relax(information, np.array([2.0, 3.0]), 1e-9 * np.eye(2), rows=np.eye(2))
    assert 0.97 * 35.0 < found.seconds <= 35.0 + 1e-6


def test_biases_that_wander_more_than_their_tolerance_take_their_time_whatever_is_measured():
    made = problem(share=1.0)
    tolerance = made.coordinates.tolerances[0]
    made.noise['accelerometer'] = made.noise['accelerometer'].__class__(
        made.noise['accelerometer'].white_variance,
        np.ones(3),
        bias_processes=(BiasProcess(3.0 * tolerance, 50.0),),
    )
    assert made.lower_bound() == pytest.approx(2 * 50.0 * (9.0 - 1.0), rel=0.05)


@pytest.mark.parametrize('white, time', [(1e-2, 100.0), (3.0, 100.0), (3.0, 8.0)])
def test_the_least_variance_of_a_bias_beside_white_noise_is_that_of_the_dense_covariance(
    white, time
):
    noise = NoiseModel(np.ones(3), np.ones(3), bias_processes=(BiasProcess(1.3, time),))
    seconds, count = 40.0, 1500
    at = (np.arange(count) + 0.5) * seconds / count
    covariance = 1.3**2 * np.exp(
        -np.abs(np.subtract.outer(at, at)) / time
    ) + white * count / seconds * np.eye(count)
    dense = 1 / np.linalg.solve(covariance, np.ones(count)).sum()
    assert least_bias_variance(noise, white, seconds) == pytest.approx(dense, rel=1e-3)


@pytest.mark.long
def test_the_bound_counts_the_white_noise_beside_a_wandering_bias():
    """At a quarter of the default tolerances it was 53 s where the plan took 91 s."""
    table = stand('three axes')
    noise = noise_of_grade(GRADES['industrial'].noise, 100.0)
    plan = make_planner(table, noise=noise, tolerances=quarter_tolerances(table)).plan()
    assert plan.missing == ()
    assert plan.lower_bound_seconds <= plan.seconds <= 1.25 * plan.lower_bound_seconds
