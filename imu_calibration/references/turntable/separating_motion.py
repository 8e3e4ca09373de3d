"""The motion of a table that separates an effect from one that would do as well."""

import numpy as np

from imu_calibration.calibration.diagnosis.findings import motions_of
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.motions import TABLE_MOTIONS
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.solution import Solution
from imu_calibration.references.turntable.observability import MotionInformation
from imu_calibration.references.turntable.standard_motions import MOTIONS, OTHER_MOUNT
from imu_calibration.selection.questions import Question

MIN_EVIDENCE_GROWTH = 9.0
"""Least growth of the evidence that a motion must promise, in squared standard deviations."""
ONE_JOINT = {
    'oscillate_fast': 'oscillate at 1, 2 and 4 Hz',
    'fast_spin': TABLE_MOTIONS['fast_spin'],
    'slow_turn': 'turn the joint slowly through full circles',
    'warm_up': 'rest in several places, cold and warm',
    'warm_and_cool': (
        'rest in several places while it warms up by ten kelvins, and again while it cools'
    ),
    'shake': 'rest in several places, quiet and while a machine shakes the table',
}
"""The motions that a table of one joint can do; the other ones require a remounted IMU."""


def separating_motion(
    solution: Solution, question: Question, mate: Question, *, gravity: float
) -> str:
    """
    Return the standard motion that separates the mate from the effect found.

    After this motion the mate could no longer pass for the effect that was found.

    For each motion: its added information about the extended model and the mate, and from that the
    part of the effect that is not collinear with the mate and the model, in squared standard
    deviations.

    Parameters
    ----------
    solution : Solution
        Of the extended model.
    question, mate : Question
        The finding and an effect that would do as well.

    """
    best = MIN_EVIDENCE_GROWTH, motions_of(question, mate)
    if not all(each.sensor in SENSORS and each.effect.groups for each in (question, mate)):
        return best[1]
    model = solution.model.with_effect(mate.sensor, mate.name)
    values = model.start_from(solution.model, solution.values)
    values = np.where(np.isfinite(values), values, 0.0)
    prior_sd = np.where(model.prior()[1] > 0, model.prior()[1], 1.0)
    own = model.slices[question.sensor, question.name]
    information = MotionInformation(model, values, solution.noise, gravity)
    for motion in MOTIONS:
        total = np.diag(1 / prior_sd**2) + information.added_by(motion)
        left = float(values[own] @ np.linalg.solve(inverse_normal(total)[own, own], values[own]))
        if left > best[0]:
            best = left, motion.text
    return best[1]


def motions_of_one_joint(question: Question, mate: Question) -> str:
    """Return the same of a table that turns about one axis only, which cannot do most of them."""
    own = dict.fromkeys(question.effect.motion + mate.effect.motion)
    found = [ONE_JOINT[name] for name in own if name in ONE_JOINT]
    if len(found) < len(own):
        found.append(OTHER_MOUNT)
    return '; '.join(found)
