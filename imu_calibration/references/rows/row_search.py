"""Search of effects on few rows of any reference, repeated without each part of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from imu_calibration.core.progress import reported
from imu_calibration.estimation.rows import Rows
from imu_calibration.references.rows.row_evidence import RowEvidence, without_groups
from imu_calibration.selection.explained_share import Explained, pruned
from imu_calibration.selection.gain import OF_MODEL, Gain, gain_of
from imu_calibration.selection.order_of_tests import EffectTests, Findings, select_findings
from imu_calibration.selection.questions import Question, smooth_parameters
from imu_calibration.selection.search import Search

OUTER = 12
"""Number of repetitions of the search without some of the groups, to measure the gain on them."""


class RowProblem:
    """Rows of a recording or of a part of it, their evidence, and the search."""

    def __init__(
        self,
        blocks: Sequence[Rows],
        prior_sd: np.ndarray,
        questions: Sequence[Question],
        *,
        baseline: Sequence[int],
    ):
        untimed = [question for question in questions if not question.effect.time_constant]
        smooth = smooth_parameters(untimed)
        self.blocks, self.questions = blocks, questions
        self.evidence = RowEvidence(blocks, prior_sd, smooth, baseline=baseline)
        self.search = Search(self.evidence, baseline, questions)
        self.explained = Explained(
            self.search, self.evidence.against_noise, self.evidence.numbers, least_part=-np.inf
        )

    def without(self, groups: np.ndarray) -> 'RowProblem':
        """Return the same problem without some groups of rows."""
        blocks = without_groups(self.blocks, groups)
        prior_sd = self.evidence.prior_sd
        return RowProblem(blocks, prior_sd, self.questions, baseline=self.search.baseline)

    def gain(
        self,
        held_out: Sequence['ChoiceWithout'],
        before: Sequence[Question],
        after: Sequence[Question],
        *,
        sensor: str,
    ) -> Gain:
        """
        Return the Gain of one choice over another on rows held out from both fit and choice.
        """
        block = self.clearest(before, after, sensor)
        pair = [np.full(block.variance.shape, np.nan) for _ in range(2)]
        for part in held_out:
            rows = np.isin(block.group, part.groups)
            for residual, choice in zip(pair, (before, after)):
                values = part.problem.search.values(part.named_in(choice))
                residual[rows] = block.select(rows).residuals_at(np.append(-values, 1.0))
        return gain_of_groups(block, pair)

    def clearest(self, before: Sequence[Question], after: Sequence[Question], sensor: str) -> Rows:
        """
        Return the rows of a sensor in which one choice improves most over another.

        The improvement is by cross-validation of the fit.
        """
        residuals_before = self.evidence.heldout_residuals(self.search.indices(before))
        residuals_after = self.evidence.heldout_residuals(self.search.indices(after))
        blocks = []
        ratios = []
        for block, rest_before, rest_after in zip(self.blocks, residuals_before, residuals_after):
            if block.sensor == sensor:
                blocks.append(block)
                ratios.append(np.sum(rest_after**2) / max(np.sum(rest_before**2), 1e-300))
        return blocks[ratios.index(min(ratios))]


@dataclass(frozen=True, eq=False)
class ChoiceWithout:
    """The complete search, repeated without some groups of rows."""

    groups: np.ndarray
    """Groups that are held out, shape (n,)."""
    named: Sequence[Question]
    """Findings without them."""
    problem: RowProblem
    """The problem without them."""

    def named_in(self, choice: Sequence[Question]) -> list[Question]:
        """Return the findings that are effects of a choice, too."""
        allowed = {question.name for question in choice}
        return [question for question in self.named if question.name in allowed]


@dataclass(frozen=True, eq=False)
class RowChoice(Findings):
    """Effects that rows support."""

    held_out: list[ChoiceWithout]
    """The search without each part of the groups; none without an effect to test."""


def choose_effects(problem: RowProblem) -> RowChoice:
    """
    Return the effects that predict rows held out from their choice, and agree in both halves.

    Parameters
    ----------
    problem : RowProblem

    """
    tests = RowTests(problem, problem.explained)
    found = select_findings(tests, problem.search.run())
    return RowChoice(found.named, found.unstable, tests.held_out)


@dataclass(eq=False)
class RowTests(EffectTests):
    """The tests of a choice on few rows."""

    problem: RowProblem
    explained: Explained
    held_out: list[ChoiceWithout] = field(default_factory=list)
    """The search without each part of the groups; empty before it is needed."""

    def preferred(self, named: Sequence[Question]) -> Sequence[Question]:
        """
        Return the effects, or others of any size where an excess remains that these reduce.

        Sizes beyond the range of known instruments are tested only for the remaining excess.
        """
        explained = self.explained
        if not explained.rest(named):
            return named
        wide = self.problem.search.asking_any_size()
        others = pruned(wide.run(), explained.share)
        if not explained.rest(others) < explained.rest(named):
            return named
        self.problem.search = wide
        return others

    def least_predicting(self, kept: list[Question]) -> int | None:
        """Return the last finding that does not improve the prediction of held-out rows."""
        if not self.held_out:
            self.held_out = _held_out(self.problem)
        poor = None
        for place, question in enumerate(kept):
            gain = self.problem.gain(
                self.held_out, kept[:place], kept[: place + 1], sensor=question.sensor
            )
            if not gain.ci95[0] > 0:
                poor = place
        return poor


def _held_out(problem: RowProblem) -> list[ChoiceWithout]:
    """Return the complete search, repeated without each part of the groups in turn."""
    groups = problem.evidence.groups
    times = min(OUTER, len(groups))
    found = []
    for number in reported('repeating the search', range(times), times):
        out = groups[number::times]
        smaller = problem.without(out)
        named = RowTests(smaller, smaller.explained).explaining(smaller.search.run())
        found.append(ChoiceWithout(out, named, smaller))
    return found


def gain_of_groups(block: Rows, pair: Sequence[np.ndarray], of: str = OF_MODEL) -> Gain:
    """
    Return the Gain from residuals of each row of a block before and after.

    Shape (m, n), resampled by group.
    """
    place = np.unique(block.group, return_inverse=True)[1]
    numbers = np.bincount(place) * block.variance.shape[1]
    return gain_of(
        block.sensor,
        block.name,
        [(np.bincount(place, (residuals**2).sum(axis=1)), numbers) for residuals in pair],
        of=of,
    )
