"""Gain of an extension of the model: errors of the corrected readings of held-out windows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Search, SelectedEffects


@dataclass(frozen=True)
class CompensatedFindings:
    """Two choices of effects, without implausible findings, which are not in the model."""

    before: list[Question]
    """The smaller choice."""
    after: list[Question]
    """The larger choice: with at least one more effect that compensation can undo."""


def compensated_findings(
    found: SelectedEffects, before: Sequence[Question], after: Sequence[Question]
) -> CompensatedFindings | None:
    """
    Return the findings of two choices that belong into the model.

    Or None if compensation corrects no additional one.
    """
    adopted_before = [question for question in before if question in found.adopted]
    adopted_after = [question for question in after if question in found.adopted]
    for question in adopted_after:
        if question not in adopted_before and question.effect.compensation == 'exact':
            return CompensatedFindings(adopted_before, adopted_after)
    return None


def sd_of_chosen(search: Search, model: SensorModel, chosen: Sequence[Question]) -> np.ndarray:
    """
    Return the standard deviations of the parameters of some effects; of other ones zero.

    A warm-up that was only tried at a bank of time constants has none for its own.
    """
    used = search.indices(chosen)
    _, covariance = search.evidence.fit(used)
    sd_of_index = dict(zip(used, np.sqrt(np.diag(covariance)), strict=True))
    sd = np.zeros(len(model.param_names))
    for question in chosen:
        start = model.slices[question.effect.key].start
        for place, index in enumerate(question.parameters):
            sd[start + place] = sd_of_index[index]
    return sd
