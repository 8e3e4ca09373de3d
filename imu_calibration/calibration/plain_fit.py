"""
Bias and matrix by plain least squares, where they predict held-out data better than the solution.

Weights by noise and effects of the catalogue give the better estimate where the residual is noise.
With a cause that no effect describes, the weight of quiet windows and effects that resemble the
cause move bias and matrix away from the values with the smallest error in motion. One rule serves
all references.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from imu_calibration.calibration.from_solution import Estimate, ModelChanges
from imu_calibration.calibration.held_out_data import HeldOutData, PlainEstimate, PlainFit
from imu_calibration.calibration.proof import smallest_errors
from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.forward_equations import not_applied
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import MODEL_ERROR, Solution, with_term

CLEARLY_BETTER = 0.98
"""Error relative to another one from which an estimate counts as better."""
FITTED = (Role.OFFSET, Role.LINEAR)
"""Effects of a plain fit."""
PARTS_OF_TIME = 3
"""Parts of a session that are held out in turn: an effect in time is applied at one moment."""

Data = TypeVar('Data', bound=HeldOutData[Any])


def sensors_with_residual(changes: ModelChanges, model: SensorModel) -> set[str]:
    """Return the sensors with a residual that is neither noise nor an effect of the model."""
    if changes.changed_at is not None:
        # No search has tested the residual of the complete recording.
        return set(SENSORS)

    sensors = set(changes.unexplained)
    # An effect that is found but not applied remains in the residual.
    for (_, name), effect in model.catalogue.effects(model.joint_names).items():
        if name in changes.implausible:
            sensors.update(effect.sensors)
    return sensors


def better_plain_fits(
    held_out: HeldOutData[Any], *, under_test: Collection[str], as_asked: bool = False
) -> tuple[PlainFit, ...]:
    """
    Return the plain fits to apply, at most one for each sensor.

    Errors are compared on data held out in turn, and as complete regimes and parts of the session:
    an effect that imitates another cause predicts only the motions from which it was estimated. For
    a sensor under test, one comparison in which the plain fit is not clearly worse suffices. For
    another one, whose effects without a compensation remain in other sessions, the plain fit must
    be better on regimes or parts.

    Parameters
    ----------
    held_out : HeldOutData
    under_test : collection of str
        Sensors with a residual that is neither noise nor an effect of the applied model.
    as_asked : bool
        Whether the model was stated and not searched for: its effects are replaced only by a test.

    """
    # Effects without a compensation are a residual of each other session.
    incomplete = {effect.sensor for effect in not_applied(held_out.solution.model)}
    better: list[PlainFit] = []
    for sensor in held_out.judged:
        is_under_test = sensor in under_test
        # Otherwise only the weights differ, by the noise.
        if not is_under_test and (as_asked or sensor not in incomplete):
            continue
        # The other sensor is the one that is applied: it has the directions of turns.
        applied = with_plain_fits(held_out.solution, better).values
        fit = compared_fit(held_out, sensor, applied)
        if fit is None:
            continue
        fits_elsewhere = held_out.fits_elsewhere(sensor, fit.estimate, applied)
        if is_under_test:
            is_applied = fit.is_close or any(other.is_close for other in fits_elsewhere)
        else:
            is_applied = any(other.is_better for other in fits_elsewhere)
        if is_applied:
            better.append(fit)
    return tuple(better)


def compared_fit(held_out: HeldOutData[Any], sensor: str, applied: np.ndarray) -> PlainFit | None:
    """
    Return the plain fit of a sensor with the errors of both estimates on held-out data.

    None for a reference without plain equations. `applied`: parameters of the other sensor, which
    are the same in all folds, shape (n_params,).
    """
    judged = held_out.judged[sensor]
    model = held_out.solution.model
    is_of_other = model.mask(lambda effect: effect.sensor not in (sensor, 'reference'))

    # Error of the solution, with the applied parameters of the other sensor.
    folds = [np.where(is_of_other, applied, values) for values in held_out.folds]
    solution_error = judged.rms(smallest_errors(held_out, sensor, folds))

    # The first plain fit has the reference as described, the others estimate it.
    chosen: PlainFit | None = None
    for equations in held_out.plain_equations(sensor, applied):
        estimate = equations.estimate(held_out.masks)
        folds = [np.where(is_of_other, applied, values) for values in estimate.folds]
        error = judged.rms(held_out.errors(sensor, folds))
        # Estimates of the table and the clock have to pay: the residual may have moved them.
        if chosen is None or error < CLEARLY_BETTER * chosen.error:
            chosen = PlainFit(
                sensor=sensor,
                estimate=estimate,
                error=error,
                error_of_solution=solution_error,
                unit=judged.unit,
            )
    return chosen


def with_plain_fits(solution: Estimate, fits: Sequence[PlainFit]) -> Estimate:
    """
    Return the solution with the values of plain fits.

    The change of each sensor is a part of its covariance: both estimates have errors of that size.
    """
    names = np.array(solution.param_names)
    for fit in fits:
        estimate = fit.estimate
        values = np.where(estimate.replaced, estimate.values, solution.values)
        change = values - solution.values
        # At their prior afterwards: parameters that a prior replaced before and that the fit does
        # not estimate, and the estimated parameters of effects that the fit drops.
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


def with_fits(held_out: Data, fits: Sequence[PlainFit]) -> Data:
    """Return the held-out data with the parameters of plain fits."""
    folds = held_out.folds
    for fit in fits:
        folds = fit.merged(folds)
    return replace(held_out, solution=with_plain_fits(held_out.solution, fits), folds=folds)


def plain_entries(fits: Sequence[PlainFit]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the part of a document's statistics: sensor -> held-out errors of both estimates."""
    if not fits:
        return {}
    entries = {}
    for fit in fits:
        entries[fit.sensor] = {
            'error': fit.error,
            'error_of_model': fit.error_of_solution,
            'unit': fit.unit,
        }
    return {'least_squares': entries}


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


def plan_of(solution: Solution, sensor: str, reference: np.ndarray) -> PlainEstimate:
    """
    Return the plan of a plain fit of a sensor: the parameters to estimate and to replace.

    Its values, from which the fit begins, are those of `reference`, shape (n_params,); parameters
    without information keep those of the solution.
    """
    model = solution.model
    replaced = np.zeros(len(reference), bool)
    fitted = np.zeros(len(reference), bool)
    dropped = []
    for effect in model.effects:
        parameters = model.slices[effect.key]
        if effect.sensor != sensor:
            continue
        if effect.role in FITTED:
            replaced[parameters] = fitted[parameters] = True
        # The limit of a range has no linear column, and the reference is that of both fits.
        elif effect.role is not Role.LIMIT and not is_of_reference(effect):
            replaced[parameters] = True
            dropped.append(effect.name)
    # Held parameters keep their values, because the data have no information on them; only weak
    # ones, which `solution.replaced` names (their estimate was replaced by the prior), are fitted.
    uninformed = solution.held & ~np.isin(solution.param_names, solution.replaced)
    fitted &= ~uninformed
    replaced &= ~uninformed
    start = np.where(uninformed, solution.values, reference)
    return PlainEstimate(
        replaced=replaced, fitted=fitted, dropped=tuple(dropped), values=start, folds=[]
    )


def is_of_reference(effect: Effect) -> bool:
    """Return whether an effect is of the table or the clock: compensation does not correct it."""
    return effect.in_reference or effect.sensor == 'reference' or effect.warp is not None
