"""Gravity as the reference: an IMU that is held still, and turned in between."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, cast

from imu_calibration.calibration.calibrate import conclude
from imu_calibration.calibration.check import ReadingErrors
from imu_calibration.calibration.coverage import Coverage
from imu_calibration.calibration.live import Place
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.reference import Inspection
from imu_calibration.core.errors import ImuCalibrationError, InputError, NotObservableError
from imu_calibration.core.samples import BlockSource, ImuSamples, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.exports.loss import TrialMotion, recorded_motion
from imu_calibration.document.rest_noise import motions_at_rest
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.recording_evidence import REFUSE
from imu_calibration.preprocessing.sample_recording import read_recording
from imu_calibration.references.gravity.hand_calibration import HandCalibration
from imu_calibration.references.gravity.hand_parameters import HandOptions, hand_options
from imu_calibration.references.gravity.hand_workflow import PoseRecording, gather_poses
from imu_calibration.references.gravity.live_poses import EMPTY_SCAN, LiveByHand, hand_coverage
from imu_calibration.references.gravity.pose_observations import HandResult, PoseObservations
from imu_calibration.references.gravity.pose_readings import errors_by_hand

if TYPE_CHECKING:
    from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis
    from imu_calibration.calibration.diagnosis.traces import Traces
    from imu_calibration.references.gravity.model_selection import HandInvestigation


@dataclass(frozen=True)
class GravityReference:
    """The reference without a table; the methods as in `MotionReference`."""

    joint_names: ClassVar[None] = None
    not_usable: ClassVar[str] = 'not usable for calibration without a table'
    is_calibration_wanted: ClassVar[bool] = False
    live = staticmethod(LiveByHand)

    def table_for(self, purpose: str, code: str = '') -> Table:
        """Raise an InputError."""
        raise InputError(f'{purpose}, none was given; give one', key='table', code=code)

    def gather(
        self,
        sources: Sequence[BlockSource],
        options: CalibrationOptions,
        *,
        names: Sequence[str] | None = None,
        jobs: int = 1,
    ) -> PoseRecording:
        """Return the poses and turns of one recording."""
        return gather_poses(sources, options)

    def errors(
        self,
        sources: Sequence[BlockSource],
        calibration: Calibration,
        options: CalibrationOptions,
        *,
        names: Sequence[str] = (),
    ) -> ReadingErrors:
        """Return the errors at rest and in turns of one recording."""
        (source,) = sources
        return errors_by_hand(source, calibration, options)

    def stored(self, source: BlockSource, options: CalibrationOptions) -> PoseRecording:
        """Return the poses and turns; the search needs both sensors."""
        return gather_poses([source], options, one_sensor=False)

    def too_few(self, result: HandResult) -> NotObservableError:
        """Return the error with the number of poses."""
        from imu_calibration.references.gravity.model_selection import too_few_poses

        return too_few_poses(len(result.solution.poses))

    def identify(self, result: HandResult) -> 'Diagnosis':
        """Return the errors of the model in poses and turns."""
        # Here, because its import is slow.
        from imu_calibration.references.gravity.diagnosis_of_poses import diagnosis_by_hand

        return diagnosis_by_hand(cast('HandInvestigation', result.search), result.solution)

    def traces(
        self, recording: PoseRecording, before: HandCalibration, after: HandCalibration
    ) -> 'Traces':
        """Return one point per pose."""
        from imu_calibration.references.gravity.diagnosis_of_poses import traces_of_poses

        return traces_of_poses(before, after)

    def inspect(
        self, source: BlockSource, lenient: BlockSource, options: CalibrationOptions
    ) -> Inspection:
        """Check a recording, and calibrate where no check refuses it."""
        preflight = Preflight(strict=False, one_sensor=True)
        calibrated: HandResult | ImuCalibrationError | None = None
        try:
            recording = read_recording(lenient, options.nominal, preflight)
            if not any(finding.severity == REFUSE for finding in recording.findings):
                poses = PoseRecording(PoseObservations.of(recording, hand_options(options)))
                calibrated = conclude(poses.solved(options), options, is_judged=False)
        except ImuCalibrationError as error:
            if not any(finding.severity == REFUSE for finding in preflight.findings):
                calibrated = error
        return Inspection(preflight, preflight.findings, calibrated)

    def reasons(self, lacking: list[str], doubts: list[str]) -> list[str]:
        """Return the doubts if the calibration lacks parameters: a complete one removes them."""
        return doubts if lacking else []

    def used_lines(self, calibration: Calibration) -> list[str]:
        """Return the number of poses and turns, and the sensors that moved at rest."""
        windows = calibration.statistics['windows']
        moved = motions_at_rest(calibration.by_hand, calibration.sensors)
        return [
            f'by hand, without a table, it determines, from {windows["static"]} poses and'
            f' {windows["turns"]} turns between them:',
            *(f'warning: {text}' for text in moved),
        ]

    def coverage(self, result: HandResult) -> Coverage:
        """Return the attitudes of the poses, and the next pose."""
        poses = replace(EMPTY_SCAN, poses=result.applied.poses)
        return hand_coverage(poses, result, HandOptions(tolerances=result.options.tolerances))

    def check_place(self, before: Place, after: Place) -> None:
        """Accept any gravity: a live session solves its poses again."""

    def live_words(self, stand: str) -> str:
        """Return what a person does."""
        return (
            'by hand, since no table or arm was given: hold the IMU still in 12 different'
            ' attitudes and turn it in between'
        )

    def trial_motion(
        self,
        source: BlockSource,
        calibration: Calibration,
        temperature: TemperatureSamples | None,
        *,
        name: str,
    ) -> TrialMotion:
        """Return the motion that the compensated readings have."""
        imu = ImuSamples.concatenate([block.imu for block in source if block.imu is not None])
        return recorded_motion(calibration, calibration.readings.apply(imu), temperature, name=name)
