"""
The joint estimate of a calibration by hand.

First guess, and the covariance due to gravity, the Earth's rate and the model error.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from imu_calibration.core.distributions import chance_of_fall
from imu_calibration.effects.base import Role
from imu_calibration.estimation.gauss_newton import gauss_newton
from imu_calibration.estimation.model_error import MIN_SCATTER_BLOCKS, ModelError
from imu_calibration.estimation.outliers import find_outliers
from imu_calibration.estimation.rows import Rows, flat
from imu_calibration.estimation.scaled_solve import triangular_of_band
from imu_calibration.estimation.solution import (
    GRAVITY,
    UNMODELLED_EARTH_RATE,
    common_scale,
    total,
)
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.kinematics.sphere import fit_sphere
from imu_calibration.references.gravity.equations import (
    COMPONENTS,
    SCATTER_SD,
    GravityRows,
    Poses,
    State,
    TurnData,
)
from imu_calibration.references.gravity.g_sensitivity import EARTH_UPWARDS_SD
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.poses import missed_angle
from imu_calibration.references.rows.row_estimate import (
    MAX_NEWTON_STEPS,
    RowEstimate,
    estimate_rows,
)
from imu_calibration.references.rows.row_model_error import model_error_of_rows

LEAST_SPREAD = 0.02
"""Spread of the directions (1/3 when they are even) from which on a sphere is a starting point."""
NORM_SD_SHARE = 1e-3
"""Sd of the lengths of gravity in the search for a starting point, as a share of gravity."""


def solve_joint(
    model: HandModel, poses: Poses, turns: list[TurnData], *, gravity_sd: float
) -> tuple[RowEstimate, dict]:
    """
    Return the estimate of all parameters from poses and turns, and the turns integrated there.

    Parameters
    ----------
    model : HandModel
        Parameters, priors, gravity.
    poses : Poses
    turns : list of TurnData
    gravity_sd : float
        Sd of gravity, m/s^2.

    """
    found = estimate_rows(
        GravityRows(model, poses, turns),
        first_state(model, poses),
        fallback=np.square(SCATTER_SD),
        withheld=model.withheld,
    )
    reference = GravityRows(model, poses, turns)
    scale = common_scale(model.model, found.state.values)
    terms = {
        **found.terms,
        **_model_error(reference, found).terms(total(found.terms)),
        GRAVITY: (gravity_sd / model.gravity) ** 2 * np.outer(scale, scale),
        UNMODELLED_EARTH_RATE: _of_earth(model, found.state, poses, found.free),
    }
    return replace(found, terms=terms), reference.memory


def _model_error(reference: GravityRows, found: RowEstimate) -> ModelError:
    """
    Return the model error; a block is a pose with the turn that begins in it.

    None where parts are fitted almost exactly: they have no scatter to compare.
    """
    model = reference.model
    free = found.free
    count = len(reference.poses)
    rows = reference.linearise(found.state)
    # The rows of poses and turns, without those that directions and parameters need; the bias of
    # the gyroscope is determined at rest.
    of_poses_and_turns = np.isin(rows.component, (0, 2)).sum()
    spare = of_poses_and_turns - 2 * count - free.sum() + free[model.gyro_bias].sum()
    if min(count, spare) < MIN_SCATTER_BLOCKS or not free.any():
        return ModelError(np.ones(model.size), *np.zeros((2, model.size)))
    return model_error_of_rows(rows, found, model.model, block=np.minimum(rows.group, count - 1))


def first_state(model: HandModel, poses: Poses) -> State:
    """
    Return a `State` from the norms in poses, which determine directions too, and the rates at rest.

    The norms have a mirrored solution, ``matrix -> -matrix``, and Gauss-Newton steps from the
    nominal values end there, or nowhere, for scale factors or biases far from the nominal ones.
    The search therefore begins in several places, and the best solution with a positive diagonal is
    returned.
    """
    values = model.nominal.copy()
    if 'accelerometer' not in model.absent:
        index = model.base_index('accelerometer')
        index = index[~model.withheld[index]]
        squares = _NormsAndPriors(model, poses.force, poses.conditions, index)
        least = np.inf
        for start in _starting_points(model, poses):
            end = gauss_newton(squares, start, n_steps=MAX_NEWTON_STEPS)
            cost = squares.cost(end) if squares.is_possible(end) else np.inf
            if cost < least:
                values = end
                least = cost
    bias, matrix, *_ = model.linear(values)
    true = np.linalg.solve(matrix, (poses.force - bias).T).T
    values[model.gyro_bias] = poses.rate.mean(0)
    return State(values, unit_rows(true), np.zeros_like(poses.rate))


def _starting_points(model: HandModel, poses: Poses) -> list[np.ndarray]:
    """Return parameter vectors: nominal, with the scale of the norms, and with the sphere."""
    bias_at = model.model.part('accelerometer', Role.OFFSET)
    matrix_at = model.model.part('accelerometer', Role.LINEAR)
    median_norm = float(np.median(np.linalg.norm(poses.force, axis=1)))
    scaled = model.nominal.copy()
    scaled[matrix_at] *= median_norm / model.gravity
    starts = [model.nominal, scaled]
    sphere = fit_sphere(poses.force)
    if sphere.spread > LEAST_SPREAD:
        with_sphere = model.nominal.copy()
        with_sphere[bias_at] = sphere.centre
        with_sphere[matrix_at] *= sphere.radius / model.gravity
        starts.append(with_sphere)
    return starts


@dataclass(frozen=True, eq=False)
class NormSquares:
    """
    Sum of squares of ``|corrected force| - gravity`` over means at rest (`LeastSquares`).

    The state has the values of all parameters, shape (n,).
    """

    model: HandModel
    force: np.ndarray
    """Means at rest, m/s^2, shape (k, 3)."""
    conditions: dict[str, Any]
    """Their time and temperature, as `Poses.conditions`."""
    index: np.ndarray
    """Parameters that are estimated, shape (n_free,)."""

    def rows(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors, shape (k,), and their columns, shape (k, n_free)."""
        errors, columns = self.model.norm_rows(values, self.force, **self.conditions)
        return errors, columns[:, self.index]

    def cost(self, values: np.ndarray) -> float:
        """Return the sum of squares."""
        errors, _ = self.rows(values)
        return float(errors @ errors)

    def moved(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the values after a step."""
        moved = values.copy()
        moved[self.index] += step
        return moved


class _NormsAndPriors(NormSquares):
    """The same in standard deviations, with the distances from the priors."""

    def rows(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors, those of the priors last, and their columns."""
        errors, columns = super().rows(values)
        norm_sd = NORM_SD_SHARE * self.model.gravity
        prior_sd = self.model.priors[self.index]
        distance = (self.model.nominal - values)[self.index] / prior_sd
        rows = np.vstack([columns / norm_sd, np.diag(1 / prior_sd)])
        return np.concatenate([errors / norm_sd, distance]), rows

    def step(self, values: np.ndarray) -> np.ndarray:
        """Return the step of the estimated parameters."""
        errors, columns = self.rows(values)
        return np.linalg.lstsq(columns, errors, rcond=None)[0]

    def is_last(self, values: np.ndarray, step: np.ndarray) -> bool:
        """Return whether a step is small, or led beyond the possible values."""
        return not self.is_possible(values) or bool(np.max(np.abs(step)) < 1e-10)

    def is_possible(self, values: np.ndarray) -> bool:
        """Return whether no scale is negative: there lies the mirrored solution, or none."""
        is_finite = np.isfinite(values).all()
        return bool(is_finite and np.diag(self.model.linear(values)[1]).min() > 0.0)


def _of_earth(model: HandModel, state: State, poses: Poses, free: np.ndarray) -> np.ndarray:
    """
    Return the contribution of the Earth's rate to the covariance.

    It is the rate about the vertical, which contributes through biases and responses to gravity.
    """
    _, columns = model.rate_rows(
        state.values, model.gravity * state.up, poses.rate, **poses.conditions
    )
    columns = columns.reshape(-1, model.size)
    # The change of the free parameters of the rates at rest by one sd of the Earth's rate.
    own = np.concatenate([np.arange(model.size)[model.gyro_bias], model.extra_index('gyroscope')])
    kept = own[free[own]]
    earth = EARTH_UPWARDS_SD * state.up.ravel()
    taken = np.zeros(model.size)
    taken[kept] = np.linalg.lstsq(columns[:, kept], earth, rcond=None)[0]
    return np.outer(taken, taken)


MAX_POSE_OUTLIERS = 0.1
"""
Largest share of each kind that is excluded (one of few); a more frequent deviation is a property of
the recording.
"""
MIN_POSE_FREEDOM = 3.0
"""Degrees of freedom of the remaining data that the test requires."""
CONTRADICTED = 0.35
"""
rad; a larger angle between rotated and observed gravity after a turn is no error of the rates:
scale errors of a tenth cause less.
"""
CONTRADICTED_TURNS = 'contradicted by gravity'
"""Kind of the turns that are left out by CONTRADICTED, in `left_out` of the statistics."""
LEAST_SHARE_OF_KIND = 1e-3
"""The same for all rows of a kind together."""
LEAST_ERROR_SHARE = 0.05
"""
A combination of a unit's rows that keeps less than this share of its error after the fit is not
tested.
"""
OUTLIER_SD_FACTOR = 1e3
"""Sd factor that excludes an outlying pose; its direction is still estimated from the turns."""


def possible_turns(
    model: HandModel, state: State, poses: Poses, *, turns: Sequence[TurnData]
) -> tuple[list[TurnData], int]:
    """
    Return (turns whose rates match gravity approximately, number of excluded turns).

    In a pause of the recorder, rates miss a turn.
    """
    kept = []
    for turn in turns:
        if turn.rotation is None:
            missed = missed_angle(state, poses, turn, matrix=model.gyro_factor * np.eye(3))
            if missed >= CONTRADICTED:
                continue
        kept.append(turn)
    return kept, len(turns) - len(kept)


def without_outlying_poses(
    model: HandModel,
    found: RowEstimate,
    *,
    poses: Poses,
    turns: list[TurnData],
    integrated: dict | None = None,
) -> tuple[Poses, list[TurnData], dict]:
    """
    Return (poses, turns, {kind: number}) without outliers.

    Leave-one-out F tests per kind, with Bonferroni correction.

    Excluded poses keep their place, with negligible weight. `integrated`: the turns at the
    estimate, from `solve_joint`.
    """
    rows = GravityRows(model, poses, turns, integrated or {}).linearise(found.state)
    rest, basis = _whitened(rows, found)
    pose = rows.group
    # The turn that begins in a pose.
    turn_of = {turn.first: number for number, turn in enumerate(turns) if turn.rotation is None}

    left: dict[str, tuple[int, ...]] = {}
    for component, kind in enumerate(COMPONENTS):
        of_kind = rows.component == component
        all_of_kind = _distance(rest[of_kind], basis[of_kind], LEAST_SHARE_OF_KIND)
        p_values = {}
        for number in np.unique(pose[of_kind]).tolist():
            own = of_kind & (pose == number)
            p_value = _p_value(_distance(rest[own], basis[own], LEAST_ERROR_SHARE), all_of_kind)
            p_values[turn_of[number] if kind == 'turn' else number] = p_value
        most = max(1, int(MAX_POSE_OUTLIERS * len(p_values)))
        out = find_outliers(p_values, n_tests=len(p_values), most=most).numbers
        if out:
            left[kind] = out
    if left.get('pose'):
        poses = replace(poses, force_sem=_loosened(poses.force_sem, left['pose']))
    if left.get('drift'):
        poses = replace(poses, rate_sem=_loosened(poses.rate_sem, left['drift']))
    turns = [turn for index, turn in enumerate(turns) if index not in left.get('turn', ())]
    return poses, turns, {kind: len(out) for kind, out in left.items()}


def _whitened(rows: Rows, found: RowEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals in sds, and an orthonormal basis of the fitted columns."""
    weighted = rows.of_parameters(found.free).with_scatter(found.scatter.variance)
    white = flat(weighted.white())
    design = white[:, :-1]
    rest = white[:, -1]
    # A ridge, as some columns may be dependent.
    ridge = np.diag(1e-6 * np.linalg.norm(design, axis=0) + 1e-300)
    factor = triangular_of_band(np.vstack([design, ridge]))
    basis = solve_triangular(factor, design.T, trans='T').T
    return rest - basis @ (basis.T @ rest), basis


class _Misfit(NamedTuple):
    """Misfit of some rows, in standard deviations after the fit."""

    square: float
    """Squared Mahalanobis distance."""
    rank: int
    """Rank of the covariance of the residuals."""


def _distance(rest: np.ndarray, basis: np.ndarray, least: float) -> _Misfit:
    """
    Return the misfit of residuals with the covariance ``1 - basis basis'`` after the fit.

    Combinations that keep less than the share `least` of their error are left out.
    """
    values, vectors = np.linalg.eigh(np.eye(len(rest)) - basis @ basis.T)
    seen = values > least
    square = np.sum((vectors[:, seen].T @ rest) ** 2 / values[seen])
    return _Misfit(float(square), int(np.count_nonzero(seen)))


def _p_value(own: _Misfit, all_rows: _Misfit) -> float:
    """Return the p-value of an F test of some rows against the other ones; 1 without freedom."""
    spare = all_rows.rank - own.rank
    if not own.rank or spare < MIN_POSE_FREEDOM:
        return 1.0
    return chance_of_fall(own.square, own.rank, rest=all_rows.square - own.square, spare=spare)


def _loosened(sem: np.ndarray, outliers: Sequence[int]) -> np.ndarray:
    """Return standard errors with negligible weights of the outliers, numbers of poses."""
    loose = sem.copy()
    loose[list(outliers)] *= OUTLIER_SD_FACTOR
    return loose
