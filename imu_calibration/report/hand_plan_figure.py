"""Pictures of poses: a box with the axes of the IMU printed on it, held with one direction up."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from imu_calibration.calibration.hand_step import HandStep, direction_words
from imu_calibration.kinematics.rotations import align
from imu_calibration.report.figures import AXIS, FAINT, GREY, INK, draw

SIZE = np.array([1.0, 0.7, 0.3])
"""Half edges of the box along x, y, z: all different, so that attitudes are distinguishable."""
VIEW = np.array([[-np.sqrt(0.5), np.sqrt(0.5), 0.0], [-0.35, -0.35, 0.87]])
"""From the level frame to the picture: seen from above one's shoulder."""
COLUMNS, MOST = 6, 36


def draw_steps(steps: Sequence[HandStep]) -> str:
    """Return the steps as SVG, numbered in the order of time."""
    shown = list(steps)[:MOST]
    rows = max(1, -(-len(shown) // COLUMNS))
    return draw('hand-steps', (8.6, 1.75 * rows), lambda figure: _paint(figure, shown, rows), label='How to hold and to turn the IMU')


def _paint(figure, steps, rows):
    axes = np.atleast_1d(figure.subplots(rows, COLUMNS)).ravel()
    for place, axis in enumerate(axes):
        axis.set_axis_off()
        if place < len(steps):
            _box(axis, steps[place].up)
            axis.set_title(f'{place + 1}: {direction_words(steps[place].up)} up', fontsize=8, color=INK)
            axis.set_aspect('equal')
            axis.set_xlim(-1.7, 1.7)
            axis.set_ylim(-1.5, 1.6)


def _box(axis, up):
    mat_ns = align(np.asarray(up, float))
    toward = np.cross(VIEW[0], VIEW[1])
    for k, sign in itertools.product(range(3), (1.0, -1.0)):
        normal = sign * np.eye(3)[k]
        if (mat_ns @ normal) @ toward > 0:
            others = [i for i in range(3) if i != k]
            corners = [normal * SIZE[k] + a * SIZE[others[0]] * np.eye(3)[others[0]] + b * SIZE[others[1]] * np.eye(3)[others[1]]
                       for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
            axis.fill(*(VIEW @ mat_ns @ np.array(corners).T), facecolor='#f4f6f9', edgecolor=FAINT, lw=1.0)
    for k, (name, colour) in enumerate(AXIS.items()):
        tip = VIEW @ mat_ns @ (np.eye(3)[k] * (SIZE[k] + 0.55))
        axis.annotate('', tip, (0, 0), arrowprops={'arrowstyle': '->', 'color': colour, 'lw': 1.4})
        axis.text(*(1.12 * tip), name, color=colour, fontsize=8, ha='center', va='center')
    axis.annotate('', (-1.55, 1.2), (-1.55, 0.4), arrowprops={'arrowstyle': '->', 'color': GREY, 'lw': 1.0})
    axis.text(-1.55, 0.2, 'up', color=GREY, fontsize=7, ha='center', va='center')
