"""
Choosing effects one after the other by held-out evidence.

With earlier choices reconsidered after each step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import AbstractSet, Any, ClassVar

import numpy as np

from imu_calibration.core.progress import reported
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.evidence import Evidence
from imu_calibration.selection.questions import Question

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


class Search:
    """
    Forward selection with reconsideration over a fixed set of questions.

    Parameters
    ----------
    evidence : Evidence
    baseline : sequence of int
        Parameters that are always there.
    questions : sequence of Question
    encoder_step : float
        Resolution of the encoders, rad.
    any_size : bool
        Whether sizes above those of any known instrument are allowed, for a remaining excess.
    resolved : set of str
        Effects that were compared at their own linearisation; this search must not revise them: not
        tested unless chosen.

    """

    def __init__(
        self,
        evidence: Evidence,
        baseline: Sequence[int],
        questions: Sequence[Question],
        *,
        encoder_step: float = 0.0,
        any_size: bool = False,
        resolved: AbstractSet[str] = frozenset(),
    ):
        self.evidence, self.baseline, self.questions = evidence, tuple(baseline), questions
        self.encoder_step, self.any_size, self.resolved = encoder_step, any_size, resolved

    def asking_any_size(self) -> 'Search':
        """Return a search that allows sizes that are known of no instrument too."""
        return Search(
            self.evidence,
            self.baseline,
            self.questions,
            encoder_step=self.encoder_step,
            any_size=True,
            resolved=self.resolved,
        )

    def indices(self, chosen: Sequence[Question]) -> tuple[int, ...]:
        """Return the parameters of the baseline and of the chosen effects."""
        return (*self.baseline, *chain.from_iterable(q.parameters for q in chosen))

    def others(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """Return the questions about effects that are not chosen, and not resolved."""
        names = {q.name for q in chosen}.union(self.resolved)
        return [q for q in self.questions if q.name not in names]

    def cost(self, chosen: Sequence[Question], most: float = np.inf) -> float:
        """
        Return the held-out cost of a choice, nats, penalties included.

        Above `most` without the penalty for implausible sizes.
        """
        cost = 0.5 * self.evidence.heldout(self.indices(chosen)) + PENALTY * sum(
            q.penalty for q in chosen
        )
        return (
            cost
            if cost > most
            else cost + IMPLAUSIBLE * sum(self.implausible(chosen, q) for q in chosen)
        )

    def score(self, chosen: Sequence[Question], question: Question) -> Score:
        """Return the Score of one more effect."""
        beside = [*chosen, question]
        smaller, larger = self.indices(chosen), self.indices(beside)
        gain = 0.5 * (self.evidence.heldout(smaller) - self.evidence.heldout(larger))
        p_value = min(1.0, self.evidence.p_value(smaller, larger) * len(self.questions))
        asked = p_value < FAMILY_WISE and gain > 0
        return Score(
            question,
            gain,
            p_value,
            asked and self.allowed(beside, question),
            asked and self.implausible(beside, question),
        )

    def allowed(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether the effect's estimate is possible.

        A lag is not negative, no angle (at 1 g) is within half an encoder step, and no size is
        implausible, unless allowed.
        """
        value, sd = self.estimate(chosen, question)
        if question.effect.nonnegative and value[0] < 0:
            return False
        if np.max(np.abs(value)) < least_angle(question.effect, self.encoder_step):
            return False
        if question.effect.known_size and np.any(np.abs(value) - 3 * sd >= question.effect.largest):
            return False
        return (self.any_size or not self.implausible(chosen, question)) and self.shows_alike(
            chosen, question
        )

    def early(self, chosen: Sequence[Question]) -> list[Question]:
        """
        Return the lags that would be significant if they were not negative.

        An early clock with a late sensor.
        """
        scores = [
            self.score(chosen, q)
            for q in self.others(chosen)
            if q.effect.nonnegative and self.estimate([*chosen, q], q)[0][0] < 0
        ]
        return [score.question for score in scores if replace(score, allowed=True).significant]

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
        Return all parameters for a choice, fitted to all rows.

        Zero for those of other effects, shape (q,).
        """
        used, values = self.indices(chosen), np.zeros(len(self.evidence.total) - 1)
        values[list(used)] = self.evidence.fit(used)[0]
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
        Return parameter -> its change when an effect joins the baseline and some choices.

        The parameters are of the baseline and of the other choices among `names`.
        """
        others = [q for q in chosen if q is not question]
        smaller, larger = self.indices(others), self.indices([*others, question])
        moved = self.evidence.fit(larger)[0][: len(smaller)] - self.evidence.fit(smaller)[0]
        return {names[k]: float(change) for k, change in zip(smaller, moved) if k < len(names)}

    def shows_alike(self, chosen: Sequence[Question], question: Question) -> bool:
        """
        Return whether no sensor on which an effect acts is predicted worse with it.

        A cause in the table must not improve one sensor and degrade the second.
        """
        if question.sensor in SENSORS or len(question.effect.acts_on) < 2:
            return True
        rest = [q for q in chosen if q is not question]
        before, after = (self.evidence.heldout_parts(self.indices(some)) for some in (rest, chosen))
        return all(
            (after[sensor] - before[sensor]).sum() < 2 * MIN_GAIN_NATS
            for sensor in after
            if sensor in question.effect.acts_on
        )

    def run(self, start: Sequence[Question] = ()) -> Sequence[Question]:
        """
        Return the chosen questions in the order in which they were found.

        From none or from a first choice.
        """
        chosen = self.reconsidered(list(start)) if start else []
        for _ in range(2 * MOST_FINDINGS):
            others = self.others(chosen)
            scores = [
                self.score(chosen, q) for q in reported('testing effects', others, len(others))
            ]
            good = [s for s in scores if s.significant]
            if not good or len(chosen) >= MOST_FINDINGS:
                break
            best = max(good, key=lambda s: s.net)
            before = [q.label for q in chosen]
            chosen = self.reconsidered([*chosen, best.question])
            if [q.label for q in chosen] == before:
                break
        return chosen

    def reconsidered(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """
        Return the choice without effects that are no longer needed.

        Better explanations are substituted in it.
        """
        for _ in range(6):
            smaller = self._dropped(chosen)
            if smaller is not None:
                chosen = smaller
                continue
            other = self._replaced(chosen)
            if other is None:
                return chosen
            chosen = other
        return chosen

    def _dropped(self, chosen: Sequence[Question]) -> list[Question] | None:
        for question in sorted(chosen, key=lambda q: -q.penalty):
            rest = [q for q in chosen if q is not question]
            if not self.score(rest, question).significant:
                return rest
        return None

    def _replaced(self, chosen: Sequence[Question]) -> list[Question] | None:
        best: list[Question] | None = None
        cost = self.cost(chosen) - MIN_REPLACEMENT_NATS
        for place, question in enumerate(chosen):
            # It could not be added again, and an effect that cancels it may be in the model.
            if question.name in self.resolved:
                continue
            rest = [*chosen[:place], *chosen[place + 1 :]]
            for other in self.others(rest):
                if other is question:
                    continue
                trial = [*chosen[:place], other, *chosen[place + 1 :]]
                value = self.cost(trial, cost)
                if (
                    value < cost
                    and all(self.allowed(trial, each) for each in trial)
                    and self.score(rest, other).significant
                ):
                    best, cost = trial, value
        return best

    def drop_insignificant(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """
        Return the effects of a choice that are still significant after removals.

        Of a clock and a lag that cancel, none.
        """
        while (smaller := self._dropped(chosen)) is not None:
            chosen = smaller
        return chosen

    def confounded(
        self, chosen: Sequence[Question], question: Question, *, most: int | None = CLASS_SIZE - 1
    ) -> list[tuple[Question, float]]:
        """
        Return (question, difference in nats) of effects that could replace `question`.

        They would do as well in its place, best first, at most `most`.
        """
        place, cost = chosen.index(question), self.cost(chosen)
        found, alike = {}, TIE
        if question.effect.smooth:
            alike = max(
                TIE,
                COLLINEAR * (self.cost([each for each in chosen if each is not question]) - cost),
            )
        for other in self.others(chosen):
            trial = [*chosen[:place], other, *chosen[place + 1 :]]
            tie = alike if other.effect.smooth else TIE
            difference = self.cost(trial, cost + tie) - cost
            if question.effect.contained_in == other.name:
                # A special case with an equal fit is preferred, and the general effect is not its
                # rival
                continue
            if difference < tie and self.allowed(trial, other):
                if other.name not in found or difference < found[other.name][1]:
                    found[other.name] = (other, difference)
        return sorted(found.values(), key=lambda pair: pair[1])[:most]


def least_angle(effect: Effect, encoder_step: float) -> float:
    """
    Return the size of an effect, an angle (at 1 g), that is half an encoder step (rad).

    0 for other effects.

    Steps repeat each time the table returns to a pose: they do not average out, and resemble errors
    of the table.
    """
    angles: dict[str | tuple, float] = {'rad': 1.0, 'rad/(m/s^2)': STANDARD_GRAVITY}
    return 0.5 * encoder_step / angles[effect.unit] if effect.unit in angles else 0.0


@dataclass(frozen=True)
class SelectionSettings:
    """How a solution with the findings of a search judges them."""

    joint_test: bool = True
    """Whether the coefficients of an effect have to be significant together, besides one alone."""
    judge_requested: bool = True
    """Whether findings that are in the requested model have to be significant, too."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SelectedEffects:
    """
    Findings of a search on data of any reference, separated by plausibility of their sizes.

    A reference that searches for more than effects overrides the properties that are empty here.
    """

    settings: ClassVar[SelectionSettings] = SelectionSettings()
    problem: Any
    """Rows, evidence and search."""
    explained: Any
    """Excess over noise, and the share of it that effects remove (`Explained`)."""
    named: Sequence[Question]
    """Questions that became findings, in the order found."""
    not_testable: list[dict]
    """Effects that could not be tested."""
    unstable: Sequence[Question] = ()
    """
    Questions that would have become findings, but the parts of the recording disagree on them.
    """
    rejected: Sequence[Question] = ()
    """
    Questions selected by likelihood but not named: their gain is too small, or the remaining excess
    too large.
    """
    limits: Sequence[Any] = ()
    """Saturations (`Saturation`)."""

    @property
    def jitter_entry(self) -> Mapping[str, Any]:
        """Independent errors of the stamps, for a document."""
        return {}

    @property
    def further_moves(self) -> Sequence[tuple[Mapping[str, float], float]]:
        """(changes of parameters by other causes than effects that are not named, weight)."""
        return ()

    @property
    def param_names(self) -> Sequence[str]:
        """Names of the parameters of the baseline and of the effects under test."""
        raise NotImplementedError

    @property
    def baseline_model(self) -> SensorModel:
        """The model that the search extends."""
        raise NotImplementedError

    @property
    def point_of_named(self) -> Mapping[str, np.ndarray]:
        """Effect -> values at which its columns are linearised, in the model with all findings."""
        raise NotImplementedError

    @property
    def point_of_adopted(self) -> dict[str, np.ndarray]:
        """Effect -> values at which its columns are linearised, of the adopted effects."""
        point = self.point_of_named
        adopted = [question.name for question in self.adopted]
        return {name: point[name] for name in adopted if name in point}

    def unexplained_rests(self) -> Mapping[str, Any]:
        """Return sensor -> its residual that no finding explains, and free what it needed."""
        raise NotImplementedError

    @property
    def search(self) -> Search:
        """On which they were chosen."""
        return self.problem.search

    @property
    def implausible(self) -> list[Question]:
        """
        Findings with sizes above those of any known instrument.

        Reported, but added to a model only on request.
        """
        return [
            question for question in self.named if self.search.implausible(self.named, question)
        ]

    @property
    def adopted(self) -> list[Question]:
        """Findings that belong into the model."""
        strange = self.implausible
        return [question for question in self.named if question not in strange]
