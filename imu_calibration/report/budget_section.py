"""The error budget as figure and numbers: contributions of the noise and of the reference."""

from typing import Any

import numpy as np

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.units import for_people
from imu_calibration.report.figures import INK, draw, log_axis
from imu_calibration.report.numbers import text
from imu_calibration.report.observability_section import short_name

COLOURS = {'noise': '#1f66a8', 'levelling': '#c0561b', 'joint position': '#2b8a57', 'table rate': '#8a5aa8', 'gravity': '#b8860b'}
LOWEST = 1e-5
"""Shares of the tolerance below this are drawn at the edge."""


def budget_section(result: CalibrationResult) -> dict[str, Any]:
    """Return the figure, the rows (largest component of each effect) and the assumptions."""
    budget = result.error_budget()
    terms = {name: np.sqrt(np.maximum(variance, 0.0)) for name, variance in result.calibration.covariance_terms.items()
             if np.any(variance > 0)}
    return {'figure': draw('budget', (8.6, 0.9 + 0.26 * len(_effects(result))), _Dots(result, budget),
                           label='Error budget of each effect by cause, in tolerances'),
            'causes': list(budget.causes), 'texts': [(cause, budget.texts[cause]) for cause in budget.causes],
            'rows': _rows(result, list(budget.causes.values()), budget.total), 'terms': list(terms),
            'term_rows': _rows(result, list(terms.values()), result.calibration.sd)}


def _effects(result):
    model = result.calibration.model
    return [(e, model.slices[e.key]) for e in model.effects if np.any(result.calibration.sd[model.slices[e.key]] > 0)]


def _rows(result, causes, total):
    """Return a row per effect: the sd of its largest component by cause, and the total."""
    rows = []
    for effect, part in _effects(result):
        factor, unit = for_people(effect.unit_of(0), effect.sensor)
        parts = [*causes, total]
        rows.append({'name': f'{effect.sensor} {effect.name.replace("_", " ")}', 'unit': '' if unit == '1' else unit,
                     'cells': [text(float(p[part].max()) * factor, 2) if p[part].max() > 1e-15 else '0' for p in parts],
                     'tolerance': text(result.tolerances[part][0] * factor, 2)})
    return rows


class _Dots:
    """One line per effect, one dot per cause, in tolerances."""

    def __init__(self, result, budget):
        self.result, self.budget = result, budget

    def __call__(self, figure):
        axes, effects = figure.subplots(), _effects(self.result)
        place = np.arange(len(effects))[::-1]
        highest = 1.0
        for cause, values in self.budget.causes.items():
            share = np.array([np.max(values[part] / self.result.tolerances[part]) for _, part in effects])
            highest = max(highest, share.max())
            shown = share > LOWEST
            axes.plot(share[shown], place[shown], 'o', color=COLOURS.get(cause, INK), label=cause, markersize=6, ls='none')
        total = np.array([np.max(self.budget.total[part] / self.result.tolerances[part]) for _, part in effects])
        axes.plot(total, place, '|', color=INK, markersize=13, mew=1.6, label='total', ls='none')
        axes.axvline(1.0, color=INK, lw=1.0)
        log_axis(axes.xaxis)
        axes.set_xlim(LOWEST, 3 * highest)
        axes.set_ylim(-0.7, len(effects) - 0.3)
        axes.set_yticks(place, [short_name(f'{e.sensor}.{e.name}') for e, _ in effects])
        axes.tick_params(axis='y', length=0)
        axes.set_xlabel('largest standard deviation / tolerance')
        axes.legend(ncols=6, loc='lower center', bbox_to_anchor=(0.45, 1.0), columnspacing=1.2, handletextpad=0.1)
