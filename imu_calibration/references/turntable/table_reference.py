"""The joints of a table or an arm as the reference."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ClassVar, cast

from imu_calibration.calibration.check import ReadingErrors
from imu_calibration.calibration.coverage import Coverage
from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis
from imu_calibration.calibration.diagnosis.traces import Traces
from imu_calibration.calibration.live import LiveByHandSettings, LiveSettings, Place
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.reference import Inspection
from imu_calibration.core.errors import ImuCalibrationError, InputError, NotObservableError
from imu_calibration.core.samples import BlockSource, TemperatureSamples
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.exports.loss import TrialMotion, measured_temperature, motion_of
from imu_calibration.document.outcome import STATED_CHECKS
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import JOINT_STATES, Preflight
from imu_calibration.preprocessing.sample_recording import read_recording
from imu_calibration.preprocessing.window_finder import session_truth
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.live_windows import LiveCalibration
from imu_calibration.references.turntable.selection.investigation import (
    Investigation,
    too_few_windows,
)
from imu_calibration.references.turntable.session_data import SessionData
from imu_calibration.references.turntable.table_calibration import (
    KeptRecording,
    StoredRecording,
    TableRecordings,
    WatchedRecording,
)
from imu_calibration.references.turntable.table_coverage import table_coverage
from imu_calibration.references.turntable.table_errors import calibrate_with_table_errors
from imu_calibration.references.turntable.window_observations import TableResult
from imu_calibration.references.turntable.window_readings import errors_on_table
from imu_calibration.references.turntable.window_traces import residual_traces


@dataclass(frozen=True, eq=False)
class TableReference:
    """A table or an arm; the methods as in `MotionReference`."""

    table: Table
    """The chain of joints."""

    not_usable: ClassVar[str] = 'not usable for calibration'
    is_calibration_wanted: ClassVar[bool] = True

    @property
    def joint_names(self) -> JointNames:
        """Names of the joints."""
        return self.table.joint_names

    def table_for(self, purpose: str, code: str = '') -> Table:
        """Return the table."""
        return self.table

    def gather(
        self,
        sources: Sequence[BlockSource],
        options: CalibrationOptions,
        *,
        names: Sequence[str] | None = None,
        jobs: int = 1,
    ) -> TableRecordings:
        """Return the recordings: several, or a long one, are read by each pass."""
        kind = KeptRecording if len(sources) == 1 else TableRecordings
        return kind.of(sources, self.table, jobs=jobs, names=names)

    def errors(
        self,
        sources: Sequence[BlockSource],
        calibration: Calibration,
        options: CalibrationOptions,
        *,
        names: Sequence[str] = (),
    ) -> ReadingErrors:
        """Return the errors of window means."""
        return errors_on_table(sources, self.table, calibration, options=options, names=names)

    def stored(self, source: BlockSource, options: CalibrationOptions) -> StoredRecording:
        """Return the recording; its first pass keeps the windows."""
        return StoredRecording.of([source], self.table)

    def too_few(self, result: TableResult) -> NotObservableError:
        """Return the error with the number of windows."""
        gathered = cast(SessionData, result.data.gathered)
        return too_few_windows(len(gathered.for_search[0].windows))

    def identify(self, result: TableResult) -> Diagnosis:
        """Return the errors of the model in windows."""
        return build_diagnosis(cast(Investigation, result.search), calibrated=result.solution)

    def traces(
        self, recording: StoredRecording, before: Solution, after: Solution | Calibration
    ) -> Traces:
        """Return the residuals of the samples in windows."""
        return residual_traces(recording.windows, self.table, before, after=after)

    def inspect(
        self, source: BlockSource, lenient: BlockSource, options: CalibrationOptions
    ) -> Inspection:
        """
        Return the checks of a recording and its calibration, or the error that prevents it.

        If the calibration ended before the end of the recording, `lenient` is read for the checks.
        """
        gravity = self.table.gravity_value
        preflight = Preflight(gravity, one_sensor=True)
        recordings = WatchedRecording.of([source], self.table)
        recordings = replace(recordings, preflight=preflight, keep_windows=False)
        calibrated: TableResult | ImuCalibrationError
        shown = []
        try:
            with_errors = calibrate_with_table_errors(recordings, options)
            calibrated = with_errors.result
            shown = [each for each in calibrated.gathered.findings if each.check in STATED_CHECKS]
            shown += with_errors.findings
        except ImuCalibrationError as error:
            calibrated = error
        if not preflight.streams:  # not read to its end
            preflight = Preflight(gravity, strict=False)
            with suppress(ImuCalibrationError):
                read_recording(lenient, options.nominal, preflight)
        findings = preflight.findings
        if isinstance(calibrated, ImuCalibrationError) and calibrated.code == 'on_table':
            # Joints that rest while the IMU turns follow from the cause that the error states,
            # such as two clocks.
            findings = tuple(each for each in findings if each.sensor != JOINT_STATES)
        return Inspection(preflight, (*findings, *shown), calibrated)

    def reasons(self, lacking: list[str], doubts: list[str]) -> list[str]:
        """Return the reasons of the calibration; `doubts` need no further motion of a table."""
        return lacking

    def used_lines(self, calibration: Calibration) -> list[str]:
        """Return the number of windows and samples of each kind, after an empty line."""
        used = calibration.statistics['samples_used']
        lines = ['']
        for kind, count in calibration.statistics['windows'].items():
            lines.append(f'{kind}: {count} windows, {used[kind]} samples')
        return lines

    def coverage(self, result: TableResult) -> Coverage:
        """Return the gain of each attitude, and the motion with the largest gain."""
        return table_coverage(result)

    def check_place(self, before: Place, after: Place) -> None:
        """Refuse another gravity, which is a part of the table."""
        if after != before:
            raise InputError(
                'gravity is part of the reference of a session on a table or an arm, it cannot'
                ' change while the node runs; start the node with it',
                key='gravity',
                code='gravity_fixed',
            )

    def live_words(self, stand: str) -> str:
        """Return the joints."""
        return f'on {stand} with the joints {", ".join(self.joint_names)}'

    def live(
        self,
        options: CalibrationOptions,
        settings: LiveSettings,
        by_hand: LiveByHandSettings,
        *,
        saved: bytes | None = None,
    ) -> LiveCalibration:
        """Return a live session on the table."""
        return LiveCalibration(self.table, options, settings, saved=saved)

    def trial_motion(
        self,
        source: BlockSource,
        calibration: Calibration,
        temperature: TemperatureSamples | None,
        *,
        name: str,
    ) -> TrialMotion:
        """Return the motion that the joints have."""
        imu, ref = session_truth(source, self.table)
        return motion_of(
            ref.force_s,
            ref.rate_s,
            ref.alpha_s,
            temperature_c=measured_temperature(calibration, temperature, imu.stamp_ns),
            text=f'{name}, moved as its table says ({len(imu)} samples)',
        )
