"""What everybody may ask of a calibration that goes on, whatever its reference: on a table `calibration.live`, by hand `by_hand.live`."""

from dataclasses import dataclass, field
from typing import Any, Protocol

from imu_calibration.calibration.coverage import Coverage
from imu_calibration.calibration.effect_states import GroupState, Progress
from imu_calibration.calibration.live_settings import LiveByHandSettings, LiveSettings
from imu_calibration.calibration.live_snapshot import LiveSnapshot
from imu_calibration.calibration.model_changes import Demand
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.table_result import TableResult
from imu_calibration.reference.table import Table
from imu_calibration.samples import ImuSamples, SampleBlock
from imu_calibration.segmentation.stamping import StampLine
from imu_calibration.segmentation.window_settings import WindowSettings


@dataclass(frozen=True)
class SessionStatus:
    """How far a session has come, for people."""

    word: Progress
    """WAITING before a solution is possible, WEAK while something is missing, or DETERMINED."""
    message: str
    """One line: what there is, and what to do next."""
    values: dict[str, Any] = field(default_factory=dict)
    """Figures by name."""


class TableSession(Protocol):
    """What is asked of a session on a table only."""

    table: Table
    """The reference."""
    options: CalibrationOptions
    """What is estimated."""
    last: LiveSnapshot | None
    """What the last solution was made of."""

    def adopt(self, demand: Demand) -> bool:
        """Take what the session demands into the model from now on; return whether anything changes."""

    @property
    def result(self) -> TableResult | None:
        """The last solution."""


class LiveSession(Protocol):
    """A calibration while the motion goes on: `push` what arrives, `solve` when it is due."""

    settings: LiveSettings
    """How often to solve, and what is kept and told; may be replaced."""
    observations: str
    """What is gathered, for people: 'windows' or 'poses'."""
    needs_joints: bool
    """Whether it waits for joint states."""

    @property
    def result(self) -> CalibrationResult | None:
        """The last solution."""

    @property
    def on_table(self) -> TableSession | None:
        """The session itself where a table is the reference, as a diagnosis asks for it; None by hand."""

    @property
    def needs_temperature(self) -> bool:
        """Whether it waits for temperatures."""

    @property
    def n_windows(self) -> int:
        """Windows or poses gathered so far, those of an earlier run included."""

    @property
    def frame_id(self) -> str:
        """Frame of the sensor; '' before the first message."""

    @property
    def counts(self) -> dict[str, int]:
        """Samples by what became of them."""

    @property
    def stamping(self) -> StampLine | None:
        """How the stamps of the IMU are; None while that is not known."""

    def push(self, block: SampleBlock) -> list:
        """Take what arrived and return the windows or poses that it completed."""

    def residuals(self, completed: list) -> ImuSamples | None:
        """Return measured minus predicted of what `push` returned, or None before the first solution."""

    def solve(self, pending: bool = False, provenance: dict | None = None) -> CalibrationResult:
        """Solve what was gathered; with `pending`, count in what would be there if the motion ended now."""

    def needs_linearising(self) -> bool:
        """Return whether the answer is not final because what it needs is no longer kept."""

    def saved(self, pending: bool = False) -> bytes:
        """Return what was gathered as bytes, for another run."""

    def groups(self) -> list[GroupState]:
        """Return what is known of each effect."""

    def status(self, hints: dict[str, str] | None = None) -> SessionStatus | None:
        """Return how far the session has come beyond what `groups` tell, or None; `hints` as for `errors.with_hint`."""

    def coverage(self) -> Coverage:
        """Return which attitudes are worth having, and what to do next."""

    def change_windows(self, windows: WindowSettings) -> None:
        """Find windows or poses by other settings from now on."""

    def change_by_hand(self, by_hand: LiveByHandSettings) -> None:
        """Take what counts where no table is the reference."""
