"""What the worker of calibration_node knows, for diagnostics and for the terminal."""

from dataclasses import dataclass, field

from imu_calibration.calibration.session import SessionStatus
from imu_calibration.diagnosis.live import DiagnosisState
from imu_calibration.preflight.stream_watch import StreamState


@dataclass(frozen=True)
class WorkerState:
    """What diagnostics tell; replaced as a whole, so that another thread may read it."""

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
    """What goes wrong at present and should not, a line each."""
    gathered: int = 0
    """Windows, or poses by hand."""
    values: dict = field(default_factory=dict)
    """Figures by name."""
    session: SessionStatus | None = None
    """How far the session has come beyond what the groups tell: the poses of a calibration by hand."""
    diagnosis: DiagnosisState | None = None
    """What the model gets wrong; None without a table."""
    place: str = ''
    """Where the calibration is saved."""
    judged: str = ''
    """The decisions in one phrase."""
    complete: bool = False
    """Whether each sensor helps and every requested parameter is determined."""
