"""What a check says about a recording."""

from dataclasses import dataclass, replace

REFUSE, WARNING, NOTE, GOOD = 'refuse', 'warning', 'note', 'good'
SEVERITIES = (REFUSE, WARNING, NOTE, GOOD)
"""The result would be wrong; it may suffer; worth knowing; checked and in order."""


@dataclass(frozen=True)
class Finding:
    """One line about a recording."""

    check: str
    """Name of the check."""
    severity: str
    """One of SEVERITIES."""
    text: str
    """What must hold, what came, what to do; for GOOD what was seen."""
    samples: int = 0
    """Samples that are unusable because of it and that no other count holds."""
    key: str | None = None
    """What has to be given, a key of `errors.KEYS`."""

    def named(self, name):
        """Return the finding with the name of its recording before the text."""
        return replace(self, text=f'{name}: {self.text}')

    def to_mapping(self):
        """Return what stands in the calibration file."""
        return {'check': self.check, 'severity': self.severity, 'text': self.text, 'samples': self.samples}
