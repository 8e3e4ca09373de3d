"""
Held-out poses and turns of a calibration by hand: errors against gravity, and plain fits of them.

A plain fit has equal weights for lengths at rest, mean rates and turns, each sensor by itself, and
no further effect.
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
    errors_of_rows,
    masks_in_turn,
)
from imu_calibration.calibration.plain_fit import PARTS_OF_TIME, compared_fit, plan_of
from imu_calibration.compensation.compensate import Corrected, compensated_samples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.trust import (
    Uncorrected,
    judged_from_of,
    latest_settling,
    uncorrected_in_time,
)
from imu_calibration.effects.base import UNITS
from imu_calibration.estimation.gauss_newton import after_one_step
from imu_calibration.estimation.rows import flat
from imu_calibration.estimation.scaled_solve import triangular_of_band
from imu_calibration.estimation.solution import HELD
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.kinematics.strapdown import total_rotation
from imu_calibration.references.gravity.equations import (
    COMPONENTS,
    GravityRows,
    Poses,
    State,
    TurnData,
    between_middles,
)
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.poses import distinct_attitudes

HAND_PROOF_FOLDS = 8
"""Number of held-out parts."""
ATTITUDES_LEAST = 10
"""
Fewest remaining attitudes when a part is held out: nine parameters of the accelerometer need one
equation each.
"""
FEW_ATTITUDES = 6
"""
Fewest remaining attitudes when one pose is held out: biases and scale factors of the accelerometer
need one equation each.
"""
TURNS_LEAST = 6
"""Fewest remaining turns, and fewest held-out turns in total."""
TURN_ANGLE_UNIT = 'rad per turn'
"""Unit of the angle between rotated and observed gravity."""
STEPS = 5
"""Gauss-Newton steps: each reduces the error by that of bias and matrix, some per cent."""


@dataclass(frozen=True, eq=False)
class HeldOutPart:
    """Poses that are held out together, with the turns that begin or end there."""

    judged: np.ndarray
    """
    True for the poses that are evaluated: held out, effects that settle have settled; shape
    (n_poses,).
    """
    turns: list[TurnData]
    """Turns against gravity that are held out and evaluated."""


@dataclass(frozen=True, eq=False)
class HeldOutPoses(HeldOutData[HandCalibration]):
    """
    Poses that are held out in turn, each with the turns that begin or end there.

    The error of the accelerometer is the length of its corrected reading in a pose less gravity;
    that of the gyroscope the angle between gravity rotated by its rates and gravity in the pose at
    the end of a turn. Readings are corrected as by compensation; with effects that have settled the
    last third of the poses is evaluated.
    """

    turns: Sequence[TurnData]
    """Turns of the estimate."""
    least_turns: int = 0
    """Fewest remaining turns when those of a part are evaluated."""

    @classmethod
    def of(
        cls,
        hand: HandCalibration,
        turns: Sequence[TurnData],
        masks: Sequence[np.ndarray],
        *,
        least_turns: int = 0,
    ) -> 'HeldOutPoses':
        """
        Return the poses, with the parameters of a solution estimated without each part.

        `masks` are True for the poses of each part, each of shape (n_poses,).
        """
        without = values_without(hand, turns, masks)
        folds = applied_folds(hand, without, uncorrected_by_hand(hand).centre)
        return cls(hand, folds, masks, turns, least_turns)

    @cached_property
    def parts(self) -> list[HeldOutPart]:
        """The poses and turns that are evaluated, of each mask."""
        hand = self.solution
        # Evaluated are poses after the effects that settle have settled.
        latest = latest_settling(hand.model, hand.values, hand.sd)
        is_settled = hand.poses.time >= judged_from_of(latest, end_by_hand(hand.poses))
        parts = []
        for out in self.masks:
            turns = []
            for turn in self.turns:
                is_held_out = out[turn.first] or out[turn.last]
                if turn.rotation is None and is_held_out and is_settled[turn.first]:
                    turns.append(turn)
            # Without too many of the turns the gyroscope is not estimated well enough to be judged.
            if len(self.turns) - len(turns) < self.least_turns:
                turns = []
            parts.append(HeldOutPart(out & is_settled, turns))
        return parts

    @cached_property
    def judged(self) -> dict[str, JudgedData]:
        """Sensor -> its poses or turns, each a block."""
        judged = {}
        n_poses = sum(int(part.judged.sum()) for part in self.parts)
        if n_poses:
            judged['accelerometer'] = JudgedData(
                counts=np.ones((n_poses, 1)),
                unit=UNITS['accelerometer'],
                windows=n_poses,
                components=1,
                # Rests near the axes of the sensor: held-out rests have the directions of the
                # other rests.
                few_directions=bool(self.solution.hand_model.held_terms),
            )
        n_turns = sum(len(part.turns) for part in self.parts)
        if n_turns >= TURNS_LEAST:
            judged['gyroscope'] = JudgedData(
                counts=np.ones((n_turns, 1)), unit=TURN_ANGLE_UNIT, windows=n_turns, components=1
            )
        return judged

    def errors(self, sensor: str, folds: Sequence[np.ndarray]) -> HeldOutErrors:
        """
        Return the errors of a sensor in each pose or turn, with the parameters of its fold.

        They are `norm_errors` of the accelerometer, `turn_errors` of the gyroscope.
        """
        errors = []
        for part, values in zip(self.parts, folds, strict=True):
            if sensor == 'accelerometer':
                errors.append(norm_errors(self.solution, values, part.judged))
            else:
                errors.append(
                    turn_errors(
                        self.solution.hand_model, values, self.solution.poses, turns=part.turns
                    )
                )
        return errors_of_rows(np.concatenate(errors)[:, None])

    def nominal(self, sensor: str, folds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return parameters of folds with those of the data sheet for a sensor."""
        nominal = replace(self.solution.hand_model, gyro_factor=1.0).nominal
        of_sensor = self.solution.model.mask(lambda effect: effect.sensor == sensor)
        return [np.where(of_sensor, nominal, values) for values in folds]

    def plain_equations(self, sensor: str, applied: np.ndarray) -> Iterator[PlainEquations]:
        """Yield the equations of a sensor; `applied` has the parameters of the accelerometer."""
        hand = self.solution
        plan = plan_of(hand, sensor, hand.prior_mean)
        plan = replace(plan, fitted=plan.fitted & ~hand.hand_model.fixed)
        if sensor == 'gyroscope':
            yield _Turns(plan, hand, self.turns, applied)
        else:
            yield _Lengths(plan, hand)

    def fits_elsewhere(
        self, sensor: str, estimate: PlainEstimate, applied: np.ndarray
    ) -> Iterator[PlainFit]:
        """
        Yield the plain fit of a sensor, with the errors on parts of the session held out in turn.

        The first and the last part are predicted like another session: data of the same drift lie
        on one side of them only.
        """
        parts = HeldOutPoses.of(self.solution, self.turns, _parts_of_time(self.solution))
        if sensor in parts.judged:
            fit = compared_fit(parts, sensor, applied)
            if fit is not None:
                yield fit


def norm_errors(hand: HandCalibration, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """
    Return ``|corrected force| - gravity`` of the poses of a mask, m/s^2.

    Readings are corrected with the parameters `values`.
    """
    poses = hand.poses.select(mask)
    corrected = corrected_with(
        hand.hand_model, values, poses.force, temperature_c=poses.temperature_c
    )
    return np.linalg.norm(corrected.force, axis=1) - hand.gravity


def values_without(
    hand: HandCalibration, turns: Sequence[TurnData], folds: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """
    Return the parameters (n,) estimated without the poses of each mask and the turns there.

    They are one Gauss-Newton step from the solution. `folds`: True for the held-out poses, each of
    shape (n_poses,).
    """
    model = hand.hand_model
    system = GravityRows(model, hand.used_poses, turns).linearise(
        replace(hand.state, values=hand.values)
    )
    scatter = np.array([hand.statistics[f'{name}_scatter_sd'] ** 2 for name in COMPONENTS])
    free = ~hand.held & ~model.fixed
    rows = flat(system.of_parameters(free).with_scatter(scatter).white())

    # Rows ``[columns | residual]`` of the priors of the free parameters.
    prior_columns = np.diag(1.0 / model.priors)
    prior_residual = (model.nominal - hand.values) / model.priors
    prior = np.column_stack([prior_columns, prior_residual])[free][:, np.append(free, True)]

    values_of_folds = []
    for out in folds:
        # Sums of biases have the group n_poses, which is never held out.
        is_held_out = np.append(out, False)
        is_out = is_held_out[system.group] | is_held_out[system.end_group]
        factor = triangular_of_band(rows[~is_out])[system.n_nuisances :, system.n_nuisances :]
        remaining = np.concatenate([factor, prior])
        values_of_folds.append(
            after_one_step(hand.values, remaining[:, :-1], remaining[:, -1], free=free)
        )
    return values_of_folds


def folds_by_hand(poses: Poses) -> list[np.ndarray]:
    """
    Return masks of the poses to hold out in turn, each of shape (n_poses,).

    Each has an eighth of the poses, or with few attitudes one pose; no mask with too few attitudes.
    """
    n_poses = len(poses)
    for count, least in ((HAND_PROOF_FOLDS, ATTITUDES_LEAST), (n_poses, FEW_ATTITUDES)):
        folds = masks_in_turn(n_poses, count)
        if all(distinct_attitudes(poses.force[~out]) >= least for out in folds):
            return folds
    return []


def end_by_hand(poses: Poses) -> float:
    """Return the end of the last pose, s since the first sample."""
    return float(poses.time[-1] + 0.5 * (poses.stop[-1] - poses.start[-1]) * poses.period)


def uncorrected_by_hand(hand: HandCalibration) -> Uncorrected:
    """Return the effects in time that compensation replaces by a constant."""
    return uncorrected_in_time(
        hand.model.at(hand.values),
        hand.values,
        hand.poses.time,
        end=end_by_hand(hand.poses),
        latest=latest_settling(hand.model, hand.values, hand.sd),
    )


def corrected_with(
    model: HandModel,
    values: np.ndarray,
    force: np.ndarray,
    *,
    rate: np.ndarray | None = None,
    temperature_c: np.ndarray | None = None,
) -> Corrected:
    """
    Return readings (n, 3) corrected as by compensation with the parameters `values` of `model`.

    Without `rate` the sensor is at rest.
    """
    rate = np.zeros_like(force) if rate is None else rate
    # Compensation uses the values alone, not their covariance and status.
    calibration = Calibration(
        model.model.at(values),
        values,
        covariance=np.zeros((model.size, model.size)),
        status=(HELD,) * model.size,
    )
    return compensated_samples(
        calibration, force, rate, alpha_s=np.zeros_like(force), temperature_c=temperature_c
    )


def turn_errors(
    model: HandModel, values: np.ndarray, poses: Poses, *, turns: Sequence[TurnData]
) -> np.ndarray:
    """Return `turn_error` of each turn with the parameters `values`, rad, shape (n_turns,)."""
    true = corrected_with(model, values, poses.force, temperature_c=poses.temperature_c).force
    up = unit_rows(true)
    errors = []
    for turn in turns:
        corrected = corrected_with(
            model, values, turn.force, rate=turn.rate, temperature_c=turn.temperature_c
        )
        errors.append(turn_error(poses, turn, corrected.rate, up=up))
    return np.array(errors)


def turn_error(poses: Poses, turn: TurnData, rates: np.ndarray, *, up: np.ndarray) -> float:
    """
    Return the angle between gravity after a turn and rotated gravity before it, rad.

    The direction of gravity before the turn is rotated by corrected rates.

    Parameters
    ----------
    poses : Poses
    turn : TurnData
    rates : array, shape (n, 3)
        Corrected rates during the turn, rad/s; samples that are not finite are omitted.
    up : array, shape (n_poses, 3)
        Unit vector of gravity in each pose.

    """
    is_finite = np.isfinite(rates).all(axis=1)
    mat_ji = total_rotation(turn.time[is_finite], rates[is_finite])
    rotation = between_middles(poses, turn, mat_ji)
    rotated = rotation @ up[turn.first]
    last = up[turn.last]
    return float(np.arctan2(np.linalg.norm(np.cross(rotated, last)), rotated @ last))


def _parts_of_time(hand: HandCalibration) -> list[np.ndarray]:
    """Return masks of the poses of each part of a session; none with too few attitudes."""
    number = np.arange(len(hand.poses.time))
    masks = [np.isin(number, part) for part in np.array_split(number, PARTS_OF_TIME)]
    for out in masks:
        if distinct_attitudes(hand.poses.force[~out]) < ATTITUDES_LEAST:
            return []
    return masks


@dataclass(frozen=True, eq=False)
class _Lengths(PlainEquations):
    """Equations ``|true force| = gravity`` of the poses."""

    n_steps = STEPS
    hand: HandCalibration

    def moved(self, values: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the parameters after a Gauss-Newton step with the poses of the mask `kept`."""
        free = self.plan.fitted
        poses = self.hand.poses
        # The columns are minus the derivative of the errors.
        errors, columns = self.hand.hand_model.norm_rows(values, poses.force, **poses.conditions)
        return after_one_step(values, columns[kept][:, free], errors[kept], free=free)


@dataclass(frozen=True, eq=False)
class _Turns(PlainEquations):
    """Equations of a gyroscope: the mean rate at rest is its bias, turns determine its matrix."""

    n_steps = STEPS
    hand: HandCalibration
    turns: Sequence[TurnData]
    reference: np.ndarray
    """Parameters of which those of the accelerometer determine the directions, shape (n,)."""

    def moved(self, values: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """
        Return the parameters estimated from the poses of the mask `kept` and the turns between.

        The bias is the mean rate at rest, the matrix a Gauss-Newton step with the turns.
        """
        hand = self.hand
        model = hand.hand_model
        fitted = self.plan.fitted
        # The bias, where it is fitted.
        is_bias = np.zeros(len(values), bool)
        is_bias[model.gyro_bias] = True
        moved = values.copy()
        moved[is_bias & fitted] = hand.poses.rate[kept].mean(axis=0)[fitted[model.gyro_bias]]

        # Two equations for each turn, with the directions of the corrected accelerometer.
        force = corrected_with(
            model, self.reference, hand.poses.force, temperature_c=hand.poses.temperature_c
        ).force
        state = State(moved, unit_rows(force), np.zeros_like(hand.poses.rate))
        used = []
        for turn in self.turns:
            if turn.rotation is None and kept[turn.first] and kept[turn.last]:
                used.append(turn)
        rows = GravityRows(model, hand.poses, used).linearise(state)
        of_turns = rows.component == COMPONENTS.index('turn')
        free = fitted & ~is_bias
        design = rows.columns[of_turns][:, free]
        return after_one_step(moved, design, rows.residual[of_turns], free=free)
