"""Counts and conditions of gathered recordings, which every reference states."""

from dataclasses import dataclass, field


@dataclass(eq=False)
class GatheredData:
    """Counts and conditions of recordings, and the windows that a report draws."""

    counts: dict = field(default_factory=dict)
    """Samples used and dropped, gaps, by reason."""
    frame_id: str = ''
    """Frame of the first IMU message."""
    first_stamp_ns: int | None = None
    """First IMU stamp."""
    last_stamp_ns: int | None = None
    """Last IMU stamp."""
    largest_rate: float = 0.0
    """Largest rate of the reference, rad/s."""
    largest_force: float = 0.0
    """Largest measured component of specific force, m/s^2."""
    temperature_c: tuple[float, float] | None = None
    """Lowest and highest temperature; None without temperatures."""
    findings: tuple = ()
    """Findings of the checks of the recording before the estimate (`CheckFinding`)."""
    unusable: dict[str, str] = field(default_factory=dict)
    """Absent sensors with readings -> why these cannot be used."""
    kept: list = field(default_factory=list)
    """Windows with all samples, for plots and the autocorrelation of residuals."""

    @property
    def duration(self) -> float:
        """Seconds from the first to the last IMU stamp, recordings added; 0 without a stamp."""
        if self.first_stamp_ns is None or self.last_stamp_ns is None:
            return 0.0
        return (self.last_stamp_ns - self.first_stamp_ns) * 1e-9
