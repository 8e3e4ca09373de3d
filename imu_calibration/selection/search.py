"""
Choosing effects one after the other by held-out evidence.

With earlier choices reconsidered after each step.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import AbstractSet

import numpy as np

from imu_calibration.core.progress import reported
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.selection.evidence import Evidence, agree
from imu_calibration.selection.questions import Question, with_exchanged

FAMILY_WISE = 0.001
"""Probability of a finding in a recording with a correct model."""
MIN_GAIN_NATS = 4.0
"""Least gain of held-out log likelihood, nats."""
PENALTY = 1.0
"""Penalty for a parameter in addition to that of held-out prediction, nats."""
MIN_REPLACEMENT_NATS = 0.01
"""
Least fall of the held-out cost for which an effect is replaced, nats: two lags are a delay, and
less than this is rounding.
"""
TIE = 8.0
"""
Difference of held-out log likelihood up to which effects are not separable by the recording, nats.
"""
COLLINEAR = 1e-3
"""
Share of the gain of an effect that is smooth in time up to which another such effect is not
separable from it: the wander of a bias follows no model well enough to separate curves that are so
alike.
"""
IMPLAUSIBLE = 8.0
"""
Price of a size above that of any known instrument, nats: a plausible effect with the same fit is
preferred.
"""
MOST_FINDINGS = 6
"""Effects that one recording may be found to lack."""
MOST_BACKWARD_STEPS = 6
"""Removals and exchanges of effects after an effect joins."""
CLASS_SIZE = 3
"""Members of a class of inseparable effects, the named one included."""


@dataclass(frozen=True, eq=False)
class Score:
    """Evidence for one effect given the current model."""

    question: Question
    """The effect under test."""
    gain: float
    """Gain of held-out log likelihood, nats."""
    p_value: float
    """Chi-square p-value times the number of effects under test, at most 1."""
    allowed: bool
    """Whether the estimate is physically possible; evaluated for an effect with evidence only."""
    implausible: bool = False
    """Whether its size exceeds that of any known instrument."""

    @property
    def net(self) -> float:
        """
        Gain less the penalty for the parameters and for a size that is known of no instrument.
        """
        return self.gain - PENALTY * self.question.penalty - IMPLAUSIBLE * self.implausible

    @property
    def significant(self) -> bool:
        """Return whether the effect may be named."""
        return (
            self.allowed
            and self.p_value < FAMILY_WISE
            and self.net > 0
            and self.gain > MIN_GAIN_NATS
        )


@dataclass(eq=False)
class Search:
    """Forward selection with reconsideration over a fixed set of candidate effects."""

    evidence: Evidence
    """Losses and fits of choices of parameters."""
    baseline: Sequence[int]
    """Parameters that are part of every choice."""
    questions: Sequence[Question]
    """Candidate effects."""
    _: KW_ONLY
    encoder_step: float = 0.0
    """Resolution of the encoders, rad."""
    any_size: bool = False
    """Whether sizes above those of any known instrument are allowed, for a remaining excess."""
    resolved: AbstractSet[str] = frozenset()
    """
    Effects that were compared at their own linearisation: this search neither adds nor replaces
    them.
    """

    def asking_any_size(self) -> 'Search':
        """Return the same search with sizes above those of any known instrument allowed."""
        return replace(self, any_size=True)

    def indices(self, chosen: Sequence[Question]) -> tuple[int, ...]:
        """Return the indices of the parameters of the baseline, then of the chosen effects."""
        indices = list(self.baseline)
        for question in chosen:
            indices += question.parameters
        return tuple(indices)

    def others(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """Return the candidate effects that are neither chosen nor resolved."""
        names = {q.name for q in chosen}.union(self.resolved)
        return [q for q in self.questions if q.name not in names]

    def cost(self, chosen: Sequence[Question], most: float = np.inf) -> float:
        """
        Return the held-out cost of a choice, nats: half of the loss, and the penalties.

        If the cost exceeds `most` without the penalty for implausible sizes, it is returned without
        that penalty, which needs a fit.
        """
        n_charged = sum(q.penalty for q in chosen)
        cost = 0.5 * self.evidence.heldout(self.indices(chosen)) + PENALTY * n_charged
        if cost > most:
            return cost
        n_implausible = sum(self.implausible(chosen, q) for q in chosen)
        return cost + IMPLAUSIBLE * n_implausible

    def score(self, chosen: Sequence[Question], question: Question) -> Score:
        """
        Return the Score of one more effect.

        With the squares chi^2 of the held-out residuals (twice the negative log likelihood)::

            gain = (chi^2 without - chi^2 with) / 2

        The p-value is that of the chi-square test times the number of tests (Bonferroni).
        """
        joined = [*chosen, question]
        without_indices = self.indices(chosen)
        with_indices = self.indices(joined)
        heldout_without = self.evidence.heldout(without_indices)
        heldout_with = self.evidence.heldout(with_indices)
        gain = 0.5 * (heldout_without - heldout_with)
        p_value = self.evidence.p_value(without_indices, with_indices) * len(self.questions)
        p_value = min(1.0, p_value)

        # Estimates only of effects with evidence.
        has_evidence = p_value < FAMILY_WISE and gain > 0
        if not has_evidence:
            return Score(question, gain, p_value, allowed=False)
        return Score(
            question,
            gain,
            p_value,
            self.allowed(joined, question),
            self.implausible(joined, question),
        )

    def allowed(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether the estimate of an effect of the choice is possible.

        A lag is not negative, no angle (at 1 g) is within half an encoder step, a size is neither
        above a known limit nor implausible (unless any size is allowed), and no sensor is predicted
        worse.
        """
        value, sd = self.estimate(chosen, question)
        if question.effect.nonnegative and value[0] < 0:
            return False
        if np.max(np.abs(value)) < least_angle(question.effect, self.encoder_step):
            return False
        # Three standard deviations above the known size.
        if question.effect.known_size and np.any(np.abs(value) - 3 * sd >= question.effect.largest):
            return False
        size_is_allowed = self.any_size or not self.implausible(chosen, question)
        return size_is_allowed and self.shows_alike(chosen, question)

    def early(self, chosen: Sequence[Question]) -> list[Question]:
        """
        Return the candidate lags that would be significant if a negative lag were possible.

        They are an early clock together with a late sensor.
        """
        early = []
        for question in self.others(chosen):
            if not question.effect.nonnegative:
                continue
            value, _ = self.estimate([*chosen, question], question)
            if not value[0] < 0:
                continue
            score = self.score(chosen, question)
            if replace(score, allowed=True).significant:
                early.append(question)
        return early

    def implausible(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether the estimate of a chosen effect exceeds any known instrument.

        The range is a prior, not a hard limit.
        """
        amplitudes = question.effect.n_amplitudes
        value, sd = self.estimate(chosen, question)
        return question.effect.surpasses(value[:amplitudes], sd[:amplitudes])

    def values(self, chosen: Sequence[Question]) -> np.ndarray:
        """
        Return all parameters for a choice, fitted to all rows, shape (q,).

        The parameters of effects that are not chosen are zero.
        """
        used = self.indices(chosen)
        fitted, _ = self.evidence.fit(used)
        values = np.zeros(len(self.evidence.total) - 1)  # the last row is the residual
        values[list(used)] = fitted
        return values

    def estimate(
        self, chosen: Sequence[Question], question: Question
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (values, standard deviations) of the parameters of a chosen effect."""
        used = self.indices(chosen)
        values, covariance = self.evidence.fit(used)
        places = [used.index(k) for k in question.parameters]
        return values[places], np.sqrt(np.diag(covariance)[places])

    def moved_by(
        self, chosen: Sequence[Question], question: Question, names: Sequence[str]
    ) -> dict[str, float]:
        """
        Return parameter -> change of its estimate when an effect joins the other chosen effects.

        Parameters
        ----------
        chosen : sequence of Question
        question : Question
            The effect that joins, last; it may be one of `chosen`.
        names : sequence of str
            Names of the first parameters of the space: those of the baseline and of the effects.
            A warm-up at a time constant of the bank has none.

        """
        others = [q for q in chosen if q is not question]
        without_indices = self.indices(others)
        without, _ = self.evidence.fit(without_indices)
        joint, _ = self.evidence.fit(self.indices([*others, question]))
        moved = {}
        for index, change in zip(without_indices, joint[: len(without)] - without):
            if index < len(names):
                moved[names[index]] = float(change)
        return moved

    def shows_alike(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether no sensor on which an effect acts is predicted worse with the effect.

        A cause in the table must not improve one sensor and degrade the second.
        """
        if question.sensor in SENSORS or len(question.effect.acts_on) < 2:
            return True
        others = [q for q in chosen if q is not question]
        before = self.evidence.heldout_parts(self.indices(others))
        after = self.evidence.heldout_parts(self.indices(chosen))
        for sensor in after:
            if sensor not in question.effect.acts_on:
                continue
            # Squares of residuals are twice the nats.
            loss = (after[sensor] - before[sensor]).sum()
            if not loss < 2 * MIN_GAIN_NATS:
                return False
        return True

    def agrees_in_halves(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether the estimates of a chosen effect from both halves of the data agree.

        Effects that are smooth in time are not tested: they differ by nature.
        """
        if question.effect.smooth:
            return True
        used = self.indices(chosen)
        fits = self.evidence.fits_of_halves(used)
        return agree(fits, [used.index(k) for k in question.parameters])

    def run(self, start: Sequence[Question] = ()) -> Sequence[Question]:
        """
        Return the chosen effects in the order in which they were found.

        The search starts from the effects `start`, which may be removed.
        """
        chosen = self.reconsidered(list(start)) if start else []
        for _ in range(2 * MOST_FINDINGS):
            # Forward: the significant effect with the largest net gain joins.
            significant = []
            others = self.others(chosen)
            for question in reported('testing effects', others, len(others)):
                score = self.score(chosen, question)
                if score.significant:
                    significant.append(score)
            if not significant or len(chosen) >= MOST_FINDINGS:
                break
            best = max(significant, key=lambda score: score.net)

            # Backward: without effects that it makes unnecessary. The same choice again is the end.
            before = [q.label for q in chosen]
            chosen = self.reconsidered([*chosen, best.question])
            if [q.label for q in chosen] == before:
                break
        return chosen

    def reconsidered(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """
        Return the choice after backward steps.

        A step removes an insignificant effect, or exchanges one effect for a better one.
        """
        for _ in range(MOST_BACKWARD_STEPS):
            smaller = self._dropped(chosen)
            if smaller is not None:
                chosen = smaller
                continue
            exchanged = self._replaced(chosen)
            if exchanged is None:
                return chosen
            chosen = exchanged
        return chosen

    def _dropped(self, chosen: Sequence[Question]) -> list[Question] | None:
        """Return the choice without its first insignificant effect; None if all are significant."""
        # Effects with many parameters first.
        for question in sorted(chosen, key=lambda q: -q.penalty):
            others = [q for q in chosen if q is not question]
            if not self.score(others, question).significant:
                return others
        return None

    def _replaced(self, chosen: Sequence[Question]) -> list[Question] | None:
        """Return the choice with the best exchange of one effect; None if none lowers the cost."""
        best: list[Question] | None = None
        cost = self.cost(chosen) - MIN_REPLACEMENT_NATS
        for place, question in enumerate(chosen):
            # A resolved effect could not be added again, and an effect that cancels it may be in
            # the model.
            if question.name in self.resolved:
                continue
            remaining = [q for q in chosen if q is not question]
            for other in self.others(remaining):
                if other is question:
                    continue
                trial = with_exchanged(chosen, place, other)
                trial_cost = self.cost(trial, cost)
                if not trial_cost < cost:
                    continue
                if not all(self.allowed(trial, each) for each in trial):
                    continue
                if self.score(remaining, other).significant:
                    best = trial
                    cost = trial_cost
        return best

    def drop_insignificant(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """
        Return the choice after insignificant effects were removed, one at a time.

        Of a clock and a lag that cancel, none remains.
        """
        while True:
            smaller = self._dropped(chosen)
            if smaller is None:
                return chosen
            chosen = smaller

    def confounded(
        self, chosen: Sequence[Question], question: Question, *, most: int | None = CLASS_SIZE - 1
    ) -> list[tuple[Question, float]]:
        """
        Return (effect, rise of the cost in nats) of effects that could replace `question`.

        The rise is below `TIE`; the least is first, and at most `most` are returned.
        """
        place = chosen.index(question)
        cost = self.cost(chosen)

        # Two effects that are smooth in time are separable less well the more they explain.
        smooth_tie = TIE
        if question.effect.smooth:
            others = [each for each in chosen if each is not question]
            gain = self.cost(others) - cost
            smooth_tie = max(TIE, COLLINEAR * gain)

        rivals: dict[str, tuple[Question, float]] = {}
        for other in self.others(chosen):
            # A special case with an equal fit is preferred: the general effect is not its rival.
            if question.effect.contained_in == other.name:
                continue
            trial = with_exchanged(chosen, place, other)
            tie = smooth_tie if other.effect.smooth else TIE
            difference = self.cost(trial, cost + tie) - cost
            if not difference < tie or not self.allowed(trial, other):
                continue
            # A warm-up is tested at several time constants; the best one counts.
            if other.name not in rivals or difference < rivals[other.name][1]:
                rivals[other.name] = (other, difference)
        return sorted(rivals.values(), key=lambda pair: pair[1])[:most]


def least_angle(effect: Effect, encoder_step: float) -> float:
    """
    Return the least size of an effect that is an angle (at 1 g): half an encoder step, rad.

    0 for other effects.

    Steps repeat each time the table returns to a pose: they do not average out, and resemble errors
    of the table.
    """
    angle_of_unit: dict[str | tuple, float] = {'rad': 1.0, 'rad/(m/s^2)': STANDARD_GRAVITY}
    if effect.unit not in angle_of_unit:
        return 0.0
    return 0.5 * encoder_step / angle_of_unit[effect.unit]
