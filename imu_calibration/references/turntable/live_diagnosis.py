"""A diagnosis during the motion: its input, a solution, and its outcome as a status."""

from dataclasses import dataclass
from typing import Any

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
from imu_calibration.references.turntable.selection.investigation import too_few_windows
from imu_calibration.references.turntable.selection.window_evidence import MIN_FOLD_WINDOWS
from imu_calibration.references.turntable.window_search import windows_to_ask


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


MATES_KEY, SIZE_KEY = 'mates of ', 'size of '
"""Prefix of the name of each finding, and of EFFECT.PARAMETER with a number in SI: for programs."""
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
            if evidence.found is None:
                raise too_few_windows(
                    sum(len(spread.windows) for spread in self.snapshot.gathered.spreads)
                )
            found, extension = evidence.found, evidence.extension
            calibrated = None if extension.changes.lacking else evidence.solution
            # Its columns, of a wider model than those of the session, need much memory.
            del evidence
            return Answer(
                live_state_of(build_diagnosis(self.snapshot.table, found, calibrated=calibrated)),
                extension,
            )
        except ImuCalibrationError as error:
            return Answer(LiveState(WAITING, str(error)))


def question_about(live: LiveSession) -> DiagnosisQuestion | None:
    """
    Return the DiagnosisQuestion about the last solution of a session.

    Or None without one or while there are too few windows.
    """
    return (
        DiagnosisQuestion(live.last)
        if live.last is not None and windows_to_ask(live.last.gathered)
        else None
    )


def live_state_of(diagnosis: Diagnosis) -> LiveState:
    """
    Return the LiveState of a Diagnosis: the first finding, or none, or the unexplained residual.
    """
    values: dict[str, Any] = {
        'windows': diagnosis.windows,
        'windows held out for the gain': diagnosis.locked,
    }
    rest = [line for line in diagnosis_lines(diagnosis) if line.startswith('unexplained')]
    values |= {
        f'unexplained {sensor} rms': in_words(found.rms, sensor, found.unit)
        for sensor, found in diagnosis.unexplained.items()
        if found.significant
    }
    if not diagnosis.findings:
        return LiveState(
            UNEXPLAINED if rest else NOTHING, '; '.join(rest) or nothing_named(diagnosis), values
        )
    first = diagnosis.findings[0]
    message = f'{first.title}: {first.explanation}'
    if first.indistinguishable_from:
        others = ', '.join(first.indistinguishable_from)
        message += (
            f' This motion does not separate it from {others}; a motion that does:'
            f' {first.separating_motion}'
        )
    low, high = first.gain.ci95
    values = {
        'effect': first.effect,
        'sensor': first.sensor,
        'explanation': first.explanation,
        **{
            name: f'{value:.4g} +- {sd:.2g} {unit}'
            for name, (value, sd, unit) in first.parameters.items()
        },
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
