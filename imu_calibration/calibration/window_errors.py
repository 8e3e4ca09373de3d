"""Errors of window means before and after calibration: the data of most figures of the report."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import coefficients
from imu_calibration.estimation.accumulator import restrict

if TYPE_CHECKING:
    from imu_calibration.calibration.table_result import TableResult


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
    """Sensor -> error of the corrected mean, shape (n, 3)."""
    floor: dict
    """Sensor -> sd of the mean from noise, shape (n, 3)."""

    def rms(self, sensor: str, which: str, kind: str | None = None) -> float:
        """Return the root mean square error of 'before' or 'after', over windows of one kind or all."""
        errors = getattr(self, which)[sensor][(self.kind == kind) if kind else slice(None)]
        return float(np.sqrt(np.mean(errors**2))) if errors.size else float('nan')


def window_residuals(result: 'TableResult') -> dict:
    """
    Return residuals per window before and after calibration: those of a nominal sensor, and those of the model.

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
