"""The order in which a choice of effects is tested, for data of any reference."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from imu_calibration.selection.questions import Question


class EffectTests(Protocol):
    """Tests of a choice of effects on the data of a reference."""

    @property
    def problem(self) -> Any:
        """Rows with their `search`."""

    def explaining(self, chosen: Sequence[Question]) -> Sequence[Question]:
        """Return the effects of which each explains most of the excess variance."""

    def predicting(self, named: Sequence[Question]) -> list[Question]:
        """Return the effects that improve the prediction of held-out data."""

    def significant(self, named: Sequence[Question]) -> Sequence[Question]:
        """Return the effects that are significant without those that were removed."""


@dataclass(frozen=True, eq=False)
class Findings:
    """Effects of a choice that data support."""

    named: Sequence[Question]
    """Questions that became findings, in the order found."""
    unstable: list[Question]
    """Rejected, because the estimates of the two halves differ significantly."""


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

    # An effect of the sensor is the same in both halves. Without the others a finding may predict
    # no longer, or be no longer significant.
    search = tests.problem.search
    unstable = [question for question in named if not search.agrees_in_halves(named, question)]
    if unstable:
        named = tests.predicting([question for question in named if question not in unstable])
    return Findings(tests.significant(named), unstable)


def without_weakest(
    chosen: Sequence[Question], weakest: Callable[[list[Question]], int | None]
) -> list[Question]:
    """
    Return a choice by backward elimination: without its weakest effect, until none is weak.

    `weakest` returns the place of the effect that is removed next, None where all remain.
    """
    kept = list(chosen)
    while kept:
        place = weakest(kept)
        if place is None:
            break
        del kept[place]
    return kept
