"""The figures of a plan: the joints' motion, and how the standard deviations fall."""

from __future__ import annotations

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.planning.hand_plan import HandPlan
from imu_calibration.planning.planner import Plan
from imu_calibration.planning.repertoire import MotionKind
from imu_calibration.report.drawn import Drawn
from imu_calibration.report.figures import AXIS, FAINT, GREY, draw, log_axis

KIND = {MotionKind.POSE: '#2b8a57', MotionKind.RETURN: '#7fbf9a', MotionKind.SPIN: '#1f66a8', MotionKind.SWING: '#d08a12',
        MotionKind.TOGETHER: '#8a4fa8', MotionKind.MOVE: '#98a2b0'}
"""Colours of the motions."""
COLOURS = tuple(AXIS.values()) + ('#8a4fa8', '#d08a12', '#555f6b', '#c0561b', '#1b2430')


def draw_motion(plan: Plan) -> str:
    """Return the joints against time as SVG, the kinds of motion as a band above."""
    return draw('plan-motion', (8.6, 3.6), lambda figure: _motion(figure, plan), label='Positions of the joints against time')


def draw_progress(plan: Plan) -> Drawn:
    """Return the standard deviations in tolerances against time as SVG, one line for each parameter."""
    return draw('plan-progress', (8.6, 4.2), lambda figure: _progress(figure, plan), label='Predicted standard deviations against time')


def _motion(figure, plan):
    axes, points = figure.subplots(), plan.points
    if not len(points):
        return
    turns = plan.motions[0].limits.turns
    time = np.concatenate([[0.0], points.time])
    position = np.concatenate([plan.start[None], points.position])
    for k, name in enumerate(points.joint_names):
        values = np.degrees(position[:, k]) if turns[k] else 1000 * position[:, k]
        wrapped = (values + 180.0) % 360.0 - 180.0 if turns[k] else values
        wrapped = np.where(np.abs(np.diff(wrapped, prepend=wrapped[0])) > 180.0, np.nan, wrapped)
        axes.plot(time, wrapped, color=COLOURS[k % len(COLOURS)], lw=1.2, label=f'{name}, {"deg" if turns[k] else "mm"}')
    top, bottom = axes.get_ylim()[1], axes.get_ylim()[0]
    begins, shown = np.concatenate([[0.0], plan.ends[:-1]]), set()
    for motion, begin, end in zip(plan.motions, begins, plan.ends, strict=True):
        axes.fill_between([begin, end], top, top + 0.06 * (top - bottom), color=KIND[motion.kind], lw=0,
                          label=None if motion.kind in shown else str(motion.kind))
        shown.add(motion.kind)
    axes.set_xlabel('time, s')
    axes.set_ylabel('position')
    axes.legend(ncols=4, loc='upper center', bbox_to_anchor=(0.5, -0.16))


def draw_steps_progress(plan: HandPlan) -> str:
    """Return the same for the steps of a plan by hand."""
    def paint(figure):
        _fall(figure.subplots(), np.arange(len(plan.history)), plan.history, plan.param_names, label='poses and turns')
    return draw('plan-progress', (8.6, 4.2), paint, label='Predicted standard deviations against steps')


def _progress(figure, plan):
    axes = figure.subplots()
    names = [name for name, wanted in zip(plan.model.param_names, plan.wanted, strict=True) if wanted]
    _fall(axes, np.concatenate([[0.0], plan.ends]), plan.history, names, label='time, s')
    if 0 < plan.lower_bound_seconds < np.inf and not plan.missing:
        axes.axvline(plan.lower_bound_seconds, color=FAINT, lw=1.2)
        axes.annotate('least time', (plan.lower_bound_seconds, axes.get_ylim()[1]), (4, -10), textcoords='offset points', color=GREY,
                      fontsize=8)


def _fall(axes, time, history, names, *, label):
    """Draw a line for each parameter, the worst of all, and the tolerance."""
    shown = set()
    for name, values in zip(names, history.T, strict=True):
        sensor = name.split('.')[0]
        colour = AXIS['x'] if sensor == SENSORS[0] else AXIS['z']
        axes.plot(time, np.maximum(values, 1e-3), color=colour, lw=0.9, alpha=0.6, label=None if sensor in shown else sensor)
        shown.add(sensor)
    axes.plot(time, history.max(axis=1), color=GREY, lw=2.2, label='worst of all')
    axes.axhline(1.0, color=FAINT, ls='--', lw=1.2)
    axes.annotate('tolerance', (time[-1], 1.0), (-4, 4), textcoords='offset points', ha='right', color=GREY, fontsize=8)
    log_axis(axes.yaxis)
    axes.set_xlabel(label)
    axes.set_ylabel('sd / tolerance')
    axes.legend(loc='upper right')
