"""
Effect of the errors in navigation.

Dead reckoning from the windows of this recording, before and after calibration.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.calibration.result import CalibrationResult, WindowErrors
from imu_calibration.compensation.compensate import compensated_samples
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.effects.base import Role
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.rotations import Reference, attitudes_with_vertical, lever_matrix
from imu_calibration.kinematics.strapdown import dead_reckoning_errors, strapdown
from imu_calibration.report.figures import AFTER, BEFORE, GREY, draw, log_axis

REST_RUN_SECONDS = 50.0
"""Length of the runs at rest, the papers' own."""
RUN_INSTANTS = 101
MAX_RUNS = 60
MIN_DRAWN_SECONDS = 5.0
"""Moving stretches shorter than this are not drawn, s."""


@dataclass(frozen=True, eq=False)
class Growth:
    """Error growth of several runs on one time grid."""

    time: np.ndarray
    """s, shape (n,)."""
    velocity: np.ndarray
    """Size of the velocity error, m/s, shape (n_runs, n)."""
    position: np.ndarray
    """Size of the position error, m, shape (n_runs, n)."""

    def last(self) -> tuple[float, float]:
        """Return the medians at the end: velocity (m/s), position (m)."""
        return float(np.median(self.velocity[:, -1])), float(np.median(self.position[:, -1]))


def navigation_section(result: CalibrationResult, errors: WindowErrors) -> dict[str, Any]:
    """Return figures and end values of dead reckoning at rest and in motion, None without it."""
    if result.calibration.absent:  # it needs both sensors
        return {'rest': None, 'moving': None}
    before = rest_growth(errors)
    moving = motion_growth(result)
    return {
        'rest': (
            None if before is None else _shown('rest', before, *expected_growth(result, errors))
        ),
        'moving': None if moving is None else _shown('moving', *moving, {}),
    }


def _shown(name, before, after, parts):
    """
    Return the figure, and (velocity, position) at the end by part of the error.

    The pairs are given before, after and of each part of the error.
    """
    return {
        'figure': draw(
            f'growth-{name}',
            (8.6, 2.9),
            _growths,
            before,
            after,
            parts,
            label='Growth of velocity and position errors, before and after calibration',
        ),
        'seconds': before.time[-1],
        'runs': len(before.velocity),
        'before': before.last(),
        'after': after.last(),
        'parts': {label: part.last() for label, part in parts.items()},
    }


def rest_growth(errors: WindowErrors) -> Growth | None:
    """
    Return the Growth of uncalibrated runs of 50 s at rest, one per pose of the recording.

    None without poses.

    Each run starts from the true attitude and feels the mean error that its window showed, as a
    constant.
    """
    static = np.flatnonzero(errors.kind == 'static')[:MAX_RUNS]
    if not len(static):
        return None
    time = np.linspace(0.0, REST_RUN_SECONDS, RUN_INSTANTS)
    runs = []
    for force, force_error, rate_error in zip(
        *(
            part[static]
            for part in (
                errors.true['accelerometer'],
                errors.before['accelerometer'],
                errors.before['gyroscope'],
            )
        )
    ):
        gravity = float(np.linalg.norm(force))
        readings = (
            np.tile(reading, (len(time), 1)) for reading in (force + force_error, rate_error)
        )
        runs.append(
            strapdown(
                time,
                *readings,
                gravity=gravity,
                mat_ns0=attitudes_with_vertical(force[None] / gravity)[0].T,
            )
        )
    return Growth(time, *(np.linalg.norm(run, axis=-1) for run in zip(*runs)))


def expected_growth(
    result: CalibrationResult, errors: WindowErrors
) -> tuple[Growth, dict[str, Growth]]:
    """
    Return the expected Growth (rms) at rest after calibration, and its parts.

    Parameters, instability, noise.

    The mean of a short window shows its noise more than the calibration's errors, so that the
    errors are predicted: a constant error d of the specific force gives ``d t``, ``d t^2 / 2``, one
    w of the rate across the vertical ``g w t^2 / 2``, ``g w t^3 / 6``; white noise of density N
    gives ``N t^(1/2)``, ``N t^(3/2) / 3^(1/2)`` and ``g N t^(3/2) / 3^(1/2)``, ``g N t^(5/2) /
    20^(1/2)``.
    """
    static = np.flatnonzero(errors.kind == 'static')[:MAX_RUNS]
    time = np.linspace(0.0, REST_RUN_SECONDS, RUN_INSTANTS)
    forces = errors.true['accelerometer'][static]
    gravity = float(np.median(np.linalg.norm(forces, axis=1)))
    uncertainty = Uncertainty(result.calibration)
    constants = np.array([_constant_variances(uncertainty, force) for force in forces])
    scatter = [
        float(np.max(result.calibration.noise(sensor)[1]))
        for sensor in ('accelerometer', 'gyroscope')
    ]
    unstable = np.tile([3 * scatter[0] ** 2, 2 * scatter[1] ** 2], (len(static), 1))
    density = [d * np.sqrt(n) for d, n in zip(noise_densities(result), (3, 2))]
    parts = {
        'parameters': _constant_growth(time, constants, gravity),
        'instability of the biases': _constant_growth(time, unstable, gravity),
        'noise': Growth(
            time,
            np.hypot(density[0] * time**0.5, gravity * density[1] * time**1.5 / np.sqrt(3))[None],
            np.hypot(
                density[0] * time**1.5 / np.sqrt(3), gravity * density[1] * time**2.5 / np.sqrt(20)
            )[None],
        ),
    }
    velocity_variance = sum(part.velocity**2 for part in parts.values())
    position_variance = sum(part.position**2 for part in parts.values())
    return Growth(time, np.sqrt(velocity_variance), np.sqrt(position_variance)), parts


def _constant_variances(uncertainty, force):
    """
    Return the variances of the errors of specific force and rate from the parameters.

    The variance of the specific-force error covers all axes, and the variance of the rate error is
    across the vertical.
    """
    covariance = uncertainty.at(force).parameters
    up = force / np.linalg.norm(force)
    return np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:]) - up @ covariance[3:, 3:] @ up


def _constant_growth(time, variances, gravity):
    force, rate = np.sqrt(np.maximum(variances, 0)).T[:, :, None]
    return Growth(
        time,
        np.hypot(force * time, gravity * rate * time**2 / 2),
        np.hypot(force * time**2 / 2, gravity * rate * time**3 / 6),
    )


def noise_densities(result: CalibrationResult) -> list[float]:
    """
    Return the densities of accelerometer and gyroscope noise at low frequency.

    The units are m/s^2/sqrt(Hz) and rad/s/sqrt(Hz).
    """
    densities = []
    for sensor in ('accelerometer', 'gyroscope'):
        statistics = result.calibration.statistics[sensor]
        # density^2 = variance of a sample * period, with the variance at low frequency.
        factor = np.asarray(statistics.get('low_frequency_factor', 1.0))
        variance = np.mean(np.square(statistics['noise_sd']) * factor)
        densities.append(float(np.sqrt(variance * result.period)))
    return densities


def motion_growth(result: CalibrationResult) -> tuple[Growth, Growth] | None:
    """
    Return (before, after) Growth over the moving stretches of the recording, or None.

    Each stretch starts from rest at the true attitude.

    The truth is that of the table, carried to the origin that the calibration compensates to. Noise
    is included.
    """
    windows = [w for w in result.gathered.kept if w.time[-1] - w.time[0] >= MIN_DRAWN_SECONDS][
        :MAX_RUNS
    ]
    if not windows:
        return None
    length = min(w.time[-1] - w.time[0] for w in windows)
    pairs = [_moving_runs(result, window, length) for window in windows]
    grid = np.linspace(0.0, length, RUN_INSTANTS)
    before = _joined_growth(grid, [raw for raw, _ in pairs])
    after = _joined_growth(grid, [corrected for _, corrected in pairs])
    return before, after


def _joined_growth(time, runs):
    """Return the Growth of several stretches on one grid of times, s."""
    return Growth(
        time, np.array([run.velocity for run in runs]), np.array([run.position for run in runs])
    )


def _moving_runs(result, window, length):
    """Return the Growth of one stretch, raw and corrected."""
    some = slice(0, int(np.searchsorted(window.time, window.time[0] + length, 'right')))
    time = window.time[some]
    motion = window.motion.select(some)
    truth = _at_origin(result.calibration, reference_motion(result.data.table, motion))
    reference_c = result.calibration.model.temperature_ref_c
    temperature = (
        np.full(len(time), reference_c)
        if window.temperature_c is None
        else window.temperature_c[some]
    )
    corrected = compensated_samples(
        result.calibration,
        window.force_s[some],
        window.rate_s[some],
        alpha_s=truth.alpha_s,
        temperature_c=temperature,
    )
    grid = np.linspace(0.0, length, RUN_INSTANTS)
    growths = []
    for force, rate in (
        (window.force_s[some], window.rate_s[some]),
        (corrected.force, corrected.rate),
    ):
        errors = dead_reckoning_errors(truth, force, rate)
        growths.append(
            Growth(
                grid,
                *(
                    np.interp(grid, time - time[0], np.linalg.norm(error, axis=1))
                    for error in errors
                ),
            )
        )
    return growths


def _at_origin(calibration, ref):
    """
    Return the reference at the origin of the calibration's arms.

    The common lever arm leads to this origin.
    """
    arm = calibration.of('accelerometer', Role.ARM)
    if arm is None:
        return ref
    force = ref.force_s + lever_matrix(ref.rate_s, ref.alpha_s) @ arm
    return Reference(ref.time, ref.mat_sn, force, ref.rate_s, ref.alpha_s, ref.gravity)


def _growths(figure, before, after, parts):
    """
    Velocity and position, each with median and the range of the runs.

    Parts of the expected error as thin lines.
    """
    for axes, name, unit in zip(figure.subplots(1, 2), ('velocity', 'position'), ('m/s', 'm')):
        for growth, colour, label in zip((before, after), (BEFORE, AFTER), ('before', 'after')):
            low, middle, high = np.quantile(
                np.maximum(getattr(growth, name)[:, 1:], 1e-12), (0.1, 0.5, 0.9), axis=0
            )
            axes.fill_between(growth.time[1:], low, high, color=colour, alpha=0.16, lw=0)
            axes.plot(growth.time[1:], middle, color=colour, label=label)
        for (label, part), dash in zip(parts.items(), ('-', '--', ':')):
            values = np.median(getattr(part, name)[:, 1:], axis=0)
            if values[-1] > 0:
                axes.plot(part.time[1:], values, color=GREY, lw=1.0, ls=dash, label=label)
        log_axis(axes.yaxis)
        axes.set(title=f'{name} error, {unit}', xlabel='time, s', xlim=(0, before.time[-1]))
    figure.axes[0].legend(loc='lower right', fontsize=8)
