"""Gain of an extension of the model: errors of the corrected readings of held-out windows."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from imu_calibration.calibration.diagnosis.traces import DistanceSums
from imu_calibration.calibration.hand_proof import corrected_with, end_by_hand, turn_errors
from imu_calibration.calibration.proof import nominal_values, with_reference
from imu_calibration.compensation.compensate import compensate
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.trust import judged_from_of, uncorrected_in_time, uncorrected_on_table
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import (
    References,
    applied_values,
    not_applied,
    sensor_output,
)
from imu_calibration.estimation.solution import HELD
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import all_samples, chunks
from imu_calibration.references.gravity.model_selection import HandInvestigation, gain_of_poses
from imu_calibration.selection.gain import APPLIED, Gain, gain_in_turn, heldout_gain
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.questions import Question
from imu_calibration.selection.saturation import measured


def gain_of_findings(
    found: Investigation,
    table: Table,
    before: Sequence[Question],
    *,
    after: Sequence[Question],
    sensors: Sequence[str],
) -> Gain:
    """
    Return the Gain of the findings `after` over the findings `before` on the locked windows.

    The residual is the error of the readings that compensation returns, relative to the reference
    that each side estimates; both sides are estimated from the other windows. If no additional
    finding can be compensated, the residual is that of the model (`gain.heldout_gain`). Sensor and
    measure are chosen on the other windows.

    Parameters
    ----------
    found : Investigation
    table : Table
    before, after : sequence of Question
    sensors : sequence of str
        Sensors that the difference acts on.

    """
    problem, applied = found.problem, _compensated(found, before, after)
    if applied is None:
        return heldout_gain(problem, before, after, sensors=sensors)
    chosen = gain_in_turn(problem, *applied, sensors=sensors)
    sides, sums = [_applied_parameters(found, some) for some in applied], DistanceSums()
    start = max(judged_from_of(model, problem.duration) for model, *_ in sides)
    held_out = [
        window
        for window, locked in zip(found.used, problem.locked)
        if locked and window.time[0] >= start
    ]
    for group in chunks(held_out):
        for window, *residuals in zip(group, *(_errors(group, table, *side) for side in sides)):
            sums.add(window, residuals, problem.noise)
    return sums.gains(chosen.sensor, APPLIED)[chosen.measure]


def _compensated(found, before, after):
    """
    Return the findings of two choices that belong into the model.

    Or None if compensation corrects no additional one.
    """
    sides = [
        [question for question in some if question in found.adopted] for some in (before, after)
    ]
    additional = [question for question in sides[1] if question not in sides[0]]
    return (
        sides if any(question.effect.compensation == 'exact' for question in additional) else None
    )


def _applied_parameters(found, chosen):
    """
    Return (model, values, values to apply) of a choice of effects.

    The last values are as compensation applies them. All are estimated without the locked windows.
    """
    problem, wide = found.problem, found.problem.recording.model
    model = replace(problem.baseline, temperature_ref_c=wide.temperature_ref_c)
    for question in chosen:
        model = model.with_effect(question.sensor, question.name)
    values = model.start_from(wide, problem.values(chosen))
    model = model.at(values)
    centre = (
        uncorrected_on_table(
            model, values, problem.recording.accumulated(wide), gathered=wide
        ).centre
        if not_applied(model)
        else {}
    )
    return model, values, applied_values(model, values, centre)


def gain_by_hand(
    found: HandInvestigation, before: Sequence[Question], *, after: Sequence[Question], sensor: str
) -> Gain:
    """
    Return the Gain of the findings `after` over the findings `before`.

    The gain is that on the held-out poses and turns.

    The errors are those of `hand_proof.prove_by_hand` and, at rest, the corrected rate less that of
    the Earth about the vertical. Choice and estimate of each side exclude the poses; if no
    additional finding can be compensated, the residual is that of the model.
    """
    applied = _compensated(found, before, after)
    if applied is None:
        return found.problem.gain(found.held_out, before, after, sensor=sensor)
    block, poses = found.problem.clearest(applied[0], applied[1], sensor), found.baseline.poses
    end = end_by_hand(poses)
    pair = [
        np.zeros((len(block.pose), 1 if block.duration is not None else block.known.shape[1]))
        for _ in applied
    ]
    start = 0.0
    for out, named, smaller in found.held_out:
        rows = np.isin(block.pose, out)
        for errors, chosen in zip(pair, applied):
            names = {question.name for question in chosen}
            model, values, earth = found.extended(
                smaller, [question for question in named if question.name in names]
            )
            moved = model.model.at(values)
            start = max(start, judged_from_of(moved, end))
            values = applied_values(
                moved, values, uncorrected_in_time(moved, values, poses.time, end=end).centre
            )
            errors[rows] = _pose_errors(found, block, np.flatnonzero(rows), model, values, earth)
    return gain_of_poses(
        block.select(late := block.time >= start), [errors[late] for errors in pair], APPLIED
    )


def _pose_errors(found, block, rows, model, values, earth):
    """
    Return the errors of some rows of a block after correction.

    Of poses m/s^2 or rad/s, of turns the angle over the duration, rad/s.
    """
    poses = found.baseline.poses
    if block.duration is not None:
        missed = turn_errors(
            model, values, poses, turns=[found.turns[row] for row in rows], gyroscope=values
        )
        return (missed / block.duration[rows])[:, None]
    warm = None if poses.temperature_c is None else poses.temperature_c[rows]
    corrected = corrected_with(
        model, values, poses.force[rows], rate=poses.rate[rows], temperature_c=warm
    )
    norm = np.linalg.norm(corrected.force, axis=1, keepdims=True)
    return (
        norm - found.baseline.gravity
        if block.sensor == 'accelerometer'
        else corrected.rate - earth * corrected.force / norm
    )


def _errors(windows, table, model, values, applied):
    """
    Yield sensor -> error of the corrected readings of each window, m/s^2 and rad/s, shape (n, 3).
    """
    motion, temperature, rows = all_samples(windows)
    ideal = with_reference(model, nominal_values(model), values)
    at_ideal = model.at(ideal)
    references = References(at_ideal, table, motion, temperature_c=temperature)
    refs = [references.at(sensor) for sensor in SENSORS]
    ref = refs[1].select(rows)
    raw = [np.concatenate([measured(window, sensor) for window in windows]) for sensor in SENSORS]
    known = Calibration(model, applied, np.zeros((len(values),) * 2), (HELD,) * len(values))
    corrected = compensate(
        known,
        *raw,
        alpha_s=ref.alpha_s,
        temperature_c=ref.temperature_c,
        thermal_branch=ref.thermal_branch,
        vibration=ref.vibration,
    )
    errors = [
        true - sensor_output(at_ideal, sensor, ideal, ref=own)[rows]
        for true, sensor, own in zip((corrected.force, corrected.rate), SENSORS, refs)
    ]
    for start, stop in pairwise(np.cumsum([0, *map(len, windows)])):
        yield {sensor: error[start:stop] for sensor, error in zip(SENSORS, errors)}
