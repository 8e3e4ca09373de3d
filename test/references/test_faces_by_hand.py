"""
Six faces by hand: cross terms of the accelerometer that no attitude tests.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_calibration.calibration.hand_proof import prove_by_hand
from imu_calibration.document.decision import HELPS, UNPROVEN, decide
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import CROSS_TERMS, HandOptions

from worlds.hand_sessions import FACES, GRAVITY, PARAM_NAMES, random_truth
from worlds.physics_hand import clipped, hold_and_turn

CROSS = [PARAM_NAMES.index(name) for name in CROSS_TERMS]


def board(seed, *, placements, rests, shared, cross=0.0, turns=False):
    """
    A board placed on its faces within 1 to 3 deg of the axes, with several rests each.

    `shared`: sd of an error of the accelerometer that the rests of a placement have in common,
    m/s^2. Without `turns` the gyroscope is clipped in each of them.
    """
    rng = np.random.default_rng(seed)
    faces = [*range(6), *rng.integers(0, 6, placements - 6)]
    attitudes, errors = [], []
    for face in faces:
        base, _ = Rotation.align_vectors([FACES[face]], [[0, 0, 1]])
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
    return imu if turns else clipped(imu, 0.3), ranges


def calibrated(imu, ranges):
    found = calibrate_by_hand(imu, HandOptions(GRAVITY), ranges)
    at = [found.param_names.index(name) for name in CROSS_TERMS]
    return found.values[at], found.sd[at], prove_by_hand(found, found.used_turns)


@pytest.mark.parametrize('seed', [0, 3, 5])
def test_untested_cross_terms_are_held_with_the_sd_of_their_prior(seed):
    values, sd, proof = calibrated(*board(seed, placements=8, rests=4, shared=0.04))
    np.testing.assert_array_equal(values, 0.0)
    assert np.all(sd > 0.09) and decide(proof['accelerometer']) is UNPROVEN


def test_a_likelihood_ratio_of_many_placements_demands_the_cross_terms():
    values, sd, proof = calibrated(*board(1, placements=30, rests=1, shared=0.002, cross=0.05))
    np.testing.assert_allclose(values, 0.05, atol=4 * sd.max())
    assert sd.max() < 0.01 and decide(proof['accelerometer']) is HELPS


def test_turns_between_faces_test_the_cross_terms():
    values, sd, proof = calibrated(*board(2, placements=14, rests=1, shared=0.002, turns=True))
    np.testing.assert_allclose(values, 0.0, atol=4 * sd.max())
    assert sd.max() < 0.003 and 'few_directions' not in proof.get('accelerometer', {})
