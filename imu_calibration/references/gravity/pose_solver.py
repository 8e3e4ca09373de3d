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
    Return (estimate of all parameters from poses and turns, turns as integrated at the estimate).

    The turns are `GravityRows.memory`.

    Parameters
    ----------
    model : HandModel
        Parameters, priors, gravity.
    poses : Poses
    turns : list of TurnData
    gravity_sd : float
        Sd of gravity, m/s^2.

    """
    estimate = estimate_rows(
        GravityRows(model, poses, turns),
        first_state(model, poses),
        fallback=np.square(SCATTER_SD),
        always_held=model.always_held,
    )
    # Its memory has the turns as integrated at the estimate, none from earlier steps.
    reference = GravityRows(model, poses, turns)
    scale = common_scale(model.model, estimate.state.values)
    terms = {
        **estimate.terms,
        **_model_error(reference, estimate).terms(total(estimate.terms)),
        GRAVITY: (gravity_sd / model.gravity) ** 2 * np.outer(scale, scale),
        UNMODELLED_EARTH_RATE: _earth_covariance(model, estimate.state, poses, estimate.free),
    }
    return replace(estimate, terms=terms), reference.memory


def _model_error(reference: GravityRows, estimate: RowEstimate) -> ModelError:
    """
    Return the model error; a block is a pose with the turn that begins in it.

    Zero, if poses or degrees of freedom are so few that the blocks are fitted almost exactly: they
    have no scatter to compare.
    """
    model = reference.model
    free = estimate.free
    count = len(reference.poses)
    rows = reference.linearise(estimate.state)
    # The rows of poses and turns, without those that directions and parameters need; the bias of
    # the gyroscope is determined at rest.
    components = [COMPONENTS.index('pose'), COMPONENTS.index('turn')]
    of_poses_and_turns = np.isin(rows.component, components).sum()
    spare = of_poses_and_turns - 2 * count - free.sum() + free[model.gyro_bias].sum()
    if min(count, spare) < MIN_SCATTER_BLOCKS or not free.any():
        return ModelError(
            factor=np.ones(model.size),
            drift_variance=np.zeros(model.size),
            scatter_variance=np.zeros(model.size),
        )
    return model_error_of_rows(rows, estimate, model.model, block=np.minimum(rows.group, count - 1))


def first_state(model: HandModel, poses: Poses) -> State:
    """
    Return the `State` in which the accelerometer fits ``|true force| = gravity`` in the poses.

    Directions are those of the corrected forces, the bias of the gyroscope is its mean reading,
    and drifts are zero. The norms have a mirrored solution, ``matrix -> -matrix``. Gauss-Newton
    steps from the nominal values end there, or do not converge, for scale factors or biases that
    differ much from the nominal ones. The search therefore begins in several places, and the best
    solution with a positive diagonal is returned.
    """
    # Bias and matrix of the accelerometer: the possible solution of least cost from all starts.
    values = model.nominal.copy()
    if 'accelerometer' not in model.absent:
        index = model.base_index('accelerometer')
        index = index[~model.always_held[index]]
        squares = _NormsAndPriors(model, poses.force, poses.conditions, index)
        least_cost = np.inf
        for start in _starting_points(model, poses):
            end = gauss_newton(squares, start, n_steps=MAX_NEWTON_STEPS)
            cost = squares.cost(end) if squares.is_possible(end) else np.inf
            if cost < least_cost:
                values = end
                least_cost = cost

    # Directions with it, and the bias of the gyroscope.
    linear = model.linear(values)
    true = np.linalg.solve(linear.force_matrix, (poses.force - linear.force_bias).T).T
    values[model.gyro_bias] = poses.rate.mean(0)
    return State(values, unit_rows(true), np.zeros_like(poses.rate))


def _starting_points(model: HandModel, poses: Poses) -> list[np.ndarray]:
    """
    Return parameter vectors from which the search for `first_state` begins, each of shape (n,).

    They are the nominal values, these with the scale of the median norm, and, if the directions are
    spread enough, these with centre and radius of the sphere through the readings.
    """
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
    """Sum of squares of `NormSquares` over `NORM_SD_SHARE`, and of the distances from priors."""

    def rows(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors in sds, (k + n_free,), those of the priors last, and their columns."""
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
        """Return whether all scale factors are positive; the mirrored solution has negative."""
        if not np.isfinite(values).all():
            return False
        return bool(np.diag(self.model.linear(values).force_matrix).min() > 0.0)


def _earth_covariance(model: HandModel, state: State, poses: Poses, free: np.ndarray) -> np.ndarray:
    """
    Return the covariance of the parameters from the Earth's rate about the vertical, shape (n, n).

    At rest the gyroscope measures e u, with the direction u of gravity and the unknown rate e of
    the sd `EARTH_UPWARDS_SD`. The parameters fitted to rates at rest, with columns A, change by
    ``e c``, and the covariance is::

        sd^2 c c',    c = lstsq(A, u)
    """
    _, columns = model.rate_rows(
        state.values, model.gravity * state.up, poses.rate, **poses.conditions
    )
    columns = columns.reshape(-1, model.size)
    at_rest = np.concatenate(
        [np.arange(model.size)[model.gyro_bias], model.extra_index('gyroscope')]
    )
    estimated = at_rest[free[at_rest]]
    earth_rates = EARTH_UPWARDS_SD * state.up.ravel()
    change = np.zeros(model.size)
    change[estimated] = np.linalg.lstsq(columns[:, estimated], earth_rates, rcond=None)[0]
    return np.outer(change, change)


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
"""Kind of the turns that are excluded by CONTRADICTED, in `left_out` of the statistics."""
LEAST_ERROR_SHARE = 0.05
"""
A combination of the rows of a pose or turn that keeps less than this share of its error after the
fit is not tested.
"""
LEAST_SHARE_OF_KIND = 1e-3
"""The share for all rows of a kind together, in place of `LEAST_ERROR_SHARE`."""
OUTLIER_SD_FACTOR = 1e3
"""Sd factor that excludes an outlying pose; its direction is still estimated from the turns."""


def possible_turns(
    model: HandModel, state: State, poses: Poses, *, turns: Sequence[TurnData]
) -> tuple[list[TurnData], int]:
    """
    Return (turns whose rates match gravity within `CONTRADICTED`, number of excluded turns).

    If the recorder paused during a turn, the integrated rates miss a part of it.
    """
    matching = []
    for turn in turns:
        if turn.rotation is None:
            missed = missed_angle(state, poses, turn, matrix=model.gyro_factor * np.eye(3))
            if missed >= CONTRADICTED:
                continue
        matching.append(turn)
    return matching, len(turns) - len(matching)


@dataclass(frozen=True, eq=False)
class Inliers:
    """Poses and turns without outliers."""

    poses: Poses
    """All poses; outlying ones have negligible weight."""
    turns: list[TurnData]
    """Turns that are no outliers."""
    n_outliers: dict[str, int]
    """Kind (`COMPONENTS`) -> number of outliers; kinds without any are omitted."""


def without_outlying_poses(
    model: HandModel,
    estimate: RowEstimate,
    *,
    poses: Poses,
    turns: list[TurnData],
    integrated: dict | None = None,
) -> Inliers:
    """
    Return the poses and turns without outliers, each compared with the other ones of its kind.

    The comparisons are F tests with Bonferroni correction. `integrated`: the turns at the estimate,
    from `solve_joint`.
    """
    rows = GravityRows(model, poses, turns, integrated or {}).linearise(estimate.state)
    residual, basis = _whitened(rows, estimate)
    of_poses, of_drifts, of_turns = COMPONENTS
    # Kind -> numbers of the poses; a turn has that of the pose in which it begins.
    outliers: dict[str, tuple[int, ...]] = {}
    for component, kind in enumerate(COMPONENTS):
        of_kind = rows.component == component
        outlying = _outlying(residual[of_kind], basis[of_kind], rows.group[of_kind])
        if outlying:
            outliers[kind] = outlying
    if of_poses in outliers:
        poses = replace(poses, force_sem=_loosened(poses.force_sem, outliers[of_poses]))
    if of_drifts in outliers:
        poses = replace(poses, rate_sem=_loosened(poses.rate_sem, outliers[of_drifts]))
    begins = outliers.get(of_turns, ())
    turns = [turn for turn in turns if turn.rotation is not None or turn.first not in begins]
    return Inliers(poses, turns, {kind: len(numbers) for kind, numbers in outliers.items()})


def _outlying(residual: np.ndarray, basis: np.ndarray, pose: np.ndarray) -> tuple[int, ...]:
    """
    Return the poses whose rows are outliers among all rows of a kind.

    `residual`, `basis`: of the rows of the kind, as from `_whitened`; `pose`: their poses, (m,).
    """
    misfit_of_kind = _misfit(residual, basis, LEAST_SHARE_OF_KIND)
    p_values = {}
    for number in np.unique(pose).tolist():
        tested = pose == number
        misfit = _misfit(residual[tested], basis[tested], LEAST_ERROR_SHARE)
        p_values[number] = _p_value(misfit, misfit_of_kind)
    most = max(1, int(MAX_POSE_OUTLIERS * len(p_values)))
    return find_outliers(p_values, n_tests=len(p_values), most=most).numbers


def _whitened(rows: Rows, estimate: RowEstimate) -> tuple[np.ndarray, np.ndarray]:
    """
    Return (residuals in sds, orthonormal basis of the columns), shapes (m,) and (m, q).

    Columns are those of the nuisances and of the estimated parameters.
    """
    weighted = rows.of_parameters(estimate.free).with_scatter(estimate.scatter.variance)
    white = flat(weighted.white())
    design = white[:, :-1]
    right_side = white[:, -1]
    # A ridge, as some columns may be dependent.
    ridge = np.diag(1e-6 * np.linalg.norm(design, axis=0) + 1e-300)
    factor = triangular_of_band(np.vstack([design, ridge]))
    basis = solve_triangular(factor, design.T, trans='T').T
    return right_side - basis @ (basis.T @ right_side), basis


class _Misfit(NamedTuple):
    """Misfit of some rows, in standard deviations after the fit."""

    square: float
    """Squared Mahalanobis distance."""
    rank: int
    """Rank of the covariance of the residuals."""


def _misfit(residual: np.ndarray, basis: np.ndarray, least: float) -> _Misfit:
    """
    Return the misfit ``r' C^-1 r`` of residuals r, in sds, with their covariance C after the fit.

    ``C = 1 - B B'`` with the rows B of the basis. Combinations of residuals with a variance below
    `least`, which the fit makes almost zero, are omitted.
    """
    variances, combinations = np.linalg.eigh(np.eye(len(residual)) - basis @ basis.T)
    tested = variances > least
    square = np.sum((combinations[:, tested].T @ residual) ** 2 / variances[tested])
    return _Misfit(float(square), int(np.count_nonzero(tested)))


def _p_value(tested: _Misfit, all_rows: _Misfit) -> float:
    """
    Return the p-value of an F test of a pose or turn against all other rows of its kind.

    It is 1 without degrees of freedom.
    """
    spare = all_rows.rank - tested.rank
    if not tested.rank or spare < MIN_POSE_FREEDOM:
        return 1.0
    other_square = all_rows.square - tested.square
    return chance_of_fall(tested.square, tested.rank, rest=other_square, spare=spare)


def _loosened(sem: np.ndarray, outliers: Sequence[int]) -> np.ndarray:
    """Return standard errors (k, 3), enlarged by `OUTLIER_SD_FACTOR` in the poses `outliers`."""
    loose = sem.copy()
    loose[list(outliers)] *= OUTLIER_SD_FACTOR
    return loose
