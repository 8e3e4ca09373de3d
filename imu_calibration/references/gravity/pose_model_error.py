"""Model error of a calibration by hand: parameters of parts of the recording differ by more than noise, tested as on a table."""

import numpy as np
import scipy.linalg

from imu_calibration.estimation.model_error import LEAST_BLOCKS, ModelError, Waves, errors_of_waves, slow_cosines
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.variance_components import GroupVariances
from imu_calibration.references.gravity.equations import Poses, State, TurnData, build_system
from imu_calibration.references.gravity.hand_parameters import HandModel


def hand_model_error(model: HandModel, state: State, poses: Poses, *, turns: list[TurnData], scatter: GroupVariances,
                     free: np.ndarray) -> ModelError:
    """
    Return the model error from the scatter of parameters between parts of a recording by hand, beyond noise and known scatter.

    A block is a pose with the turn that begins in it. Directions of gravity and drifts of the bias are estimated too, so that the expected
    covariance of the shifts is the one of rows from which these, and the parameters, have been fitted.

    Parameters
    ----------
    model : HandModel
    state : State
        The estimate.
    poses : Poses
    turns : list of TurnData
    scatter : GroupVariances
        Beyond the noise.
    free : array of bool, shape (n,)
        Parameters that were estimated.

    """
    count = len(poses.start)
    if count < LEAST_BLOCKS or not free.any():
        return ModelError(np.ones(model.size), *np.zeros((2, model.size)))
    system = build_system(model, state, poses, turns=turns)
    spare = np.isin(system.component, (0, 2)).sum() - 2 * count - free.sum() + free[model.gyro_bias].sum()
    if spare < LEAST_BLOCKS:   # parts that are fitted almost exactly have no scatter to compare
        return ModelError(np.ones(model.size), *np.zeros((2, model.size)))
    root = np.sqrt(scatter.total(system.noise, system.component))
    along, rest = system.nuisance / root[:, None], system.residual / root
    fitted, _ = scipy.linalg.qr(along, mode='economic')
    main = system.main[:, free] / root[:, None]
    main -= fitted @ (fitted.T @ main)
    covariance = inverse_normal(main.T @ main)
    basis = np.hstack([fitted, np.linalg.qr(main)[0]])
    weights = slow_cosines(count)[:, _pose_of_rows(count, turns)]
    weighted = weights[:, :, None] * main
    moved = np.einsum('kmp,m->kp', weighted, rest) @ covariance
    seen = np.einsum('mb,kmp->kbp', basis, weighted)
    expected = covariance @ (np.einsum('kmp,kmq->kpq', weighted, weighted) - np.einsum('kbp,kbq->kpq', seen, seen)) @ covariance
    return errors_of_waves(Waves(np.flatnonzero(free), moved, expected, covariance=covariance), model.model)[0]


def _pose_of_rows(count, turns):
    """Return the pose of each row of `build_system`; a turn counts with the pose that it begins in, one of known angle with the last."""
    of_turns = [np.full(2, turn.first) if turn.rotation is None else np.full(3, count - 1) for turn in turns]
    return np.concatenate([np.tile(np.repeat(np.arange(count), 3), 3), *of_turns]).astype(int)
