"""
From recordings to a calibration that prints, draws and saves itself.

The module also holds the test of a calibration on another recording.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from imu_calibration.api.choices import (
    Choices,
    made_from,
    provenance_with,
    readings_for,
    require_same_inputs,
)
from imu_calibration.api.recordings import (
    Stand,
    jobs_for,
    name_of,
    provenance_of,
)
from imu_calibration.api.references import inputs_of
from imu_calibration.calibration.calibrate import calibrate_by_evidence
from imu_calibration.calibration.check import check_errors
from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.calibration.reference import MotionReference
from imu_calibration.calibration.result import CalibrationResult, summary
from imu_calibration.core.progress import report
from imu_calibration.core.readings import STATED_KEYS
from imu_calibration.core.samples import SampleBlock
from imu_calibration.core.settings import CHANGE
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.change import checked_limit
from imu_calibration.document.decision import Verdict
from imu_calibration.document.outcome import JudgedResult
from imu_calibration.document.proof_entry import EarlierErrors, Proof
from imu_calibration.document.verdict import judged
from imu_calibration.report.figures import Drawn

if TYPE_CHECKING:  # in the standard library from Python 3.11 on
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class Calibrated(JudgedResult):
    """
    Result of a calibration.

    It prints the parameters and the verdict, draws residuals, and saves calibration.yaml and
    report.html.
    """

    result: CalibrationResult
    """The calibration with all data of a report."""
    reference: MotionReference
    """The reference of its recordings."""

    @property
    def calibration(self) -> Calibration:
        """The calibration: compensates arrays; `save` writes it."""
        return self.result.calibration

    @property
    def verdict(self) -> Verdict:
        """The decision per sensor with warnings, notes and next steps."""
        return self.result.verdict

    def plot(self, sensor: str = 'accelerometer') -> Drawn:
        """
        Return the errors of one sensor in every window, before and after, as a figure.
        """
        from imu_calibration.report.calibration_sections import draw_windows

        return draw_windows(self.result.window_errors(), sensor)

    @cached_property
    def report(self) -> str:
        """The report as one HTML page."""
        report('drawing the report')
        from imu_calibration.report.calibration_sections import calibration_report

        return calibration_report(self.result)

    def save(self, folder: str | PathLike, *, report: bool = True, force: bool = False) -> None:
        """
        Write calibration.yaml and, when wanted, report.html into a folder.

        The result of other inputs there is replaced only with `force`.
        """
        if not force:
            require_same_inputs(folder, lambda: self.calibration.provenance, report=report)
        texts = {}
        if report:
            texts[files.REPORT] = self.report
        texts['calibration.yaml'] = calibration_to_text(self.calibration)
        files.write_texts(folder, texts)

    def __repr__(self):
        return repr(self.calibration)

    def __str__(self):
        return '\n'.join([str(self.calibration), *(f'  {line}' for line in summary(self.result))])

    def _repr_html_(self):
        from markupsafe import escape

        lines = ''.join(f'<li>{escape(line)}</li>' for line in summary(self.result))
        return f'<p><b>{self.verdict.text}</b></p><ul>{lines}</ul>{self.calibration._repr_html_()}'


def calibrate_recordings(
    recordings: str | PathLike | SampleBlock | Sequence,
    table: Stand | None = None,
    *,
    jobs: int | None = 1,
    earlier: Calibration | str | PathLike | None = None,
    **choices: 'Unpack[Choices]',
) -> Calibrated:
    """
    Calibrate from one or several recordings of the same IMU.

    Parameters
    ----------
    recordings : path-like, SampleBlock, or a sequence of them
        Bags, or samples in memory.
    table : path-like, Table or Arm, optional
        The reference: a table description, a robot description (.urdf, .xacro), or their content;
        without it gravity: poses held still and the turns between them.
    jobs : int or None
        Recordings that are read side by side, in processes; None: one per processor.
    earlier : Calibration or path-like, optional
        A calibration of this IMU from before, proven on the same recordings; needs a table.
    choices
        See `Choices`.

    Raises
    ------
    ImuCalibrationError
        When a recording cannot be used, or no parameter can be determined from it.

    """
    documented_choices = {**choices, 'earlier': earlier}
    earlier = None if earlier is None else files.given_calibration(earlier)
    if isinstance(recordings, (str, PathLike, SampleBlock)):
        recordings = [recordings]
    else:
        recordings = list(recordings)
    options, reference, sources = inputs_of(recordings, table, choices)
    if earlier is not None:
        reference.table_for('an earlier calibration must be compared on a table', 'table_missing')
    jobs = jobs_for(jobs, len(recordings))
    with ThreadPoolExecutor(1) as hashing:  # reads the files during the calibration, not before it
        provenance = hashing.submit(
            provenance_with, 'calibrate', recordings, documented_choices, stand=table
        )
        gathered = reference.gather(sources, options, names=_distinct_names(recordings), jobs=jobs)
        result = calibrate_by_evidence(gathered, options)
        if earlier is not None and result.calibration.proof:
            earlier_proof = reference.errors(sources, earlier, options).proof
            result = _with_earlier_errors(result, earlier_proof)
        calibration = result.calibration
        calibration = replace(calibration, provenance=calibration.provenance | provenance.result())
        return Calibrated(replace(result, calibration=calibration), reference)


def _with_earlier_errors(result: CalibrationResult, earlier_proof: Proof) -> CalibrationResult:
    """Return the result, in its proof the errors with an earlier calibration (`earlier_proof`)."""
    proof = dict(result.calibration.proof)
    for sensor in proof.keys() & earlier_proof.keys():
        earlier = EarlierErrors(earlier_proof[sensor].after, earlier_proof[sensor].ci95)
        proof[sensor] = replace(proof[sensor], earlier=earlier)
    calibration = judged(replace(result.calibration, proof=proof), result.tolerances)
    return replace(result, calibration=calibration)


def _distinct_names(recordings: Sequence[str | PathLike | SampleBlock]) -> list[str]:
    """Return the names of recordings, of equal ones the path or the number."""
    names = [name_of(recording) for recording in recordings]
    distinct = []
    for number, (name, recording) in enumerate(zip(names, recordings, strict=True), 1):
        if names.count(name) > 1:
            if isinstance(recording, SampleBlock):
                name = f'recording {number}'
            else:
                name = str(Path(recording))
        distinct.append(name)
    return distinct


def check_recording(
    recording: str | PathLike | SampleBlock,
    calibration: Calibration | str | PathLike,
    table: Stand | None = None,
    *,
    change: float = CHANGE,
    **choices: 'Unpack[Choices]',
) -> CheckResult:
    """
    Test whether a calibration helps on a recording, and whether its error has changed.

    Compared are the errors of raw and corrected readings, by sensor and kind of motion, and the
    error now with the held-out error in the file.

    Parameters
    ----------
    recording : path-like or SampleBlock
        A bag, or samples in memory, of the IMU that was calibrated.
    calibration : Calibration or path-like
    table : path-like, Table or Arm, optional
        The reference of this recording; it need not be the one of the calibration. Without it
        gravity is: the IMU held still in some attitudes, and the turns between them.
    change : float
        Factor of the error from which a significant change counts, at least 1.
    choices
        See `Choices`; the topics, the window settings and the local gravity apply.

    Raises
    ------
    ImuCalibrationError
        When the recording cannot be used, or is of an IMU that is not on the table.

    """
    limit = checked_limit(change)
    calibration = files.given_calibration(calibration)
    # The readings are those of the calibration, unless the choices state others.
    with_readings = {**choices, 'nominal': readings_for(calibration, choices)}
    for name in STATED_KEYS:
        with_readings.pop(name, None)
    options, reference, sources = inputs_of([recording], table, with_readings)
    errors = reference.errors(sources, calibration, options, names=[name_of(recording)])
    same_hashes = made_from(calibration.provenance) & made_from(provenance_of([recording], {}))
    return check_errors(errors, calibration, change_limit=limit, own_recording=bool(same_hashes))
