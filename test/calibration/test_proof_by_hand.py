"""A calibration by hand is proven on poses and turns that took no part."""

from dataclasses import replace

import numpy as np
import pytest

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.calibration.proof import prove
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document.decision import HELPS, decide
from imu_calibration.references.gravity.hand_calibration import gather_by_hand, solve_by_hand
from imu_calibration.references.gravity.hand_parameters import HandOptions
from imu_calibration.references.gravity.held_out_poses import (
    HAND_PROOF_FOLDS,
    HeldOutPoses,
    folds_by_hand,
    values_without,
)

from worlds.candidates import FEW
from worlds.hand_sessions import GRAVITY, NOMINAL, simulate

OPTIONS = HandOptions(gravity=GRAVITY)


@pytest.fixture(scope='module')
def session():
    imu, ranges, _ = simulate(3, n_poses=20)
    return gather_by_hand(imu, ranges)


def proof_of(hand, turns):
    return prove(HeldOutPoses.of(hand, turns, folds_by_hand(hand.poses)))


def test_a_good_calibration_is_proven_on_poses_and_turns(session):
    hand = solve_by_hand(session, OPTIONS)
    proof = proof_of(hand, session.turns)
    assert (
        proof['accelerometer'].windows == 20
        and proof['gyroscope'].unit == 'rad per turn'
        and all(decide(entry) is HELPS for entry in proof.values())
    )
    for entry in proof.values():
        assert entry.after < 0.2 * entry.before and entry.ci95[1] < 0.3


def test_a_part_is_left_out_as_if_it_had_not_been_recorded(session):
    hand = solve_by_hand(session, OPTIONS)
    out = np.arange(20) % HAND_PROOF_FOLDS == 3
    (step,) = values_without(hand, session.turns, [out])
    place = np.cumsum(~out) - 1
    rest = [
        replace(turn, first=int(place[turn.first]), last=int(place[turn.last]))
        for turn in session.turns
        if not (out[turn.first] or out[turn.last])
    ]
    parts = {
        name: getattr(session.poses, name)[~out]
        for name in ('force', 'rate', 'force_sem', 'rate_sem', 'start', 'stop', 'time')
    }
    again = solve_by_hand(
        replace(session, poses=replace(session.poses, **parts), turns=rest), OPTIONS
    )
    free, sd = ~hand.hand_model.fixed, hand.sd[~hand.hand_model.fixed]
    moved = (again.values - hand.values)[free] / sd
    assert np.abs(moved).max() > 0.5
    assert np.abs((step - again.values)[free] / sd).max() < 0.35 * np.abs(moved).max()


def test_an_imu_without_errors_is_not_helped_and_says_so():
    imu, _, _ = simulate(5, n_poses=20, truth=NOMINAL.copy(), pose_sd=0.02)
    found = calibrate_recordings(SampleBlock(imu), gravity=GRAVITY, candidates=FEW)
    assert found.verdict.word is not HELPS and found.exit_code == 3


def test_few_attitudes_are_left_out_one_by_one_and_six_are_too_few():
    for poses, windows in ((6, None), (8, 8), (9, 9), (20, 20)):
        imu, ranges, _ = simulate(4, n_poses=poses)
        data = gather_by_hand(imu, ranges)
        found = proof_of(solve_by_hand(data, OPTIONS), data.turns)
        assert getattr(found.get('accelerometer'), 'windows', None) == windows
        assert not found or found['accelerometer'].ci95[1] < 1.0
