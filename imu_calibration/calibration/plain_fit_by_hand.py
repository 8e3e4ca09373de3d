"""
Bias and matrix by plain least squares by hand: lengths at rest, mean rates, and turns.

With equal weights, each sensor by itself, and no further effect; for the rule by which they are
applied see `plain_fit`.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.hand_proof import (
    ATTITUDES_LEAST,
    TURN_ANGLE_UNIT,
    TURNS_LEAST,
    HeldOutPoses,
    applied_by_hand,
    corrected_with,
    folds_by_hand,
    held_out_by_hand,
    norm_errors,
    turn_errors,
)
from imu_calibration.calibration.plain_fit import (
    PARTS_OF_TIME,
    PlainEstimate,
    PlainFit,
    misses,
    plan_of,
    replaceable_sensors,
    with_plain_fits,
)
from imu_calibration.calibration.proof import compared
from imu_calibration.effects.base import SENSORS, UNITS
from imu_calibration.estimation.scaled_solve import scaled_lstsq
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.references.gravity.equations import COMPONENTS, GravityRows, State, TurnData
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.poses import distinct_attitudes

STEPS = 5
"""Gauss-Newton steps: each reduces the error by that of bias and matrix, some per cent."""


def better_plain_fits_by_hand(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    *,
    under_test: Collection[str],
    as_asked: bool = False,
) -> tuple[PlainFit, ...]:
    """
    Return the plain fits to apply: they predict held-out poses and turns better than a solution.

    By the rule of `plain_fit.better_plain_fits`. Poses are held out in turn, and as parts of the
    session. The error is the one of `hand_proof.prove_by_hand`.

    Parameters
    ----------
    hand : HandCalibration
    turns : sequence of TurnData
        Turns of the estimate.
    under_test : collection of str
        Sensors with a residual that is neither noise nor an effect of the catalogue.
    as_asked : bool
        Whether the model was stated and not searched for.

    """
    replaceable = replaceable_sensors(hand.model, under_test, as_asked=as_asked)
    folds = folds_by_hand(hand.poses)
    if not folds or not replaceable:
        return ()
    parts_of_time = _parts_of_time(hand)

    better: list[PlainFit] = []
    for sensor in SENSORS:
        if sensor not in replaceable or sensor in hand.hand_model.absent:
            continue
        # The directions of the turns are those of the accelerometer that is applied.
        reference = with_plain_fits(hand, better).values
        in_turn = _compared(hand, turns, sensor, reference=reference, masks=folds)
        in_time = _compared(hand, turns, sensor, reference=reference, masks=parts_of_time)
        if in_turn is None:
            continue
        is_better = sensor in under_test and in_turn.is_close
        # The first and the last part of a session are predicted as another session is: no part
        # of the same drift lies on their other side.
        if in_time is not None and (sensor in under_test or in_turn.estimate.dropped):
            is_better |= misses(in_time.error_of_solution, in_time.error)
        if is_better:
            better.append(in_turn)
    return tuple(better)


def _parts_of_time(hand: HandCalibration) -> list[np.ndarray]:
    """Return masks of the poses of each part of a session; none with too few attitudes."""
    number = np.arange(len(hand.poses.time))
    masks = [np.isin(number, part) for part in np.array_split(number, PARTS_OF_TIME)]
    for out in masks:
        if distinct_attitudes(hand.poses.force[~out]) < ATTITUDES_LEAST:
            return []
    return masks


def _compared(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    sensor: str,
    *,
    reference: np.ndarray,
    masks: Sequence[np.ndarray],
) -> PlainFit | None:
    """
    Return the plain fit with the errors of both estimates without the poses of each mask.

    None with too few held-out turns.
    """
    estimate = _plain_estimate(hand, turns, sensor, reference=reference, masks=masks)
    held_out = held_out_by_hand(hand, turns, masks)
    solution = applied_by_hand(hand, turns, masks)
    of_solution = []
    of_plain = []
    for part, values, fitted in zip(held_out, solution, estimate.folds, strict=True):
        of_solution.append(_errors(hand, sensor, part, values, reference=reference))
        of_plain.append(_errors(hand, sensor, part, fitted, reference=reference))
    counts = np.array([len(errors) for errors in of_solution])
    if counts.sum() < (TURNS_LEAST if sensor == 'gyroscope' else 1):
        return None
    unit = TURN_ANGLE_UNIT if sensor == 'gyroscope' else UNITS[sensor]
    errors = compared(
        np.array([errors @ errors for errors in of_solution]),
        np.array([errors @ errors for errors in of_plain]),
        counts,
        unit=unit,
        components=1,
    )
    return PlainFit(sensor, estimate, errors.after, errors.before, unit)


def _errors(
    hand: HandCalibration,
    sensor: str,
    part: HeldOutPoses,
    values: np.ndarray,
    *,
    reference: np.ndarray,
) -> np.ndarray:
    """Return the errors of a sensor: lengths, or turns with the accelerometer of `reference`."""
    if sensor == 'accelerometer':
        return norm_errors(hand, values, part.judged)
    return turn_errors(hand.hand_model, reference, hand.poses, turns=part.turns, gyroscope=values)


def _plain_estimate(
    hand: HandCalibration,
    turns: Sequence[TurnData],
    sensor: str,
    *,
    reference: np.ndarray,
    masks: Sequence[np.ndarray],
) -> PlainEstimate:
    """Return the plain fit of a sensor, and one step from it without the poses of each mask."""
    plan = plan_of(hand, sensor, hand.prior_mean)
    fitted = plan.fitted & ~hand.hand_model.fixed
    estimator = _Lengths(hand) if sensor == 'accelerometer' else _Turns(hand, turns, reference)
    everything = np.ones(len(hand.poses.time), bool)
    values = plan.values
    for _ in range(STEPS):
        values = estimator.moved(values, fitted, everything)
    folds = [estimator.moved(values, fitted, ~out) for out in masks]
    return replace(plan, fitted=fitted, values=values, folds=folds)


@dataclass(frozen=True, eq=False)
class _Lengths:
    """Equations ``|true force| = gravity`` of the poses."""

    hand: HandCalibration

    def moved(self, values: np.ndarray, fitted: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the parameters after a step with some of the poses."""
        poses = self.hand.poses
        # the rows are minus the derivative of the errors
        errors, rows = self.hand.hand_model.norm_rows(values, poses.force, **poses.conditions)
        moved = values.copy()
        moved[fitted] += scaled_lstsq(rows[kept][:, fitted], errors[kept])
        return moved


@dataclass(frozen=True, eq=False)
class _Turns:
    """Equations of a gyroscope: the mean rate at rest is its bias, turns determine its matrix."""

    hand: HandCalibration
    turns: Sequence[TurnData]
    reference: np.ndarray
    """Parameters of which those of the accelerometer determine the directions, shape (n,)."""

    def moved(self, values: np.ndarray, fitted: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return the parameters after a step with some of the poses, and the turns between them."""
        hand, model = self.hand, self.hand.hand_model
        bias = np.zeros(len(values), bool)
        bias[model.gyro_bias] = True
        moved = values.copy()
        moved[bias & fitted] = hand.poses.rate[kept].mean(axis=0)[fitted[model.gyro_bias]]

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
        matrix = fitted & ~bias
        moved[matrix] += scaled_lstsq(rows.main[of_turns][:, matrix], rows.residual[of_turns])
        return moved
