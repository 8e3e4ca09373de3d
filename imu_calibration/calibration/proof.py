"""
Does a calibration help on held-out data? Errors of short pieces before and after.

By sensor and by regime of motion.

The error of a piece is its mean reading, corrected as compensation corrects it, minus the
reference, before with nominal parameters and after with the calibration. The position of the
table's reference point and the delay of the readings, which compensation does not correct, are
estimated for each side: so a wrong scale that compensates for a lag is visible.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.document.calibration import Calibration
from imu_calibration.document.proof_entry import Proof, ProofEntry, RegimeErrors
from imu_calibration.effects.base import SENSORS, UNITS, Effect, Role
from imu_calibration.effects.forward_equations import Centre, applied_values, coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulated_rows import one_attitude
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.session_data import HeldOut
from imu_calibration.references.turntable.window_statistics import N_AXES, PIECE_TIME, Regime

BLOCK_RESAMPLES = 1000
"""Resamples of complete blocks for an interval."""
MIN_REGIME_BLOCKS = 3
"""Least blocks for a result in a regime."""
MAX_SEARCHED_DELAY = 0.1
"""Largest delay of the search, s."""
Side = tuple[HeldOut, Sequence[Sequence[np.ndarray]]]


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of one sensor with one set of parameters."""

    squares: np.ndarray
    """Sum of squared errors by block and regime, shape (n_blocks, n_regimes)."""
    delay: float
    """Delay of the readings in addition to these parameters, s."""
    without_delay: float
    """Sum of squared errors without an estimate of the delay."""


def applied_folds(held_out: HeldOut, solution: Solution, *, centre: Centre) -> list[np.ndarray]:
    """
    Return the parameters of a solution without each fold, as compensation applies them.

    Parameters
    ----------
    held_out : HeldOut
        The windows of the solution in folds, with the columns of its model.
    solution : Solution
    centre : mapping
        Operating point at which effects that compensation cannot undo are applied.

    """
    folds = held_out.values_without(solution)
    return [
        applied_values(solution.model, values, centre, absent=solution.absent) for values in folds
    ]


def prove_solution(held_out: HeldOut, solution: Solution, folds: Sequence[np.ndarray]) -> Proof:
    """
    Return the proof of a solution on held-out windows (see `prove`).

    Every fold of windows is predicted with parameters estimated without it, as compensation applies
    them (`applied_values`). The correction is linearised at the reference motion, ``true +
    matrix^-1 (measured - output(true))``, which the statistics of windows allow; it differs from
    that of readings by the square of the errors.

    Parameters
    ----------
    held_out : HeldOut
        The windows of the solution in folds, with the columns of its model.
    solution : Solution
    folds : sequence of ndarray, shape (n_params,)
        Parameters without each fold (`applied_folds`).

    """
    model = solution.model
    nominal = nominal_values(model)
    described = [with_reference(model, values, nominal) for values in folds]
    proof = prove(
        model,
        before=(held_out, ([nominal], [with_reference(model, nominal, solution.values)])),
        after=(held_out, (folds, described)),
    )
    if 'accelerometer' in proof and one_attitude(
        [block.accumulator for block in held_out.blocks], model
    ):
        same = replace(proof['accelerometer'], one_attitude=True)
        proof = {**proof, 'accelerometer': same}
    return proof


def prove_readings(
    before: HeldOut, after: HeldOut, model: SensorModel, *, reference: np.ndarray
) -> Proof:
    """
    Return the proof of corrected readings `after` and raw readings `before`.

    With the columns of `model`: bias, matrix, reference.

    `reference` has the parameters of the table and the clock, shape (n_params,).
    """
    nominal = nominal_values(model)
    candidates = ([nominal], [with_reference(model, nominal, reference)])
    return prove(model, before=(before, candidates), after=(after, candidates))


def prove(model: SensorModel, *, before: Side, after: Side) -> Proof:
    """
    Return for each sensor its errors before and after, in all motions and by regime.

    Parameters
    ----------
    model : SensorModel
    before, after : tuple
        (HeldOut with the columns of `model`, candidates): each candidate has parameters for the
        blocks of each fold, in turn. The candidate with the smaller error counts: each side may be
        compared with the table as it was estimated or as it was described.

    """
    regimes, counts = judged_regimes(before[0])
    if not regimes:
        return {}
    proof: dict[str, ProofEntry] = {}
    for sensor in before[0].sensors:
        was, now = (
            min(
                (
                    errors_of(dealt, model, sensor, folds=each, regimes=regimes)
                    for each in candidates
                ),
                key=lambda errors: errors.squares.sum(),
            )
            for dealt, candidates in (before, after)
        )
        unit = UNITS[sensor]
        of_regimes = {}
        for k, name in enumerate(regimes):
            if (counts[:, k] > 0).sum() >= MIN_REGIME_BLOCKS:
                of_regimes[str(name)] = errors_in_pieces(
                    was.squares[:, k], now.squares[:, k], counts[:, k], unit=unit
                )
        in_total = errors_in_pieces(
            was.squares.sum(axis=1), now.squares.sum(axis=1), counts.sum(axis=1), unit=unit
        )
        proof[sensor] = ProofEntry(
            **vars(replace(in_total, windows=before[0].n_judged)),
            delay_s=now.delay,
            delay_explains=float(1.0 - now.squares.sum() / max(now.without_delay, 1e-300)),
            regimes=of_regimes,
        )
    return proof


def judged_regimes(held_out: HeldOut) -> tuple[list[Regime], np.ndarray]:
    """
    Return (regimes with pieces, their numbers in each block); no regime with too few blocks.

    The numbers have the shape (n_blocks, n_regimes).
    """
    blocks = held_out.blocks
    regimes = [name for name in Regime if any(name in block.counts for block in blocks)]
    counts = np.array([[block.counts.get(name, 0) for name in regimes] for block in blocks])
    if (counts.sum(axis=1) > 0).sum() < MIN_REGIME_BLOCKS:
        return [], counts
    return regimes, counts


def nominal_values(model: SensorModel) -> np.ndarray:
    """Return the parameters of a sensor as its data sheet has it on a table as described."""
    values = model.prior()[0]
    return np.where(np.isfinite(values), values, 0.0)


def reference_model(calibration: Calibration, table: Table) -> SensorModel:
    """
    Return the model of a recording of corrected readings.

    Bias, matrix, and the effects of the table and the clock that are known.
    """
    known, same_joints = calibration.model, calibration.model.joint_names == table.joint_names
    names = {
        sensor: tuple(
            effect.name
            for effect in known.effects
            if effect.sensor == sensor
            and (
                effect.role in (Role.OFFSET, Role.LINEAR) or same_joints and is_of_reference(effect)
            )
        )
        for sensor in SENSORS
    }
    model = SensorModel(
        names['accelerometer'],
        names['gyroscope'],
        reference=known.reference if same_joints else (),
        joint_names=table.joint_names,
        temperature_ref_c=known.temperature_ref_c,
        catalogue=known.catalogue,
    )
    model = model.at(reference_values(model, calibration))
    # The position of the sensor on the table is no error of either side: it is estimated for each.
    return (
        model
        if model.find('accelerometer', Role.ARM) or table.mount_xyz is not None
        else model.with_role('accelerometer', Role.ARM)
    )


def reference_values(model: SensorModel, calibration: Calibration) -> np.ndarray:
    """
    Return nominal values of the sensors with those of a calibration for the table and the clock.

    Shape (n_params,).
    """
    values = nominal_values(model)
    for effect in calibration.model.effects:
        if effect.key in model.slices and is_of_reference(effect):
            values[model.slices[effect.key]] = calibration.values[
                calibration.model.slices[effect.key]
            ]
    return values


def with_reference(model: SensorModel, values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """
    Return the values with the table and the clock of other values `reference`, shape (n_params,).
    """
    values = values.copy()
    for effect in model.effects:
        if is_of_reference(effect):
            values[model.slices[effect.key]] = reference[model.slices[effect.key]]
    return values


def is_of_reference(effect: Effect) -> bool:
    """Return whether an effect is of the table or the clock: compensation does not correct it."""
    return effect.in_reference or effect.sensor == 'reference' or effect.warp is not None


def errors_of(
    held_out: HeldOut,
    model: SensorModel,
    sensor: str,
    *,
    folds: Sequence[np.ndarray],
    regimes: Sequence[Regime],
) -> Errors:
    """
    Return the Errors of parameters (one set for each fold in turn).

    With the delay and the common arm that suit them best.
    """
    parts = [
        (k, regimes.index(regime), rows, folds[k % len(folds)])
        for k, block in enumerate(held_out.blocks)
        for (name, regime), rows in block.pieces.items()
        if name == sensor and len(rows)
    ]
    known = {id(values): _Correction(model, sensor, values) for values in folds}
    stacks = [known[id(values)].errors(rows) for _, _, rows, values in parts]
    best, delay_free = _nuisances(np.concatenate(stacks, axis=1))
    squares = np.zeros((len(held_out.blocks), len(regimes)))
    for (k, regime, *_), (error, *changes) in zip(parts, stacks):
        left = error + np.tensordot(best, changes, axes=1) if len(best) else error
        squares[k, regime] += (left**2).sum()
    return Errors(squares, float(best[0]), delay_free)


def _nuisances(stacked: np.ndarray) -> tuple[np.ndarray, float]:
    """
    Return the nuisances that minimise ``error + sum(nuisance change)``.

    The delay is the first nuisance. The sum of squares without a delay is returned as well.
    """
    error, changes = stacked[0].ravel(), stacked[1:].reshape(len(stacked) - 1, -1)
    best = np.linalg.lstsq(changes.T, -error, rcond=1e-9)[0]
    others = changes[1:]
    rest = np.linalg.lstsq(others.T, -error, rcond=1e-9)[0] if len(others) else np.zeros(0)
    without = error + rest @ others
    best[0] = np.clip(best[0], -MAX_SEARCHED_DELAY, MAX_SEARCHED_DELAY)
    return best, float(without @ without)


class _Correction:
    """
    How rows of columns and outputs become errors of corrected readings.

    The rows are ``[columns | d(true input)/dt | output]``. How nuisances change these errors is
    included.
    """

    def __init__(self, model: SensorModel, sensor: str, values: np.ndarray):
        total = coefficients(model, sensor, values)
        self.matrix = model.matrix(sensor, values)
        self.inverse = np.linalg.inv(self.matrix)
        self.total, self.arms = total, []
        arm = model.part(sensor, Role.ARM)
        for index in range(arm.start, arm.stop):
            moved = values.copy()
            moved[index] += 1.0
            self.arms.append(coefficients(model, sensor, moved) - total)

    def errors(self, rows: np.ndarray) -> np.ndarray:
        """
        Return errors and their change with each nuisance, (1 + n_nuisances, k, 3).

        The delay, s, and the arm, m.
        """
        columns, slope, output = (
            rows[:, : -2 * N_AXES],
            rows[:, -2 * N_AXES : -N_AXES],
            rows[:, -N_AXES:],
        )
        # measured(t) = matrix @ true(t - delay): the error is the delay times the slope.
        parts = [
            output - columns @ self.total,
            slope @ self.matrix.T,
            *(-columns @ arm for arm in self.arms),
        ]
        return np.stack(parts) @ self.inverse.T


def errors_in_pieces(
    before: np.ndarray, after: np.ndarray, count: np.ndarray, *, unit: str
) -> RegimeErrors:
    """Return `compared` errors of the means of so many pieces, with their length."""
    found = compared(before, after, count, unit=unit)
    return replace(found, seconds=float(count.sum() * PIECE_TIME))


def compared(
    before: np.ndarray,
    after: np.ndarray,
    count: np.ndarray,
    *,
    unit: str,
    components: int = N_AXES,
) -> RegimeErrors:
    """
    Return the rms errors per component, and the interval of their ratio.

    The interval is over resamples of complete blocks.

    Parameters
    ----------
    before, after : array, shape (n_blocks,)
        Sums of squared errors.
    count : array, shape (n_blocks,)
        Number of errors in each sum, per component.
    unit : str
    components : int

    """
    held = count > 0
    before, after, count = before[held], after[held], count[held]
    draw = np.random.default_rng(1).integers(0, len(count), (BLOCK_RESAMPLES, len(count)))
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.sqrt(after[draw].sum(axis=1) / before[draw].sum(axis=1))
    low, high = np.nan_to_num(np.quantile(ratio, (0.025, 0.975)), nan=1.0, posinf=1e9)
    total = components * count.sum()
    return RegimeErrors(
        before=float(np.sqrt(before.sum() / total)),
        after=float(np.sqrt(after.sum() / total)),
        ci95=(float(low), float(high)),
        unit=unit,
    )
