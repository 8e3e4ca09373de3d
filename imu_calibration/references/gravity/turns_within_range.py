"""The full-scale factor of a gyroscope, from the directions of gravity before and after each turn."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.kinematics.strapdown import integrate_turn
from imu_calibration.preprocessing.full_scale import LEAST_TURNS, MOST_TURNS, believed_factor
from imu_calibration.references.gravity.equations import Poses, State, TurnData


def full_scale_factor(state: State, poses: Poses, turns: Sequence[TurnData]) -> float:
    """
    Return the factor between measured and true rates, 1 if the rotated gravity matches its observed direction (`preprocessing.full_scale`).

    Only turns with gravity as reference count; the bias of each is the mean of the rates at rest before and after it.

    Parameters
    ----------
    state : State
        Directions of gravity from the norms.
    poses : Poses
    turns : sequence of TurnData

    """
    some = [turn for turn in turns if turn.rotation is None][:MOST_TURNS]
    if len(some) < LEAST_TURNS:
        return 1.0

    def missed(factor):
        return float(np.median([missed_angle(state, poses, turn, matrix=factor * np.eye(3)) for turn in some]))

    return believed_factor(missed)


def missed_angle(state: State, poses: Poses, turn: TurnData, *, matrix: np.ndarray) -> float:
    """Return the angle between rotated and observed gravity after a turn when the gyroscope reads `matrix` times the rate, rad."""
    bias = 0.5 * (poses.rate[turn.first] + poses.rate[turn.last])
    mat_ji = integrate_turn(turn.time, turn.rate, bias=bias, matrix=matrix).mat_ji
    return float(np.arccos(np.clip(mat_ji @ state.up[turn.first] @ state.up[turn.last], -1.0, 1.0)))
