"""A finished calibration with the data for a report, for any kind of reference; its summary and its exit code."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from imu_calibration.calibration.decision import HELPS, most_cautious
from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.error_budget import ErrorBudget, ReferenceErrors
from imu_calibration.calibration.gathered import Gathered
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.status import DETERMINED
from imu_calibration.calibration.trust import usage
from imu_calibration.calibration.verdict import Verdict
from imu_calibration.calibration.window_errors import WindowErrors
from imu_calibration.segmentation.window import Window


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationResult(ABC):
    """A calibration with the data for a report: on a table a `TableResult`, by hand a `by_hand.result.HandResult`."""

    calibration: Calibration
    """The document's content."""
    gathered: Gathered
    """Windows, counts, kept samples."""
    tolerances: np.ndarray
    """Tolerance of each parameter."""
    needed: dict[str, tuple[str, float]]
    """Parameter that is not determined -> (the motion that would serve it best, its sd after a minute of that motion, NaN when unknown)."""
    options: CalibrationOptions = CalibrationOptions()
    """Options of the requested model."""

    observations: ClassVar[str]
    """Unit of the data: 'windows' or 'poses'."""

    @property
    def verdict(self) -> Verdict:
        """The decision per sensor with all statements."""
        assert self.calibration.judgement is not None, 'a result is made of a calibration that was judged'
        return self.calibration.judgement

    @property
    @abstractmethod
    def reference(self) -> str:
        """Short description of the reference of the sensor."""

    @property
    @abstractmethod
    def gravity(self) -> float:
        """Gravity of the reference, m/s^2."""

    @property
    @abstractmethod
    def period(self) -> float:
        """Sampling period, s."""

    @property
    @abstractmethod
    def singular_values(self) -> np.ndarray:
        """Singular values of the design in units of the tolerances, descending; none where they are not known."""

    @abstractmethod
    def first_rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean specific force and rate of the first pose at rest, each shape (3,)."""

    @abstractmethod
    def window_errors(self) -> WindowErrors:
        """Return the errors of window means before and after."""

    @abstractmethod
    def residuals_of(self, window: Window) -> dict[str, np.ndarray]:
        """Return sensor -> measured minus predicted of a window that was kept, shape (n, 3)."""

    @abstractmethod
    def error_budget(self, errors: ReferenceErrors = ReferenceErrors()) -> ErrorBudget:
        """Return the standard deviation of each parameter by cause."""


def summary(result: CalibrationResult, hints: dict[str, str] | None = None) -> tuple[str, list[str]]:
    """
    Return (the more cautious decision, lines for the user: decisions, parameters, warnings, notes and next steps).

    `hints` as for `errors.with_hint`.
    """
    lines, told = result.verdict.lines(hints), usage(result.calibration)
    return str(result.verdict.word), [*lines, *[told] * bool(told)]


def exit_code(calibration: Calibration) -> int:
    """Return 0 when each sensor helps, every requested parameter is determined and no data were lost, else 3."""
    harmful = most_cautious(calibration.decisions.values()) is not HELPS
    lacking = harmful or any(status != DETERMINED for status in calibration.requested.values())
    return 3 if lacking or calibration.statistics.get('dropped') or calibration.statistics.get('unusable') else 0
