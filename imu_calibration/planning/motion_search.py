"""Search for a plan: greedy by gain per second, then by exchange until no exchange shortens it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from imu_calibration.planning.belief import Belief
from imu_calibration.planning.situation import Situation

MOST_MOTIONS = 400
"""Motions of a plan at most."""
FURTHER = 1.02
"""Factor on standard deviations when the belief thinks itself at the goal and the exact weights do not."""
LEAST_GAIN = 2e-3
"""A motion must lower the sum of logarithms of excess over tolerance by so much to be worth it, near the goal by this share of it."""


class Offers:
    """The gain of every motion from where the joints are."""

    def __init__(self, situation: Situation, belief: Belief, place: int, *, margin: float = 1.0, factor: float = 1.0):
        self.places = situation.repertoire.place_of
        self.seconds = situation.seconds + situation.way_seconds[place, self.places]
        size = belief.size
        self.information = (situation.information + situation.way_information(place)) / factor
        self.possible = self.seconds > 0
        after = belief.after(self.information, self.seconds)
        before = situation.goal.left(belief.known[None], margin)[0]
        self.left = situation.goal.left(after[:, :size, :size], margin)
        self.gain = np.where(self.possible, before - self.left, 0.0)
        self.least = LEAST_GAIN * min(1.0, float(before))

    def hopeless(self, number: int) -> bool:
        """Return whether a motion has almost no gain and does not reach the goal."""
        return bool(self.gain[number] < self.least and self.left[number] > 0)

    @property
    def best(self) -> int:
        """The motion with the largest gain per second."""
        return int(np.argmax(np.where(self.possible, self.gain / np.maximum(self.seconds, 1e-9), -np.inf)))


def greedy(situation: Situation, start: int, *, known: np.ndarray | None = None, first: Sequence[int] = (),
           progress: Callable[[float], None] | None = None, longest: float = np.inf) -> list[int]:
    """
    Return motions that reach the goal, or the smallest distance to it, each with the best gain per second at its step.

    Parameters
    ----------
    situation : Situation
    start : int
        Place where the joints are.
    known : ndarray, optional
        Information about z in addition to the prior.
    first : sequence of int
        Mandatory first motions.
    progress : callable, optional
        Called with the completed share.
    longest : float
        Time at most, s.

    """
    belief, place, chosen, spent, margin, factor = situation.belief(known), start, [], 0.0, 1.0, 0.0
    taken: list[tuple[np.ndarray, float]] = []
    beginning = situation.goal.left(belief.known[None])[0]
    while len(chosen) < MOST_MOTIONS and spent < longest:
        if factor != (factor := situation.variance_factor(situation.timed(chosen, start)[0], known)):
            belief = situation.belief(known)
            for information, seconds in taken:
                belief.take(information / factor, seconds)
        choice = Offers(situation, belief, place, margin=margin, factor=factor)
        must = len(chosen) < len(first)
        number = first[len(chosen)] if must else choice.best
        if not must and (choice.hopeless(number) or spent + float(choice.seconds[number]) > longest):
            break
        taken.append((factor * choice.information[number], float(choice.seconds[number])))
        belief.take(choice.information[number], taken[-1][1])
        chosen.append(number)
        spent += float(choice.seconds[number])
        place = int(situation.repertoire.place_of[number])
        left = situation.goal.left(belief.known[None], margin)[0]
        if progress is not None:
            progress(1.0 - left / max(beginning, 1e-9))
        if left == 0.0 and len(chosen) >= len(first):
            if meets(situation, chosen, start, known=known):
                break
            # The belief has constant biases within a motion; if that was optimistic, the target must be lower.
            margin *= FURTHER
    return chosen


def meets(situation: Situation, sequence: Sequence[int], start: int, *, known: np.ndarray | None = None) -> bool:
    """Return whether motions reach the goal."""
    return bool(situation.goal.left(situation.covariance_after(sequence, start, known, cautious=True)[0][None])[0] == 0.0)


def exchanged(situation: Situation, sequence: Sequence[int], start: int, *, known: np.ndarray | None = None,
              fixed: int = 0) -> list[int]:
    """Return a shorter plan that does as much: motions are left out, latest first and none of the first `fixed`."""
    def left(trial):
        return float(situation.goal.left(situation.covariance_after(trial, start, known, cautious=True)[0][None])[0])

    best, goal = list(sequence), left(sequence) + 1e-9
    for place in range(len(best) - 1, fixed - 1, -1):
        trial = best[:place] + best[place + 1:]
        if left(trial) <= goal:
            best = trial
    return best
