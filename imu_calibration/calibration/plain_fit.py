"""
Bias and matrix by plain least squares, where they predict held-out data better than the solution.

Weights by noise and effects of the catalogue give the better estimate where the residual is noise.
With a cause that no effect describes, the weight of quiet windows and effects that resemble the
cause move bias and matrix away from the values with the smallest error in motion.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

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
from imu_calibration.effects.base import UNITS, Role
from imu_calibration.effects.forward_equations import (
    Centre,
    applied_values,
    coefficients,
    not_applied,
)
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import Prior, fixed_parameters, make_prior
from imu_calibration.estimation.scaled_solve import scaled_lstsq
from imu_calibration.estimation.solution import MODEL_ERROR, Solution, with_term
from imu_calibration.references.turntable.accumulator import stack
from imu_calibration.references.turntable.session_data import TABLE_FOLDS, HeldOut
from imu_calibration.references.turntable.window_statistics import N_AXES, count_pieces

HARDLY_WORSE = 1.02
"""
Error on held-out data, relative to that of the solution, up to which a plain fit is applied: an
unexplained residual differs in other sessions, so that the solution has to be better by more.
"""
CLEARLY_BETTER = 0.98
"""Error relative to another one from which an estimate counts as better."""
FITTED = (Role.OFFSET, Role.LINEAR)
"""Effects of a plain fit."""
PARTS_OF_TIME = 3
"""Parts of a session that are held out in turn: an effect in time is applied at one moment."""

Fitted = TypeVar('Fitted', bound=Solution)


@dataclass(frozen=True, eq=False)
class PlainEstimate:
    """Bias and matrix of one sensor by least squares, its further effects at their prior."""

    replaced: np.ndarray
    """True for the parameters that the fit replaces in a solution, shape (n_params,)."""
    fitted: np.ndarray
    """True for those that it estimates, shape (n_params,)."""
    dropped: tuple[str, ...]
    """Names of the effects that it leaves at their prior."""
    values: np.ndarray
    """Parameters from all data, shape (n_params,); of use where `replaced`."""
    folds: list[np.ndarray]
    """The same without the data of each fold."""


@dataclass(frozen=True, eq=False)
class PlainFit:
    """A plain estimate that predicts held-out data better than a solution."""

    sensor: str
    """The sensor."""
    estimate: PlainEstimate
    """Its bias and matrix."""
    error: float
    """Rms error on held-out data, SI; by hand of a gyroscope rad per turn."""
    error_of_solution: float
    """Rms error of the solution on the same data."""
    unit: str = ''
    """Unit of both errors; empty: that of the sensor."""

    @property
    def is_close(self) -> bool:
        """Whether the plain fit is better than the solution, or hardly worse."""
        return self.error < HARDLY_WORSE * self.error_of_solution

    def merged(self, folds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return parameters of folds with those of the fit."""
        merged = []
        for values, fitted in zip(folds, self.estimate.folds, strict=True):
            merged.append(np.where(self.estimate.replaced, fitted, values))
        return merged


def better_plain_fits(
    held_out: HeldOut,
    solution: Solution,
    folds: Sequence[np.ndarray],
    *,
    under_test: Collection[str],
    centre: Centre,
    as_asked: bool = False,
) -> tuple[PlainFit, ...]:
    """
    Return the plain fits to apply: they predict held-out windows better than a solution.

    Windows are held out in turn, and as complete regimes and parts of the session: an effect that
    stands in for another cause predicts the motions from which it was estimated only.

    Parameters
    ----------
    held_out : HeldOut
        Windows in folds, with the columns of the model of the solution.
    solution : Solution
    folds : sequence of ndarray, shape (n_params,)
        Parameters as compensation applies them, estimated without each fold.
    under_test : collection of str
        Sensors with a residual that is neither noise nor an effect of the catalogue.
    centre : mapping
        As for `applied_folds`.
    as_asked : bool
        Whether the model was stated and not searched for: its effects are replaced only by a test.

    """
    regimes, counts = judged_regimes(held_out)
    model = solution.model
    replaceable = replaceable_sensors(model, under_test, as_asked=as_asked)
    if not regimes or not replaceable:
        return ()
    nominal = nominal_values(model)
    described = [with_reference(model, values, nominal) for values in folds]
    # The table and the clock as described, and as the solution has them.
    references = (nominal, with_reference(model, nominal, solution.values))

    def squares(sensor: str, candidate: Sequence[np.ndarray]) -> np.ndarray:
        """Return the squared errors on the held-out pieces of each block."""
        errors = errors_of(held_out, model, sensor, folds=candidate, regimes=regimes)
        return errors.squares.sum(axis=1)

    better = []
    for sensor in held_out.sensors:
        if sensor not in replaceable:
            continue
        of_solution = min(squares(sensor, folds), squares(sensor, described), key=np.sum)

        # Estimates of the table and the clock have to pay: the residual may have moved them.
        estimates = [_plain_estimate(held_out, solution, sensor, each) for each in references]
        with_described, with_estimated = (squares(sensor, each.folds) for each in estimates)
        chosen, of_plain = estimates[0], with_described
        if np.sqrt(with_estimated.sum()) < CLEARLY_BETTER * np.sqrt(with_described.sum()):
            chosen, of_plain = estimates[1], with_estimated

        errors = compared(of_solution, of_plain, counts.sum(axis=1), unit=UNITS[sensor])
        fit = PlainFit(sensor, chosen, errors.after, errors.before)
        if (sensor in under_test and fit.is_close) or _misses_other_regimes(
            held_out, solution, chosen, sensor, centre=centre
        ):
            better.append(fit)
    return tuple(better)


def replaceable_sensors(
    model: SensorModel, under_test: Collection[str], *, as_asked: bool
) -> set[str]:
    """
    Return the sensors with a solution that has to predict better than a plain fit.

    Arguments as for `better_plain_fits`.
    """
    replaceable = set(under_test)
    if not as_asked:
        # An effect that compensation does not apply is a residual of each other session.
        replaceable |= {effect.sensor for effect in not_applied(model)}
    return replaceable


def misses(error: float, error_of_plain: float) -> bool:
    """Return whether a solution predicts data of another kind worse than a plain fit."""
    return error > HARDLY_WORSE * error_of_plain


def with_plain_fits(solution: Fitted, fits: Sequence[PlainFit]) -> Fitted:
    """
    Return the solution with the values of plain fits.

    The change of each sensor is a part of its covariance: both estimates have errors of that size.
    """
    names = np.array(solution.param_names)
    for fit in fits:
        estimate = fit.estimate
        values = np.where(estimate.replaced, estimate.values, solution.values)
        change = values - solution.values
        at_prior = np.isin(names, solution.replaced) & ~estimate.fitted
        at_prior |= estimate.replaced & ~estimate.fitted & ~solution.held
        solution = replace(
            solution,
            values=values,
            terms=with_term(solution.terms, MODEL_ERROR, np.outer(change, change)),
            held=(solution.held | at_prior) & ~estimate.fitted,
            replaced=tuple(names[at_prior].tolist()),
        )
    return solution


def plain_entries(fits: Sequence[PlainFit]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the part of a document's statistics: sensor -> held-out errors of both estimates."""
    if not fits:
        return {}
    return {
        'least_squares': {
            fit.sensor: {
                'error': fit.error,
                'error_of_model': fit.error_of_solution,
                'unit': fit.unit or UNITS[fit.sensor],
            }
            for fit in fits
        }
    }


def changes_with(changes: ModelChanges, fits: Sequence[PlainFit]) -> ModelChanges:
    """Return the changes of a model in which effects that plain fits replace are not added."""
    replaced = set()
    for fit in fits:
        replaced.update(fit.estimate.dropped)
    dropped = tuple(name for name in changes.added if name in replaced)
    return replace(
        changes,
        added=tuple(name for name in changes.added if name not in replaced),
        unstable=(*changes.unstable, *dropped),
    )


def _plain_estimate(
    held_out: HeldOut, solution: Solution, sensor: str, reference: np.ndarray
) -> PlainEstimate:
    """Return the estimate of a sensor with the table and the clock of `reference`."""
    model = solution.model
    plan = plan_of(solution, sensor, reference)
    start = plan.values
    rows, targets = _equations(held_out, model, sensor, start=start, fitted=plan.fitted)
    folds = []
    for fold in range(TABLE_FOLDS):
        others = [k for k in range(len(rows)) if k % TABLE_FOLDS != fold]
        folds.append(_solved(start, plan.fitted, rows, targets, others))
    values = _solved(start, plan.fitted, rows, targets, range(len(rows)))
    return replace(plan, values=values, folds=folds)


def plan_of(solution: Solution, sensor: str, reference: np.ndarray) -> PlainEstimate:
    """Return which parameters a plain fit estimates and replaces, at the values of `reference`."""
    model = solution.model
    replaced = np.zeros(len(reference), bool)
    fitted = np.zeros(len(reference), bool)
    dropped = []
    for effect in model.effects:
        part = model.slices[effect.key]
        if effect.sensor != sensor:
            continue
        if effect.role in FITTED:
            replaced[part] = fitted[part] = True
        elif effect.role is not Role.LIMIT and not is_of_reference(effect):
            replaced[part] = True
            dropped.append(effect.name)
    # Entries without information keep their values; weak ones at their prior are estimated.
    uninformed = solution.held & ~np.isin(solution.param_names, solution.replaced)
    fitted &= ~uninformed
    replaced &= ~uninformed
    start = np.where(uninformed, solution.values, reference)
    return PlainEstimate(replaced, fitted, tuple(dropped), start, [])


def _misses_other_regimes(
    held_out: HeldOut, solution: Solution, plain: PlainEstimate, sensor: str, *, centre: Centre
) -> bool:
    """
    Return whether the effects of a solution predict regimes worse that they were not fitted to.

    Effects and plain fit are estimated by least squares from the same pieces, so that only the
    effects differ; the effects have their priors.
    """
    model = solution.model
    free = np.zeros(len(solution.values), bool)
    for effect in model.effects:
        amplitudes = model.slices[effect.key].start + np.arange(effect.n_amplitudes)
        if effect.sensor == sensor and not is_of_reference(effect):
            free[amplitudes] = True
    free &= ~fixed_parameters(model) & ~solution.held
    if not np.any(free & ~plain.fitted):
        return False
    prior = make_prior(model)
    n_pieces = 0
    for block in held_out.blocks:
        n_pieces += sum(count_pieces(row.duration) for row in block.accumulator.rows)
    # Another regime of the same session has its drift; another session has the applied values.
    trials = (
        (_groups_by_regime(held_out, sensor), None),
        (_groups_by_time(held_out, sensor), centre),
    )
    for groups, applied_at in trials:
        if len(groups) < 2:
            continue
        of_model = _error_on_groups(
            groups,
            model,
            sensor,
            values=solution.values,
            free=free,
            centre=applied_at,
            prior=prior,
            n_pieces=n_pieces,
        )
        of_plain = _error_on_groups(groups, model, sensor, values=plain.values, free=plain.fitted)
        if misses(of_model, of_plain):
            return True
    return False


def _groups_by_regime(held_out: HeldOut, sensor: str) -> list[np.ndarray]:
    """Return ``[columns | output]`` of the pieces of each regime of motion, as factors."""
    stacked: dict[tuple[str, str], np.ndarray] = {}
    for block in held_out.blocks:
        for kept in (block.pieces, block.earlier):
            for (name, regime), part in kept.items():
                if name == sensor:
                    # without the derivative of the true input
                    rows = np.delete(part, np.s_[-2 * N_AXES : -N_AXES], axis=1)
                    stack(stacked, (name, regime), rows)
    return list(stacked.values())


def _groups_by_time(held_out: HeldOut, sensor: str) -> list[np.ndarray]:
    """Return ``[columns | output]`` of the window means of each part of a session, as factors."""
    windows = [row for block in held_out.blocks for row in block.accumulator.rows]
    end = max((row.time for row in windows), default=0.0)
    stacked: dict[tuple[str, str], np.ndarray] = {}
    for row in windows:
        part = min(int(PARTS_OF_TIME * row.time / max(end, 1e-9)), PARTS_OF_TIME - 1)
        weight = np.sqrt(count_pieces(row.duration))
        stack(stacked, (sensor, str(part)), weight * row.sensors[sensor].mean[None])
    return list(stacked.values())


def _error_on_groups(
    groups: Sequence[np.ndarray],
    model: SensorModel,
    sensor: str,
    *,
    values: np.ndarray,
    free: np.ndarray,
    centre: Centre | None = None,
    prior: Prior | None = None,
    n_pieces: int = 1,
) -> float:
    """
    Return the root of the sum of squared errors on groups, each predicted from the remaining ones.

    One step from `values`, with parameters as compensation applies them where there is a `centre`.
    `n_pieces`: number of pieces that the factors stand for, for the weight of the prior.
    """
    # Slopes per standard deviation of the prior: the coefficients are linear over it.
    total = coefficients(model, sensor, values)
    index = np.flatnonzero(free)
    sd = model.prior()[1][index]
    slopes = []
    for place, step in zip(index, sd, strict=True):
        moved = values.copy()
        moved[place] += step
        slopes.append(coefficients(model, sensor, moved) - total)
    designs = []
    targets = []
    for group in groups:
        columns, output = group[:, :-N_AXES], group[:, -N_AXES:]
        designs.append(np.stack([(columns @ slope).ravel() for slope in slopes], axis=1))
        targets.append((output - columns @ total).ravel())

    # The prior has the weight of its information relative to the residual.
    known = np.zeros((0, len(index)))
    known_targets = np.zeros(0)
    if prior is not None:
        residual_sd = np.sqrt(np.sum(np.concatenate(targets) ** 2) / (N_AXES * n_pieces))
        known = residual_sd * prior.root[:, index] * sd
        known_targets = residual_sd * (prior.root @ (prior.mean - values))

    squares = 0.0
    for held, group in enumerate(groups):
        others = [k for k in range(len(groups)) if k != held]
        design = np.concatenate([known, *(designs[k] for k in others)])
        target = np.concatenate([known_targets, *(targets[k] for k in others)])
        fitted = values.copy()
        fitted[index] += sd * scaled_lstsq(design, target)
        if centre is not None:
            fitted = applied_values(model, fitted, centre)
        error = group[:, -N_AXES:] - group[:, :-N_AXES] @ coefficients(model, sensor, fitted)
        squares += float(np.sum(error**2))
    return float(np.sqrt(squares))


def _equations(
    held_out: HeldOut, model: SensorModel, sensor: str, *, start: np.ndarray, fitted: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
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
    width = len(total)
    rows = []
    targets = []
    for block in held_out.blocks:
        pieces = [np.zeros((0, width + 2 * N_AXES))]
        for kept in (block.pieces, block.earlier):
            pieces += [part for (name, _), part in kept.items() if name == sensor]
        stacked = np.concatenate(pieces)
        columns, output = stacked[:, :width], stacked[:, -N_AXES:]
        rows.append(np.stack([(columns @ slope).ravel() for slope in slopes], axis=1))
        targets.append((output - columns @ total).ravel())
    return rows, targets


def _solved(
    start: np.ndarray,
    fitted: np.ndarray,
    rows: list[np.ndarray],
    targets: list[np.ndarray],
    blocks: Sequence[int],
) -> np.ndarray:
    """Return the parameters that fit the rows of some blocks, numbers in their list."""
    design = np.concatenate([rows[k] for k in blocks])
    target = np.concatenate([targets[k] for k in blocks])
    values = start.copy()
    values[fitted] += scaled_lstsq(design, target)
    return values
