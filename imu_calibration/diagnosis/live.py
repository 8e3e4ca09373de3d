"""A diagnosis while the motion goes on: the windows that are kept for it, and its outcome in the words of a status."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from imu_calibration.calibration.by_evidence import baseline_model
from imu_calibration.calibration.session import TableSession
from imu_calibration.diagnosis.diagnose import diagnose
from imu_calibration.diagnosis.result import Diagnosis
from imu_calibration.diagnosis.workflow import diagnosis_lines, in_words, nothing_named
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.errors import ImuCalibrationError
from imu_calibration.estimation.window_store import owned_window
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window
from imu_calibration.selection.investigation import LEAST_WINDOWS


class Outcome(StrEnum):
    """What a diagnosis came to."""

    WAITING = 'waiting'
    """It cannot be asked yet."""
    OFF = 'off'
    """It is not asked."""
    FOUND = 'found'
    """The model lacks something that has a name."""
    NOTHING = 'nothing found'
    """The model is adequate."""
    UNEXPLAINED = 'unexplained'
    """Something stays that no effect explains."""
    FAILED = 'failed'
    """It ended by a fault."""


MATES, SIZE = 'mates of ', 'size of '
"""What stands before the name of each finding, and before EFFECT.PARAMETER with a bare number in SI: for programs."""
WAITING, OFF, FOUND, NOTHING, UNEXPLAINED, FAILED = Outcome


@dataclass(frozen=True)
class DiagnosisState:
    """What a diagnosis said, or why none was made yet."""

    word: Outcome = WAITING
    """What it came to."""
    message: str = f'it is asked after a solution, once there are {LEAST_WINDOWS} windows'
    """One line."""
    values: dict = field(default_factory=dict)
    """Figures by name."""


class RecentWindows:
    """
    The last windows of a session, with their samples.

    Parameters
    ----------
    most : int
        Samples kept at most; the oldest windows go first.

    """

    def __init__(self, most: int):
        self._most, self._windows, self.n_samples, self.forgotten = most, deque(), 0, 0

    def __len__(self) -> int:
        return len(self._windows)

    def add(self, windows: Sequence) -> None:
        """Take windows in order."""
        for window in windows:
            if window.kind != 'unused' and len(window) <= self._most:
                self._windows.append(owned_window(window))
                self.n_samples += len(window)
        while self.n_samples > self._most:
            self.n_samples -= len(self._windows.popleft())
            self.forgotten += 1

    def list(self) -> list[Window]:
        """Return the windows in order; they are not changed by anybody."""
        return list(self._windows)


class LiveDiagnosis:
    """
    Keeps the last windows of a live calibration, and asks about them.

    Parameters
    ----------
    most : int
        Samples kept at most; 0: nothing is kept and nothing is asked.

    """

    def __init__(self, most: int):
        self._most, self.recent = most, RecentWindows(most)

    def add(self, windows: Sequence) -> None:
        """Take the windows that a `LiveCalibration` has completed."""
        if self._most:
            self.recent.add(windows)

    def question(self, live: TableSession | None) -> 'DiagnosisQuestion | None':
        """Return the DiagnosisQuestion about the last solution of a session, or None without a table or while there are too few windows."""
        if live is None:
            return None
        windows = self.recent.list() + live.open_windows
        if live.result is None or len(windows) < LEAST_WINDOWS or not self._most:
            return None
        return DiagnosisQuestion(windows, live.table, baseline_model(live.options, live.table, live.result.model), self.recent.forgotten,
                                 live.options.bias_processes)


@dataclass(frozen=True, eq=False)
class DiagnosisQuestion:
    """What a diagnosis needs, for another thread."""

    windows: list
    """Windows in order."""
    table: Table
    """The Table."""
    model: SensorModel
    """The model to diagnose."""
    forgotten: int = 0
    """Windows that were no longer there."""
    bias_processes: dict = field(default_factory=dict)
    """Sensor -> how its bias moves, where that was measured apart."""

    def answer(self, progress: Callable[[float], object] | None = None) -> DiagnosisState:
        """Diagnose and return the DiagnosisState; `progress` is called with the share done and may raise to end it."""
        try:
            return describe(diagnose(self.windows, self.table, self.model, progress=progress, bias_processes=self.bias_processes), self.forgotten)
        except ImuCalibrationError as error:
            return DiagnosisState(WAITING, str(error), {'windows': len(self.windows)})


def describe(diagnosis: Diagnosis, forgotten: int = 0) -> DiagnosisState:
    """Return the DiagnosisState of a Diagnosis: the first finding, or nothing, or what stays unexplained."""
    values: dict[str, Any] = {'windows': diagnosis.windows, 'windows held out for the gain': diagnosis.locked,
                              'older windows not looked at': forgotten}
    rest = [line for line in diagnosis_lines(diagnosis) if line.startswith('unexplained')]
    values |= {f'unexplained {sensor} rms': in_words(found.rms, sensor, found.unit)
               for sensor, found in diagnosis.unexplained.items() if found.significant}
    if not diagnosis.findings:
        return DiagnosisState(UNEXPLAINED if rest else NOTHING, '; '.join(rest) or nothing_named(diagnosis), values)
    first = diagnosis.findings[0]
    message = f'{first.title}: {first.explanation}'
    if first.indistinguishable_from:
        others = ', '.join(first.indistinguishable_from)
        message += f' This motion cannot tell it from {others}; to separate them: {first.separating_motion}'
    low, high = first.gain.ci95
    values = {'effect': first.effect, 'sensor': first.sensor, 'explanation': first.explanation,
              **{name: f'{value:.4g} +- {sd:.2g} {unit}' for name, (value, sd, unit) in first.parameters.items()},
              'p-value': f'{first.p_value:.2g}', 'held-out reduction': f'{first.gain.reduction:.3f}',
              'held-out reduction, 95 % interval': f'{low:.3f} to {high:.3f}',
              'held-out measure': f'{first.gain.sensor} {first.gain.measure}',
              'indistinguishable from': ' '.join(first.indistinguishable_from),
              'further findings': ' '.join(finding.effect for finding in diagnosis.findings[1:]),
              'implausible': ' '.join(finding.effect for finding in diagnosis.findings if finding.implausible), **values}
    for finding in diagnosis.findings:
        values[MATES + finding.effect] = ' '.join(finding.indistinguishable_from)
        sized = {finding.effect: finding.parameters, **finding.sizes_of_mates}
        values |= {f'{SIZE}{effect}.{name}': repr(float(value)) for effect, sizes in sized.items() for name, (value, *_) in sizes.items()}
    return DiagnosisState(FOUND, message, values)
