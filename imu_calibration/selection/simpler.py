"""Preference for the simpler of two explanations in the presence of unexplained misfit."""

from collections.abc import Sequence

from imu_calibration.selection.attempt import Attempt
from imu_calibration.selection.explained_share import Explained, needed_share, sensors_of
from imu_calibration.selection.gain import LEAST_REDUCTION, gain_in_turn
from imu_calibration.selection.questions import Question

AS_MUCH = 0.5
"""Share of the held-out likelihood of an effect that a simpler one must reach to be tested as its replacement."""


def simpler(attempt: Attempt, explained: Explained, named: Sequence[Question]) -> Sequence[Question]:
    """
    Return findings with no more parameters than the held-out residual supports.

    With unexplained misfit, likelihood prefers more parameters: arms of the three accelerometers, where one common arm
    fits as well. So an effect with fewer parameters replaces a finding when the unweighted residual, in the unit of the
    sensor, is not sure to fall by `LEAST_REDUCTION` from the one to the other.
    """
    kept = list(named)
    for place, question in enumerate(named):
        if not explained.rest_beside(kept, question):
            continue
        for other in _fewer(attempt.search, kept, question):
            instead = [*kept[:place], other, *kept[place + 1:]]
            if (attempt.search.allowed(instead, other) and explained.share(instead, other) >= needed_share(other)
                    and gain_in_turn(attempt, instead, kept, sensors=sensors_of(question.effect)).ci95[0] <= LEAST_REDUCTION):
                kept = instead
                break
    return kept


def _fewer(search, kept, question):
    """Return effects of the same sensors with fewer parameters that explain about as much in the place of a finding, fewest first."""
    beside = [each for each in kept if each is not question]
    enough = AS_MUCH * search.score(beside, question).gain
    fewer = [other for other in search.others(kept) if other.penalty < question.penalty and '@' not in other.label
             and sensors_of(other.effect) == sensors_of(question.effect)]
    scores = [search.score(beside, other) for other in fewer]
    return sorted((score.question for score in scores if score.significant and score.gain >= enough), key=lambda other: other.penalty)
