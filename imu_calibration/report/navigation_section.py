"""
Effect of the errors in navigation.

Dead reckoning from the windows of this recording, before and after calibration.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.calibration.result import CalibrationResult, WindowErrors
from imu_calibration.compensation.compensate import compensated_samples
from imu_calibration.compensation.covariance import Uncertainty
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import Role
from imu_calibration.kinematics.chain import reference_motion
from imu_calibration.kinematics.rotations import Reference, attitudes_with_vertical, lever_matrix
from imu_calibration.kinematics.strapdown import dead_reckoning_errors, strapdown
from imu_calibration.preprocessing.window import Window
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
    rest = None
    before = rest_growth(errors)
    if before is not None:
        rest = _content('rest', before, *expected_growth(result, errors))
    moving = motion_growth(result)
    if moving is not None:
        moving = _content('moving', *moving, {})
    return {'rest': rest, 'moving': moving}


def _content(name: str, before: Growth, after: Growth, parts: dict[str, Growth]) -> dict[str, Any]:
    """
    Return the content of the page for runs at rest or in motion (`name`).

    The figure, and the (velocity, position) errors at the end: before and after calibration, and of
    each part of the expected error, if there are `parts`.
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

    Each run starts from the true attitude, with constant readings: the true ones and the mean
    errors of its window.
    """
    static = np.flatnonzero(errors.kind == 'static')[:MAX_RUNS]
    if not len(static):
        return None
    time = np.linspace(0.0, REST_RUN_SECONDS, RUN_INSTANTS)
    velocities = []
    positions = []
    for k in static:
        force = errors.true['accelerometer'][k]
        gravity = float(np.linalg.norm(force))
        velocity, position = strapdown(
            time,
            np.tile(force + errors.before['accelerometer'][k], (len(time), 1)),
            np.tile(errors.before['gyroscope'][k], (len(time), 1)),
            gravity=gravity,
            mat_ns0=attitudes_with_vertical(force[None] / gravity)[0].T,
        )
        velocities.append(np.linalg.norm(velocity, axis=-1))
        positions.append(np.linalg.norm(position, axis=-1))
    return Growth(time, np.array(velocities), np.array(positions))


def expected_growth(
    result: CalibrationResult, errors: WindowErrors
) -> tuple[Growth, dict[str, Growth]]:
    """
    Return the expected Growth (rms) at rest after calibration, and its parts by their label.

    The parts are errors of the parameters, instability of the biases and noise. They are predicted,
    because the mean of a short window has more noise than error of the calibration::

                                            velocity              position
        constant force error d              d t                   d t^2 / 2
        constant horizontal rate error w    g w t^2 / 2           g w t^3 / 6
        white force noise of density N      N t^(1/2)             N t^(3/2) / 3^(1/2)
        white rate noise of density N       g N t^(3/2) / 3^(1/2) g N t^(5/2) / 20^(1/2)

    With all axes: three of the force, two horizontal ones of the rate.
    """
    static = np.flatnonzero(errors.kind == 'static')[:MAX_RUNS]
    time = np.linspace(0.0, REST_RUN_SECONDS, RUN_INSTANTS)
    # Variances of constant errors, (n_runs, 2): of the parameters, different in each pose, and of
    # the biases.
    forces = errors.true['accelerometer'][static]
    gravity = float(np.median(np.linalg.norm(forces, axis=1)))
    uncertainty = Uncertainty(result.calibration)
    constants = np.array([_constant_variances(uncertainty, force) for force in forces])
    force_sd = float(np.max(result.calibration.noise('accelerometer')[1]))
    rate_sd = float(np.max(result.calibration.noise('gyroscope')[1]))
    instabilities = np.tile([3 * force_sd**2, 2 * rate_sd**2], (len(static), 1))
    parts = {
        'parameters': _constant_growth(time, constants, gravity),
        'instability of the biases': _constant_growth(time, instabilities, gravity),
        'noise': _noise_growth(time, noise_densities(result), gravity),
    }
    velocity_variance = sum(part.velocity**2 for part in parts.values())
    position_variance = sum(part.position**2 for part in parts.values())
    expected = Growth(
        time, velocity=np.sqrt(velocity_variance), position=np.sqrt(position_variance)
    )
    return expected, parts


def _constant_variances(uncertainty: Uncertainty, force: np.ndarray) -> tuple[float, float]:
    """
    Return the variances of force and rate errors from the parameters, at rest with a force, (3,).

    Of the force the sum over its axes, of the rate the sum over the horizontal axes.
    """
    covariance = uncertainty.at(force).parameters
    rate_cov = covariance[3:, 3:]
    up = force / np.linalg.norm(force)
    return np.trace(covariance[:3, :3]), np.trace(rate_cov) - up @ rate_cov @ up


def _constant_growth(time: np.ndarray, variances: np.ndarray, gravity: float) -> Growth:
    """
    Return the Growth of constant errors (`expected_growth`), one run per row of `variances`.

    `variances`: of the errors of force and horizontal rate, shape (n_runs, 2).
    """
    force, rate = np.sqrt(np.maximum(variances, 0)).T[:, :, None]
    return Growth(
        time,
        velocity=np.hypot(force * time, gravity * rate * time**2 / 2),
        position=np.hypot(force * time**2 / 2, gravity * rate * time**3 / 6),
    )


def _noise_growth(time: np.ndarray, densities: list[float], gravity: float) -> Growth:
    """
    Return the Growth of white noise (`expected_growth`) as one run.

    `densities`: of each axis, accelerometer and gyroscope (`noise_densities`).
    """
    force, rate = densities
    force *= np.sqrt(3)
    rate *= np.sqrt(2)
    velocity = np.hypot(force * time**0.5, gravity * rate * time**1.5 / np.sqrt(3))
    position = np.hypot(force * time**1.5 / np.sqrt(3), gravity * rate * time**2.5 / np.sqrt(20))
    return Growth(time, velocity[None], position[None])


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
    windows = [w for w in result.gathered.kept if w.time[-1] - w.time[0] >= MIN_DRAWN_SECONDS]
    windows = windows[:MAX_RUNS]
    if not windows:
        return None
    length = min(w.time[-1] - w.time[0] for w in windows)
    pairs = [_moving_runs(result, window, length) for window in windows]
    before = _joined_growth([raw for raw, _ in pairs])
    after = _joined_growth([corrected for _, corrected in pairs])
    return before, after


def _joined_growth(runs: list[Growth]) -> Growth:
    """Return the Growth of several runs of one size (n,) on one grid of times."""
    velocity = np.array([run.velocity for run in runs])
    return Growth(runs[0].time, velocity, np.array([run.position for run in runs]))


def _moving_runs(result: Any, window: Window, length: float) -> list[Growth]:
    """Return the Growth, shapes (n,), in the first `length` s of a window: raw, then corrected."""
    stretch = slice(0, int(np.searchsorted(window.time, window.time[0] + length, 'right')))
    time = window.time[stretch]
    force_s = window.force_s[stretch]
    rate_s = window.rate_s[stretch]
    motion = window.motion.select(stretch)
    truth = _at_origin(result.calibration, reference_motion(result.data.table, motion))
    if window.temperature_c is None:
        temperature_c = np.full(len(time), result.calibration.model.temperature_ref_c)
    else:
        temperature_c = window.temperature_c[stretch]
    corrected = compensated_samples(
        result.calibration,
        force_s,
        rate_s,
        alpha_s=truth.alpha_s,
        temperature_c=temperature_c,
    )
    grid = np.linspace(0.0, length, RUN_INSTANTS)
    growths = []
    for force, rate in ((force_s, rate_s), (corrected.force, corrected.rate)):
        sizes = []
        for error in dead_reckoning_errors(truth, force, rate):  # of velocity and position
            sizes.append(np.interp(grid, time - time[0], np.linalg.norm(error, axis=1)))
        growths.append(Growth(grid, *sizes))
    return growths


def _at_origin(calibration: Calibration, ref: Reference) -> Reference:
    """Return the reference at the origin of the accelerometers, by their common lever arm."""
    arm = calibration.of('accelerometer', Role.ARM)
    if arm is None:
        return ref
    force = ref.force_s + lever_matrix(ref.rate_s, ref.alpha_s) @ arm
    return replace(ref, force_s=force)


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
