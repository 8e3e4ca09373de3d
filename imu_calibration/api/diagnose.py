"""From a recording to the model errors, their causes, and the extended model."""

import json
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING

from imu_calibration.api.choices import (
    Choices,
    provenance_with,
    require_same_inputs,
)
from imu_calibration.api.recordings import Stand
from imu_calibration.api.references import inputs_of
from imu_calibration.calibration.diagnosis.diagnose import diagnose_recording
from imu_calibration.calibration.diagnosis.diagnosis_workflow import DiagnosisResult
from imu_calibration.core.progress import report
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.document.outcome import JudgedResult
from imu_calibration.report.figures import Drawn

if TYPE_CHECKING:  # in the standard library from Python 3.11 on
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class Diagnosed(JudgedResult):
    """
    Result of a diagnosis.

    It prints the findings, draws them, and saves diagnosis.json, the extended calibration.yaml and
    report.html.
    """

    result: DiagnosisResult
    """The diagnosis with all data of a report."""

    @property
    def calibration(self) -> Calibration:
        """The extended calibration; the baseline's without findings."""
        return self.result.calibration

    @property
    def proposed(self) -> Calibration | None:
        """
        The calibration with the formulas proposed for unexplained residuals; None without any.
        """
        return self.result.proposed

    @property
    def transferable(self) -> Calibration | None:
        """
        As `proposed`, with only those formulas that compensation of other recordings undoes.

        Formulas in time, joints or attitude are quantities of this session.
        """
        return self.result.transferable

    @property
    def findings(self) -> tuple:
        """Effects missing from the model, the strongest first."""
        return self.result.diagnosis.findings

    @property
    def document(self) -> dict:
        """The content of diagnosis.json."""
        return self.result.document

    def plot(self, number: int = 1) -> Drawn:
        """
        Return the residual against the cause of a finding, before and after, as a figure.

        `number` counts the findings from 1; for 0, or without findings, residuals over time.
        """
        from imu_calibration.report.diagnosis_page import draw_finding, draw_over_time

        if not number or not self.findings:
            return draw_over_time(self.result)
        return draw_finding(self.result.diagnosis, self.findings[number - 1], number)

    @cached_property
    def report(self) -> str:
        """The report as one HTML page."""
        report('drawing the report')
        from imu_calibration.report.diagnosis_page import diagnosis_report

        return diagnosis_report(self.result)

    def save(self, folder: str | PathLike, *, force: bool = False) -> None:
        """
        Write diagnosis.json, report.html and the extended calibration.yaml into a folder.

        With proposed formulas that compensation undoes extended.yaml is written too. The result of
        other inputs there is replaced only with `force`.
        """
        if not force:
            require_same_inputs(folder, lambda: self.calibration.provenance)
        texts = {
            'diagnosis.json': json.dumps(self.document, indent=1) + '\n',
            files.REPORT: self.report,
            'calibration.yaml': calibration_to_text(self.calibration),
        }
        if self.transferable is not None:
            texts['extended.yaml'] = calibration_to_text(self.transferable)
        files.write_texts(folder, texts)

    def save_overlay(self, path: str | PathLike, *, force: bool = False) -> None:
        """
        Write signals, residuals, spectra and histograms as MCAP for Foxglove.

        The signals are measured and simulated ones (`overlay_topics`). An existing file is replaced
        only with `force`.
        """
        from imu_calibration.api.view import mcap_bytes, overlay_topics

        files.require_new(path, force=force)
        diagnosis = self.result.diagnosis
        topics = overlay_topics(diagnosis.traces, diagnosis.baseline.model.joint_names)
        files.write_whole(path, mcap_bytes(topics))

    def __str__(self):
        return '\n'.join(self.result.lines)

    __repr__ = __str__

    def _repr_html_(self):
        from markupsafe import escape

        return ''.join(f'<p>{escape(line)}</p>' for line in self.result.lines)


def diagnose(
    recording: str | PathLike | SampleBlock,
    table: Stand | None = None,
    **choices: 'Unpack[Choices]',
) -> Diagnosed:
    """
    Find the model errors on a recording and their causes, and extend the model.

    Parameters
    ----------
    recording : path-like or SampleBlock
        A bag, or samples in memory.
    table : path-like or Table, optional
        The reference; without it gravity is.
    choices
        See `Choices`; the models are the initial models of the diagnosis, by default only bias and
        matrix.

    Raises
    ------
    ImuCalibrationError
        When the recording cannot be used, or no parameter can be determined from it.

    """
    options, reference, (source,) = inputs_of([recording], table, choices)
    provenance = provenance_with('diagnose', [recording], choices, stand=table)
    return Diagnosed(diagnose_recording(source, reference, options, provenance=provenance))
