"""The motion of a table that separates a finding from a collinear effect."""

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
    Return the text of the standard motion that separates a finding from a collinear effect.

    For each motion, the model is extended by the mate, and the values v of the finding have the
    covariance C after the motion alone. The best motion has the largest evidence ``v' C^-1 v``: it
    counts only the part of the finding that is not collinear with the mate and the model. If no
    evidence exceeds `MIN_EVIDENCE_GROWTH`, the motions of both effects.

    Parameters
    ----------
    solution : Solution
        Of the extended model.
    question, mate : Question
        The finding and the collinear effect.

    """
    best_text = motions_of(question, mate)
    for tested in (question, mate):
        # The standard motions show effects of the sensors with columns only.
        if tested.sensor not in SENSORS or not tested.effect.groups:
            return best_text
    model = solution.model.with_effect(mate.sensor, mate.name)
    values = model.start_from(solution.model, solution.values)
    values = np.where(np.isfinite(values), values, 0.0)
    prior_sd = np.where(model.prior()[1] > 0, model.prior()[1], 1.0)
    part = model.slices[question.sensor, question.name]
    information = MotionInformation(model, values, solution.noise, gravity)
    largest = MIN_EVIDENCE_GROWTH
    for motion in MOTIONS:
        total = np.diag(1 / prior_sd**2) + information.added_by(motion)
        covariance = inverse_normal(total)[part, part]
        evidence = float(values[part] @ np.linalg.solve(covariance, values[part]))
        if evidence > largest:
            largest = evidence
            best_text = motion.text
    return best_text


def motions_of_one_joint(question: Question, mate: Question) -> str:
    """
    Return the text of the motions of both effects that a table with one joint can do.

    If it cannot do all of them, the advice to mount the IMU differently is added.
    """
    names = dict.fromkeys(question.effect.motion + mate.effect.motion)
    texts = [ONE_JOINT[name] for name in names if name in ONE_JOINT]
    if len(texts) < len(names):
        texts.append(OTHER_MOUNT)
    return '; '.join(texts)
