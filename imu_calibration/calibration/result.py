"""
A finished calibration with the data for a report, the same for any reference.

A reference contributes the data that it gathered (`Observations`) and predictions of held-out data
(`HeldOutData`); what follows from a solution is concluded once, in `calibrate.conclude`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol

import numpy as np

from imu_calibration.calibration.from_solution import Estimate
from imu_calibration.calibration.gathered_data import GatheredData
from imu_calibration.calibration.held_out_data import HeldOutData, PlainFit
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import Verdict
from imu_calibration.document.statistics import RecordingStatistics
from imu_calibration.document.trust import Uncorrected, usage
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.preprocessing.recording_evidence import CheckFinding
from imu_calibration.preprocessing.window import Window
from imu_calibration.selection.selected_effects import SelectedEffects

GRAVITY_SD = 5e-4
"""
Standard deviation of the local gravity where a table description or the options give it without
one, m/s^2.
"""


@dataclass(frozen=True, eq=False)
class WindowErrors:
    """One row per window; errors are readings minus true values, in SI."""

    time: np.ndarray
    """Middle of the window, s, shape (n,)."""
    kind: np.ndarray
    """'static', 'spin' or 'dynamic', shape (n,)."""
    measured: dict
    """Sensor -> mean reading, shape (n, 3)."""
    true: dict
    """Sensor -> mean specific force or rate as the reference has it, shape (n, 3)."""
    before: dict
    """Sensor -> error of the mean reading, shape (n, 3)."""
    after: dict
    """
    Sensor -> error of the mean corrected with parameters that were estimated without the window,
    shape (n, 3).
    """
    floor: dict
    """Sensor -> sd of the mean from noise, shape (n, 3)."""


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Standard deviation of each parameter by cause."""

    param_names: tuple
    """Names in the order of the rows."""
    causes: dict[str, np.ndarray]
    """Cause -> standard deviations, shape (n_params,); 'noise' first."""
    texts: dict[str, str]
    """Cause -> assumption."""

    @property
    def total(self) -> np.ndarray:
        """Root of the sum of squares of all causes, shape (n_params,)."""
        return np.sqrt(sum(sd**2 for sd in self.causes.values()))


@dataclass(frozen=True, eq=False)
class Needs:
    """Parameters that a recording does not determine, and the motions that determine them."""

    motions: dict[str, tuple[str, float]]
    """
    Parameter that is not determined -> (the motion that determines it best, its sd after a minute
    of that motion, NaN when unknown).
    """
    undetermined: tuple[dict[str, Any], ...]
    """Entries of the document: parameters with their sds in tolerances, and the need."""


class Observations(Protocol[Estimate]):
    """Data that a reference gathered in recordings of one IMU, with its errors."""

    unit: ClassVar[str]
    """Unit of the data: 'windows' or 'poses'."""

    @property
    def gathered(self) -> GatheredData:
        """Counts, conditions and stored windows of the recordings."""

    @property
    def reference(self) -> str:
        """Short description of the reference."""

    @property
    def gravity(self) -> float:
        """Gravity of the reference, m/s^2."""

    @property
    def period(self) -> float:
        """Sampling period, s."""

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without readings."""

    @property
    def tested(self) -> tuple[str, ...]:
        """Parameters that a likelihood-ratio test holds at their prior."""

    def searches(
        self, solution: Estimate, options: CalibrationOptions
    ) -> Iterator[SelectedEffects]:
        """
        Yield the search of effects that a solution lacks, in each recording with enough data.

        The largest recording is first; nothing where options request no search.
        """

    def gauge(self, solution: Estimate) -> dict[str, Any]:
        """Return the conventions of origin and axes."""

    def findings(self, solution: Estimate) -> tuple[CheckFinding, ...]:
        """
        Return the findings of the recordings and those that a solution adds to them.

        Raises
        ------
        InputError
            When the readings are clearly in another unit.

        """

    def with_reference_errors(self, solution: Estimate) -> Estimate:
        """Return the solution with errors of the reference in its covariance."""

    def held_out(self, solution: Estimate) -> HeldOutData[Estimate]:
        """Return the data in folds, with the parameters of a solution without each fold."""

    def uncorrected(self, solution: Estimate) -> Uncorrected:
        """Return the errors that compensation leaves uncorrected."""

    def statistics(self, solution: Estimate) -> RecordingStatistics:
        """Return the statistics of the recordings and of a solution."""

    def needs(
        self, solution: Estimate, tolerances: np.ndarray, *, quality: dict[str, Any]
    ) -> Needs:
        """
        Return the needs of a solution.

        `quality`: statistics of the document, from which it follows whether the model is complete.
        """

    def singular_values(self, result: 'CalibrationResult[Estimate]') -> np.ndarray:
        """
        Return the singular values of the design in units of the tolerances, descending.

        None where directions are estimated too.
        """

    def window_errors(self, result: 'CalibrationResult[Estimate]') -> WindowErrors:
        """Return the errors of window means before and after."""

    def residuals_of(
        self, result: 'CalibrationResult[Estimate]', window: Window
    ) -> dict[str, np.ndarray]:
        """Return sensor -> measured minus predicted of a window that was kept, shape (n, 3)."""

    def error_budget(self, result: 'CalibrationResult[Estimate]') -> ErrorBudget:
        """Return the standard deviation of each parameter by cause."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationResult(Generic[Estimate]):
    """A calibration with the data for a report."""

    calibration: Calibration
    """The document's content."""
    data: Observations[Estimate]
    """What the reference gathered."""
    gathered: GatheredData
    """Counts, conditions and stored windows of the recordings, with all findings."""
    tolerances: np.ndarray
    """Tolerance of each parameter."""
    needed: dict[str, tuple[str, float]]
    """`Needs.motions` of the parameters that are not determined."""
    options: CalibrationOptions = CalibrationOptions()
    """Options of the requested model."""
    solution: Estimate
    """The estimate with weights by noise, and with all effects."""
    applied: Estimate
    """The estimate in the document: `solution` with the values of `fits`."""
    fits: tuple[PlainFit, ...] = ()
    """Plain fits that predict held-out data better than the solution."""
    search: SelectedEffects | None = None
    """Result of the search for the model; None without a search."""

    @property
    def model(self) -> SensorModel:
        """The model that was solved."""
        return self.solution.model

    @property
    def reference(self) -> str:
        """Short description of the reference."""
        return self.data.reference

    @property
    def gravity(self) -> float:
        """Gravity of the reference, m/s^2."""
        return self.data.gravity

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return self.data.period

    @property
    def observations(self) -> str:
        """Unit of the data: 'windows' or 'poses'."""
        return self.data.unit

    @property
    def verdict(self) -> Verdict:
        """The decision per sensor with all statements."""
        assert self.calibration.judgement is not None, (
            'a result is made of a calibration that was judged'
        )
        return self.calibration.judgement

    @property
    def singular_values(self) -> np.ndarray:
        """Singular values of the design (`Observations.singular_values`)."""
        return self.data.singular_values(self)

    def window_errors(self) -> WindowErrors:
        """Return the errors of window means before and after."""
        return self.data.window_errors(self)

    def residuals_of(self, window: Window) -> dict[str, np.ndarray]:
        """Return sensor -> measured minus predicted of a window that was kept, shape (n, 3)."""
        return self.data.residuals_of(self, window)

    def error_budget(self) -> ErrorBudget:
        """Return the standard deviation of each parameter by cause."""
        return self.data.error_budget(self)


def summary(result: CalibrationResult[Any], hints: dict[str, str] | None = None) -> list[str]:
    """
    Return the lines for the user: decisions, parameters, warnings, notes and next steps.

    `hints` as for `errors.with_hint`.
    """
    lines = list(result.verdict.lines(hints))
    hint = usage(result.calibration)
    if hint:
        lines.append(hint)
    return lines
