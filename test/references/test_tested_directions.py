"""
Six faces by hand: cross terms of the accelerometer that no attitude tests.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calibration.calibration.proof import prove
from imu_calibration.document.decision import HELPS, UNPROVEN, decide
from imu_calibration.effects.sensor_model import BASE, SensorModel
from imu_calibration.estimation.solution import PLACEMENTS, tolerances_of, with_weak_replaced
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import (
    CROSS_TERMS,
    HandModel,
    HandOptions,
)
from imu_calibration.references.gravity.held_out_poses import HeldOutPoses, folds_by_hand
from imu_calibration.references.gravity.tested_directions import fit_placements, placements_demand

from worlds.hand_sessions import FACES, GRAVITY, PARAM_NAMES, random_truth
from worlds.physics_hand import clipped, hold_and_turn

CROSS = [PARAM_NAMES.index(name) for name in CROSS_TERMS]
PRIOR_SD = 0.1


def shortest_turn(up):
    """Return the rotation by the smallest angle that turns z to a coordinate axis `up`."""
    z = np.array([0.0, 0.0, 1.0])
    if z @ up < 0:  # every horizontal axis fits
        return Rotation.from_rotvec([np.pi, 0.0, 0.0])
    axis = np.cross(z, up)
    return Rotation.from_rotvec(np.pi / 2 * axis)


def board(seed, **options):
    """Samples and ranges of `board_of`."""
    return board_of(seed, **options)[:2]


def board_of(seed, *, placements, rests, shared, cross=0.0, turns=False):
    """
    Return (samples, ranges at rest, truth) of a board.

    A board placed on its faces within 1 to 3 deg of the axes, with several rests each.

    `shared`: sd of an error of the accelerometer that the rests of a placement have in common,
    m/s^2. Without `turns` the gyroscope is clipped in each of them.
    """
    rng = np.random.default_rng(seed)
    faces = [*range(6), *rng.integers(0, 6, placements - 6)]
    attitudes, errors = [], []
    for face in faces:
        base = shortest_turn(FACES[face])
        tilt, along = np.radians(rng.uniform(1, 3)), rng.uniform(0, 2 * np.pi)
        error = rng.normal(0, shared, 3)
        for _ in range(rests):
            around = tilt * np.array([np.cos(along), np.sin(along), 0])
            around[:2] += np.radians(0.1) * rng.normal(0, 1, 2)
            attitudes.append((base * Rotation.from_rotvec(around)).inv())
            errors.append(error)
    truth = random_truth(rng)
    truth[CROSS] = cross
    imu, ranges, _ = hold_and_turn(
        seed,
        n_poses=len(attitudes),
        attitudes=attitudes,
        truth=truth,
        pose_sd=0.001,
        still=1.5,
        rate_hz=50.0,
    )
    force = imu.force_s.copy()
    edges = [*(part.start for part in ranges), len(force)]
    for error, start, stop in zip(errors, edges, edges[1:]):
        force[start:stop] += error
    imu = replace(imu, force_s=force)
    return imu if turns else clipped(imu, 0.3), ranges, truth


def calibrated(imu, ranges):
    found = calibrate_by_hand(imu, HandOptions(GRAVITY), ranges)
    at = [found.param_names.index(name) for name in CROSS_TERMS]
    held_out = HeldOutPoses.of(found, found.used_turns, folds_by_hand(found.poses))
    return found.values[at], found.sd[at], prove(held_out)


def test_untested_cross_terms_are_held_with_the_sd_of_their_prior():
    values, sd, proof = calibrated(*board(0, placements=8, rests=4, shared=0.04))
    np.testing.assert_array_equal(values, 0.0)
    assert np.all(sd > 0.09) and decide(proof['accelerometer']) is UNPROVEN


def test_a_likelihood_ratio_of_many_placements_demands_the_cross_terms():
    values, sd, proof = calibrated(*board(1, placements=30, rests=1, shared=0.002, cross=0.05))
    np.testing.assert_allclose(values, 0.05, atol=4 * sd.max())
    assert sd.max() < 0.01 and decide(proof['accelerometer']) is HELPS


def test_turns_between_faces_test_the_cross_terms():
    values, sd, proof = calibrated(*board(2, placements=14, rests=1, shared=0.002, turns=True))
    np.testing.assert_allclose(values, 0.0, atol=4 * sd.max())
    assert sd.max() < 0.003 and not any(entry.few_directions for entry in proof.values())


def test_errors_of_placements_do_not_demand_cross_terms():
    # Twelve placements with an error each: as 36 independent rests they gave 3.8 sd, and `helps`.
    faces = board(722, placements=12, rests=3, shared=0.01, cross=-0.0231)
    values, sd, proof = calibrated(*faces)
    assert np.all(np.abs(values + 0.0231) < 3 * sd) and decide(proof['accelerometer']) is UNPROVEN
    # Their standard deviation is that of the prior: a bias that moves does not add to it.
    np.testing.assert_allclose(sd, PRIOR_SD, rtol=0.02)


@pytest.mark.long
def test_a_wandering_bias_estimated_with_cross_terms_does_not_demand_them():
    # Its path fitted errors of placements: p = 1e-5, 7.1 sd wrong, and `helps`.
    values, sd, proof = calibrated(*board(7426, placements=15, rests=5, shared=0.01))
    np.testing.assert_array_equal(values, 0.0)
    assert np.all(sd > 0.09) and decide(proof['accelerometer']) is UNPROVEN


@pytest.mark.parametrize('wrong', [0.0, 0.4])
def test_one_wrong_placement_demands_no_cross_terms(wrong):
    model, held, poses, up = placed(7440, count=16, cross=0.0, wrong=wrong)
    used = np.ones(len(up), bool)
    assert not placements_demand(model, held, poses, up=up, used=used)


def test_placements_demand_a_cross_term_of_three_degrees_and_state_their_error():
    normalised = []
    for seed in range(7441, 7445):
        model, held, poses, up = placed(seed, count=20, cross=0.05)
        used = np.ones(len(up), bool)
        assert placements_demand(model, held, poses, up=up, used=used)
        fit = fit_placements(model, model.nominal, poses, up=up, used=used)
        is_cross = np.isin(np.array(model.model.param_names)[fit.index], CROSS_TERMS)
        sd = np.sqrt(np.diag(fit.covariance)[is_cross])
        normalised.append((fit.values[fit.index][is_cross] - 0.05) / sd)
    # Student's t widens the sd of few placements
    assert np.max(np.abs(normalised)) < 3.5 and 0.4 < np.std(normalised) < 1.3


def placed(seed, *, count, cross, wrong=0.0):
    """Return models with free and held cross terms, and mean readings on faces, with directions."""
    rng = np.random.default_rng(seed)
    model = HandModel(SensorModel(BASE, BASE), GRAVITY)
    matrix = np.eye(3) + np.diag(rng.normal(0, 0.01, 3)) + cross * np.tri(3, k=-1)
    force = []
    for k in range(count):
        tilt, along = np.radians(rng.uniform(1, 3)), rng.uniform(0, 2 * np.pi)
        up = Rotation.from_rotvec(tilt * np.array([np.cos(along), np.sin(along), 0])).as_matrix()[2]
        up = np.sign(0.5 - k // 3 % 2) * np.roll(up, k % 3)
        force.append(GRAVITY * matrix @ up + rng.normal(0, 0.003, 3))
    force = np.array(force)
    force[-1] += wrong * force[-1] / GRAVITY
    poses = SimpleNamespace(force=force, conditions={})
    directions = force / np.linalg.norm(force, axis=1)[:, None]
    return model, replace(model, held_terms=CROSS_TERMS), poses, directions


@pytest.mark.parametrize(('seed', 'count', 'shared'), [(10337, 9, 0.0374), (10341, 8, 0.0299)])
def test_rests_of_a_placement_are_one_observation_of_its_error(seed, count, shared):
    # As three independent rests each, parameters were 4 sd wrong.
    imu, ranges, truth = board_of(seed, placements=count, rests=3, shared=shared, turns=True)
    found = calibrate_by_hand(imu, HandOptions(GRAVITY), ranges)
    at = [found.param_names.index(name) for name in PARAM_NAMES[:21]]
    errors = np.abs(found.values[at] - truth[:21])
    assert np.max(errors / found.sd_without(PLACEMENTS)[at]) > 3.5
    assert np.max(errors / found.sd[at]) < 3.0

    # The estimates are those of independent rests.
    tolerances = tolerances_of(found.model)
    alone = {name: term for name, term in found.terms.items() if name != PLACEMENTS}
    values = with_weak_replaced(replace(found, terms=alone), tolerances).values
    np.testing.assert_array_equal(with_weak_replaced(found, tolerances).values, values)


def test_a_rest_by_itself_has_no_error_in_common():
    imu, ranges = board(10338, placements=14, rests=1, shared=0.03, turns=True)
    assert PLACEMENTS not in calibrate_by_hand(imu, HandOptions(GRAVITY), ranges).terms
