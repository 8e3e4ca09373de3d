"""The page of a plan, on a table or by hand, with its figures."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.rotations import align
from imu_calibration.planning.motion_library import MotionKind
from imu_calibration.planning.planner import Plan
from imu_calibration.references.gravity.advice import HandStep, direction_words
from imu_calibration.report.figures import AXIS_COLOURS, FAINT, GREY, INK, Drawn, draw, log_axis
from imu_calibration.report.page import render

HALF_EDGES = np.array([1.0, 0.7, 0.3])
"""Half edges of the box along x, y, z: all different, so that attitudes are distinguishable."""
VIEW = np.array([[-np.sqrt(0.5), np.sqrt(0.5), 0.0], [-0.35, -0.35, 0.87]])
"""From the level frame to the picture (right, up): seen from above one's shoulder."""
FIGURE_COLUMNS = 6
"""Drawings of attitudes in a row."""
MAX_ATTITUDES = 36
"""Steps that are drawn."""


def draw_steps(steps: Sequence[HandStep]) -> str:
    """Return the steps as SVG, numbered in the order of time."""
    shown = list(steps)[:MAX_ATTITUDES]
    rows = max(1, -(-len(shown) // FIGURE_COLUMNS))
    return draw(
        'hand-steps',
        (8.6, 1.75 * rows),
        _steps,
        shown,
        rows,
        label='How to hold and to turn the IMU',
    )


def _steps(figure, steps, rows):
    """Draw the attitude of each step in a panel, with its number and the direction that is up."""
    panels = np.atleast_1d(figure.subplots(rows, FIGURE_COLUMNS)).ravel()
    for axes in panels:
        axes.set_axis_off()
    for number, (axes, step) in enumerate(zip(panels, steps), 1):
        _box(axes, step.up)
        axes.set_title(f'{number}: {direction_words(step.up)} up', fontsize=8, color=INK)
        axes.set(aspect='equal', xlim=(-1.7, 1.7), ylim=(-1.5, 1.6))


def _box(axes, up):
    """Draw the IMU as a box with its axes; `up`: vertical direction in the sensor frame, (3,)."""
    mat_ns = align(np.asarray(up, float))
    toward_viewer = np.cross(VIEW[0], VIEW[1])
    edges = np.diag(HALF_EDGES)
    # The visible faces: the normal, an axis k of the sensor or its opposite, points to the viewer.
    # A face is at the half edge along its normal, its corners at plus and minus the two other ones.
    for k, sign in itertools.product(range(3), (1.0, -1.0)):
        normal = sign * np.eye(3)[k]
        if (mat_ns @ normal) @ toward_viewer <= 0:
            continue
        i, j = (axis for axis in range(3) if axis != k)
        corners = [
            sign * edges[k] + a * edges[i] + b * edges[j]
            for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ]
        x, y = VIEW @ mat_ns @ np.array(corners).T
        axes.fill(x, y, facecolor='#f4f6f9', edgecolor=FAINT, lw=1.0)
    for k, (name, colour) in enumerate(AXIS_COLOURS.items()):
        tip = VIEW @ mat_ns @ (np.eye(3)[k] * (HALF_EDGES[k] + 0.55))
        axes.annotate('', tip, (0, 0), arrowprops={'arrowstyle': '->', 'color': colour, 'lw': 1.4})
        axes.text(*(1.12 * tip), name, color=colour, fontsize=8, ha='center', va='center')
    axes.annotate(
        '', (-1.55, 1.2), (-1.55, 0.4), arrowprops={'arrowstyle': '->', 'color': GREY, 'lw': 1.0}
    )
    axes.text(-1.55, 0.2, 'up', color=GREY, fontsize=7, ha='center', va='center')


KIND = {
    MotionKind.POSE: '#2b8a57',
    MotionKind.RETURN: '#7fbf9a',
    MotionKind.SPIN: '#1f66a8',
    MotionKind.SWING: '#d08a12',
    MotionKind.TOGETHER: '#8a4fa8',
    MotionKind.MOVE: '#98a2b0',
}
"""Colours of the motions."""
JOINT_COLOURS = tuple(AXIS_COLOURS.values()) + (
    '#8a4fa8',
    '#d08a12',
    '#555f6b',
    '#c0561b',
    '#1b2430',
)


def draw_motion(plan: Plan) -> str:
    """Return the joints against time as SVG, the kinds of motion as a band above."""
    return draw(
        'plan-motion', (8.6, 3.6), _motion, plan, label='Positions of the joints against time'
    )


def draw_progress(plan: Plan) -> Drawn:
    """
    Return the standard deviations in tolerances against time as SVG, one line for each parameter.
    """
    return draw(
        'plan-progress',
        (8.6, 4.2),
        _progress,
        plan,
        label='Predicted standard deviations against time',
    )


def _motion(figure, plan):
    """Draw the joints against time, angles within one turn, and a band of the kinds of motion."""
    axes = figure.subplots()
    points = plan.points
    if not len(points):
        return
    turns = plan.motions[0].limits.turns
    time = np.concatenate([[0.0], points.time])
    position = np.concatenate([plan.start[None], points.position])
    for k, name in enumerate(points.joint_names):
        if turns[k]:
            unit = 'deg'
            values = (np.degrees(position[:, k]) + 180.0) % 360.0 - 180.0
        else:
            unit = 'mm'
            values = 1000 * position[:, k]
        # No line across the panel where an angle continues at the other end of its turn.
        steps = np.abs(np.diff(values, prepend=values[0]))
        axes.plot(
            time,
            np.where(steps > 180.0, np.nan, values),
            color=JOINT_COLOURS[k % len(JOINT_COLOURS)],
            lw=1.2,
            label=f'{name}, {unit}',
        )
    _kinds(axes, plan)
    axes.set(xlabel='time, s', ylabel='position')
    axes.legend(ncols=4, loc='upper center', bbox_to_anchor=(0.5, -0.16))


def _kinds(axes, plan):
    """Draw a band above the curves, in the colour of each motion's kind while it lasts."""
    bottom, top = axes.get_ylim()
    band_top = top + 0.06 * (top - bottom)
    begins = np.concatenate([[0.0], plan.ends[:-1]])
    labelled = set()  # kinds that are in the legend
    for motion, begin, end in zip(plan.motions, begins, plan.ends, strict=True):
        label = None if motion.kind in labelled else str(motion.kind)
        axes.fill_between([begin, end], top, band_top, color=KIND[motion.kind], lw=0, label=label)
        labelled.add(motion.kind)


def _progress(figure, plan):
    """Draw a line for each parameter, the worst of all, the tolerance, and the least time."""
    axes = figure.subplots()
    time = np.concatenate([[0.0], plan.ends])
    history = plan.history  # a column for each requested parameter
    labelled = set()  # sensors that are in the legend
    names = itertools.compress(plan.model.param_names, plan.wanted)
    for name, values in zip(names, history.T, strict=True):
        sensor = name.split('.')[0]
        colour = AXIS_COLOURS['x'] if sensor == SENSORS[0] else AXIS_COLOURS['z']
        label = None if sensor in labelled else sensor
        axes.plot(time, np.maximum(values, 1e-3), color=colour, lw=0.9, alpha=0.6, label=label)
        labelled.add(sensor)
    axes.plot(time, history.max(axis=1), color=GREY, lw=2.2, label='worst of all')
    axes.axhline(1.0, color=FAINT, ls='--', lw=1.2)
    axes.annotate(
        'tolerance',
        (time[-1], 1.0),
        (-4, 4),
        textcoords='offset points',
        ha='right',
        color=GREY,
        fontsize=8,
    )
    log_axis(axes.yaxis)
    axes.set(xlabel='time, s', ylabel='sd / tolerance')
    axes.legend(loc='upper right')
    if 0 < plan.lower_bound_seconds < np.inf and not plan.missing:
        axes.axvline(plan.lower_bound_seconds, color=FAINT, lw=1.2)
        axes.annotate(
            'least time',
            (plan.lower_bound_seconds, axes.get_ylim()[1]),
            (4, -10),
            textcoords='offset points',
            color=GREY,
            fontsize=8,
        )


@dataclass(frozen=True)
class PlanTexts:
    """Texts of the page of a plan."""

    order: str
    """What to do; '': the number of motions of each kind."""
    drawing: str
    """Under the drawing of the motions."""
    column: str
    """Heading of the labels of the motions."""
    least_time: str
    """How the least time is meant; '': there is none."""


OF_JOINTS = PlanTexts(
    '',
    'Positions of the joints; the band above shows the kind of motion. Angles of endless joints are'
    ' drawn within one turn.',
    'until, s',
    'The least time is a lower bound: information is counted as if the biases of different windows'
    ' were independent, and motions as if fractions of them and moves of zero length were possible.'
    ' No plan made of the same motions is shorter.',
)
OF_POSES = PlanTexts(
    'Do the steps in this order, each by the turn that is named',
    'The IMU as a box, x its longest side, z its thinnest; as it is held at the end of each step.',
    'step',
    '',
)


def plan_report(plan: Plan, provenance: dict[str, Any]) -> str:
    """Return the report as one self-contained HTML page; the same input gives the same bytes."""
    within = plan.sd <= plan.tolerances * (1 + 1e-6)
    if plan.start is None:
        texts = OF_POSES
        motion = draw_steps(plan.motions)
        labels = [str(number) for number, _ in enumerate(plan.motions, 1)]
    else:
        texts = OF_JOINTS
        motion = draw_motion(plan)
        labels = [f'{end:.1f}' for end in plan.ends]
    return render(
        'plan.html',
        texts=texts,
        labels=labels,
        title='Plan of a calibration',
        plan=plan,
        within=within,
        met=int(within[plan.wanted].sum()),
        count=int(plan.wanted.sum()),
        provenance=provenance,
        progress=draw_progress(plan),
        motion=motion,
    )
