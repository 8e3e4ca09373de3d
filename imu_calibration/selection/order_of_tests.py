"""The order in which a choice of effects is tested, for data of any reference."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from imu_calibration.selection.explained_share import Explained, pruned
from imu_calibration.selection.questions import Question, without_weakest
from imu_calibration.selection.search import Search


class SearchProblem(Protocol):
    """Data of a recording with the columns of all effects under test."""

    search: Search
    """Search of effects in these data."""

    @property
    def explained(self) -> Explained:
        """Excess over noise in these data, and the share of it that effects remove."""


@dataclass(eq=False)
class EffectTests(ABC):
    """Tests of a choice of effects on the data of a reference."""

    problem: SearchProblem
    """The data and the search that made the choice."""

    def explaining(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """Return the effects of which each explains most of the excess variance."""
        return self.preferred(pruned(chosen, self.problem.explained.share))

    def predicting(self, named: Sequence[Question]) -> list[Question]:
        """Return the effects that improve the prediction of held-out data."""
        return without_weakest(self.admissible(named), self.least_predicting)

    @abstractmethod
    def preferred(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects, or a choice that explains the excess better or more simply."""

    def admissible(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects of which the prediction is tested, here all."""
        return named

    @abstractmethod
    def least_predicting(self, kept: list[Question]) -> int | None:
        """
        Return the place of the effect that improves the prediction least.

        None if all improve the prediction of held-out data.
        """

    def significant(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects that are still significant after removals, here all."""
        return named


@dataclass(frozen=True, eq=False)
class Findings:
    """Effects of a choice that the data support."""

    named: Sequence[Question]
    """Effects that became findings, in the order found."""
    unstable: list[Question]
    """Effects that are rejected because the estimates of the two halves differ significantly."""


def select_findings(tests: EffectTests, chosen: Sequence[Question]) -> Findings:
    """
    Return the findings of a choice that a search made by likelihood.

    Parameters
    ----------
    tests : EffectTests
    chosen : sequence of Question
        In the order found.

    """
    # Likelihood alone prefers any effect that correlates with an unknown cause.
    named = tests.predicting(tests.explaining(chosen))

    # An effect of the sensor is the same in both halves. Without the removed effects a finding may
    # predict no longer, or be no longer significant.
    search = tests.problem.search
    unstable = [question for question in named if not search.agrees_in_halves(named, question)]
    if unstable:
        named = tests.predicting([question for question in named if question not in unstable])
    return Findings(tests.significant(named), unstable)
