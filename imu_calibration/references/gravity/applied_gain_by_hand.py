"""Gain of findings by hand: errors of the corrected readings of held-out poses and turns."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.calibration.diagnosis.applied_gain import compensated_findings, sd_of_chosen
from imu_calibration.document.trust import judged_from_of, latest_settling, uncorrected_in_time
from imu_calibration.effects.forward_equations import applied_values
from imu_calibration.estimation.rows import Rows
from imu_calibration.references.gravity.held_out_poses import (
    corrected_with,
    end_by_hand,
    turn_errors,
)
from imu_calibration.references.gravity.model_selection import ExtendedBaseline, HandInvestigation
from imu_calibration.references.rows.row_search import gain_of_groups
from imu_calibration.selection.gain import APPLIED, Gain
from imu_calibration.selection.questions import Question


def gain_by_hand(
    search: HandInvestigation, before: Sequence[Question], *, after: Sequence[Question], sensor: str
) -> Gain:
    """
    Return the Gain of the findings `after` over the findings `before` on held-out poses and turns.

    The errors are those of `HeldOutPoses` and, at rest, the corrected rate less that of
    the Earth about the vertical. Choice and estimate of each side exclude the poses; if no
    additional finding can be compensated, the residual is that of the model.
    """
    compensated = compensated_findings(search, before, after)
    if compensated is None:
        return search.problem.gain(search.held_out, before, after, sensor=sensor)

    # The rows in which the difference of the two choices is clearest. Turns, which have a duration,
    # have one error: an angle.
    block = search.problem.clearest(compensated.before, compensated.after, sensor)
    poses = search.baseline.poses
    end = end_by_hand(poses)
    n_columns = 1 if block.duration is not None else block.variance.shape[1]
    errors_before = np.zeros((len(block.group), n_columns))
    errors_after = np.zeros((len(block.group), n_columns))

    # Each part of the recording is predicted by a fit to the other parts, with the effects of each
    # choice that are found in them.
    settled_from = 0.0
    for part in search.held_out:
        rows = np.flatnonzero(np.isin(block.group, part.groups))
        for errors, chosen in (
            (errors_before, compensated.before),
            (errors_after, compensated.after),
        ):
            additional = part.named_in(chosen)
            extended = search.extended(part.problem, additional)
            values = extended.values
            linearised = extended.model.model.at(values)
            sd = sd_of_chosen(part.problem.search, linearised, additional)
            latest = latest_settling(linearised, values, sd)
            settled_from = max(settled_from, judged_from_of(latest, end))

            # Compensation replaces effects in time by a constant.
            uncorrected = uncorrected_in_time(
                linearised, values, poses.time, end=end, latest=latest
            )
            applied = applied_values(linearised, values, uncorrected.centre)
            errors[rows] = _pose_errors(search, block, rows, extended._replace(values=applied))

    # Only rows after the effects of both choices have settled.
    settled = block.time >= settled_from
    pair = [errors_before[settled], errors_after[settled]]
    return gain_of_groups(block.select(settled), pair, APPLIED)


def _pose_errors(
    search: HandInvestigation, block: Rows, rows: np.ndarray, extended: ExtendedBaseline
) -> np.ndarray:
    """
    Return the errors of rows of a block after correction with the parameters of a model.

    They are those of poses in m/s^2 or rad/s, with the Earth's rate about the vertical, of turns
    the angle over the duration in rad/s. `rows`: indices, shape (m,).
    """
    model = extended.model
    values = extended.values
    poses = search.baseline.poses
    if block.duration is not None:
        angles = turn_errors(model, values, poses, turns=[search.turns[row] for row in rows])
        return (angles / block.duration[rows])[:, None]
    temperature_c = None if poses.temperature_c is None else poses.temperature_c[rows]
    corrected = corrected_with(
        model, values, poses.force[rows], rate=poses.rate[rows], temperature_c=temperature_c
    )
    # At rest the force is gravity, and points up: the vertical Earth's rate is along it.
    norm = np.linalg.norm(corrected.force, axis=1, keepdims=True)
    if block.sensor == 'accelerometer':
        return norm - search.baseline.gravity
    return corrected.rate - extended.earth_rate * corrected.force / norm
