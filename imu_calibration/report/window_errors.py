"""Errors of window means before and after calibration, on a table and by hand: what most of the report is drawn from."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.effects.forward_equations import coefficients
from imu_calibration.estimation.accumulator import restrict


@dataclass(frozen=True, eq=False)
class WindowErrors:
    """One row per window; errors are what the sensor reads beyond the truth, in SI."""

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
    """Sensor -> error of the corrected mean, shape (n, 3)."""
    floor: dict
    """Sensor -> what noise alone leaves in the mean, one sd, shape (n, 3)."""

    def rms(self, sensor, which, kind=None):
        """Return the root mean square error of 'before' or 'after', over windows of one kind or all."""
        errors = getattr(self, which)[sensor][(self.kind == kind) if kind else slice(None)]
        return float(np.sqrt(np.mean(errors**2))) if errors.size else float('nan')


def window_errors(result):
    """Return the WindowErrors of a calibration."""
    return _by_hand(result) if result.table is None else _on_table(result)


def _on_table(result):
    found, calibration, rows = window_residuals(result), result.calibration, result.gathered.accumulator.rows
    kind, count = np.array(found['kind']), np.array(found['count'], float)
    parts = {name: {} for name in ('measured', 'true', 'before', 'after', 'floor')}
    for sensor in SENSORS:
        true = np.array([row.sensors[sensor].mean[result.gathered_model.columns_of(sensor, Role.LINEAR)] for row in rows])
        noise = result.solution.noise[sensor]
        parts['measured'][sensor], parts['true'][sensor] = found[sensor]['measured'], true
        parts['before'][sensor] = found[sensor]['before']
        parts['after'][sensor] = found[sensor]['after'] @ np.linalg.inv(calibration.of(sensor, Role.LINEAR)).T
        parts['floor'][sensor] = np.sqrt(noise.low_variance / count[:, None] + noise.offset_sd**2 + noise.bias_variance)
    return WindowErrors(found['time'], kind, **parts)


def _by_hand(result):
    hand = result.solution
    poses, force, rate = hand.poses, hand.poses.force, hand.poses.rate
    true = hand.gravity * hand.state.up
    corrected_force, corrected_rate = hand.compensate(force, rate)
    duration = result.gathered.duration
    samples = max(int(poses.stop[-1]), 1)
    time = (poses.start + poses.stop) / 2 * duration / max(samples - 1, 1)
    scatter = [float(hand.statistics.get(f'{name}_scatter_sd', 0.0)) for name in ('pose', 'drift')]
    zero = np.zeros_like(rate)
    return WindowErrors(time, np.full(len(force), 'static'), {'accelerometer': force, 'gyroscope': rate},
                        {'accelerometer': true, 'gyroscope': zero}, {'accelerometer': force - true, 'gyroscope': rate},
                        {'accelerometer': corrected_force - true, 'gyroscope': corrected_rate},
                        {'accelerometer': np.hypot(poses.force_sem, scatter[0]), 'gyroscope': np.hypot(poses.rate_sem, scatter[1])})


def window_residuals(result):
    """
    Return residuals per window before and after: what a nominal sensor would show, and what the model leaves.

    Returns
    -------
    dict
        'time', 'kind', 'count', and per sensor 'before', 'after', each shape (n_windows, 3): residuals of window means.

    """
    solution, rows = result.solution, result.gathered.accumulator.rows
    wide, narrow = result.gathered_model, result.model
    accumulator = result.gathered.accumulator if wide is narrow else restrict(result.gathered.accumulator, wide, narrow)
    found = {'time': np.array([r.time for r in rows]), 'kind': [r.kind for r in rows], 'count': np.array([r.count for r in rows])}
    nominal = narrow.start()
    for sensor in SENSORS:
        means = np.array([row.sensors[sensor].mean for row in accumulator.rows])
        after, before = (coefficients(narrow, sensor, values) for values in (solution.values, np.where(np.isfinite(nominal), nominal, 0.0)))
        found[sensor] = {'before': means[:, -3:] - means[:, :-3] @ before, 'after': means[:, -3:] - means[:, :-3] @ after,
                         'measured': means[:, -3:], 'predicted': means[:, :-3] @ after}
    return found
