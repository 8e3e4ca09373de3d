"""Gain of an extension of the model: errors of the corrected readings of held-out windows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Search
from imu_calibration.selection.selected_effects import SelectedEffects


@dataclass(frozen=True)
class CompensatedFindings:
    """Two choices of effects without the implausible ones, which are in no model."""

    before: list[Question]
    """The smaller choice."""
    after: list[Question]
    """The larger choice: with at least one more effect that compensation can undo."""


def compensated_findings(
    search: SelectedEffects, before: Sequence[Question], after: Sequence[Question]
) -> CompensatedFindings | None:
    """
    Return the plausible findings of two choices.

    None if compensation can undo no additional one of the larger choice `after`.
    """
    adopted_before = [question for question in before if question in search.adopted]
    adopted_after = [question for question in after if question in search.adopted]
    for question in adopted_after:
        if question not in adopted_before and question.effect.compensation == 'exact':
            return CompensatedFindings(adopted_before, adopted_after)
    return None


def sd_of_chosen(search: Search, model: SensorModel, chosen: Sequence[Question]) -> np.ndarray:
    """
    Return the sds of the parameters of a model in a search, shape (n_params,).

    They are zero for parameters of effects that are not chosen, and for time constants that the
    search chose from a list.
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
