"""
Bias and matrix by plain least squares, where they predict held-out data better than the solution.

Weights by noise and effects of the catalogue give the better estimate where the residual is noise.
With a cause that no effect describes, the weight of quiet windows and effects that resemble the
cause move bias and matrix away from the values with the smallest error in motion.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.from_solution import ModelChanges
from imu_calibration.calibration.proof import (
    compared,
    errors_of,
    is_of_reference,
    judged_regimes,
    nominal_values,
    with_reference,
)
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import coefficients
from imu_calibration.estimation.scaled_solve import scaled_lstsq
from imu_calibration.estimation.solution import MODEL_ERROR, Solution, with_term
from imu_calibration.estimation.window_statistics import N_AXES
from imu_calibration.references.turntable.session_data import TABLE_FOLDS, HeldOut

HARDLY_WORSE = 1.02
"""
Error on held-out data, relative to that of the solution, up to which a plain fit is applied: an
unexplained residual differs in other sessions, so that the solution has to be better by more.
"""
CLEARLY_BETTER = 0.98
"""Error relative to another one from which an estimate counts as better."""
FITTED = (Role.OFFSET, Role.LINEAR)
"""Effects of a plain fit."""


@dataclass(frozen=True, eq=False)
class PlainFit:
    """Bias and matrix of one sensor by least squares, its further effects at their prior."""

    sensor: str
    """The sensor."""
    replaced: np.ndarray
    """True for the parameters that the fit replaces in a solution, shape (n_params,)."""
    fitted: np.ndarray
    """True for those that it estimates, shape (n_params,)."""
    dropped: tuple[str, ...]
    """Names of the effects that it leaves at their prior."""
    values: np.ndarray
    """Parameters from all pieces, shape (n_params,); of use where `replaced`."""
    folds: list[np.ndarray]
    """The same without the pieces of each fold."""
    error: float
    """Rms error on held-out pieces, SI."""
    error_of_solution: float
    """Rms error of the solution on the same pieces, SI."""

    def merged(self, folds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return parameters of folds with those of the fit."""
        pairs = zip(folds, self.folds, strict=True)
        return [np.where(self.replaced, fitted, values) for values, fitted in pairs]


def better_plain_fits(
    held_out: HeldOut,
    solution: Solution,
    folds: Sequence[np.ndarray],
    *,
    unexplained: Collection[str],
) -> tuple[PlainFit, ...]:
    """
    Return the plain fits to apply: they predict held-out windows better than a solution.

    Parameters
    ----------
    held_out : HeldOut
        Windows in folds, with the columns of the model of the solution.
    solution : Solution
    folds : sequence of ndarray, shape (n_params,)
        Parameters as compensation applies them, estimated without each fold.
    unexplained : collection of str
        Sensors with a residual that is neither noise nor an effect of the model.

    """
    regimes, counts = judged_regimes(held_out)
    if not regimes or not unexplained:
        return ()
    model = solution.model
    nominal = nominal_values(model)
    described = [with_reference(model, values, nominal) for values in folds]
    # The table and the clock as described, and as the solution has them.
    references = (nominal, with_reference(model, nominal, solution.values))
    better = []
    for sensor in SENSORS:
        if sensor not in unexplained:
            continue
        squares_of_solution = _least(
            errors_of(held_out, model, sensor, folds=candidate, regimes=regimes).squares.sum(axis=1)
            for candidate in (folds, described)
        )
        fits = [_plain_fit(held_out, solution, sensor, reference) for reference in references]
        squares = [
            errors_of(held_out, model, sensor, folds=fit.folds, regimes=regimes).squares.sum(axis=1)
            for fit in fits
        ]
        # Estimates of the table and the clock have to pay: the residual may have moved them.
        described_error, estimated_error = (np.sqrt(each.sum()) for each in squares)
        best = int(estimated_error < CLEARLY_BETTER * described_error)
        figures = compared(squares_of_solution, squares[best], counts.sum(axis=1))
        ratio = figures['after'] / max(figures['before'], 1e-300)
        if ratio < HARDLY_WORSE:
            better.append(
                replace(fits[best], error=figures['after'], error_of_solution=figures['before'])
            )
    return tuple(better)


def with_plain_fits(solution: Solution, fits: Sequence[PlainFit]) -> Solution:
    """
    Return the solution with the values of plain fits.

    The change of each sensor is a part of its covariance: both estimates have errors of that size.
    """
    for fit in fits:
        values = np.where(fit.replaced, fit.values, solution.values)
        change = values - solution.values
        at_prior = np.isin(solution.param_names, solution.replaced) & ~fit.fitted
        at_prior |= fit.replaced & ~fit.fitted & ~solution.held
        solution = replace(
            solution,
            values=values,
            terms=with_term(solution.terms, MODEL_ERROR, np.outer(change, change)),
            held=(solution.held | at_prior) & ~fit.fitted,
            replaced=tuple(np.array(solution.param_names)[at_prior].tolist()),
        )
    return solution


def plain_entries(fits: Sequence[PlainFit]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the part of a document's statistics: sensor -> held-out errors of both estimates."""
    if not fits:
        return {}
    return {
        'least_squares': {
            fit.sensor: {'error': fit.error, 'error_of_model': fit.error_of_solution}
            for fit in fits
        }
    }


def changes_with(changes: ModelChanges, fits: Sequence[PlainFit]) -> ModelChanges:
    """Return the changes of a model in which effects that plain fits replace are not added."""
    names = {name for fit in fits for name in fit.dropped}
    dropped = tuple(name for name in changes.added if name in names)
    return replace(
        changes,
        added=tuple(name for name in changes.added if name not in names),
        unstable=(*changes.unstable, *dropped),
    )


def _least(candidates):
    return min(candidates, key=lambda squares: squares.sum())


def _plain_fit(held_out, solution, sensor, reference):
    """Return the `PlainFit` of a sensor with the table and the clock of `reference`."""
    model = solution.model
    replaced = np.zeros(len(reference), bool)
    fitted = np.zeros(len(reference), bool)
    dropped = []
    for effect in model.effects:
        if effect.sensor == sensor and effect.role in FITTED:
            fitted[model.slices[effect.key]] = True
        elif effect.sensor != sensor or effect.role is Role.LIMIT or is_of_reference(effect):
            continue
        else:
            dropped.append(effect.name)
        replaced[model.slices[effect.key]] = True
    # Entries without information keep their values; weak ones at their prior are estimated.
    uninformed = solution.held & ~np.isin(solution.param_names, solution.replaced)
    fitted &= ~uninformed
    replaced &= ~uninformed
    start = np.where(uninformed, solution.values, reference)

    rows, targets = _equations(held_out, model, sensor, start=start, fitted=fitted)
    folds = []
    for fold in range(TABLE_FOLDS):
        others = [k for k in range(len(rows)) if k % TABLE_FOLDS != fold]
        folds.append(_solved(start, fitted, rows, targets, others))
    values = _solved(start, fitted, rows, targets, range(len(rows)))
    return PlainFit(sensor, replaced, fitted, tuple(dropped), values, folds, np.nan, np.nan)


def _equations(held_out, model, sensor, *, start, fitted):
    """
    Return for each block the rows and right sides of ``output = columns @ coefficients(values)``.

    The coefficients are linear in bias and matrix, so that one step from `start` is exact.
    """
    total = coefficients(model, sensor, start)
    slopes = []
    for index in np.flatnonzero(fitted):
        moved = start.copy()
        moved[index] += 1.0
        slopes.append(coefficients(model, sensor, moved) - total)
    rows, targets = [], []
    for block in held_out.blocks:
        pieces = [
            part
            for kept in (block.pieces, block.earlier)
            for (name, _), part in kept.items()
            if name == sensor
        ]
        width = len(total)
        stacked = np.concatenate([*pieces, np.zeros((0, width + 2 * N_AXES))])
        columns, output = stacked[:, :width], stacked[:, -N_AXES:]
        rows.append(np.stack([(columns @ slope).ravel() for slope in slopes], axis=1))
        targets.append((output - columns @ total).ravel())
    return rows, targets


def _solved(start, fitted, rows, targets, blocks):
    """Return the parameters that fit the rows of some blocks."""
    values = start.copy()
    values[fitted] += scaled_lstsq(
        np.concatenate([rows[k] for k in blocks]), np.concatenate([targets[k] for k in blocks])
    )
    return values
