"""Gain of an extension of the model: errors of the corrected readings of held-out windows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.diagnosis.applied_gain import compensated_findings, sd_of_chosen
from imu_calibration.calibration.diagnosis.traces import DistanceSums
from imu_calibration.compensation.compensate import compensated_samples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.trust import judged_from_of, latest_settling
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import (
    Centre,
    References,
    applied_values,
    not_applied,
    sensor_output,
)
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import HELD
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, all_samples, chunks
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.held_out_windows import nominal_values, with_reference
from imu_calibration.references.turntable.residuals.proposals import Proposal, with_formulas
from imu_calibration.references.turntable.residuals.residual_blocks import residuals
from imu_calibration.references.turntable.selection.investigation import Investigation
from imu_calibration.references.turntable.selection.window_gain import gain_in_turn, heldout_gain
from imu_calibration.references.turntable.uncorrected_windows import uncorrected_on_table
from imu_calibration.references.turntable.window_statistics import measured, reduce_windows
from imu_calibration.selection.gain import APPLIED, OF_MODEL, SAMPLES, Gain
from imu_calibration.selection.questions import Question


@dataclass(frozen=True, eq=False)
class _Side:
    """A model with its parameters, as estimated and as compensation applies them."""

    model: SensorModel
    """At the point of `values`."""
    values: np.ndarray
    """Shape (n_params,)."""
    applied: np.ndarray
    """Effects that compensation cannot undo are at their centre, shape (n_params,)."""
    latest: SensorModel
    """At the largest probable time constants (`trust.latest_settling`)."""


def gain_of_findings(
    investigation: Investigation,
    before: Sequence[Question],
    *,
    after: Sequence[Question],
    sensors: Sequence[str],
) -> Gain:
    """
    Return the Gain of the findings `after` over the findings `before` on the locked windows.

    The residual is the error of the readings that compensation returns, relative to the reference
    that each side estimates; both sides are estimated from the other windows. If no additional
    finding can be compensated, the residual is that of the model (`window_gain.heldout_gain`).
    Sensor and measure are chosen on the other windows.

    Parameters
    ----------
    investigation : Investigation
    before, after : sequence of Question
    sensors : sequence of str
        Sensors that the difference acts on.

    """
    compensated = compensated_findings(investigation, before, after)
    if compensated is None:
        return heldout_gain(investigation.problem, before, after, sensors=sensors)

    # Sensor and measure from the windows that choose, then the errors in the locked windows.
    chosen = gain_in_turn(
        investigation.problem, compensated.before, compensated.after, sensors=sensors
    )
    sides = [
        _applied_parameters(investigation, compensated.before),
        _applied_parameters(investigation, compensated.after),
    ]
    sums = _locked_errors(investigation, sides)
    return sums.gains(chosen.sensor, APPLIED)[chosen.measure]


def gains_of_formulas(
    investigation: Investigation, proposals: Sequence[Proposal]
) -> dict[str, Gain]:
    """
    Return sensor -> Gain of the proposed formulas over the findings on the locked windows.

    The residual is the error of corrected readings, sample by sample. Where compensation cannot
    undo the formula, it is the residual of the model. Model and formulas are estimated together
    from the other windows.

    Parameters
    ----------
    investigation : Investigation
    proposals : sequence of Proposal
        At most one for each sensor.

    """
    if not proposals:
        return {}
    problem = investigation.problem
    before = _applied_parameters(investigation, investigation.adopted)

    # The model with the formulas, linearised at their amplitudes.
    model, values = with_formulas(before.model, before.values, proposals)
    model = model.at(values)

    # Estimated from the windows that are not locked.
    accumulator = Accumulator()
    unlocked = [window for window, locked in zip(investigation.used, problem.locked) if not locked]
    for group in chunks(unlocked):
        for window in reduce_windows(group, model, investigation.table):
            accumulator.add(window)
    solution = solve(accumulator, model, noise=problem.noise)
    estimated = solution.values

    # Compensation fixes the effects of the model that it does not undo as on the first side.
    applied = applied_values(model, estimated)
    for effect in not_applied(before.model):
        applied[model.slices[effect.key]] = before.applied[before.model.slices[effect.key]]
    latest = latest_settling(model, estimated, solution.sd)
    after = _Side(model.at(estimated), estimated, applied, latest)

    # A formula that compensation cannot undo has a gain in the residual of the model only.
    sums_of: dict[str, DistanceSums] = {}  # by APPLIED or OF_MODEL
    gains = {}
    for proposal in proposals:
        is_compensated = any(effect.compensation == 'exact' for effect in proposal.effects)
        error_kind = APPLIED if is_compensated else OF_MODEL
        if error_kind not in sums_of:
            sums_of[error_kind] = _locked_errors(investigation, [before, after], of=error_kind)
        gain = sums_of[error_kind].gains(proposal.sensor, error_kind)[SAMPLES]
        white_variance = problem.noise[proposal.sensor].white_variance
        gains[proposal.sensor] = replace(gain, noise_rms=float(np.sqrt(np.mean(white_variance))))
    return gains


def _locked_errors(
    investigation: Investigation, sides: Sequence[_Side], *, of: str = APPLIED
) -> DistanceSums:
    """
    Return the sums of squared errors of each side over the locked windows.

    `of`: `APPLIED`, the errors of corrected readings, or `OF_MODEL`, the residuals of the model.
    Windows before effects have settled are omitted, as in `HeldOutData`.
    """
    problem = investigation.problem
    start = max(judged_from_of(side.latest, problem.duration) for side in sides)
    held_out = []
    for window, locked in zip(investigation.used, problem.locked):
        if locked and window.time[0] >= start:
            held_out.append(window)

    table = investigation.table
    sums = DistanceSums()
    for group in chunks(held_out):
        errors_of_sides = []
        for side in sides:
            if of == APPLIED:
                errors_of_sides.append(_errors(group, table, side))
            else:
                errors_of_sides.append(residuals(group, table, side.model, values=side.values))

        # The errors of a group are those of its windows, one after the other.
        edges = np.cumsum([0, *map(len, group)])
        for window, first, last in zip(group, edges, edges[1:]):
            errors_of_window = []
            for errors in errors_of_sides:
                errors_of_window.append(
                    {sensor: error[first:last] for sensor, error in errors.items()}
                )
            sums.add(window, errors_of_window, problem.noise)
    return sums


def _applied_parameters(investigation: Investigation, chosen: Sequence[Question]) -> _Side:
    """Return the model with some effects, estimated without the locked windows."""
    # The baseline with these effects, at the values that the windows of the selection give.
    problem = investigation.problem
    gathered = problem.recording.model  # with all effects under test
    model = replace(problem.baseline, temperature_ref_c=gathered.temperature_ref_c)
    for question in chosen:
        model = model.with_effect(question.sensor, question.name)
    values = model.start_from(gathered, problem.values(chosen))
    model = model.at(values)
    latest = latest_settling(model, values, sd_of_chosen(problem.search, model, chosen))

    # Compensation applies effects that it cannot undo at their centre.
    centre: Centre = {}
    if not_applied(model):
        accumulator = problem.recording.accumulated(gathered)
        uncorrected = uncorrected_on_table(
            model, values, accumulator, gathered=gathered, latest=latest
        )
        centre = uncorrected.centre
    return _Side(model, values, applied_values(model, values, centre), latest)


def _errors(windows: Sequence[Window], table: Table, side: _Side) -> dict[str, np.ndarray]:
    """
    Return sensor -> error of the corrected readings of windows, m/s^2 and rad/s, shape (n, 3).

    The true readings are the output of an ideal sensor on the table as this side estimates it.
    """
    # Ideal sensors at the estimated reference (angles, places, delays of the table). A rest has one
    # row of motion; `rows` has the row of each sample.
    motion, temperature, rows = all_samples(windows)
    ideal = with_reference(side.model, nominal_values(side.model), side.values)
    ideal_model = side.model.at(ideal)
    references = References(ideal_model, table, motion, temperature_c=temperature)
    reference_of = {sensor: references.at(sensor) for sensor in SENSORS}

    # Readings as compensation corrects them, with the motion at the gyroscope. Their covariance is
    # not used: the calibration is given without one.
    ref = reference_of['gyroscope'].select(rows)
    raw = []
    for sensor in SENSORS:
        raw.append(np.concatenate([measured(window, sensor) for window in windows]))
    count = len(side.values)
    calibration = Calibration(side.model, side.applied, np.zeros((count, count)), (HELD,) * count)
    corrected = compensated_samples(
        calibration,
        *raw,
        alpha_s=ref.alpha_s,
        temperature_c=ref.temperature_c,
        thermal_branch=ref.thermal_branch,
        vibration=ref.vibration,
    )

    corrected_of = {'accelerometer': corrected.force, 'gyroscope': corrected.rate}
    errors = {}
    for sensor in SENSORS:
        true = sensor_output(ideal_model, sensor, ideal, ref=reference_of[sensor])
        errors[sensor] = corrected_of[sensor] - true[rows]
    return errors
