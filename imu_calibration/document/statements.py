"""Statements about a calibration (decisions, warnings, notes, with the next step), and the verdict that they form."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from imu_calibration.core.errors import with_hint
from imu_calibration.document.decision import (
    HELPS,
    SensorDecision,
    decisions_text,
    most_cautious,
)
from imu_calibration.effects.base import SENSORS


class StatementKind(StrEnum):
    """Kind of a statement."""

    DECISION = 'decision'
    """The decision on a sensor."""
    PARAMETERS = 'parameters'
    """How many parameters are within their tolerance, or which are not."""
    WARNING = 'warning'
    """A finding that the user should follow up."""
    NOTE = 'note'
    """A remark."""


DECISION, PARAMETERS, WARNING, NOTE = StatementKind


@dataclass(frozen=True)
class Reason:
    """One statement about the calibration."""

    word: StatementKind
    """Its kind."""
    what: str
    """The statement."""
    next: str
    """The next step; empty when no action is needed."""
    key: str | None = None
    """The input needed for it, a key of `errors.KEYS`."""
    sensors: tuple[str, ...] = SENSORS
    """Sensors with parameters that it concerns."""

    def advice(self, hints: dict[str, str] | None = None) -> str:
        """Return the next step with the local name of its key (`errors.with_hint`); empty for none."""
        return with_hint(self.next, self.key, hints or {}) if self.next else ''


@dataclass(frozen=True)
class Verdict:
    """The decisions with all statements, the most important first."""

    decisions: dict[str, SensorDecision]
    """Sensor -> decision."""
    reasons: tuple[Reason, ...]
    """Decisions, parameters, warnings, notes."""
    within: int
    """Requested parameters that are determined."""
    requested: int
    """Requested parameters."""
    limiting: tuple[str, float]
    """The requested parameter with the largest sd in units of its tolerance, and that ratio; ('', 0) without any."""

    @property
    def word(self) -> SensorDecision:
        """The more cautious of the decisions."""
        return most_cautious(self.decisions.values())

    @property
    def complete(self) -> bool:
        """Whether each sensor helps and every requested parameter is determined."""
        return self.word is HELPS and self.within == self.requested

    @property
    def text(self) -> str:
        """The decisions in one phrase."""
        return decisions_text(self.decisions)

    def lines(self, hints: dict[str, str] | None = None) -> list[str]:
        """Return the statements and next steps, a line each; `hints` as for `errors.with_hint`."""
        return lines_of(self.reasons, hints)


def lines_of(reasons: Iterable[Reason], hints: dict[str, str] | None = None) -> list[str]:
    """Return statements and next steps, a line each; `hints` as for `errors.with_hint`."""
    lines = []
    for reason in reasons:
        lines.append(f'{reason.word}: {reason.what}' if reason.word in (WARNING, NOTE) else reason.what)
        lines += [f'next: {reason.advice(hints)}'] if reason.next else []
    return list(dict.fromkeys(lines))
