"""The result of a calibration on a table."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from imu_calibration.calibration.error_budget import ErrorBudget, ReferenceErrors, error_budget
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.window_errors import WindowErrors, window_residuals
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import predict
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.observability import tolerance_scaled_singular_values
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import Solution
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window import Window


@dataclass(frozen=True, eq=False, kw_only=True)
class TableResult(CalibrationResult):
    """A calibration on a table with the data for a report."""

    solution: Solution
    """Parameters with noise and residuals."""
    table: Table
    """The reference."""
    model: SensorModel
    """The model that was solved."""
    gathered_model: SensorModel
    """The model of the gathered columns; it may have more effects."""

    observations: ClassVar[str] = 'windows'

    @property
    def reference(self) -> str:
        """The joints of the table."""
        return f'table with {len(self.table.joints)} joints ({", ".join(self.table.joint_names)})'

    @property
    def gravity(self) -> float:
        """Gravity of the table, m/s^2."""
        return self.table.gravity_value

    @property
    def period(self) -> float:
        """Median sampling period of the windows, s."""
        return float(np.median([row.duration / max(row.count - 1, 1) for row in self.gathered.accumulator.rows]))

    @property
    def singular_values(self) -> np.ndarray:
        """Singular values of the design in units of the tolerances; directions that the gauge fixes by convention are left out."""
        convention = make_prior(self.solution.model).root[len(self.tolerances):]
        values = tolerance_scaled_singular_values(self.solution.information + convention.T @ convention, self.tolerances)
        return values[len(convention):]

    def first_rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean specific force and rate of the first window, each shape (3,)."""
        row = self.gathered.accumulator.rows[0]
        return row.sensors['accelerometer'].mean[-3:], row.sensors['gyroscope'].mean[-3:]

    def window_errors(self) -> WindowErrors:
        """Return the errors of window means before and after, against the table."""
        found, rows = window_residuals(self), self.gathered.accumulator.rows
        kind, count = np.array(found['kind']), np.array(found['count'], float)
        parts = {name: {} for name in ('measured', 'true', 'before', 'after', 'floor')}
        for sensor in SENSORS:
            true = np.array([row.sensors[sensor].mean[self.gathered_model.columns_of(sensor, Role.LINEAR)] for row in rows])
            noise = self.solution.noise[sensor]
            parts['measured'][sensor], parts['true'][sensor] = found[sensor]['measured'], true
            parts['before'][sensor] = found[sensor]['before']
            parts['after'][sensor] = found[sensor]['after'] @ np.linalg.inv(self.calibration.of(sensor, Role.LINEAR)).T
            parts['floor'][sensor] = np.sqrt(noise.low_variance / count[:, None] + noise.offset_sd**2 + noise.bias_variance)
        return WindowErrors(found['time'], kind, **parts)

    def residuals_of(self, window: Window) -> dict[str, np.ndarray]:
        """Return measured values minus those predicted from the motion of the table."""
        predicted = predict(self.solution.model, self.solution.values, self.table, motion=window.motion, temperature_c=window.temperature_c)
        return {sensor: measured - model for sensor, measured,
                model in zip(SENSORS, (window.force_s, window.rate_s), predicted, strict=True)}

    def error_budget(self, errors: ReferenceErrors = ReferenceErrors()) -> ErrorBudget:
        """Return the contributions of the noise and of the table."""
        return error_budget(self, errors)
