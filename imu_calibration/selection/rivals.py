"""Effects that are collinear where small, such as a delay and a lag: compared at their estimated sizes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from imu_calibration.selection.attempt import Attempt
from imu_calibration.selection.evidence import WindowEvidence
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import PENALTY, TIE

SHOWN = 0.1
"""Evidence of a curvature below which it does not separate effects, nats: a delay of 0.1 ms is a lag of 0.1 ms."""


@dataclass(frozen=True, eq=False)
class Rival:
    """An alternative to a chosen effect that fits nearly as well."""

    question: Question
    """The effect that it would replace."""
    other: Question
    """The effect that was not chosen."""
    behind: float
    """Held-out log likelihood that it lacks, nats, each linearised where it is."""
    moves: dict[str, float] = field(default_factory=dict)
    """Parameter of the baseline -> its difference with the rival in the model."""

    @property
    def weight(self) -> float:
        """Posterior probability of the rival."""
        return float(1.0 / (1.0 + np.exp(min(self.behind, 700.0))))


def settle_rivals(attempt: Attempt, chosen: Sequence[Question], attempted: Callable) -> tuple[Attempt, list[Rival]]:
    """
    Return (the Attempt at the best of a choice and its rivals, the rivals close to it).

    The first derivatives of a delay and of a low-pass are the same, and a search that is linearised at one of them represents its rival by
    its tangent only: the first one would win. So each is linearised at its own estimate, and all are compared with the same noise,
    estimated with each in turn; only compared effects have columns there.

    Parameters
    ----------
    attempt : Attempt
        Linearised where none of them acts.
    chosen : sequence of Question
    attempted : callable
        ``attempted(point=..., effects=...)``: the Attempt elsewhere, or with some of the effects.

    """
    chosen = [question for question in chosen if '@' not in question.label]
    choices = [chosen, *_swapped(attempt, chosen)]
    if len(choices) == 1:
        return attempt, []
    few = partial(attempted, effects=list({question.name: question.effect for choice in choices for question in choice}.values()))
    start = few()
    attempts = [few(point=start.point(same_questions(start, choice))) for choice in choices]
    choices = [same_questions(there, choice) for there, choice in zip(attempts, choices)]
    costs = np.mean([[_cost(*each, judge) for each in zip(attempts, choices)] for judge in attempts], axis=0)
    best = int(np.argmin(costs))
    values = [dict(zip(there.space.names, there.values(choice))) for there, choice in zip(attempts, choices)]
    near = [k for k in range(len(choices)) if k != best and costs[k] - costs[best] < TIE]
    settled, found = attempted(point=attempt.point(same_questions(attempt, choices[best]))), []
    for k in near:
        taken, other = same_questions(settled, _difference(choices[best], choices[k]))
        moves = {name: values[k][name] - values[best][name] for name in attempt.baseline.param_names}
        found.append(Rival(taken, other, float(costs[k] - costs[best]), moves))
    return settled, found


def same_questions(attempt: Attempt, chosen: Sequence[Question]) -> list[Question]:
    """Return the same questions in another attempt: a warm-up at the likeliest time constant of its bank."""
    found = []
    for each in chosen:
        asked = [question for question in attempt.questions if question.name == each.name]
        same = [question for question in asked if question.label == each.label]
        found.append((same or [min(asked, key=lambda question: attempt.evidence.loss(attempt.search.used([question])))])[0])
    return found


def _swapped(attempt, chosen):
    """Return the choices with an effect replaced by one that only curvature separates from it, where the curvature is observable."""
    return [[other if each is question else each for each in chosen] for question in chosen
            if question.effect.warp is not None and attempt.curvature_shows(chosen, question) > SHOWN
            for other, _ in attempt.search.class_mates(chosen, question, most=None) if other.effect.warp is not None]


def _difference(one, two):
    """Return the first pair of questions in which two choices differ."""
    return next(pair for pair in zip(one, two) if pair[0].name != pair[1].name)


def _cost(attempt, chosen, judge):
    """Return the held-out cost of a choice at its own linearisation, judged with the noise and the band of another attempt."""
    space = replace(attempt.evidence.space, slow_only=judge.space.slow_only, slow_variance=judge.space.slow_variance)
    evidence = WindowEvidence(space, judge.noise, attempt.evidence.fold)
    return 0.5 * evidence.heldout(attempt.search.used(chosen)) + PENALTY * sum(question.penalty for question in chosen)
