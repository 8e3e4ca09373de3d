"""What a verb asks of the reference of its recordings, whichever it is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from imu_calibration.calibration.check import ReadingErrors
from imu_calibration.calibration.coverage import Coverage
from imu_calibration.calibration.live import (
    LiveByHandSettings,
    LiveSession,
    LiveSettings,
    Place,
)
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.solved import ModelSource
from imu_calibration.core.errors import ImuCalibrationError, NotObservableError
from imu_calibration.core.samples import BlockSource, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.exports.loss import TrialMotion
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.recording_evidence import CheckFinding

if TYPE_CHECKING:
    from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis
    from imu_calibration.calibration.diagnosis.traces import Traces


@dataclass(frozen=True, eq=False)
class Inspection:
    """Checks of a recording, and a calibration that shows what its motions determine."""

    preflight: Preflight
    """The checks, after the complete recording."""
    findings: tuple[CheckFinding, ...]
    """Findings of the checks and of the calibration."""
    calibrated: CalibrationResult[Any] | ImuCalibrationError | None
    """The calibration, or its error; None where it would be wrong."""


class MotionReference(Protocol):
    """The truth about the motion in recordings: a table or an arm, or gravity by hand."""

    @property
    def joint_names(self) -> JointNames | None:
        """Names of the joints that recordings must have; None: joints are not read."""

    @property
    def not_usable(self) -> str:
        """First words on a recording from which no calibration results."""

    @property
    def is_calibration_wanted(self) -> bool:
        """Whether a recording is inspected for its calibration; without a table perhaps not."""

    def table_for(self, purpose: str, code: str = '') -> Table:
        """
        Return the table.

        Raises
        ------
        InputError
            Without one: the `purpose`, in a sentence, needs it.

        """

    def gather(
        self,
        sources: Sequence[BlockSource],
        options: CalibrationOptions,
        *,
        names: Sequence[str] | None = None,
        jobs: int = 1,
    ) -> ModelSource[Any]:
        """Return the recordings as source of solutions; arguments as for `TableRecordings.of`."""

    def errors(
        self,
        sources: Sequence[BlockSource],
        calibration: Calibration,
        options: CalibrationOptions,
        *,
        names: Sequence[str] = (),
    ) -> ReadingErrors:
        """Return the errors of readings before and after a calibration; as `errors_on_table`."""

    def stored(self, source: BlockSource, options: CalibrationOptions) -> ModelSource[Any]:
        """Return a recording for a diagnosis, which is read once."""

    def too_few(self, result: CalibrationResult[Any]) -> NotObservableError:
        """Return the error where the data of a result do not suffice for a search of effects."""

    def identify(self, result: CalibrationResult[Any]) -> 'Diagnosis':
        """Return the result of a search as a Diagnosis, without traces."""

    def traces(self, recording: Any, before: Any, after: Any) -> 'Traces':
        """
        Return the residuals of two solutions of a recording, for plots.

        `recording`: as `stored` returns it.
        """

    def inspect(
        self, source: BlockSource, lenient: BlockSource, options: CalibrationOptions
    ) -> Inspection:
        """
        Check a recording, and calibrate from it as far as it allows.

        `lenient`: the same recording without an error for missing or ambiguous topics.
        """

    def reasons(self, lacking: list[str], doubts: list[str]) -> list[str]:
        """
        Return why a recording that was inspected is not good enough, a line each.

        `lacking`: what its calibration lacks; `doubts`: warnings of the checks.
        """

    def used_lines(self, calibration: Calibration) -> list[str]:
        """Return how much of a recording a calibration used, a line each."""

    def coverage(self, result: CalibrationResult[Any]) -> Coverage:
        """Return the directions that a calibration covers, and the next motion."""

    def check_place(self, before: Place, after: Place) -> None:
        """
        Raise an InputError where a live session cannot change to another gravity.

        `before`, `after`: as `LiveByHandSettings.place`.
        """

    def live_words(self, stand: str) -> str:
        """Return how a live session calibrates on a stand of that name, for a message."""

    def live(
        self,
        options: CalibrationOptions,
        settings: LiveSettings,
        by_hand: LiveByHandSettings,
        *,
        saved: bytes | None = None,
    ) -> LiveSession:
        """Return a live session; `saved`: the bytes of an earlier run, which it continues."""

    def trial_motion(
        self,
        source: BlockSource,
        calibration: Calibration,
        temperature: TemperatureSamples | None,
        *,
        name: str,
    ) -> TrialMotion:
        """Return the motion of a recording of that name, on which a calibration is tried."""
