"""What the errors become in navigation: dead reckoning from the windows of this recording, before and after calibration."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.compensation import compensate
from imu_calibration.navigation import strapdown
from imu_calibration.observability import _attitudes
from imu_calibration.reference import Reference, lever_matrix
from imu_calibration.report.figures import AFTER, BEFORE, draw
from imu_calibration.report.numbers import text
from imu_calibration.turntable import reference_motion

SECONDS = 50.0
"""Length of the runs at rest, the papers' own."""
STEPS = 101
MOST_POSES = 60
SHORTEST = 5.0
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

    def last(self):
        """Return the medians at the end: velocity (m/s), position (m)."""
        return float(np.median(self.velocity[:, -1])), float(np.median(self.position[:, -1]))


def navigation_section(result, errors):
    """Return figures and end values of dead reckoning at rest and in motion."""
    at_rest, moving = rest_growth(result, errors), motion_growth(result)
    return {'rest': _shown('rest', at_rest) if at_rest else None, 'moving': _shown('moving', moving) if moving else None}


def _shown(name, pair):
    before, after = pair
    (velocity_before, position_before), (velocity_after, position_after) = before.last(), after.last()
    return {'figure': draw(f'growth-{name}', (8.6, 2.9), _Growths(before, after), 'Growth of velocity and position errors, before and after calibration'),
            'seconds': text(before.time[-1]), 'runs': len(before.velocity), 'velocity': (text(velocity_before), text(velocity_after)),
            'position': (text(position_before), text(position_after)), 'gain': text(position_before / position_after, 2) if position_after > 0 else '–'}


def rest_growth(result, errors):
    """
    Return (before, after) Growth of runs of 50 s at rest, one per pose of the recording; None without poses.

    Each run starts from the true attitude and feels the mean error that its window showed, as a constant.
    """
    static = np.flatnonzero(errors.kind == 'static')[:MOST_POSES]
    if not len(static):
        return None
    time = np.linspace(0.0, SECONDS, STEPS)
    growths = []
    for which in (errors.before, errors.after):
        runs = [_rest_run(time, errors.true['accelerometer'][k], which['accelerometer'][k], which['gyroscope'][k]) for k in static]
        growths.append(_growth(time, runs))
    return tuple(growths)


def _rest_run(time, force, force_error, rate_error):
    gravity = float(np.linalg.norm(force))
    attitude = _attitudes(force[None] / gravity)[0].T
    count = len(time)
    return strapdown(time, np.tile(force + force_error, (count, 1)), np.tile(rate_error, (count, 1)), gravity, attitude)


def _growth(time, runs):
    return Growth(time, np.array([np.linalg.norm(run.velocity_n, axis=1) for run in runs]), np.array([np.linalg.norm(run.position_n, axis=1) for run in runs]))


def motion_growth(result):
    """
    Return (before, after) Growth over the moving stretches of the recording, each from rest at the true attitude, or None.

    The truth is that of the table, carried to the origin that the calibration compensates to. Noise is included.
    """
    if result.table is None:
        return None
    windows = [w for w in result.gathered.kept if w.time[-1] - w.time[0] >= SHORTEST][:MOST_POSES]
    if not windows:
        return None
    length = min(w.time[-1] - w.time[0] for w in windows)
    pairs = [_moving_runs(result, window, length) for window in windows]
    grid = np.linspace(0.0, length, STEPS)
    return tuple(Growth(grid, *(np.array([getattr(pair[k], name) for pair in pairs]) for name in ('velocity', 'position'))) for k in range(2))


def _moving_runs(result, window, length):
    """Return the Growth of one stretch, raw and corrected."""
    some = slice(0, int(np.searchsorted(window.time, window.time[0] + length, 'right')))
    time, motion = window.time[some], window.motion.select(some)
    truth = _at_origin(result.calibration, reference_motion(result.table, motion))
    temperature = np.full(len(time), result.calibration.model.temperature_ref_c) if window.temperature_c is None else window.temperature_c[some]
    corrected = compensate(result.calibration, window.force_s[some], window.rate_s[some], truth.alpha_s, temperature)
    grid, start = np.linspace(0.0, length, STEPS), truth.mat_sn[0].T
    true = strapdown(time, truth.force_s, truth.rate_s, truth.gravity, start)
    growths = []
    for force, rate in ((window.force_s[some], window.rate_s[some]), (corrected.force, corrected.rate)):
        run = strapdown(time, force, rate, truth.gravity, start)
        errors = [np.linalg.norm(getattr(run, name) - getattr(true, name), axis=1) for name in ('velocity_n', 'position_n')]
        growths.append(Growth(grid, *(np.interp(grid, time - time[0], error) for error in errors)))
    return growths


def _at_origin(calibration, ref):
    """Return the reference at the origin of the calibration's arms, which the common lever arm leads to."""
    if not calibration.has('accelerometer', 'lever_arm'):
        return ref
    force = ref.force_s + lever_matrix(ref.rate_s, ref.alpha_s) @ calibration.value('accelerometer', 'lever_arm')
    return Reference(ref.time, ref.mat_sn, force, ref.rate_s, ref.alpha_s, ref.gravity)


class _Growths:
    """Velocity and position, each with median and the range of the runs."""

    def __init__(self, before, after):
        self.pair = (before, after)

    def __call__(self, figure):
        for axes, name, unit in zip(figure.subplots(1, 2), ('velocity', 'position'), ('m/s', 'm')):
            for growth, colour, label in zip(self.pair, (BEFORE, AFTER), ('before', 'after')):
                values = np.maximum(getattr(growth, name)[:, 1:], 1e-12)
                low, middle, high = np.quantile(values, (0.1, 0.5, 0.9), axis=0)
                axes.fill_between(growth.time[1:], low, high, color=colour, alpha=0.16, lw=0)
                axes.plot(growth.time[1:], middle, color=colour, label=label)
            axes.set_yscale('log')
            axes.set_title(f'{name} error, {unit}')
            axes.set_xlabel('time, s')
            axes.set_xlim(0, self.pair[0].time[-1])
        figure.axes[0].legend(loc='lower right')
