"""
The search from windows to named effects.

Remove clipped samples, linearise, choose, prove, relinearise.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import AbstractSet

import numpy as np

from imu_calibration.core.errors import NotObservableError
from imu_calibration.effects.base import Effect
from imu_calibration.effects.reference_effects import CLOCK, FAMILY
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.residuals.find_onset import find_onset
from imu_calibration.references.turntable.selection.extended_model import (
    point_with,
    without_saturation,
)
from imu_calibration.references.turntable.selection.extended_solution import extended_solution
from imu_calibration.references.turntable.selection.lag_explanations import (
    Explanation,
    LagExplanations,
    lag_explanations,
    simplest,
)
from imu_calibration.references.turntable.selection.linearised_problem import (
    LinearisedProblem,
    SearchedWindows,
)
from imu_calibration.references.turntable.selection.rivals import (
    Rival,
    best_pairs,
    same_questions,
    settle_rivals,
    simpler,
)
from imu_calibration.references.turntable.selection.saturation import (
    Saturation,
    windows_at,
    without_clipping,
)
from imu_calibration.references.turntable.selection.testable_effects import testable_effects
from imu_calibration.references.turntable.selection.window_evidence import MIN_FOLD_WINDOWS
from imu_calibration.references.turntable.selection.window_gain import gain_in_turn
from imu_calibration.selection.explained_share import pruned
from imu_calibration.selection.gain import LEAST_REDUCTION
from imu_calibration.selection.onset import Onset
from imu_calibration.selection.order_of_tests import EffectTests, select_findings
from imu_calibration.selection.questions import Question
from imu_calibration.selection.selected_effects import SelectedEffects

LINEARISATIONS = 5
"""Largest number of linearisations."""
EXPLANATIONS = 4
"""Explanations of the lags that are tried, at most."""
MAX_REMAINING_EXCESS = 0.1
"""Largest remaining share of a significant excess after pairs, or effects of implausible size."""
MAX_EXCESS_BEFORE = 3 * MAX_REMAINING_EXCESS
"""
The same before the choice is relinearised: a larger share is rejected at once, because a trial
needs up to eight linearisations.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Investigation(SelectedEffects):
    """Numerical result of a search, without sentences."""

    table: Table
    """The reference."""
    used: list[Window]
    """Windows that were fitted to, without clipped samples."""
    problem: LinearisedProblem
    """Linearised at the findings."""
    limits: Sequence[Saturation] = ()
    """Limits at which outputs pile up."""
    rivals: Sequence[Rival] = field(default_factory=list)
    """Alternatives to findings that fit nearly as well."""
    onset: Onset | None = None
    """
    Parameters that change at one moment: the other results are those of the longer part of the
    recording.
    """

    @property
    def changed_at(self) -> float | None:
        """Time of the onset, s."""
        return None if self.onset is None else self.onset.time

    @property
    def param_names(self) -> Sequence[str]:
        """Names of the parameters of the baseline and of the effects under test."""
        return self.problem.space.names

    @property
    def baseline_model(self) -> SensorModel:
        """The model that the search extends."""
        return self.problem.baseline

    @property
    def point_of_named(self) -> Mapping[str, np.ndarray]:
        """Effect -> values at which its columns are linearised."""
        return self.problem.recording.model.point

    def clipped_solution(self) -> Solution | None:
        """Return the solution without the saturated samples; None where no limit was found."""
        if not self.limits:
            return None
        return extended_solution(self.problem, self.adopted, saturations=self.limits)


def investigate(
    windows: Sequence[Window],
    table: Table,
    model: SensorModel,
    *,
    bias_processes: dict | None = None,
) -> Investigation:
    """
    Test every effect that a model lacks on held-out windows.

    If parameters change at one moment (`find_onset`), the search is repeated: with a step of the
    clock, or on the longer part alone.

    Parameters
    ----------
    windows : sequence of Window
        One recording in order; windows of kind 'unused' are excluded.
    table : Table
        The reference.
    model : SensorModel
        The model to be extended.
    bias_processes : dict, optional
        Sensor -> its bias processes, where measured separately.

    Raises
    ------
    NotObservableError
        When there are too few windows to hold any out.

    """
    # Windows of the search without clipped samples, the locked ones, and the effects under test.
    used = [window for window in windows if window.kind != 'unused']
    if len(used) < MIN_FOLD_WINDOWS:
        raise too_few_windows(len(used))
    model = replace(model, joint_names=table.joint_names)
    used, locked, limits = without_clipping(used, table, model)
    testable, not_testable = testable_effects(model, table, windows_at(used, ~locked))
    effects = without_saturation(testable)
    searched = SearchedWindows(
        used, table, model, effects=effects, locked=locked, bias_processes=bias_processes
    )

    # Search for constant parameters.
    result = _search_result(searched.linearised(), searched)

    # An excess remains: do parameters change at one moment?
    onset = None
    if result.outcome.remaining_excess:
        outcome = result.outcome
        onset = find_onset(outcome.problem, outcome.named, windows=used, table=table)

    # A step of the clock is an effect: the search is repeated with it, and counts if it removes
    # most of the excess.
    step = next((effect for effect in testable if effect.located), None)
    if onset is not None and onset.what == CLOCK and step is not None:
        with_step = _with_clock_step(searched, step, onset)
        if (
            with_step.outcome.remaining_excess
            < MAX_REMAINING_EXCESS * result.outcome.remaining_excess
        ):
            result = with_step
            onset = None

    # Any other change: only the longer part.
    if onset is not None:
        before_onset = [window for window in used if window.time[-1] < onset.time]
        after_onset = [window for window in used if window.time[0] >= onset.time]
        longer = max(before_onset, after_onset, key=len)
        of_part = investigate(longer, table, model, bias_processes=bias_processes)
        return replace(of_part, onset=onset)

    # Once more where an excess remains: with plausible sizes, then with any size.
    outcome = result.outcome
    tried = {_labels(outcome.chosen)}
    for any_size in (False, True):
        of_size = replace(result.searched, any_size=any_size)
        outcome = _looked_again(outcome, of_size, tried)

    # Rivals of effects that became findings, and are no findings themselves.
    named = outcome.named
    unstable = outcome.unstable
    names = {question.name for question in named}
    rivals = []
    for rival in result.rivals:
        if rival.question.name in names and rival.other.name not in names:
            rivals.append(rival)
    rejected = [question for question in outcome.chosen if question not in (*named, *unstable)]
    return Investigation(
        table=table,
        used=used,
        problem=outcome.problem,
        named=named,
        not_testable=not_testable,
        unstable=unstable,
        rejected=rejected,
        limits=limits,
        rivals=rivals,
    )


@dataclass(frozen=True, eq=False)
class _SearchResult:
    """A search with its lags and rivals compared at their own linearisations."""

    outcome: '_Outcome'
    """The choice and its findings."""
    rivals: Sequence[Rival]
    """Alternatives to its effects that fit nearly as well."""
    searched: SearchedWindows
    """The windows for further searches, with the lags resolved if there are any."""


def _with_clock_step(searched: SearchedWindows, step: Effect, onset: Onset) -> _SearchResult:
    """Return the search with a step of the clock too, from the values of an onset of the clock."""
    # An onset of the clock has one parameter, its offset: that before the onset, and the step.
    ((offset_name, offset),) = onset.before.items()
    size_name, time_name = step.param_names()
    values = {
        offset_name: offset,
        size_name: onset.after[offset_name] - offset,
        time_name: onset.time,
    }
    effects = [*searched.effects, step]
    searched = replace(searched, effects=effects)
    problem = searched.linearised(point_with(searched.baseline, effects, values))
    start = [question for question in problem.questions if question.name == step.name]
    return _search_result(problem, searched, start)


def _search_result(
    problem: LinearisedProblem, searched: SearchedWindows, start: Sequence[Question] = ()
) -> _SearchResult:
    """
    Return the result of a search from the effects `start`.

    Lags are explained together (`lag_explanations`); they are resolved effects in further searches.
    Without lags, timing effects are compared at their own linearisations (`settle_rivals`).
    """
    likeliest = problem.search.run(start)
    # Lags on which the windows disagree need no explanation.
    chosen = []
    for question in likeliest:
        if question.name not in FAMILY or problem.windows_agree(likeliest, question):
            chosen.append(question)

    # Lags together. An early clock with a late sensor looks like a negative lag, which a search
    # does not choose.
    early_lags = problem.search.early(chosen)
    explanations = lag_explanations(problem, [*chosen, *early_lags], searched)
    if explanations is not None:
        searched = replace(searched, resolved=FAMILY)
        outcome, rivals = _with_lags(explanations, searched)
        return _SearchResult(outcome, rivals, searched)

    # No lags, or none that explains the data: each timing effect against its rivals.
    settled, rivals = settle_rivals(problem, chosen, searched)
    if settled is not problem:
        chosen = settled.search.run()
    return _SearchResult(_settled(searched, settled, chosen), rivals, searched)


@dataclass(frozen=True, eq=False)
class _Outcome:
    """A choice of effects, linearised, with the result of its tests."""

    problem: LinearisedProblem
    """Linearised at the choice."""
    chosen: Sequence[Question]
    """Effects that the search chose by likelihood."""
    named: Sequence[Question]
    """Those that became findings."""
    unstable: Sequence[Question]
    """Those whose estimates from both halves differ significantly."""

    @cached_property
    def remaining_excess(self) -> float:
        """Significant excess over noise with the findings in the model."""
        return self.problem.explained.remaining_excess(self.named)


@dataclass(frozen=True, eq=False)
class _Trial:
    """One explanation of the lags with the outcome of its search."""

    number: int
    """Number of the trial, from 0."""
    lags: AbstractSet[str]
    """Effects of the explanation."""
    outcome: _Outcome
    """Outcome of the search that starts from these effects."""
    rivals: Sequence[Rival]
    """Alternatives to its findings."""

    @property
    def rank(self) -> tuple[int, int, int]:
        """Sort key: numbers of its lags that are named, and chosen; then the earlier trial."""
        named = {question.name for question in self.outcome.named}
        chosen = {question.name for question in self.outcome.chosen}
        return len(self.lags & named), len(self.lags & chosen), -self.number

    @property
    def names_all_lags(self) -> bool:
        """Whether all of its lags are named."""
        return self.rank[0] == len(self.lags)

    def finished(self, searched: SearchedWindows) -> '_Trial':
        """Return the trial relinearised at its choice, without the lags that are not named."""
        return replace(self, outcome=_settled(searched, self.outcome.problem, self.outcome.chosen))


def _with_lags(
    explanations: LagExplanations, searched: SearchedWindows
) -> tuple[_Outcome, Sequence[Rival]]:
    """
    Return (outcome with the simplest explanation of the lags that are all named, its rivals).

    If one of several lags is not named, an explanation with fewer effects is tried; if a single one
    is not, another explanation. To save time, a trial is relinearised at its choice only if all of
    its lags are named before, or if no trial succeeds and it is the best.
    """
    candidates = explanations.explanations
    refused: list[Explanation] = []  # explanations of which some lags are not named
    tried = []
    for number in range(EXPLANATIONS):
        # Search for the other effects at the lags of the simplest explanation.
        selected = simplest(candidates, explanations.cost_without_lag)
        at_lags = explanations.settled(selected, searched)
        chosen = at_lags.problem.search.run(at_lags.chosen)
        # Its timing effects may be replaced by rivals, at another linearisation.
        settled, rivals = settle_rivals(at_lags.problem, chosen, searched)
        if settled is not at_lags.problem:
            chosen = _chosen_again(settled, chosen)
        outcome = _outcome(settled, chosen)

        # The trial succeeds if all lags are named, also without the effects that are not.
        trial = _Trial(number, selected.lags.keys(), outcome, [*at_lags.rivals, *rivals])
        if trial.names_all_lags:
            trial = trial.finished(searched)
            if trial.names_all_lags:
                return trial.outcome, trial.rivals
        tried.append(trial)

        # Next an explanation with fewer effects; with one effect, if this one had only one.
        refused.append(selected)
        candidates = explanations.others(max(len(selected.lags) - 1, 1), refused)
        if not candidates:
            break
    best = _best_of(tried, searched)
    return best.outcome, best.rivals


def _best_of(trials: Iterable[_Trial], searched: SearchedWindows) -> _Trial:
    """
    Return the finished trial with the highest rank, of at least one trial.

    Finishing can lower a rank. A trial is finished only if its rank exceeds that of the best
    finished one.
    """
    first, *others = sorted(trials, key=lambda trial: trial.rank, reverse=True)
    best = first.finished(searched)
    for trial in others:
        if trial.rank > best.rank:
            finished = trial.finished(searched)
            if finished.rank > best.rank:
                best = finished
    return best


def _labels(chosen: Sequence[Question]) -> frozenset[str]:
    """Return the labels of a choice, by which equal choices are recognised."""
    return frozenset(question.label for question in chosen)


def _looked_again(
    outcome: _Outcome, searched: SearchedWindows, tried: set[frozenset[str]]
) -> _Outcome:
    """
    Return the outcome of further searches if they remove nearly all of a remaining excess.

    They start from the resolved effects alone and with each of the best pairs of effects;
    `searched.any_size` allows implausible sizes. Any two of many effects reduce an excess of a
    different cause somewhat: together they must remove nearly all. Otherwise `outcome` is returned.

    `tried`: labels of the choices that were linearised. Those of a new choice are added to it.
    """
    excess = outcome.remaining_excess
    if not excess:
        return outcome

    # The choice of least cost of all searches.
    problem = outcome.problem.asking_any_size() if searched.any_size else outcome.problem
    search = problem.search
    resolved = _resolved(problem, outcome.chosen)
    choices = [search.run([*resolved, *start]) for start in ((), *best_pairs(search))]
    best = min(choices, key=search.cost)

    # Is it worth its linearisations?
    if _labels(best) in tried:
        return outcome
    if outcome.problem.explained.remaining_excess(best) >= MAX_EXCESS_BEFORE * excess:
        return outcome
    # Implausible sizes have a price; without them the better choice has the lower cost.
    if not searched.any_size and search.cost(best) >= search.cost(outcome.chosen):
        return outcome

    tried.add(_labels(best))
    other = _settled(searched, problem, best)
    return other if other.remaining_excess < MAX_REMAINING_EXCESS * excess else outcome


def _settled(
    searched: SearchedWindows, problem: LinearisedProblem, chosen: Sequence[Question]
) -> _Outcome:
    """
    Return the outcome of a choice, linearised at its effects and then at its findings alone.
    """
    return _without_unnamed(_relinearised(searched, problem, chosen), searched)


def _relinearised(
    searched: SearchedWindows, problem: LinearisedProblem, chosen: Sequence[Question]
) -> _Outcome:
    """Return the outcome of a choice, linearised at all of its effects."""
    for _ in range(LINEARISATIONS - 1):
        if not problem.needs_another(chosen):
            break
        problem = searched.linearised(problem.point(chosen))
        chosen = _chosen_again(problem, chosen)
    return _outcome(problem, chosen)


def _outcome(problem: LinearisedProblem, chosen: Sequence[Question]) -> _Outcome:
    """Return the outcome of a choice at the linearisation of a problem."""
    # A warm-up of the bank that appears this late has no columns of its own for the final solution.
    chosen = [question for question in chosen if '@' not in question.label]
    found = select_findings(WindowTests(problem), chosen)
    return _Outcome(problem, chosen, named=found.named, unstable=found.unstable)


def _without_unnamed(outcome: _Outcome, searched: SearchedWindows) -> _Outcome:
    """
    Return the outcome linearised at its findings alone.

    It is unchanged if no lag or error of the table that is not named acts at its linearisation.
    """
    for _ in range(LINEARISATIONS - 1):
        if not outcome.problem.acts_beside(outcome.named):
            break
        problem = searched.linearised(outcome.problem.point(outcome.named))
        named = pruned(same_questions(problem, outcome.named), problem.explained.share)
        outcome = _Outcome(
            problem,
            same_questions(problem, outcome.chosen),
            named=WindowTests(problem).predicting(named),
            unstable=same_questions(problem, outcome.unstable),
        )
    return outcome


def _chosen_again(problem: LinearisedProblem, chosen: Sequence[Question]) -> Sequence[Question]:
    """Return the choice of a new search of a problem, from the resolved effects of a choice."""
    return problem.search.run(_resolved(problem, chosen))


def _resolved(problem: LinearisedProblem, chosen: Sequence[Question]) -> Sequence[Question]:
    """Return the questions of a problem for the resolved effects of a choice."""
    resolved = [question for question in chosen if question.name in problem.search.resolved]
    return same_questions(problem, resolved)


def too_few_windows(count: int) -> NotObservableError:
    """Return the error of a recording with so few windows that none can be held out."""
    return NotObservableError(
        f'a diagnosis needs at least {MIN_FOLD_WINDOWS} windows, so that some can be held out, '
        f'{count} were found; rest in more poses, or spin and swing the table',
        code='too_few_windows',
    )


@dataclass(eq=False)
class WindowTests(EffectTests):
    """The tests of a choice on the windows of a table."""

    problem: LinearisedProblem
    """Linearised at the choice, or near it."""

    def preferred(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects, or a simpler alternative."""
        return simpler(self.problem, named)

    def admissible(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects of a possible size on which the windows agree."""
        problem = self.problem
        admissible = []
        for question in named:
            if problem.search.allowed(named, question) and problem.windows_agree(named, question):
                admissible.append(question)
        return admissible

    def least_predicting(self, kept: list[Question]) -> int | None:
        """
        Return the place of the finding that improves the prediction least; None if all improve it.

        Likelihood alone is not enough: without rests the noise is estimated from the misfit, and a
        misfit that repeats with the motion is evidence for any effect that correlates with it. So
        the unweighted residual must decrease too. The locked windows are not used: their later gain
        would be biased.
        """
        place = None
        least = np.inf
        for k, question in enumerate(kept):
            reduction = _sure_reduction(self.problem, kept, question)
            if not reduction > _needed_reduction(self.problem, kept, question):
                # Without an interval (NaN) the reduction is the least of all.
                reduction = -np.inf if np.isnan(reduction) else reduction
                if place is None or reduction < least:
                    place = k
                    least = reduction
        return place

    def significant(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects that are still significant after removals."""
        return self.problem.search.drop_insignificant(named)


def _needed_reduction(
    problem: LinearisedProblem, chosen: Sequence[Question], question: Question
) -> float:
    """
    Return the required relative reduction of the residual by an effect.

    Zero; `LEAST_REDUCTION` with an unexplained excess, or without rests to separate misfit from
    noise.
    """
    has_rests = not problem.recording.moving.all()
    if has_rests and not problem.explained.remaining_beside(chosen, question):
        return 0.0
    return LEAST_REDUCTION


def _sure_reduction(
    problem: LinearisedProblem, chosen: Sequence[Question], question: Question
) -> float:
    """
    Return the lower end of the interval of an effect's reduction of the cross-validated residual.
    """
    others = [q for q in chosen if q is not question]
    gain = gain_in_turn(problem, others, chosen, sensors=question.effect.sensors)
    return gain.ci95[0]
