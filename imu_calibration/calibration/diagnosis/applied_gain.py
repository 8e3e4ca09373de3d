"""Gain of an extension of the model: errors of the corrected readings of held-out windows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from imu_calibration.calibration.diagnosis.traces import DistanceSums
from imu_calibration.calibration.held_out_poses import corrected_with, end_by_hand, turn_errors
from imu_calibration.calibration.held_out_windows import nominal_values, with_reference
from imu_calibration.compensation.compensate import compensated_samples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.trust import (
    judged_from_of,
    latest_settling,
    uncorrected_in_time,
    uncorrected_on_table,
)
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import (
    References,
    applied_values,
    not_applied,
    sensor_output,
)
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import HELD
from imu_calibration.estimation.solver import solve
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window, all_samples, chunks
from imu_calibration.references.gravity.hand_parameters import HandModel
from imu_calibration.references.gravity.model_selection import (
    HandInvestigation,
)
from imu_calibration.references.turntable.accumulator import Accumulator
from imu_calibration.references.turntable.window_statistics import reduce_windows
from imu_calibration.selection.gain import (
    APPLIED,
    OF_MODEL,
    SAMPLES,
    Gain,
    gain_in_turn,
    heldout_gain,
)
from imu_calibration.selection.investigation import Investigation
from imu_calibration.selection.linearised_problem import LinearisedProblem
from imu_calibration.selection.proposals import Proposal
from imu_calibration.selection.questions import Question
from imu_calibration.selection.residual_blocks import residuals
from imu_calibration.selection.row_evidence import RowBlock
from imu_calibration.selection.row_search import RowProblem, gain_of_groups
from imu_calibration.selection.saturation import measured


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
    """At the largest probable time constants: what has settled (`trust.latest_settling`)."""


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
    sums = _locked_errors(found, table, [_applied_parameters(found, some) for some in applied])
    return sums.gains(chosen.sensor, APPLIED)[chosen.measure]


def gains_of_formulas(
    found: Investigation, table: Table, proposals: Sequence[Proposal]
) -> dict[str, Gain]:
    """
    Return sensor -> Gain of the proposed formulas over the findings on the locked windows.

    The residual is the error of corrected readings, sample by sample, as for findings; that of the
    model where compensation cannot undo the formula. Model and formulas are estimated together from
    the other windows.

    Parameters
    ----------
    found : Investigation
    table : Table
    proposals : sequence of Proposal
        At most one for each sensor.

    """
    if not proposals:
        return {}
    problem = found.problem
    before = _applied_parameters(found, found.adopted)
    model, values = before.model, before.values

    # The model with the formulas, linearised at their amplitudes.
    for proposal in proposals:
        for effect, size in zip(proposal.effects, proposal.values):
            known = replace(model, catalogue=model.catalogue.with_effects(effect))
            model, values = known.with_sized_effect(values, effect.sensor, effect.name, size=size)
    model, accumulator = model.at(values), Accumulator()
    unlocked = [window for window, locked in zip(found.used, problem.locked) if not locked]
    for group in chunks(unlocked):
        for window in reduce_windows(group, model, table):
            accumulator.add(window)
    solution = solve(accumulator, model, noise=problem.noise)
    estimated = solution.values

    # Compensation fixes the effects of the model that it does not undo as on the first side.
    after = applied_values(model, estimated)
    for effect in not_applied(before.model):
        after[model.slices[effect.key]] = before.applied[before.model.slices[effect.key]]
    latest = latest_settling(model, estimated, solution.sd)
    sides = [before, _Side(model.at(estimated), estimated, after, latest)]
    sums, gains = {}, {}
    for proposal in proposals:
        undone = any(effect.compensation == 'exact' for effect in proposal.effects)
        of = APPLIED if undone else OF_MODEL
        if of not in sums:
            sums[of] = _locked_errors(found, table, sides, of=of)
        gain = sums[of].gains(proposal.sensor, of)[SAMPLES]
        noise = problem.noise[proposal.sensor].white_variance
        gains[proposal.sensor] = replace(gain, noise_rms=float(np.sqrt(np.mean(noise))))
    return gains


def _locked_errors(
    found: Investigation,
    table: Table,
    sides: Sequence[_Side],
    *,
    of: str = APPLIED,
) -> DistanceSums:
    """
    Return the sums over the locked windows of the errors of corrected readings, or of the model.

    The windows are those of `HeldOutData` and the documents: after effects have settled.
    """
    problem, sums = found.problem, DistanceSums()
    start = max(judged_from_of(side.latest, problem.duration) for side in sides)
    held_out = [
        window
        for window, locked in zip(found.used, problem.locked)
        if locked and window.time[0] >= start
    ]
    errors_of = _errors if of == APPLIED else _model_errors
    for group in chunks(held_out):
        for window, *errors in zip(group, *(errors_of(group, table, side) for side in sides)):
            sums.add(window, errors, problem.noise)
    return sums


def _compensated(
    found: Investigation | HandInvestigation, before: Sequence[Question], after: Sequence[Question]
) -> list[list[Question]] | None:
    """
    Return the findings of two choices that belong into the model.

    Or None if compensation corrects no additional one.
    """
    adopted_before = [question for question in before if question in found.adopted]
    adopted_after = [question for question in after if question in found.adopted]
    for question in adopted_after:
        if question not in adopted_before and question.effect.compensation == 'exact':
            return [adopted_before, adopted_after]
    return None


def _applied_parameters(found: Investigation, chosen: Sequence[Question]) -> _Side:
    """
    Return a choice of effects as compensation applies it.

    It is estimated without the locked windows.
    """
    problem, wide = found.problem, found.problem.recording.model
    model = replace(problem.baseline, temperature_ref_c=wide.temperature_ref_c)
    for question in chosen:
        model = model.with_effect(question.sensor, question.name)
    values = model.start_from(wide, problem.values(chosen))
    model = model.at(values)
    latest = latest_settling(model, values, _sd_of(problem, model, chosen))
    centre: Mapping[str, np.ndarray] = {}
    if not_applied(model):
        accumulator = problem.recording.accumulated(wide)
        uncorrected = uncorrected_on_table(model, values, accumulator, gathered=wide, latest=latest)
        centre = uncorrected.centre
    return _Side(model, values, applied_values(model, values, centre), latest)


def _sd_of(
    problem: LinearisedProblem | RowProblem, model: SensorModel, chosen: Sequence[Question]
) -> np.ndarray:
    """
    Return the standard deviations of the parameters of some effects; of other ones zero.

    A warm-up that was only tried at a bank of time constants has none for its own.
    """
    used = problem.search.indices(chosen)
    covariance = problem.evidence.fit(used)[1]
    known = dict(zip(used, np.sqrt(np.diag(covariance)), strict=True))
    sd = np.zeros(len(model.param_names))
    for question in chosen:
        start = model.slices[question.effect.key].start
        for place, index in enumerate(question.parameters):
            sd[start + place] = known[index]
    return sd


def gain_by_hand(
    found: HandInvestigation, before: Sequence[Question], *, after: Sequence[Question], sensor: str
) -> Gain:
    """
    Return the Gain of the findings `after` over the findings `before`.

    The gain is that on the held-out poses and turns.

    The errors are those of `HeldOutPoses` and, at rest, the corrected rate less that of
    the Earth about the vertical. Choice and estimate of each side exclude the poses; if no
    additional finding can be compensated, the residual is that of the model.
    """
    applied = _compensated(found, before, after)
    if applied is None:
        return found.problem.gain(found.held_out, before, after, sensor=sensor)
    block, poses = found.problem.clearest(applied[0], applied[1], sensor), found.baseline.poses
    end = end_by_hand(poses)
    pair = [
        np.zeros((len(block.group), 1 if block.duration is not None else block.known.shape[1]))
        for _ in applied
    ]
    start = 0.0
    for part in found.held_out:
        rows = np.isin(block.group, part.groups)
        for errors, chosen in zip(pair, applied):
            additional = part.named_in(chosen)
            model, values, earth = found.extended(part.problem, additional)
            moved = model.model.at(values)
            latest = latest_settling(moved, values, _sd_of(part.problem, moved, additional))
            start = max(start, judged_from_of(latest, end))
            uncorrected = uncorrected_in_time(moved, values, poses.time, end=end, latest=latest)
            values = applied_values(moved, values, uncorrected.centre)
            errors[rows] = _pose_errors(found, block, np.flatnonzero(rows), model, values, earth)
    return gain_of_groups(
        block.select(late := block.time >= start), [errors[late] for errors in pair], APPLIED
    )


def _pose_errors(
    found: HandInvestigation,
    block: RowBlock,
    rows: np.ndarray,
    model: HandModel,
    values: np.ndarray,
    earth: float,
) -> np.ndarray:
    """
    Return the errors of some rows of a block after correction.

    Of poses m/s^2 or rad/s, of turns the angle over the duration, rad/s.
    """
    poses = found.baseline.poses
    if block.duration is not None:
        missed = turn_errors(model, values, poses, turns=[found.turns[row] for row in rows])
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


def _errors(
    windows: Sequence[Window], table: Table, side: _Side
) -> Iterator[dict[str, np.ndarray]]:
    """
    Yield sensor -> error of the corrected readings of each window, m/s^2 and rad/s, shape (n, 3).
    """
    model, values = side.model, side.values
    motion, temperature, rows = all_samples(windows)
    ideal = with_reference(model, nominal_values(model), values)
    at_ideal = model.at(ideal)
    references = References(at_ideal, table, motion, temperature_c=temperature)
    refs = [references.at(sensor) for sensor in SENSORS]
    ref = refs[1].select(rows)
    raw = []
    for sensor in SENSORS:
        raw.append(np.concatenate([measured(window, sensor) for window in windows]))
    count = len(values)
    known = Calibration(model, side.applied, np.zeros((count, count)), (HELD,) * count)
    corrected = compensated_samples(
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


def _model_errors(
    windows: Sequence[Window], table: Table, side: _Side
) -> Iterator[dict[str, np.ndarray]]:
    """
    Yield sensor -> residual of the model in each window, m/s^2 and rad/s, shape (n, 3).
    """
    left = residuals(windows, table, side.model, values=side.values)
    for start, stop in pairwise(np.cumsum([0, *map(len, windows)])):
        yield {sensor: rest[start:stop] for sensor, rest in left.items()}
