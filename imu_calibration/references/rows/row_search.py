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
    """
    Rows of a recording or of a part of it, their evidence, and the search.

    Parameters
    ----------
    blocks : sequence of Rows
        Poses, turns or other rows, with the columns of all parameters.
    prior_sd : array, shape (q,)
        Prior standard deviations of the parameters.
    questions : sequence of Question
        Candidate effects.
    baseline : sequence of int
        Parameters of the model under diagnosis.

    """

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
        self.evidence = RowEvidence(blocks, prior_sd, smooth, baseline=baseline)
        self.search = Search(self.evidence, baseline, questions)
        self.explained = Explained(
            self.search, self.evidence.against_noise, self.evidence.numbers, least_part=-np.inf
        )

    def without(self, groups: np.ndarray) -> 'RowProblem':
        """Return the same problem without some groups of rows."""
        search = self.search
        return RowProblem(
            without_groups(self.evidence.blocks, groups),
            self.evidence.prior_sd,
            search.questions,
            baseline=search.baseline,
        )

    def gain(
        self,
        held_out: Sequence['ChoiceWithout'],
        before: Sequence[Question],
        after: Sequence[Question],
        *,
        sensor: str,
    ) -> Gain:
        """
        Return the Gain of the choice `after` over `before` on held-out rows of a sensor.

        Of each choice only the effects count that are found again without the held-out groups, at
        values that are fitted without them.
        """
        block = self.clearest(before, after, sensor)
        residuals = []
        for choice in (before, after):
            residual = np.full(block.variance.shape, np.nan)
            for part in held_out:
                rows = np.isin(block.group, part.groups)
                used = part.problem.search.indices(part.named_in(choice))
                weights = part.problem.evidence.weights(used)
                residual[rows] = block.select(rows).residuals_at(weights)
            residuals.append(residual)
        return gain_of_groups(block, residuals)

    def clearest(self, before: Sequence[Question], after: Sequence[Question], sensor: str) -> Rows:
        """
        Return the block of a sensor in which `after` improves most over `before`.

        That is the least ratio of the sums of squares of the cross-validated residuals.
        """
        residuals_before = self.evidence.heldout_residuals(self.search.indices(before))
        residuals_after = self.evidence.heldout_residuals(self.search.indices(after))
        ratios = []
        for block, rest_before, rest_after in zip(
            self.evidence.blocks, residuals_before, residuals_after
        ):
            ratio = np.inf
            if block.sensor == sensor:
                ratio = np.sum(rest_after**2) / max(np.sum(rest_before**2), 1e-300)
            ratios.append(ratio)
        return self.evidence.blocks[int(np.argmin(ratios))]


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
    tests = RowTests(problem)
    findings = select_findings(tests, problem.search.run())
    return RowChoice(findings.named, findings.unstable, tests.held_out)


@dataclass(eq=False)
class RowTests(EffectTests):
    """The tests of a choice on few rows."""

    problem: RowProblem
    """All rows."""
    held_out: list[ChoiceWithout] = field(default_factory=list)
    """The search without each part of the groups; empty before it is needed."""

    def preferred(self, named: Sequence[Question]) -> Sequence[Question]:
        """
        Return the effects, or those of a search that allows any size, if less excess remains.

        Sizes beyond the range of known instruments are tested only where an excess remains. The
        problem has that search from then on.
        """
        explained = self.problem.explained
        if not explained.remaining_excess(named):
            return named
        search_of_any_size = self.problem.search.asking_any_size()
        of_any_size = pruned(search_of_any_size.run(), explained.share)
        if not explained.remaining_excess(of_any_size) < explained.remaining_excess(named):
            return named
        self.problem.search = search_of_any_size
        return of_any_size

    def least_predicting(self, kept: list[Question]) -> int | None:
        """
        Return the place of the last finding that does not improve the prediction; None: all do.

        Each finding is compared with the ones before it, on rows held out from fit and choice.
        """
        if not self.held_out:
            self.held_out = _held_out(self.problem)
        not_improving = None
        for place, question in enumerate(kept):
            gain = self.problem.gain(
                self.held_out, kept[:place], kept[: place + 1], sensor=question.sensor
            )
            if not gain.ci95[0] > 0:
                not_improving = place
        return not_improving


def _held_out(problem: RowProblem) -> list[ChoiceWithout]:
    """Return the complete search, repeated without each part of the groups in turn."""
    groups = problem.evidence.groups
    n_parts = min(OUTER, len(groups))
    choices = []
    for number in reported('repeating the search', range(n_parts), n_parts):
        left_out = groups[number::n_parts]
        smaller = problem.without(left_out)
        named = RowTests(smaller).explaining(smaller.search.run())
        choices.append(ChoiceWithout(left_out, named, smaller))
    return choices


def gain_of_groups(block: Rows, residuals: Sequence[np.ndarray], of: str = OF_MODEL) -> Gain:
    """
    Return the Gain from the residuals of a block before and after, each of shape (m, n_axes).

    Its interval is by resampling the groups of rows.
    """
    group_of_row = np.unique(block.group, return_inverse=True)[1]
    numbers = np.bincount(group_of_row) * block.variance.shape[1]
    pair = []
    for residual in residuals:
        squares = np.bincount(group_of_row, (residual**2).sum(axis=1))
        pair.append((squares, numbers))
    return gain_of(block.sensor, block.name, pair, of=of)
