"""Windows of a calibration on a table: all that a calibration needs of its reference."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from imu_calibration.calibration.from_solution import noise_entry
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import (
    CalibrationResult,
    ErrorBudget,
    Needs,
    WindowErrors,
)
from imu_calibration.document.reference_texts import MOUNT_AXES
from imu_calibration.document.statistics import AttitudeScatter, RecordingStatistics
from imu_calibration.document.trust import Uncorrected, latest_settling
from imu_calibration.effects.base import Role
from imu_calibration.effects.forward_equations import coefficients
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.prior import make_prior
from imu_calibration.estimation.solution import GRAVITY, Solution, common_scale, with_term
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.recording_evidence import CheckFinding, with_findings_of
from imu_calibration.preprocessing.window import Window
from imu_calibration.preprocessing.window_cutter import dropped
from imu_calibration.references.turntable import latitude_check, mount_check
from imu_calibration.references.turntable.error_budget_of_windows import error_budget
from imu_calibration.references.turntable.held_out_windows import HeldOutWindows, nominal_values
from imu_calibration.references.turntable.needs import motions_needed, weak_on_table
from imu_calibration.references.turntable.noise_model import noise_of_windows
from imu_calibration.references.turntable.observability import tolerance_scaled_singular_values
from imu_calibration.references.turntable.residuals.residual_analysis import ResidualAnalysis
from imu_calibration.references.turntable.residuals.residual_blocks import residuals
from imu_calibration.references.turntable.session_data import HeldOut, HeldOutBlock, SessionData
from imu_calibration.references.turntable.uncorrected_windows import uncorrected_on_table
from imu_calibration.references.turntable.window_search import search_windows

TableResult = CalibrationResult[Solution]
"""A calibration on a table."""


@dataclass(frozen=True, eq=False)
class WindowObservations:
    """Windows of recordings on a table, reduced with the columns of a model."""

    table: Table
    """The reference."""
    gathered: SessionData
    """The windows, conditions and counts."""
    model: SensorModel
    """The model of the gathered columns; the solved one may have fewer effects."""

    unit: ClassVar[str] = 'windows'
    """Name of an observation in the plural."""
    tested: ClassVar[tuple[str, ...]] = ()

    @property
    def reference(self) -> str:
        """Short description of the table."""
        table = self.table
        return f'table with {len(table.joints)} joints ({", ".join(table.joint_names)})'

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without usable readings."""
        return self.gathered.absent

    @property
    def gravity(self) -> float:
        """Gravity at the table, m/s^2."""
        return self.table.gravity_value

    @property
    def period(self) -> float:
        """Sampling period, s."""
        rows = self.gathered.accumulator.rows
        return float(np.median([row.duration / max(row.count - 1, 1) for row in rows]))

    def gauge(self, solution: Solution) -> dict[str, Any]:
        """Return the conventions of origin and axes."""
        # The gauge of the prior fixes the mean of the sensitive points where it is estimated.
        is_mean = len(make_prior(solution.model).gauge) > 0
        gauge: dict[str, Any] = {
            'origin': 'mean_of_sensitive_points' if is_mean else 'mount',
            'axes': MOUNT_AXES,
        }
        joint_names = solution.model.joint_names
        if joint_names.angle_sd is not None:
            gauge['zeros_as_described'] = list(joint_names.taken_as_described)
        return gauge

    def findings(self, solution: Solution) -> tuple[CheckFinding, ...]:
        """
        Return the findings of the recordings, of the mount and of the latitude.

        Raises
        ------
        InputError
            When the latitude has the wrong sign.

        """
        mounted = with_findings_of(
            mount_check.MOUNT_CHECK,
            mount_check.mount_findings(solution, self.table),
            self.gathered.findings,
        )
        if 'gyroscope' in self.absent:
            return mounted
        windows = None
        if not self.absent:
            windows = latitude_check.window_rates(self.gathered, self.model, self.table)
        return with_findings_of(
            latitude_check.LATITUDE_CHECK,
            latitude_check.latitude_findings(solution, self.table, windows),
            mounted,
        )

    def with_reference_errors(self, solution: Solution) -> Solution:
        """Return the solution with the uncertainty of gravity in its covariance."""
        table = self.table
        # A relative error of gravity shifts the parameters along the common scale.
        scale = common_scale(solution.model, solution.values)
        moved = scale * table.gravity_sd_value / table.gravity_value
        terms = with_term(solution.terms, GRAVITY, np.outer(moved, moved))
        return replace(solution, terms=terms)

    def searches(
        self, solution: Solution, options: CalibrationOptions
    ) -> Iterator[ResidualAnalysis]:
        """Yield the search of effects in each recording with enough windows."""
        return search_windows(self.gathered, self.table, solution.model, options=options)

    def held_out(self, solution: Solution) -> HeldOutWindows:
        """Return the windows in folds, with the parameters of a solution without each fold."""
        windows = self.gathered.held_out.restricted(self.model, solution.model)
        return HeldOutWindows.of(windows, solution, self.uncorrected(solution).centre)

    def uncorrected(self, solution: Solution) -> Uncorrected:
        """Return the errors that compensation does not correct."""
        values = solution.values
        return uncorrected_on_table(
            solution.model.at(values),
            values,
            self.gathered.accumulator,
            gathered=self.model,
            latest=latest_settling(solution.model, values, solution.sd),
        )

    def statistics(self, solution: Solution) -> RecordingStatistics:
        """Return the statistics of windows, noise and residuals, and the common turn."""
        sensors = {}
        for sensor, noise in noise_of_windows(solution).items():
            attitude = None
            if sensor in solution.attitude:
                dependence = solution.attitude[sensor]
                attitude = AttitudeScatter(
                    variance_ratio=dependence.ratio, p_value=dependence.p_value
                )
            has_biases = sensor in solution.session_biases
            moving, of_means = solution.residual_rms[sensor]
            sensors[sensor] = replace(
                noise_entry(noise),
                low_frequency_factor=noise.inflation,
                wander_time_s=float('nan') if noise.bias_time is None else noise.bias_time,
                residual_rms_moving=moving,
                residual_rms_window_means=of_means,
                chi2_per_dof=solution.chi2_per_dof[sensor],
                slow_over_fast=solution.slow_over_fast.get(sensor, {}),
                attitude=attitude,
                between_recordings_sd=noise.session_sd if has_biases else None,
                bias_of_recordings=solution.session_biases.get(sensor),
                left_out_s=[time for _, time in sorted(noise.left_out)] or None,
            )
        gathered = self.gathered
        lost = dropped(gathered.counts)
        return RecordingStatistics(
            sensors=sensors,
            not_believed=solution.not_believed or None,
            windows=dict(sorted(gathered.accumulator.windows.items())),
            samples_used=dict(sorted(gathered.accumulator.samples.items())),
            dropped=lost,
            stream={key: n for key, n in sorted(gathered.counts.items()) if key not in lost},
            common_turn_deg=mount_check.common_turn_deg(solution),
            unusable_sensors=gathered.unusable or None,
        )

    def needs(
        self, solution: Solution, tolerances: np.ndarray, *, quality: dict[str, Any]
    ) -> Needs:
        """Return the needs of a solution, see `Observations.needs`."""
        motions = motions_needed(solution, tolerances, self.table, quality=quality)
        return Needs(motions, weak_on_table(solution, tolerances, motions))

    def singular_values(self, result: TableResult) -> np.ndarray:
        """
        Return the singular values of the design in units of the tolerances.

        Directions that the gauge fixes by convention are left out.
        """
        prior = make_prior(result.solution.model)
        # The rows of the prior after one row for each parameter are those of the gauge, which are
        # so precise that its directions have the largest singular values, and of sums.
        conventions = prior.root[len(result.tolerances) :]
        values = tolerance_scaled_singular_values(
            result.solution.information + conventions.T @ conventions, result.tolerances
        )
        return values[len(prior.gauge) :]

    def window_errors(self, result: TableResult) -> WindowErrors:
        """
        Return the errors of window means against the table, with two sets of parameters.

        Before: nominal parameters. After: estimated without the fold of the window.
        """
        # Parameters without each fold of windows. Where no windows are held out, all of them are
        # one block with the parameters of the solution.
        solution = result.solution
        model = solution.model
        held_out = self.gathered.held_out
        if not held_out.n_windows:
            held_out = HeldOut([HeldOutBlock(self.gathered.accumulator)])
        held_out = held_out.restricted(self.model, model)
        folds = [solution.values]
        if len(held_out.blocks) > 1:
            folds = held_out.values_without(solution)

        # The windows of all blocks, and the fold of each window.
        rows = []
        fold = []
        for number, block in enumerate(held_out.blocks):
            for row in block.accumulator.rows:
                rows.append(row)
                fold.append(number % len(folds))

        # Errors of each sensor.
        count = np.array([row.count for row in rows], float)
        errors = WindowErrors(
            time=np.array([row.time for row in rows]),
            kind=np.array([row.kind for row in rows]),
            measured={},
            true={},
            before={},
            after={},
            floor={},
        )
        for sensor, noise in solution.noise.items():
            means = np.array([row.sensors[sensor].mean for row in rows])
            columns_of_means = means[:, :-3]
            output = means[:, -3:]
            errors.measured[sensor] = output
            errors.true[sensor] = means[:, model.columns_of(sensor, Role.LINEAR)]
            nominal = coefficients(model, sensor, nominal_values(model))
            errors.before[sensor] = output - columns_of_means @ nominal

            # Corrected: matrix^-1 (output - columns @ coefficients), with the coefficients of the
            # fold of each window, shape (n, n_columns, 3).
            after = np.array([coefficients(model, sensor, values) for values in folds])[fold]
            residual = output - np.einsum('ni,nij->nj', columns_of_means, after)
            matrix = result.calibration.of(sensor, Role.LINEAR)
            errors.after[sensor] = residual @ np.linalg.inv(matrix).T
            errors.floor[sensor] = np.sqrt(
                noise.low_variance / count[:, None] + noise.offset_sd**2 + noise.bias_variance
            )
        return errors

    def residuals_of(self, result: TableResult, window: Window) -> dict[str, np.ndarray]:
        """Return sensor -> measured minus predicted samples of a window, shape (n, 3)."""
        solution = result.solution
        return residuals([window], self.table, solution.model, values=solution.values)

    def error_budget(self, result: TableResult) -> ErrorBudget:
        """Return the contributions of the noise and of the table."""
        return error_budget(self.table, self.gathered, result.solution)
