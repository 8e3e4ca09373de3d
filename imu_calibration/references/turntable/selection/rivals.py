"""
Alternatives to a finding.

Collinear effects compared at their estimated sizes, pairs of effects, and the simpler of two
explanations.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import scipy.linalg

from imu_calibration.estimation.scaled_solve import JITTER
from imu_calibration.references.turntable.selection.linearised_problem import (
    LinearisedProblem,
    SearchedWindows,
)
from imu_calibration.references.turntable.selection.window_gain import gain_in_turn
from imu_calibration.selection.explained_share import needed_share
from imu_calibration.selection.gain import LEAST_REDUCTION
from imu_calibration.selection.questions import Question, with_exchanged
from imu_calibration.selection.search import PENALTY, TIE, Search

MIN_CURVATURE_NATS = 0.1
"""
Evidence of a curvature below which it does not separate effects, nats: a delay of 0.1 ms is a lag
of 0.1 ms.
"""


@dataclass(frozen=True, eq=False)
class Rival:
    """An alternative to a chosen effect that fits nearly as well."""

    question: Question
    """The effect that it would replace."""
    other: Question
    """The effect that was not chosen."""
    behind: float
    """Rise of the held-out cost with it, nats, each effect linearised at its estimate."""
    moves: dict[str, float] = field(default_factory=dict)
    """Parameter of the baseline -> its difference with the rival in the model."""

    @property
    def weight(self) -> float:
        """Posterior probability of the rival."""
        return float(1.0 / (1.0 + np.exp(min(self.behind, 700.0))))


def settle_rivals(
    problem: LinearisedProblem, chosen: Sequence[Question], searched: SearchedWindows
) -> tuple[LinearisedProblem, list[Rival]]:
    """
    Return (problem linearised at the best of a choice and its variants, the close variants).

    A variant has a rival in place of one effect.

    The first derivatives of a delay and of a low-pass are the same, and a search that is linearised
    at one of them represents its rival by its tangent only: the first one would win. So each is
    linearised at its own estimate, and all are compared with the same noise, estimated with each in
    turn; only compared effects have columns there.

    Parameters
    ----------
    problem : LinearisedProblem
        Linearised where none of them acts.
    chosen : sequence of Question
    searched : SearchedWindows
        For the LinearisedProblem elsewhere, or with some of the effects.

    """
    chosen = [question for question in chosen if '@' not in question.label]
    choices: list[Sequence[Question]] = [chosen, *_swapped(problem, chosen)]
    if len(choices) == 1:
        return problem, []

    # Linearise each choice at its own estimate, with columns of the compared effects only.
    effects = {}
    for choice in choices:
        for question in choice:
            effects[question.name] = question.effect
    compared = list(effects.values())
    start = searched.linearised(effects=compared)
    attempts = []  # problem linearised at each choice
    for number, choice in enumerate(choices):
        attempt = searched.linearised(
            effects=compared, point=start.point(same_questions(start, choice))
        )
        attempts.append(attempt)
        choices[number] = same_questions(attempt, choice)

    # Mean cost of each choice, judged with the noise of each in turn.
    costs_of_judges = []
    for judge in attempts:
        costs_of_judges.append(
            [_cost(attempt, choice, judge) for attempt, choice in zip(attempts, choices)]
        )
    costs = np.mean(costs_of_judges, axis=0)
    best = int(np.argmin(costs))

    # The rivals within the resolution of the search, with the parameters that they would change.
    values = []
    for attempt, choice in zip(attempts, choices):
        values.append(dict(zip(attempt.space.names, attempt.values(choice))))
    settled = searched.linearised(point=problem.point(same_questions(problem, choices[best])))
    rivals = []
    for k, choice in enumerate(choices):
        if k == best or costs[k] - costs[best] >= TIE:
            continue
        # The two choices have different effects in one place.
        different = next(
            pair for pair in zip(choices[best], choice) if pair[0].name != pair[1].name
        )
        question, other = same_questions(settled, different)
        names = problem.baseline.param_names
        moves = {name: values[k][name] - values[best][name] for name in names}
        behind = float(costs[k] - costs[best])
        rivals.append(Rival(question, other, behind=behind, moves=moves))
    return settled, rivals


def same_questions(problem: LinearisedProblem, chosen: Sequence[Question]) -> list[Question]:
    """
    Return the questions of a problem for the effects of a choice at another linearisation.

    Of a warm-up that has no question with the same label it is the one with the likeliest time
    constant.
    """
    same = []
    for each in chosen:
        of_effect = [question for question in problem.questions if question.name == each.name]
        with_label = [question for question in of_effect if question.label == each.label]
        if with_label:
            same.append(with_label[0])
            continue
        likeliest = min(of_effect, key=lambda q: problem.evidence.loss(problem.search.indices([q])))
        same.append(likeliest)
    return same


def _swapped(problem: LinearisedProblem, chosen: Sequence[Question]) -> list[list[Question]]:
    """
    Return the choices with one timing effect replaced by another with the same tangent.

    Only where the curvature, which separates the two, is observable.
    """
    swapped = []
    for place, question in enumerate(chosen):
        if question.effect.warp is None:
            continue
        if problem.curvature_shows(chosen, question) <= MIN_CURVATURE_NATS:
            continue
        for other, _ in problem.search.confounded(chosen, question, most=None):
            if other.effect.warp is not None:
                swapped.append(with_exchanged(chosen, place, other))
    return swapped


def _cost(
    problem: LinearisedProblem, chosen: Sequence[Question], judge: LinearisedProblem
) -> float:
    """Return the held-out cost of a choice with the noise and the band of the problem `judge`."""
    loss = problem.judged_by(judge).heldout(problem.search.indices(chosen))
    return 0.5 * loss + PENALTY * sum(question.penalty for question in chosen)


AS_MUCH = 0.5
"""
Share of the held-out likelihood of an effect that a simpler one must reach to be tested as its
replacement.
"""


def simpler(problem: LinearisedProblem, named: Sequence[Question]) -> Sequence[Question]:
    """
    Return findings with no more parameters than the held-out residual supports.

    With unexplained misfit, likelihood prefers more parameters: arms of the three accelerometers,
    where one common arm fits as well. So an effect with fewer parameters replaces a finding unless
    the finding surely (97.5 %) reduces the unweighted residual by more than `LEAST_REDUCTION` of
    that with the simpler effect.
    """
    kept = list(named)
    for place, question in enumerate(named):
        if not problem.explained.remaining_beside(kept, question):
            continue
        for other in _fewer(problem.search, kept, question):
            instead = with_exchanged(kept, place, other)
            if not problem.search.allowed(instead, other):
                continue
            if problem.explained.share(instead, other) < needed_share(other):
                continue
            # A finding that surely lowers the residual below that of the simpler one is kept.
            gain = gain_in_turn(problem, instead, kept, sensors=question.effect.sensors)
            if gain.ci95[0] <= LEAST_REDUCTION:
                kept = instead
                break
    return kept


def _fewer(search: Search, kept: Sequence[Question], question: Question) -> list[Question]:
    """
    Return smaller effects that explain about as much in the place of a finding.

    They are effects of the same sensors with fewer parameters, fewest first.
    """
    remaining = [each for each in kept if each is not question]
    least_gain = AS_MUCH * search.score(remaining, question).gain
    fewer = []
    for other in search.others(kept):
        is_smaller = other.penalty < question.penalty and '@' not in other.label
        if not is_smaller or other.effect.sensors != question.effect.sensors:
            continue
        score = search.score(remaining, other)
        if score.significant and score.gain >= least_gain:
            fewer.append(other)
    return sorted(fewer, key=lambda other: other.penalty)


MIN_UNIQUE_SHARE = 0.05
"""Least share of the signal of each member that the other cannot imitate."""
TRIED = 3
"""Pairs from which a search is started."""


def best_pairs(search: Search) -> list[list[Question]]:
    """
    Return the pairs that lower the loss most and are possible, the best first, at most three.

    The normal matrix with the baseline projected out and each effect's block scaled to the unit
    matrix gives a system of two blocks for each pair; systems of one shape are solved together.
    Each effect must keep some signal that is not collinear with the other. That each is significant
    in addition to the other is tested by the search from the pair (`Search.run`).
    """
    blocks = _Blocks(search)
    pairs_of_shape = defaultdict(list)
    for one, two in combinations(range(len(search.questions)), 2):
        names = {search.questions[one].name, search.questions[two].name}
        # No pair of one effect at two time constants, and none that the search may not add.
        if len(names) == 2 and not names & search.resolved:
            pairs_of_shape[blocks.size(one), blocks.size(two)].append((one, two))
    scored: list[tuple[float, int, int]] = []
    for pairs in pairs_of_shape.values():
        scored += blocks.score(pairs)

    # The best pairs that are possible; of pairs that differ in a time constant only, the best one.
    best: list[list[Question]] = []
    names_of_best: list[set[str]] = []
    for _, one, two in sorted(scored, reverse=True):
        pair = [search.questions[one], search.questions[two]]
        names = {question.name for question in pair}
        if names not in names_of_best and all(search.allowed(pair, each) for each in pair):
            best.append(pair)
            names_of_best.append(names)
        if len(best) == TRIED:
            break
    return best


BLOCK_JITTER = 1e4 * JITTER
"""Added to the diagonal of scaled blocks, so that a singular one has a factor."""


class _Blocks:
    """
    Normal equations ``M x = b`` of the parameters of all questions, one question after the other.

    The baseline is projected out, and the block of M of each question is the unit matrix.
    """

    def __init__(self, search: Search):
        self.questions = search.questions
        information, right = search.evidence.equations()
        base = list(search.baseline)
        free: list[int] = []
        self.params_of: list[slice] = []
        """Place of the parameters of each question in M and b."""
        for question in search.questions:
            start = len(free)
            free += question.parameters
            self.params_of.append(slice(start, len(free)))

        # Schur complement: M = I_ff - I_fb I_bb^-1 I_bf, and the same of the right side.
        factor = scipy.linalg.cho_factor(information[np.ix_(base, base)])
        cross = information[np.ix_(base, free)]
        matrix = information[np.ix_(free, free)] - cross.T @ scipy.linalg.cho_solve(factor, cross)
        right = right[free] - cross.T @ scipy.linalg.cho_solve(factor, right[base])

        # Scale rows and columns by L^-1 of each block L L'. The factor is that of the block scaled
        # to a unit diagonal, because the units of its parameters differ.
        for params in self.params_of:
            scale = np.sqrt(np.diag(matrix)[params])
            block = matrix[params, params] / np.outer(scale, scale)
            lower = np.linalg.cholesky(block + BLOCK_JITTER * np.eye(len(block))) * scale[:, None]
            matrix[params] = np.linalg.solve(lower, matrix[params])
            matrix[:, params] = np.linalg.solve(lower, matrix[:, params].T).T
            right[params] = np.linalg.solve(lower, right[params])
        self.matrix = matrix
        self.right = right

    def size(self, number: int) -> int:
        """Return the number of parameters of a question."""
        return len(self.questions[number].parameters)

    def score(self, pairs: Sequence[tuple[int, int]]) -> Iterator[tuple[float, int, int]]:
        """
        Yield (fall of the loss in nats less the penalty, one, two) of pairs of questions.

        All pairs have the same numbers of parameters. Pairs in which one effect imitates the other
        are omitted.
        """
        # Rows and columns of each pair in M, shape (n_pairs, n_first + n_second).
        indices = np.arange(len(self.right))
        params_of_pairs = []
        for one, two in pairs:
            params_of_pairs.append([*indices[self.params_of[one]], *indices[self.params_of[two]]])
        places = np.array(params_of_pairs)
        n_first = self.size(pairs[0][0])
        systems = self.matrix[places[:, :, None], places[:, None, :]]
        systems = systems + BLOCK_JITTER * np.eye(places.shape[1])

        # The loss falls by x' b at the solution x of M x = b.
        values = np.linalg.solve(systems, self.right[places][:, :, None])[:, :, 0]
        fall = np.einsum('ki,ki->k', values, self.right[places])
        # Share |M_21 x_1|^2 / |x_1|^2 of the signal of each effect that the other imitates; both
        # blocks on the diagonal are unit matrices.
        cross = systems[:, :n_first, n_first:]
        first = values[:, :n_first]
        second = values[:, n_first:]
        of_first = np.einsum('kij,ki->kj', cross, first)
        of_second = np.einsum('kij,kj->ki', cross, second)
        for k, (one, two) in enumerate(pairs):
            imitated = max(
                (of_first[k] @ of_first[k]) / max(first[k] @ first[k], 1e-300),
                (of_second[k] @ of_second[k]) / max(second[k] @ second[k], 1e-300),
            )
            if 1.0 - imitated > MIN_UNIQUE_SHARE:
                penalty = self.questions[one].penalty + self.questions[two].penalty
                yield 0.5 * fall[k] - PENALTY * penalty, one, two
