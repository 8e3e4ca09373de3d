"""Effects that are one column where they are small, such as a delay and a lag: told apart where each is as large as it is."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from imu_calibration.selection.attempt import Attempt
from imu_calibration.selection.evidence import WindowEvidence
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import PENALTY, TIE

SHOWN = 0.1
"""Evidence of a curvature below which it tells nothing from anything, nats: a delay of 0.1 ms is a lag of 0.1 ms."""


@dataclass(frozen=True, eq=False)
class Rival:
    """What would do nearly as well as a choice."""

    question: Question
    """The effect in whose place it stands."""
    other: Question
    """The effect that was not taken."""
    behind: float
    """Held-out log likelihood that it lacks, nats, each linearised where it is."""
    moves: dict[str, float] = field(default_factory=dict)
    """Parameter of the baseline -> by how much it differs when the rival is taken."""

    @property
    def weight(self) -> float:
        """Share of the belief that evidence leaves to the rival."""
        return float(1.0 / (1.0 + np.exp(min(self.behind, 700.0))))


def settle_rivals(attempt: Attempt, chosen: Sequence[Question], attempted: Callable) -> tuple[Attempt, list[Rival]]:
    """
    Return (the Attempt at the best of a choice and its rivals, the rivals that come near it).

    The first derivatives of a delay and of a low-pass are the same, and a search that takes its columns at one of them sees the other by
    its straight line alone: whichever it met first would win. So each is linearised where it is, and all are judged with the same noise,
    that of each in turn; only those that are compared have columns there.

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
    """Return the questions of another attempt that ask the same: a warm-up that it has in its bank at the likeliest time constant."""
    found = []
    for each in chosen:
        asked = [question for question in attempt.questions if question.name == each.name]
        same = [question for question in asked if question.label == each.label]
        found.append((same or [min(asked, key=lambda question: attempt.evidence.loss(attempt.search.used([question])))])[0])
    return found


def _swapped(attempt, chosen):
    """Return the choices in which an effect gave way to one that only its curvature tells from it, where that can tell anything."""
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
