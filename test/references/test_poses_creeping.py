"""
A hand that creeps while it holds still.

Gravity's slope in a pose says by how much, and turns go from where poses end to where they begin.
"""

import numpy as np
import pytest

from imu_calibration.references.gravity import poses as poses_module
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions

from worlds.hand_sessions import GRAVITY
from worlds.physics_hand import hold_and_turn

CREEP = np.radians(0.15)


def gyroscope_error(seed, creep):
    """Return the rms error of the gyroscope's matrix, and the HandCalibration."""
    imu, ranges, truth = hold_and_turn(seed, n_poses=16, creep=creep)
    found = calibrate_by_hand(imu, HandOptions(GRAVITY), ranges)
    return np.sqrt(np.mean((found.gyroscope[1].ravel() - truth[12:21]) ** 2)), found


@pytest.mark.parametrize('seed', [61, 62])
def test_turns_go_from_the_end_of_a_pose_to_the_beginning_of_the_next(seed, monkeypatch):
    better, found = gyroscope_error(seed, CREEP)
    assert 0.5 < np.sqrt(np.mean(found.poses.half_turn**2)) / (CREEP * 1.5 * np.sqrt(2 / 3)) < 1.5
    monkeypatch.setattr(poses_module, 'CREEPS', np.inf)
    worse, _ = gyroscope_error(seed, CREEP)
    assert better < 0.7 * worse


def test_poses_held_still_stay_as_they_are():
    """Slopes that are no more than noise correct nothing: they would only add it."""
    assert all(not gyroscope_error(seed, 0.0)[1].poses.half_turn.any() for seed in (61, 62, 63))
