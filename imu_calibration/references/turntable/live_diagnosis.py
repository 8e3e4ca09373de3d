"""A diagnosis during the motion: its input, a solution, and its outcome as a status."""

from dataclasses import dataclass
from typing import Any, cast

from imu_calibration.calibration.diagnosis.diagnosis_result import Diagnosis
from imu_calibration.calibration.diagnosis.diagnosis_workflow import (
    diagnosis_lines,
    in_words,
    nothing_named,
)
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.live import LiveSession
from imu_calibration.core.errors import ImuCalibrationError
from imu_calibration.core.progress import LiveState
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.references.turntable.diagnosis_of_windows import build_diagnosis
from imu_calibration.references.turntable.live_windows import LiveSnapshot
from imu_calibration.references.turntable.selection.investigation import (
    Investigation,
    too_few_windows,
)
from imu_calibration.references.turntable.selection.window_evidence import MIN_FOLD_WINDOWS
from imu_calibration.references.turntable.window_search import windows_to_search


class Outcome(StrEnum):
    """Outcome of a diagnosis."""

    WAITING = 'waiting'
    """It is not possible yet."""
    OFF = 'off'
    """It is disabled."""
    FOUND = 'found'
    """The model lacks something that has a name."""
    NOTHING = 'nothing found'
    """The model is adequate."""
    UNEXPLAINED = 'unexplained'
    """A residual is unexplained."""
    FAILED = 'failed'
    """It ended by a fault."""


MATES_KEY = 'mates of '
"""Status key for programs: this prefix and the name of a finding -> effects collinear with it."""
SIZE_KEY = 'size of '
"""Status key for programs: this prefix and EFFECT.PARAMETER -> its value in SI."""
WAITING, OFF, FOUND, NOTHING, UNEXPLAINED, FAILED = Outcome


NOT_YET = LiveState(WAITING, f'it follows a solution of at least {MIN_FOLD_WINDOWS} windows')
"""Before the first diagnosis."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Outcome of a diagnosis, and its consequence for the calibration."""

    state: LiveState
    """For display."""
    extension: ModelExtension | None = None
    """Effects that the windows support; None where they could not be tested."""


@dataclass(frozen=True, eq=False)
class DiagnosisQuestion:
    """Input of a diagnosis, for another thread."""

    snapshot: LiveSnapshot
    """Data of a solution."""

    @property
    def samples(self) -> dict:
        """Numbers of samples: equal for two questions about the same ones."""
        return self.snapshot.gathered.accumulator.samples

    def answer(self) -> Answer:
        """
        Diagnose and return the `Answer`.

        A listener of its progress (`core.progress`) may raise to end it.
        """
        try:
            evidence = self.snapshot.evidence()
            if evidence.search is None:
                for_search = self.snapshot.gathered.for_search
                raise too_few_windows(sum(len(kept.windows) for kept in for_search))
            search = cast(Investigation, evidence.search)
            extension = evidence.extension
            calibrated = None if extension.changes.lacking else evidence.solution
            # Its columns of a wider model need much memory.
            del evidence
            diagnosis = build_diagnosis(search, calibrated=calibrated)
            return Answer(live_state_of(diagnosis), extension)
        except ImuCalibrationError as error:
            return Answer(LiveState(WAITING, str(error)))


def question_about(live: LiveSession) -> DiagnosisQuestion | None:
    """
    Return the DiagnosisQuestion about the last solution of a session.

    None before a solution, and while there are too few windows.
    """
    if live.last is None or not windows_to_search(live.last.gathered):
        return None
    return DiagnosisQuestion(live.last)


def live_state_of(diagnosis: Diagnosis) -> LiveState:
    """
    Return the LiveState of a Diagnosis: its first finding, otherwise the unexplained residual.
    """
    values: dict[str, Any] = {
        'windows': diagnosis.windows,
        'windows held out for the gain': diagnosis.locked,
    }
    for sensor, residual in diagnosis.unexplained.items():
        if residual.significant:
            values[f'unexplained {sensor} rms'] = in_words(residual.rms, sensor, residual.unit)
    if not diagnosis.findings:
        lines = [line for line in diagnosis_lines(diagnosis) if line.startswith('unexplained')]
        if lines:
            return LiveState(UNEXPLAINED, '; '.join(lines), values)
        return LiveState(NOTHING, nothing_named(diagnosis), values)
    first = diagnosis.findings[0]
    message = f'{first.title}: {first.explanation}'
    if first.indistinguishable_from:
        others = ', '.join(first.indistinguishable_from)
        message += (
            f' This motion does not separate it from {others}; a motion that does:'
            f' {first.separating_motion}'
        )
    low, high = first.gain.ci95
    parameters = {}
    for name, (value, sd, unit) in first.parameters.items():
        parameters[name] = f'{value:.4g} +- {sd:.2g} {unit}'
    values = {
        'effect': first.effect,
        'sensor': first.sensor,
        'explanation': first.explanation,
        **parameters,
        'p-value': f'{first.p_value:.2g}',
        'held-out reduction': f'{first.gain.reduction:.3f}',
        'held-out reduction, 95 % interval': f'{low:.3f} to {high:.3f}',
        'held-out measure': f'{first.gain.sensor} {first.gain.measure}, {first.gain.of}',
        'indistinguishable from': ' '.join(first.indistinguishable_from),
        'further findings': ' '.join(finding.effect for finding in diagnosis.findings[1:]),
        'implausible': ' '.join(
            finding.effect for finding in diagnosis.findings if finding.implausible
        ),
        **values,
    }
    for finding in diagnosis.findings:
        values[MATES_KEY + finding.effect] = ' '.join(finding.indistinguishable_from)
        sized = {finding.effect: finding.parameters, **finding.sizes_of_mates}
        for effect, sizes in sized.items():
            for name, (size, *_) in sizes.items():
                values[f'{SIZE_KEY}{effect}.{name}'] = repr(float(size))
    return LiveState(FOUND, message, values)
