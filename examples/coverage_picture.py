"""
Draw docs/coverage.png.

The markers of imu/coverage at the beginning, in the middle and at the end of a calibration by hand.
"""

import textwrap
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from builtin_interfaces.msg import Time
from visualization_msgs.msg import Marker

from imu_calibration.calibration.coverage import DIRECTIONS, Coverage, Step
from imu_calibration.nodes.calibration_status import markers_of
from imu_calibration.references.gravity.advice import HandStep, foretold
from imu_calibration.references.gravity.hand_parameters import HandOptions
from imu_calibration.references.gravity.live_poses import EMPTY_SCAN, knowledge_of

PICTURE = Path(__file__).resolve().parents[1] / 'docs' / 'coverage.png'
MINIMUM = 8.0
"""Points; markers are drawn in proportion to their scale."""


def states():
    """
    Yield a Coverage at three times of a session of recommended motions.

    The times are the beginning, after six poses, and the end of the session, which follows the
    recommended motions.
    """
    up = np.array([0.0, 0.0, 1.0])
    knowledge, seen = (
        knowledge_of(EMPTY_SCAN, None, HandOptions(gravity=9.81)).then(HandStep(up)),
        [up],
    )
    yield shown(knowledge, seen)
    for step in foretold(knowledge)[:6]:
        knowledge = knowledge.then(step)
        seen.append(step.up)
    yield shown(knowledge, seen)
    seen += [step.up for step in foretold(knowledge)]
    yield Coverage(np.zeros(len(DIRECTIONS)), np.array(seen), seen[-1], Step(''), 0.0, done=True)


def shown(knowledge, seen):
    """Return the Coverage as published by calibration_node."""
    steps = foretold(knowledge)
    first, seconds = steps[0], sum(step.seconds for step in steps)
    return Coverage(
        knowledge.best().gains,
        np.array(seen),
        seen[-1],
        Step(first.words, first.up, first.axis, first.angle),
        seconds,
    )


def draw(axes, coverage):
    """Draw the markers of a Coverage."""
    for marker in markers_of(coverage, Time()).markers:
        color = (marker.color.r, marker.color.g, marker.color.b, marker.color.a)
        points = np.array([(point.x, point.y, point.z) for point in marker.points])
        place = (marker.pose.position.x, marker.pose.position.y, marker.pose.position.z)
        if marker.action == Marker.DELETEALL:
            continue
        if marker.type == Marker.SPHERE:
            axes.scatter(
                *place,
                s=(MINIMUM + 170 * marker.scale.x) ** 2 / 2.5,
                color=color,
                edgecolors='none',
            )
        elif marker.type == Marker.SPHERE_LIST:
            axes.scatter(*points.T, s=14, color=color)
        elif marker.type == Marker.ARROW:
            axes.quiver(
                *points[0],
                *(points[1] - points[0]),
                color=color,
                linewidth=2.5,
                arrow_length_ratio=0.18,
            )
        elif marker.type == Marker.LINE_STRIP:
            axes.plot(*points.T, color=color, linewidth=2.5)
        elif marker.type == Marker.TEXT_VIEW_FACING:
            axes.set_title(textwrap.fill(marker.text, 46), fontsize=9)
    axes.set_box_aspect((1, 1, 1))
    axes.set(xlim=(-0.42, 0.42), ylim=(-0.42, 0.42), zlim=(-0.42, 0.42))
    axes.view_init(elev=22, azim=40)
    axes.set_axis_off()


def main():
    """Write the picture."""
    figure, axes = plt.subplots(
        1, 3, figsize=(11, 3.6), subplot_kw={'projection': '3d'}, layout='constrained'
    )
    for part, coverage in zip(axes, states(), strict=True):
        draw(part, coverage)
    figure.savefig(PICTURE, dpi=85)
    print(f'written: {PICTURE}')


if __name__ == '__main__':
    main()
