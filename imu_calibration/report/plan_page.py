"""The report of a plan: what it promises first, then the motion and how it comes to be."""

from __future__ import annotations

from typing import Any

import numpy as np

from imu_calibration.planning.motions import MotionKind
from imu_calibration.planning.planner import Plan
from imu_calibration.report.numbers import text
from imu_calibration.report.page import render
from imu_calibration.report.plan_figures import draw_motion, draw_progress
from imu_calibration.units import for_people

SAYS = {MotionKind.POSE: 'rest', MotionKind.RETURN: 'return', MotionKind.SPIN: 'spin', MotionKind.SWING: 'swing',
        MotionKind.TOGETHER: 'joint turn', MotionKind.MOVE: 'move'}
"""What is counted, in the singular."""


def plan_report(plan: Plan, provenance: dict[str, Any]) -> str:
    """Return the report as one HTML page that needs nothing else; the same input gives the same bytes."""
    count = int(plan.wanted.sum())
    met = count - len(plan.missing)
    bound = plan.lower_bound_seconds
    tiles = [{'what': 'time', 'number': text(plan.seconds), 'unit': 's', 'before': '', 'note': f'{len(plan.motions)} motions'},
             {'what': 'least time', 'number': text(bound) if np.isfinite(bound) else 'not worked out',
              'unit': 's' if np.isfinite(bound) else '', 'before': '', 'note': 'no plan of these motions takes less'},
             {'what': 'within tolerance', 'number': f'{met} of {count}', 'unit': '', 'before': '', 'note': 'parameters'}]
    return render('plan.html', title='Plan of a calibration', word='good' if not plan.missing else 'weak',
                  headline=f'{met} of {count} parameters within tolerance after {text(plan.seconds)} s', missing=plan.missing, tiles=tiles,
                  facts=[(str(what).replace('_', ' '), value) for what, value in provenance.items()], kinds=_kinds(plan),
                  motion=draw_motion(plan), progress=draw_progress(plan), rows=_rows(plan), groups=_groups(plan))


def _kinds(plan):
    counts = {kind: sum(motion.kind is kind for motion in plan.motions) for kind in SAYS}
    return ', '.join(f'{count} {SAYS[kind]}{"s" if count > 1 else ""}' for kind, count in counts.items() if count) or 'nothing to do'


def _rows(plan):
    return [{'until': f'{end:.1f}', 'kind': str(motion.kind), 'words': motion.words}
            for motion, end in zip(plan.motions, plan.ends, strict=True)]


def _groups(plan):
    """Return for each effect what is predicted of its parameters, in units that people read."""
    groups = []
    for effect in plan.model.effects:
        part = plan.model.slices[effect.key]
        if plan.wanted[part].any():
            factor, unit = for_people(effect.unit)
            rows = [{'name': name, 'component': name.split('.')[-1], 'sd': text(factor * sd), 'tolerance': text(factor * tolerance),
                     'share': text(sd / tolerance, 2), 'bar': min(100, round(100 * float(sd / tolerance))),
                     'status': 'determined' if sd <= tolerance * (1 + 1e-6) else 'weak'}
                    for name, sd, tolerance in zip(plan.model.param_names[part], plan.sd[part], plan.tolerances[part], strict=True)]
            groups.append({'title': f'{effect.sensor}: {effect.name}', 'unit': unit, 'rows': rows})
    return groups
