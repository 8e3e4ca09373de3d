"""State of the worker of calibration_node, for diagnostics and for the terminal."""

from dataclasses import dataclass, field

from imu_calibration.calibration.diagnosis.live_diagnosis import DiagnosisState
from imu_calibration.calibration.session import SessionStatus
from imu_calibration.preprocessing.stream_watch import StreamState


@dataclass(frozen=True)
class WorkerState:
    """State shown in diagnostics; replaced as one object, so that another thread may read it."""

    groups: list = field(default_factory=list)
    """GroupState of every effect."""
    streams: StreamState | None = None
    """How the streams are."""
    solution: int = 0
    """Number of the last solution; 0 before the first."""
    verdict: str = ''
    """The more cautious decision; '' before the first solution."""
    lines: tuple = ()
    """Reasons and next steps."""
    trouble: str = ''
    """Why there is no new solution."""
    faults: tuple = ()
    """Present faults, a line each."""
    gathered: int = 0
    """Windows, or poses by hand."""
    values: dict = field(default_factory=dict)
    """Figures by name."""
    session: SessionStatus | None = None
    """Progress in addition to the parameter groups: the poses of a calibration by hand."""
    diagnosis: DiagnosisState | None = None
    """Detected model errors; None without a table."""
    place: str = ''
    """Where the calibration is saved."""
    judged: str = ''
    """The decisions in one phrase."""
    complete: bool = False
    """Whether each sensor helps and every requested parameter is determined."""
