"""The scale factors, installation angles and lever arms that follow from the parameters, in numbers and drawn."""

from typing import Any

import numpy as np

from imu_calibration.calibration.installation_angles import PAIRS, derive, in_paper_units
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.compensation.compensate import arms_of
from imu_calibration.core.units import DEG, decimals
from imu_calibration.effects.base import SENSORS, Role
from imu_calibration.report.figures import AXIS, GREY, INK, draw
from imu_calibration.report.numbers import fixed, pair

PLANES = ((0, 1), (0, 2), (1, 2))


def derived_section(result: CalibrationResult) -> list[dict[str, Any]]:
    """Return scale factors, angles and biases of both sensors, as rows of text."""
    return [_derived(derive(result.calibration, sensor), result.options.nominal) for sensor in SENSORS]


def _derived(found, nominal):
    angles = [[' ± '.join(pair(v / DEG, s / DEG)) for v, s in zip(*rows)] for rows in zip(found.angles, found.angles_sd)]
    between = [('xyz'[i] + '–' + 'xyz'[j], ' ± '.join(pair(v / DEG, s / DEG)))
               for (i, j), v, s in zip(PAIRS, found.between, found.between_sd)]
    lines = [{'what': what, 'unit': unit, 'values': [' ± '.join(pair(v, s)) for v, s in zip(values, sds)]}
             for what, unit, values, sds in in_paper_units(found, nominal)]
    ppm = [fixed((v - 1) * 1e6, decimals(max(s, 1e-12) * 1e6)) for v, s in zip(found.scale, found.scale_sd)]
    return {'sensor': found.sensor, 'lines': lines, 'ppm': ppm, 'angles': angles, 'between': between}


def lever_section(result: CalibrationResult) -> dict[str, Any] | None:
    """Return the drawing of the lever arms, or None when the model has none."""
    if result.calibration.of('accelerometer', Role.ARMS) is None:
        return None
    gauge = result.calibration.gauge.get('origin')
    origin = 'the mean of the three sensitive points' if gauge == 'mean_of_sensitive_points' else 'the reference point of the mount'
    return {'figure': draw('lever-arms', (8.6, 3.15), _Arms(result.calibration),
                           label='Sensitive points of the three accelerometers in three views'), 'origin': origin}


class _Arms:
    """Three views: sensitive points with ellipses of two sd."""

    def __init__(self, calibration):
        self.arms = arms_of(calibration) * 1e3
        part = calibration.model.part('accelerometer', Role.ARMS)
        self.cov = calibration.covariance[part, part] * 1e6

    def __call__(self, figure):
        limit = 1.25 * max(float(np.max(np.abs(self.arms))), 3 * float(np.sqrt(np.diag(self.cov).min())), 1e-3)
        for axes, (across, up) in zip(figure.subplots(1, 3), PLANES):
            axes.axhline(0, color=GREY, lw=0.6)
            axes.axvline(0, color=GREY, lw=0.6)
            for element, colour in enumerate(AXIS.values()):
                self._point(axes, element, across, up, colour)
            axes.plot(0, 0, '+', color=INK, markersize=9, mew=1.3)
            axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect='equal', xlabel=f'{"xyz"[across]}, mm', ylabel=f'{"xyz"[up]}, mm')
            axes.locator_params(nbins=5)

    def _point(self, axes, element, across, up, colour):
        x, y = self.arms[element, across], self.arms[element, up]
        axes.annotate('', (x, y), (0, 0), arrowprops={'arrowstyle': '-', 'color': colour, 'lw': 1.1, 'alpha': 0.55})
        axes.plot(x, y, 'o', color=colour, markersize=5)
        index = [3 * element + across, 3 * element + up]
        values, vectors = np.linalg.eigh(self.cov[np.ix_(index, index)])
        angle = np.linspace(0, 2 * np.pi, 61)
        ring = 2 * np.sqrt(np.maximum(values, 0))[:, None] * np.stack([np.cos(angle), np.sin(angle)])
        axes.plot(*(np.array([[x], [y]]) + vectors @ ring), color=colour, lw=0.9)
        away = 11 * np.array([x, y]) / max(np.hypot(x, y), 1e-9)
        axes.annotate('xyz'[element], (x, y), away, textcoords='offset points', color=colour, fontsize=10, fontweight='bold', ha='center',
                      va='center')
