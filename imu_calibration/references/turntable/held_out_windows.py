"""
Held-out windows on a table: errors of short pieces, and plain fits of them.

The error of a piece is its mean reading, corrected as compensation corrects it, minus the
reference. It is computed with nominal parameters (before) and with the calibration (after). The
position of the sensor on the table and the delay of the readings, which compensation does not
correct, are estimated for both: so a wrong scale that compensates for a lag is visible.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from imu_calibration.calibration.held_out_data import (
    HeldOutData,
    HeldOutErrors,
    JudgedData,
    PlainEquations,
    PlainEstimate,
    PlainFit,
    applied_folds,
    masks_in_turn,
)
from imu_calibration.calibration.plain_fit import PARTS_OF_TIME, is_of_reference, plan_of
from imu_calibration.calibration.proof import MIN_REGIME_BLOCKS, proof_entry, smallest
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.proof_entry import Proof, ProofEntry
from imu_calibration.effects.base import SENSORS, UNITS, Role
from imu_calibration.effects.forward_equations import Centre, applied_values, coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.gauss_newton import after_one_step
from imu_calibration.estimation.prior import Prior, fixed_parameters, make_prior
from imu_calibration.estimation.scaled_solve import scaled_lstsq
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.accumulator import stack
from imu_calibration.references.turntable.estimation.one_attitude import one_attitude
from imu_calibration.references.turntable.session_data import TABLE_FOLDS, HeldOut
from imu_calibration.references.turntable.window_statistics import (
    N_AXES,
    PIECE_TIME,
    Regime,
    count_pieces,
)

MAX_SEARCHED_DELAY = 0.1
"""Largest delay of the search, s."""


@dataclass(frozen=True, eq=False)
class HeldOutWindows(HeldOutData[Solution]):
    """
    Windows in folds, each predicted with parameters that were estimated without it.

    The correction is linearised at the reference motion, ``corrected = true + matrix^-1 (measured -
    output(true))``, because statistics of windows suffice for it. It differs from the correction
    of single readings by the square of the errors.
    """

    windows: HeldOut
    """The windows in folds, with the columns of the model of the solution."""
    centre: Centre
    """Operating point at which effects that compensation cannot undo are applied."""

    @classmethod
    def of(cls, windows: HeldOut, solution: Solution, centre: Centre) -> 'HeldOutWindows':
        """Return the windows with the parameters of a solution without each fold."""
        folds = applied_folds(solution, windows.values_without(solution), centre)
        masks = masks_in_turn(len(windows.blocks), TABLE_FOLDS)
        return cls(solution, folds, masks, windows, centre)

    @cached_property
    def _nominal(self) -> np.ndarray:
        """Nominal parameters, with the table and the clock as described."""
        return nominal_values(self.solution.model)

    @cached_property
    def _nominal_sensors(self) -> np.ndarray:
        """Nominal parameters of the sensors, with the table and the clock as estimated."""
        return with_reference(self.solution.model, self._nominal, self.solution.values)

    @cached_property
    def judged(self) -> dict[str, JudgedData]:
        """Sensor -> numbers of its pieces."""
        judged = judged_pieces(self.windows)
        accumulators = [block.accumulator for block in self.windows.blocks]
        if 'accelerometer' in judged and one_attitude(accumulators, self.solution.model):
            judged['accelerometer'] = replace(judged['accelerometer'], one_attitude=True)
        return judged

    def errors(self, sensor: str, folds: Sequence[np.ndarray]) -> HeldOutErrors:
        """Return the errors of the pieces of a sensor."""
        return errors_of(self.windows, self.solution.model, sensor, folds=folds)

    def nominal(self, sensor: str, folds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return nominal parameters of the sensors, with the table and the clock as estimated."""
        return [self._nominal_sensors]

    def descriptions(self, folds: Sequence[np.ndarray]) -> Iterator[Sequence[np.ndarray]]:
        """Yield the parameters with the table and the clock as estimated and as described."""
        yield folds
        yield [with_reference(self.solution.model, values, self._nominal) for values in folds]

    def plain_equations(self, sensor: str, applied: np.ndarray) -> Iterator[PlainEquations]:
        """Yield the equations with the table and the clock as described, and as estimated."""
        for reference in (self._nominal, self._nominal_sensors):
            plan = plan_of(self.solution, sensor, reference)
            yield _Pieces.of(self.windows, self.solution.model, sensor, plan)

    def fits_elsewhere(
        self, sensor: str, estimate: PlainEstimate, applied: np.ndarray
    ) -> Iterator[PlainFit]:
        """
        Yield the errors on regimes and parts of the session that no estimate has seen.

        Effects and plain fit are estimated by least squares from the same pieces, so that only the
        effects differ; the effects have their priors.
        """
        # The amplitudes of the effects of the sensor that were estimated.
        model = self.solution.model
        free = np.zeros(len(self.solution.values), bool)
        for effect in model.effects:
            amplitudes = model.slices[effect.key].start + np.arange(effect.n_amplitudes)
            if effect.sensor == sensor and not is_of_reference(effect):
                free[amplitudes] = True
        free &= ~fixed_parameters(model) & ~self.solution.held
        if not np.any(free):
            return
        prior = make_prior(model)
        n_pieces = 0
        for block in self.windows.blocks:
            n_pieces += sum(count_pieces(row.duration) for row in block.accumulator.rows)
        # Another regime of the same session has its drift; another part of the session stands for
        # another session, in which compensation applies the values at the centre.
        groups_and_centres = (
            (_groups_by_regime(self.windows, sensor), None),
            (_groups_by_time(self.windows, sensor), self.centre),
        )
        for groups, centre in groups_and_centres:
            if len(groups) < 2:
                continue
            of_model = _error_on_groups(
                groups,
                model,
                sensor,
                values=self.solution.values,
                free=free,
                centre=centre,
                prior=prior,
                n_pieces=n_pieces,
            )
            of_plain = _error_on_groups(
                groups, model, sensor, values=estimate.values, free=estimate.fitted
            )
            yield PlainFit(sensor, estimate, of_plain, of_model, UNITS[sensor])


def prove_readings(
    before: HeldOut, after: HeldOut, model: SensorModel, *, reference: np.ndarray
) -> Proof:
    """
    Return the errors of raw and of corrected readings in the same windows, with their ratio.

    Parameters
    ----------
    before, after : HeldOut
        The windows with raw and with corrected readings.
    model : SensorModel
        The model of their columns: bias, matrix, reference.
    reference : array, shape (n_params,)
        Parameters of which those of the table and the clock are used.

    """
    nominal = nominal_values(model)
    # Each side may be compared with the table as it was estimated or as it was described.
    candidates = (nominal, with_reference(model, nominal, reference))
    proof: dict[str, ProofEntry] = {}
    for sensor, judged in judged_pieces(before).items():
        raw = smallest(errors_of(before, model, sensor, folds=[values]) for values in candidates)
        corrected = smallest(
            errors_of(after, model, sensor, folds=[values]) for values in candidates
        )
        proof[sensor] = proof_entry(judged, raw, corrected)
    return proof


def judged_pieces(windows: HeldOut) -> dict[str, JudgedData]:
    """Return sensor -> numbers of its pieces by block and regime; empty with too few blocks."""
    regimes = _regimes_of(windows)
    counts = np.array([[block.counts.get(name, 0) for name in regimes] for block in windows.blocks])
    if (counts.sum(axis=1) > 0).sum() < MIN_REGIME_BLOCKS:
        return {}
    judged = {}
    for sensor in windows.sensors:
        judged[sensor] = JudgedData(
            counts,
            UNITS[sensor],
            windows=windows.n_judged,
            components=N_AXES,
            regimes=tuple(regimes),
            piece_time=PIECE_TIME,
        )
    return judged


def _regimes_of(windows: HeldOut) -> list[Regime]:
    """Return the regimes of motion of the pieces."""
    return [name for name in Regime if any(name in block.counts for block in windows.blocks)]


def nominal_values(model: SensorModel) -> np.ndarray:
    """Return the prior means of the parameters, 0 where there is none, shape (n_params,)."""
    values = model.prior()[0]
    return np.where(np.isfinite(values), values, 0.0)


def reference_model(calibration: Calibration, table: Table) -> SensorModel:
    """
    Return the model of a recording with corrected readings.

    It has bias, matrix, and the effects of the table and the clock that the calibration has.
    """
    calibrated = calibration.model
    same_joints = calibrated.joint_names == table.joint_names
    names: dict[str, list[str]] = {sensor: [] for sensor in SENSORS}
    for effect in calibrated.effects:
        is_plain = effect.role in (Role.OFFSET, Role.LINEAR)
        if effect.sensor in names and (is_plain or (same_joints and is_of_reference(effect))):
            names[effect.sensor].append(effect.name)
    model = SensorModel(
        tuple(names['accelerometer']),
        tuple(names['gyroscope']),
        reference=calibrated.reference if same_joints else (),
        joint_names=table.joint_names,
        temperature_ref_c=calibrated.temperature_ref_c,
        catalogue=calibrated.catalogue,
    )
    model = model.at(reference_values(model, calibration))
    # The position of the sensor on the table is no error of either side: it is estimated for each.
    if not model.find('accelerometer', Role.ARM) and table.mount_xyz is None:
        model = model.with_role('accelerometer', Role.ARM)
    return model


def reference_values(model: SensorModel, calibration: Calibration) -> np.ndarray:
    """
    Return nominal values of the sensors, and those of a calibration for the table and the clock.

    Shape (n_params,).
    """
    calibrated = model.start_from(calibration.model, calibration.values)
    return with_reference(model, nominal_values(model), calibrated)


def with_reference(model: SensorModel, values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """
    Return `values` with the parameters of the table and the clock from `reference`.

    All three have the shape (n_params,).
    """
    return np.where(model.mask(is_of_reference), reference, values)


def errors_of(
    held_out: HeldOut,
    model: SensorModel,
    sensor: str,
    *,
    folds: Sequence[np.ndarray],
) -> HeldOutErrors:
    """
    Return the errors of the pieces of a sensor, corrected with parameters of each fold.

    Block k is corrected with ``folds[k % len(folds)]``. The nuisances, a delay and an arm common to
    all pieces, are those with the smallest errors.
    """
    # Of each block and regime: the errors, then their change with each nuisance, shape
    # (1 + n_nuisances, n_rows, 3), and its (block, index of the regime).
    regimes = _regimes_of(held_out)
    corrections = [_Correction(model, sensor, values) for values in folds]
    places: list[tuple[int, int]] = []
    stacks: list[np.ndarray] = []
    for k, block in enumerate(held_out.blocks):
        for (name, regime), rows in block.pieces.items():
            if name == sensor and len(rows):
                places.append((k, regimes.index(Regime(regime))))
                stacks.append(corrections[k % len(folds)].errors(rows))

    # One delay and one arm for all of them.
    nuisances, without_delay = _nuisances(np.concatenate(stacks, axis=1))
    squares = np.zeros((len(held_out.blocks), len(regimes)))
    for place, (error, *changes) in zip(places, stacks, strict=True):
        remaining = error + np.tensordot(nuisances, changes, axes=1)
        squares[place] += (remaining**2).sum()
    return HeldOutErrors(squares, float(nuisances[0]), without_delay)


def _nuisances(stacked: np.ndarray) -> tuple[np.ndarray, float]:
    """
    Return the nuisances n with the smallest ``|error + sum_j n_j change_j|^2``.

    The second result is the smallest sum of squares without a delay.

    Parameters
    ----------
    stacked : array, shape (1 + n_nuisances, k, 3)
        Error, then its change with each nuisance; the first nuisance is the delay.

    """
    error = stacked[0].ravel()
    changes = stacked[1:].reshape(len(stacked) - 1, -1)
    nuisances = np.linalg.lstsq(changes.T, -error, rcond=1e-9)[0]
    # Again with the arm alone, if there is one.
    arm_changes = changes[1:]
    arm = np.zeros(0)
    if len(arm_changes):
        arm = np.linalg.lstsq(arm_changes.T, -error, rcond=1e-9)[0]
    without_delay = error + arm @ arm_changes
    nuisances[0] = np.clip(nuisances[0], -MAX_SEARCHED_DELAY, MAX_SEARCHED_DELAY)
    return nuisances, float(without_delay @ without_delay)


class _Correction:
    """Errors of the corrected readings of one sensor, with one set of parameters."""

    def __init__(self, model: SensorModel, sensor: str, values: np.ndarray):
        self.coefficients = coefficients(model, sensor, values)
        """Of the columns, shape (n_columns, 3): ``output = columns @ coefficients``."""
        self.matrix = model.matrix(sensor, values)
        """Scales and axes, ``output = matrix @ true + ...``, shape (3, 3)."""
        self.inverse = np.linalg.inv(self.matrix)
        """Its inverse, with which compensation corrects readings."""
        arm = model.part(sensor, Role.ARM)
        self.arm_slopes = _slopes(model, sensor, values, range(arm.start, arm.stop))
        """Derivative of the coefficients by each component of the arm."""

    def errors(self, rows: np.ndarray) -> np.ndarray:
        """
        Return errors of corrected readings and their change with each nuisance.

        Parameters
        ----------
        rows : array, shape (k, n_columns + 6)
            ``[columns | d(true input)/dt | output]``.

        Returns
        -------
        array, shape (1 + n_nuisances, k, 3)
            ``matrix^-1 (output - columns @ coefficients)``, its change per s of delay, and per m
            of each component of the arm.

        """
        columns = rows[:, : -2 * N_AXES]
        slope = rows[:, -2 * N_AXES : -N_AXES]
        output = rows[:, -N_AXES:]
        # measured(t) = matrix @ true(t - delay): the error is the delay times the slope.
        error_and_changes = [output - columns @ self.coefficients, slope @ self.matrix.T]
        for arm_slope in self.arm_slopes:
            error_and_changes.append(-columns @ arm_slope)
        return np.stack(error_and_changes) @ self.inverse.T


def _slopes(
    model: SensorModel,
    sensor: str,
    values: np.ndarray,
    places: Sequence[int] | np.ndarray,
    steps: np.ndarray | float = 1.0,
) -> list[np.ndarray]:
    """
    Return the change of the coefficients of a sensor with a step of each parameter in turn.

    `places`: indices of the parameters. Each change has the shape (n_columns, 3).
    """
    total = coefficients(model, sensor, values)
    slopes = []
    for place, step in zip(places, np.broadcast_to(steps, len(places)), strict=True):
        moved = values.copy()
        moved[place] += step
        slopes.append(coefficients(model, sensor, moved) - total)
    return slopes


def _linearised(
    groups: Sequence[np.ndarray],
    model: SensorModel,
    sensor: str,
    values: np.ndarray,
    *,
    places: np.ndarray,
    steps: np.ndarray | float = 1.0,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """
    Return the equations of groups, ``output - columns @ coefficients(values) = design @ change``.

    Parameters
    ----------
    groups : sequence of array
        Rows that begin with the columns and end with the output, shape (m, n_columns + 3 or more).
    places, steps : array, shape (n,)
        Indices of the parameters that change, and the unit of each change.

    Returns
    -------
    tuple
        The design of each group, shape (3 m, n), and the left side of each, shape (3 m,).

    """
    total = coefficients(model, sensor, values)
    slopes = _slopes(model, sensor, values, places, steps)
    designs = []
    targets = []
    for group in groups:
        columns = group[:, : len(total)]
        output = group[:, -N_AXES:]
        designs.append(np.stack([(columns @ slope).ravel() for slope in slopes], axis=1))
        targets.append((output - columns @ total).ravel())
    return designs, targets


def _groups_by_regime(held_out: HeldOut, sensor: str) -> list[np.ndarray]:
    """Return the triangular factor of ``[columns | output]`` of the pieces of each regime."""
    stacked: dict[tuple[str, str], np.ndarray] = {}
    for block in held_out.blocks:
        for factors in (block.pieces, block.earlier):
            for (name, regime), factor in factors.items():
                if name == sensor:
                    # without the derivative of the true input
                    rows = np.delete(factor, np.s_[-2 * N_AXES : -N_AXES], axis=1)
                    stack(stacked, (name, regime), rows)
    return list(stacked.values())


def _groups_by_time(held_out: HeldOut, sensor: str) -> list[np.ndarray]:
    """
    Return the triangular factor of ``[columns | output]`` of each part of a session.

    Its rows are the window means, weighted by their numbers of pieces.
    """
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
    Return the root of the sum of squared errors of the groups, each predicted from the remaining.

    Parameters
    ----------
    groups : sequence of array
        Triangular factor of ``[columns | output]`` of each group.
    model, sensor
        The columns.
    values : array, shape (n_params,)
        Start of the one step of least squares.
    free : array, shape (n_params,)
        True for the parameters that are estimated.
    centre : Centre, optional
        With it the parameters are used as compensation applies them.
    prior : Prior, optional
        Of the parameters; default: none.
    n_pieces : int
        Number of pieces in all groups, for the weight of the prior.

    """
    # Changes in standard deviations of the prior: the coefficients are linear over them.
    index = np.flatnonzero(free)
    sd = model.prior()[1][index]
    designs, targets = _linearised(groups, model, sensor, values, places=index, steps=sd)

    # The noise of the data rows is the residual, to which the rows of the prior are scaled.
    prior_design = np.zeros((0, len(index)))
    prior_target = np.zeros(0)
    if prior is not None:
        residual_sd = np.sqrt(np.sum(np.concatenate(targets) ** 2) / (N_AXES * n_pieces))
        prior_design = residual_sd * prior.root[:, index] * sd
        prior_target = residual_sd * (prior.root @ (prior.mean - values))

    squares = 0.0
    for held_out, group in enumerate(groups):
        others = [k for k in range(len(groups)) if k != held_out]
        design = np.concatenate([prior_design, *(designs[k] for k in others)])
        target = np.concatenate([prior_target, *(targets[k] for k in others)])
        fitted = values.copy()
        fitted[index] += sd * scaled_lstsq(design, target)
        if centre is not None:
            fitted = applied_values(model, fitted, centre)
        error = group[:, -N_AXES:] - group[:, :-N_AXES] @ coefficients(model, sensor, fitted)
        squares += float(np.sum(error**2))
    return float(np.sqrt(squares))


@dataclass(frozen=True, eq=False)
class _Pieces(PlainEquations):
    """
    Equations ``output = columns @ coefficients(values)`` of the pieces of each block.

    The coefficients are linear in bias and matrix, so that one step from the start is exact.
    """

    rows: list[np.ndarray]
    """Of each block: derivatives by the fitted parameters, shape (m, n_fitted)."""
    targets: list[np.ndarray]
    """Of each block: output minus the output predicted with the start values, shape (m,)."""

    @classmethod
    def of(
        cls, held_out: HeldOut, model: SensorModel, sensor: str, plan: PlainEstimate
    ) -> '_Pieces':
        """Return the equations of the pieces of a sensor."""
        width = model.layout(sensor).width + 2 * N_AXES
        blocks = []
        for block in held_out.blocks:
            pieces = [np.zeros((0, width))]
            for factors in (block.pieces, block.earlier):
                pieces += [factor for (name, _), factor in factors.items() if name == sensor]
            blocks.append(np.concatenate(pieces))
        places = np.flatnonzero(plan.fitted)
        return cls(plan, *_linearised(blocks, model, sensor, plan.values, places=places))

    def moved(self, values: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the parameters that fit the blocks of a mask; `values` do not matter."""
        blocks = np.flatnonzero(kept)
        design = np.concatenate([self.rows[k] for k in blocks])
        target = np.concatenate([self.targets[k] for k in blocks])
        return after_one_step(self.plan.values, design, target, free=self.plan.fitted)
