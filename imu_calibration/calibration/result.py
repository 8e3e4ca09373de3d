"""
A finished calibration with the data for a report, for any kind of reference.

With its summary.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from imu_calibration.document.calibration import Calibration
from imu_calibration.document.decision import Verdict
from imu_calibration.document.trust import usage
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.session_data import SessionData

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
    causes: dict
    """Cause -> standard deviations, shape (n_params,); 'noise' first."""
    texts: dict
    """Cause -> assumption."""

    @property
    def total(self) -> np.ndarray:
        """All causes together, shape (n_params,)."""
        return np.sqrt(sum(part**2 for part in self.causes.values()))


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationResult(ABC):
    """
    A calibration with the data for a report: on a table a `TableResult`, by hand a `HandResult`.
    """

    calibration: Calibration
    """The document's content."""
    gathered: SessionData
    """Windows, counts, kept samples."""
    tolerances: np.ndarray
    """Tolerance of each parameter."""
    needed: dict[str, tuple[str, float]]
    """
    Parameter that is not determined -> (the motion that would serve it best, its sd after a minute
    of that motion, NaN when unknown).
    """
    options: CalibrationOptions = CalibrationOptions()
    """Options of the requested model."""
    reference: str
    """Short description of the reference of the sensor."""
    gravity: float
    """Gravity of the reference, m/s^2."""
    period: float
    """Sampling period, s."""

    observations: ClassVar[str]
    """Unit of the data: 'windows' or 'poses'."""

    @property
    def verdict(self) -> Verdict:
        """The decision per sensor with all statements."""
        assert self.calibration.judgement is not None, (
            'a result is made of a calibration that was judged'
        )
        return self.calibration.judgement

    @property
    def singular_values(self) -> np.ndarray:
        """
        Singular values of the design in units of the tolerances, descending.

        None by hand, where directions are estimated too.
        """
        return np.zeros(0)

    @abstractmethod
    def window_errors(self) -> WindowErrors:
        """Return the errors of window means before and after."""

    @abstractmethod
    def residuals_of(self, window: Window) -> dict[str, np.ndarray]:
        """Return sensor -> measured minus predicted of a window that was kept, shape (n, 3)."""

    @abstractmethod
    def error_budget(self) -> ErrorBudget:
        """Return the standard deviation of each parameter by cause."""


def summary(result: CalibrationResult, hints: dict[str, str] | None = None) -> list[str]:
    """
    Return the lines for the user: decisions, parameters, warnings, notes and next steps.

    `hints` as for `errors.with_hint`.
    """
    hint = usage(result.calibration)
    return [*result.verdict.lines(hints), *[hint] * bool(hint)]
