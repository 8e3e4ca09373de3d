"""The motion that would separate two effects: the best of the standard motions, for the estimated sizes of the effects."""

from typing import Any

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.observability import added_information
from imu_calibration.estimation.scaled_solve import inverse_normal
from imu_calibration.estimation.solution import Solution
from imu_calibration.estimation.standard_motions import MOTIONS, ONE_JOINT, OTHER_MOUNT, TABLE_MOTIONS
from imu_calibration.selection.questions import Question

ENOUGH = 9.0
"""Least growth of the evidence that a motion must promise, in squared standard deviations."""


def separating_motion(solution: Solution, question: Question, mate: Question, *, gravity: float) -> Any:
    """
    Return the standard motion after which the mate could no longer pass for the effect that was found.

    For each motion: its added information about the extended model and the mate, and from that the part of the effect
    that is not collinear with the mate and the model, in squared standard deviations.

    Parameters
    ----------
    solution : Solution
        Of the extended model.
    question, mate : Question
        The finding and an effect that would do as well.

    """
    if question.sensor in SENSORS and mate.sensor in SENSORS and question.effect.groups and mate.effect.groups:
        text = _best_motion(solution, question, mate, gravity)
        if text is not None:
            return text
    return motions_of(question, mate)


def motions_of(question: Question, mate: Question) -> str:
    """Return the motions that two effects declare as theirs."""
    own = [name for name in question.effect.motion + mate.effect.motion]
    texts = {motion.name: motion.text for motion in MOTIONS} | TABLE_MOTIONS
    return '; '.join(dict.fromkeys(texts[name] for name in own if name in texts))


def motions_of_one_joint(question: Question, mate: Question) -> str:
    """Return the same of a table that turns about one axis only, which cannot do most of them."""
    own = dict.fromkeys(question.effect.motion + mate.effect.motion)
    found = [ONE_JOINT[name] for name in own if name in ONE_JOINT]
    return '; '.join(found + [OTHER_MOUNT] * (len(found) < len(own)))


def _best_motion(solution, question, mate, gravity):
    model = solution.model.with_effect(mate.sensor, mate.name)
    values = model.start_from(solution.model, solution.values)
    values = np.where(np.isfinite(values), values, 0.0)
    prior_sd = np.where(model.prior()[1] > 0, model.prior()[1], 1.0)
    own = model.slices[question.sensor, question.name]
    best = (ENOUGH, None)
    for motion in MOTIONS:
        total = np.diag(1 / prior_sd**2) + added_information(model, values, solution.noise, motion=motion, gravity=gravity)
        left = _unimitated(total, values, own)
        if left > best[0]:
            best = (left, motion.text)
    return best[1]


def _unimitated(information, values, own):
    """Return the squared standard deviations of the effect's part that is not collinear with the model, its mate included."""
    return float(values[own] @ np.linalg.solve(inverse_normal(information)[own, own], values[own]))
