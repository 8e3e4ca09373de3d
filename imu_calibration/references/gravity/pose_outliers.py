"""Outlying poses and turns: a touch of the IMU, or a turn that the recorder missed."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.core.distributions import chance_of_fall
from imu_calibration.estimation.row_estimate import RowEstimate
from imu_calibration.references.gravity.equations import COMPONENTS, GravityRows, Poses, State, TurnData
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.turns import missed_angle

P_VALUE = 1e-3
"""False positive rate for a recording without outliers, per kind."""
SHARE = 0.1
"""Largest share of each kind that is excluded (one of few); a more frequent deviation is a property of the recording."""
LEAST_SPARE = 3.0
"""Degrees of freedom of the remaining data that the test requires."""
CONTRADICTED = 0.35
"""
rad; a larger angle between rotated and observed gravity after a turn is no error of the rates: scale errors of a tenth cause less.
"""
LEAST_ERROR_SHARE = 0.05
"""A combination of a unit's rows that keeps less than this share of its error after the fit is not tested."""
OUTLIER_SD_FACTOR = 1e3
"""Sd factor that excludes an outlying pose; its direction is still estimated from the turns."""


def possible_turns(model: HandModel, state: State, poses: Poses, *, turns: Sequence[TurnData]) -> tuple[list[TurnData], int]:
    """Return (turns whose rates match gravity approximately, number of excluded turns): in a pause of the recorder, rates miss a turn."""
    kept = [turn for turn in turns if turn.rotation is not None
            or missed_angle(state, poses, turn, matrix=model.gyro_factor * np.eye(3)) < CONTRADICTED]
    return kept, len(turns) - len(kept)


def without_outliers(model: HandModel, found: RowEstimate, *, poses: Poses, turns: list[TurnData]) -> tuple[Poses, list[TurnData], dict]:
    """
    Return (poses, turns, {kind: number}) without outliers: leave-one-out F tests per kind, with Bonferroni correction.

    Excluded poses keep their place, with negligible weight.
    """
    rows = GravityRows(model, poses, turns).linearise(found.state)
    rest, leverage = _whitened(rows, found)
    left, first, of_turn = {}, rows.group[:, 0], {turn.first: number for number, turn in enumerate(turns) if turn.rotation is None}
    for kind in range(len(COMPONENTS)):
        of_kind = rows.component == kind
        index = of_turn if COMPONENTS[kind] == 'turn' else range(len(poses.start))
        own = [(index[number], of_kind & (first == number)) for number in np.unique(first[of_kind])]
        total, spare = _distance(rest[of_kind], leverage[of_kind], 1e-3)
        allowed = max(1, int(SHARE * len(own)))
        worst = sorted((_p_value(rest[at], leverage[at], total, spare), number) for number, at in own)
        out = [number for p, number in worst[:allowed] if p * max(len(own), 1) < P_VALUE]
        if out:
            left[COMPONENTS[kind]] = out
    if left.get('pose'):
        poses = replace(poses, force_sem=_loosened(poses.force_sem, left['pose']))
    if left.get('drift'):
        poses = replace(poses, rate_sem=_loosened(poses.rate_sem, left['drift']))
    turns = [turn for index, turn in enumerate(turns) if index not in left.get('turn', ())]
    return poses, turns, {kind: len(out) for kind, out in left.items()}


def _whitened(rows, found):
    """Return residuals in sds, and an orthonormal basis of the fitted columns."""
    root = np.sqrt(found.scatter.total(rows.noise, rows.component))
    design = np.hstack([rows.nuisance, rows.main[:, found.free]]) / root[:, None]
    rest = rows.residual / root
    basis = np.linalg.qr(np.vstack([design, np.diag(1e-6 * np.linalg.norm(design, axis=0) + 1e-300)]))[0][:len(rest)]
    return rest - basis @ (basis.T @ rest), basis


def _distance(rest, basis, least):
    """Return (squared Mahalanobis distance of some residuals, with the covariance of residuals after the fit, and its rank)."""
    values, vectors = np.linalg.eigh(np.eye(len(rest)) - basis @ basis.T)
    seen = values > least
    return float(np.sum((vectors[:, seen].T @ rest)**2 / values[seen])), int(np.count_nonzero(seen))


def _p_value(rest, basis, total, spare):
    square, count = _distance(rest, basis, LEAST_ERROR_SHARE)
    if not count or spare - count < LEAST_SPARE:
        return 1.0
    return chance_of_fall(square, count, rest=total - square, spare=spare - count)


def _loosened(sem, index):
    loose = sem.copy()
    loose[index] *= OUTLIER_SD_FACTOR
    return loose
