"""Zhang's Tables 2 and 4 for this recording: readings at +-1 g, at rest and in rotation, before and after compensation."""

from typing import Any

import numpy as np

from imu_calibration.calibration.result import CalibrationResult, WindowErrors
from imu_calibration.papers.zhang2017 import axis_readings
from imu_calibration.report.numbers import fixed, text

LEVEL = 0.02
"""Windows with a mean specific force further than this share from 1 g turn through the vertical and have no reading at 1 g."""


def reading_tables(result: CalibrationResult, errors: WindowErrors) -> list[list[dict[str, Any]]]:
    """Return two lists of lines: at rest (Table 2) and in rotation (Table 4)."""
    gravity = result.gravity
    true = errors.true['accelerometer']
    chosen = (np.abs(np.linalg.norm(true, axis=1) / gravity - 1) < LEVEL) & (errors.kind != 'dynamic')
    lines = axis_readings(errors.measured['accelerometer'][chosen], (true + errors.after['accelerometer'])[chosen], true[chosen],
                          rate=np.linalg.norm(errors.true['gyroscope'][chosen], axis=1), gravity=gravity)
    return [_lines([line for line in lines if (line.rate_deg_s == 0) == at_rest]) for at_rest in (True, False)]


def _lines(readings):
    """Return lines of three sensors each: position, rate, and per sensor theoretical, before, after, errors in mg."""
    lines = []
    for first in range(0, len(readings), 3):
        triple = readings[first:first + 3]
        cells = [{'sensor': r.sensor, 'theory': fixed(r.theoretical_g, 5), 'before': fixed(r.before_g, 5), 'after': fixed(r.after_g, 5),
                  'error_before': text(abs(r.before_g - r.theoretical_g) * 1e3, 3),
                  'error_after': text(abs(r.after_g - r.theoretical_g) * 1e3, 2),
                  'gain': text(r.improvement, 2) if np.isfinite(r.improvement) else '–'} for r in triple]
        lines.append({'position': triple[0].position.replace('-', '−'), 'rate': text(triple[0].rate_deg_s), 'windows': triple[0].n_windows,
                      'cells': cells})
    return lines
