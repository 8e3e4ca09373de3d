"""The report of a plan: the predicted result first, then the motion and its derivation."""

from __future__ import annotations

from typing import Any

import numpy as np

from imu_calibration.core.units import for_people
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.planning.hand_plan import HandPlan
from imu_calibration.planning.planner import Plan
from imu_calibration.planning.repertoire import MotionKind
from imu_calibration.report.hand_plan_figure import draw_steps
from imu_calibration.report.numbers import text
from imu_calibration.report.page import render
from imu_calibration.report.plan_figures import draw_motion, draw_progress, draw_steps_progress

SAYS = {MotionKind.POSE: 'rest', MotionKind.RETURN: 'return', MotionKind.SPIN: 'spin', MotionKind.SWING: 'swing',
        MotionKind.TOGETHER: 'joint turn', MotionKind.MOVE: 'move'}
"""Unit of the count, in the singular."""


def plan_report(plan: Plan, provenance: dict[str, Any]) -> str:
    """Return the report as one self-contained HTML page; the same input gives the same bytes."""
    count, bound = int(plan.wanted.sum()), plan.lower_bound_seconds
    met = int((plan.sd <= plan.tolerances * (1 + 1e-6))[plan.wanted].sum())
    tiles = [_tile('time', text(plan.seconds), 's', f'{len(plan.motions)} motions'),
             _tile('least time', text(bound), 's', 'lower bound for plans of these motions') if np.isfinite(bound) else
             _tile('least time', 'not worked out', '', ''),
             _tile('within tolerance', f'{met} of {count}', '', 'parameters')]
    sense = _kinds(plan)
    if plan.missing:
        sense = f'out of reach for every motion of these joints within their limits: {", ".join(plan.missing)}'
    return _page(plan.model, {name: k for k, name in enumerate(plan.model.param_names) if plan.wanted[k]}, plan.sd, plan.tolerances,
                 word='good' if not plan.missing else 'weak', sense=sense, tiles=tiles, facts=_facts(provenance), motion=draw_motion(plan),
                 headline=f'{plan.told_apart} separated after {text(plan.seconds)} s' if plan.told_apart and not plan.missing else
                 f'{met} of {count} parameters within tolerance after {text(plan.seconds)} s', caption=CAPTION, reading=READING,
                 count='until, s', progress=draw_progress(plan), rows=_rows(plan))


def hand_plan_report(plan: HandPlan, model: SensorModel, provenance: dict[str, Any]) -> str:
    """Return the report of a plan by hand, as text and pictures."""
    count, met = len(plan.param_names), len(plan.param_names) - len(plan.missing)
    rows = [{'until': f'{number}', 'kind': 'turn' if step.is_turn else 'pose', 'words': step.words}
            for number, step in enumerate(plan.steps, start=1)]
    sense = f'no pose and no turn by hand brings these within their tolerance: {", ".join(plan.missing)}' if plan.missing else \
        'do the steps in this order, each by the turn that is named'
    return _page(model, {name: k for k, name in enumerate(plan.param_names)}, plan.sd, plan.tolerances,
                 word='good' if not plan.missing else 'weak', sense=sense, facts=_facts(provenance),
                 tiles=[_tile('time', text(plan.seconds), 's', f'{len(plan.steps)} poses and turns'),
                        _tile('within tolerance', f'{met} of {count}', '', 'parameters')],
                 headline=f'{met} of {count} parameters within tolerance after {len(plan.steps)} poses and turns',
                 motion=draw_steps(plan.steps), reading=READING[:1], count='step',
                 caption='The IMU as a box, x its longest side, z its thinnest; as it is held at the end of each step.',
                 progress=draw_steps_progress(plan), rows=rows)


CAPTION = ('Positions of the joints; the band above shows the kind of motion. Angles of endless joints are drawn within one turn.')
READING = ('The standard deviations are those that a calibration of this motion will report, from the same columns, windows and noise. The '
           'biases wander according to the grade or the noise file: therefore long rests are rare and returns are frequent.',
           'The least time is a lower bound: information is counted as if the biases of different windows were independent, and '
           'motions as if fractions of them and moves of zero length were possible. No plan made of the same motions '
           'is shorter.')


def _page(model, places, sd, tolerances, **content):
    return render('plan.html', title='Plan of a calibration', groups=_groups(model, places, sd, tolerances), **content)


def _tile(what, number, unit, note):
    return {'what': what, 'number': number, 'unit': unit, 'before': '', 'note': note}


def _facts(provenance):
    return [(str(what).replace('_', ' '), value) for what, value in provenance.items()]


def _kinds(plan):
    counts = {kind: sum(motion.kind is kind for motion in plan.motions) for kind in SAYS}
    return ', '.join(f'{count} {SAYS[kind]}{"s" if count > 1 else ""}' for kind, count in counts.items() if count) or 'nothing to do'


def _rows(plan):
    return [{'until': f'{end:.1f}', 'kind': str(motion.kind), 'words': motion.words}
            for motion, end in zip(plan.motions, plan.ends, strict=True)]


def _groups(model, places, sd, tolerances):
    """Return the predicted standard deviations of the parameters of each effect, in common units."""
    groups = []
    for effect in model.effects:
        names = [name for name in effect.param_names() if name in places]
        factor, unit = for_people(effect.unit_of(0), effect.sensor)
        rows = [{'name': name, 'component': name.split('.')[-1], 'sd': text(factor * sd[places[name]]),
                 'tolerance': text(factor * tolerances[places[name]]), 'share': text(sd[places[name]] / tolerances[places[name]], 2),
                 'bar': min(100, round(100 * float(sd[places[name]] / tolerances[places[name]]))),
                 'status': 'determined' if sd[places[name]] <= tolerances[places[name]] * (1 + 1e-6) else 'weak'} for name in names]
        if rows:
            groups.append({'title': f'{effect.sensor}: {effect.name}', 'unit': unit, 'rows': rows})
    return groups
