"""The result of a check of a recording."""

from dataclasses import dataclass, replace
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding matters, the worst first."""

    REFUSE = 'refuse'
    """The result would be wrong."""
    WARNING = 'warning'
    """It may suffer."""
    NOTE = 'note'
    """Worth knowing."""
    GOOD = 'good'
    """Checked and in order."""


REFUSE, WARNING, NOTE, GOOD = Severity


@dataclass(frozen=True)
class CheckFinding:
    """One line about a recording."""

    check: str
    """Name of the check."""
    severity: Severity
    """How much it matters."""
    text: str
    """Requirement, received value and remedy; for GOOD, the observation."""
    samples: int = 0
    """Samples that are unusable because of it and that no other count holds."""
    key: str | None = None
    """The missing input, a key of `errors.KEYS`."""

    def named(self, name: str) -> 'CheckFinding':
        """Return the finding with the name of its recording before the text."""
        return replace(self, text=f'{name}: {self.text}')

    def to_mapping(self) -> dict:
        """Return the entry for the calibration file."""
        return {'check': self.check, 'severity': self.severity, 'text': self.text, 'samples': self.samples}
