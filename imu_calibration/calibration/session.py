"""Common interface of live calibrations: on a table `calibration.live`, by hand `by_hand.live`."""

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
from imu_calibration.segmentation.window import WindowSettings


@dataclass(frozen=True)
class SessionStatus:
    """Progress of a session, for the user."""

    word: Progress
    """WAITING before a solution is possible, WEAK while something is missing, or DETERMINED."""
    message: str
    """One line: the present state and the next step."""
    values: dict[str, Any] = field(default_factory=dict)
    """Figures by name."""


class TableSession(Protocol):
    """Interface of a session on a table only."""

    table: Table
    """The reference."""
    options: CalibrationOptions
    """Options of the estimate."""
    last: LiveSnapshot | None
    """The data of the last solution."""

    def adopt(self, demand: Demand) -> bool:
        """Add the effects that the session supports to the model from now on; return whether the model changes."""

    @property
    def result(self) -> TableResult | None:
        """The last solution."""


class LiveSession(Protocol):
    """A calibration during the motion: `push` for new blocks, `solve` when it is due."""

    settings: LiveSettings
    """Solving interval, storage and published data; may be replaced."""
    observations: str
    """Unit of the gathered data, for the user: 'windows' or 'poses'."""
    needs_joints: bool
    """Whether it waits for joint states."""

    @property
    def result(self) -> CalibrationResult | None:
        """The last solution."""

    @property
    def on_table(self) -> TableSession | None:
        """The session itself if a table is the reference, for a diagnosis; None by hand."""

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
        """Samples by their use."""

    @property
    def stamping(self) -> StampLine | None:
        """How the stamps of the IMU are; None while that is not known."""

    def push(self, block: SampleBlock) -> list:
        """Process a block and return the windows or poses that it completed."""

    def residuals(self, completed: list) -> ImuSamples | None:
        """Return measured minus predicted values of the windows or poses from `push`, or None before the first solution."""

    def solve(self, pending: bool = False, provenance: dict | None = None) -> CalibrationResult:
        """Solve the gathered data; with `pending`, include open windows or poses as if the motion ended now."""

    def needs_linearising(self) -> bool:
        """Return whether the result is not final because data for another linearisation are no longer kept."""

    def saved(self, pending: bool = False) -> bytes:
        """Return the gathered data as bytes, for another run."""

    def groups(self) -> list[GroupState]:
        """Return the state of each effect."""

    def status(self, hints: dict[str, str] | None = None) -> SessionStatus | None:
        """Return the progress of the session in addition to `groups`, or None; `hints` as for `errors.with_hint`."""

    def coverage(self) -> Coverage:
        """Return the gain of further attitudes, and the next step."""

    def change_windows(self, windows: WindowSettings) -> None:
        """Find windows or poses by other settings from now on."""

    def change_by_hand(self, by_hand: LiveByHandSettings) -> None:
        """Apply the settings of a calibration by hand."""
