"""
By hand too, standard deviations allow for parameters that move in a recording.

They allow for nothing where nothing moves.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.estimation.solution import DRIFT, MODEL_ERROR
from imu_calibration.references.gravity.hand_calibration import calibrate_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions

from worlds.candidates import FEW
from worlds.hand_coverage import GROUPS, errors
from worlds.hand_sessions import GRAVITY, PARAM_NAMES
from worlds.physics_hand import hold_and_turn

MATRIX = PARAM_NAMES[12:21]


def test_a_gyroscope_whose_scale_walks_is_not_known_to_the_noise():
    """
    Its scale walks by two per cent through the recording.

    What one session says of the next errs by about that, and not by the noise of turns.
    """
    imu, ranges, _ = hold_and_turn(0, n_poses=24, rate_hz=50.0)
    walk = np.linspace(0, 0.02, len(imu))[:, None]
    walking, steady = (
        calibrate_by_hand(replace(imu, rate_s=rate), HandOptions(GRAVITY), ranges)
        for rate in (imu.rate_s * (1 + walk), imu.rate_s)
    )
    own = steady.hand_model.gyro_matrix
    assert not steady.terms[DRIFT][own, own].any() and not steady.terms[MODEL_ERROR][own, own].any()
    assert np.sqrt(np.diag(walking.terms[DRIFT])[walking.hand_model.gyro_matrix].max()) > 2e-3
    assert max(walking.sd_of(name) for name in MATRIX) > 10 * max(
        steady.sd_of(name) for name in MATRIX
    )


@pytest.mark.long
def test_clean_sessions_become_no_wider():
    few = CalibrationOptions(gravity=GRAVITY, catalogue=CATALOGUE.with_candidates(FEW))
    found = [errors('clean', seed, few, n_poses=16) for seed in range(4)]
    grown = np.concatenate([each[group][2] for each in found for group in GROUPS])
    assert np.quantile(grown, 0.95) < 1.3 and np.median(grown) == pytest.approx(1.0)
