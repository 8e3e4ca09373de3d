"""Independent errors of the time stamps, from the scatter of the residual in motion."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class StampJitter:
    """Independent errors of the time stamps."""

    sd: float
    """Their standard deviation, s."""
    significant: bool
    """Whether the scatter of each sensor alone shows errors of this size."""
    ratio: dict[str, dict[str, float]] = field(default_factory=dict)
    """
    Sensor -> kind of moving window -> variance of the noise and these errors over that of the
    noise.
    """

    @property
    def lines(self) -> list[str]:
        """Description, empty where they are not significant."""
        return [jitter_text(self.sd)] if self.significant else []

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry of a calibration document, empty where they are not significant."""
        return {'sd_s': self.sd, 'variance_ratio': self.ratio} if self.significant else {}


NO_JITTER = StampJitter(sd=0.0, significant=False)
"""Where no errors are estimated."""


def jitter_text(sd: float) -> str:
    """Return the statement of independent errors of the stamps of a standard deviation, s."""
    return (
        f'the stamps have independent errors of {1e6 * sd:.0f} us (1 sd), which explain scatter of'
        ' both sensors in motion'
    )
