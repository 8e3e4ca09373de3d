"""Parts of the document that describe windows on a table: conventions and statistics."""

from dataclasses import replace
from typing import Any

from imu_calibration.calibration.from_solution import noise_entry
from imu_calibration.document.reference_texts import MOUNT_AXES
from imu_calibration.document.statistics import AttitudeScatter, RecordingStatistics
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.preprocessing.window_cutter import dropped
from imu_calibration.references.turntable.mount_check import common_turn_deg
from imu_calibration.references.turntable.noise_model import noise_of_windows
from imu_calibration.references.turntable.session_data import SessionData


def gauge_of(model: SensorModel) -> dict[str, Any]:
    """Return the conventions of origin and axes on a table."""
    both_arms = {effect.role for effect in model.arms} == {Role.ARMS, Role.ARM}
    gauge: dict[str, Any] = {
        'origin': 'mean_of_sensitive_points' if both_arms else 'mount',
        'axes': MOUNT_AXES,
    }
    if model.joint_names.angle_sd is not None:
        gauge['zeros_as_described'] = list(model.joint_names.taken_as_described)
    return gauge


def statistics(solution: Solution, gathered: SessionData) -> RecordingStatistics:
    """Return the statistics of windows: noise, residuals, chi-square, dropped samples."""
    sensors = {}
    for sensor, noise in noise_of_windows(solution).items():
        attitude = None
        if sensor in solution.attitude:
            dependence = solution.attitude[sensor]
            attitude = AttitudeScatter(variance_ratio=dependence.ratio, p_value=dependence.p_value)
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
    accumulator = gathered.accumulator
    lost = dropped(gathered.counts)
    return RecordingStatistics(
        sensors=sensors,
        not_believed=solution.not_believed or None,
        windows=dict(sorted(accumulator.windows.items())),
        samples_used=dict(sorted(accumulator.samples.items())),
        dropped=lost,
        stream={key: n for key, n in sorted(gathered.counts.items()) if key not in lost},
        common_turn_deg=common_turn_deg(solution),
        unusable_sensors=gathered.unusable or None,
    )
