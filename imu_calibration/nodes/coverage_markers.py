"""A `Coverage` as visualization_msgs/MarkerArray: the same picture in RViz, Foxglove and every other viewer of markers."""

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from imu_calibration.calibration.coverage import ARMS_TIMES, ARROW, DONE, NOW, RADIUS, SEEN, TINY, WHITE, Coverage, cells_of, line_of


def markers_of(coverage: Coverage, stamp: Time) -> MarkerArray:
    """
    Return the picture, in the frame of the sensor; each message replaces the one before.

    Cells: orange and large where another rest is informative, green and small elsewhere. An arrow from the present up direction to the
    next one, a ring of the turn between them; blue points: earlier up directions; the arms of the three sensitive points; one line of text.
    """
    frame = coverage.frame_id or 'imu_link'
    made = [_marker('all', 0, Marker.SPHERE), *_cells(coverage), *_seen(coverage), *_next(coverage), *_arms(coverage), _text(coverage)]
    made[0].action = Marker.DELETEALL
    for marker in made:
        marker.header.frame_id, marker.header.stamp = frame, stamp
    return MarkerArray(markers=made)


def driven_markers(up: np.ndarray, text: str, *, frame_id: str, stamp: Time) -> MarkerArray:
    """Return the planner's markers: an arrow to the up direction after the driven motion, and a description of that motion."""
    made = [_arrow('driven', np.zeros(3), 1.25 * RADIUS * up, ARROW), _marker('driven', 1, Marker.TEXT_VIEW_FACING, scale=(0.0, 0.0, 0.08))]
    made[1].text = text
    _at(made[1], (0.0, 0.0, -1.5 * RADIUS))
    for marker in made:
        marker.header.frame_id, marker.header.stamp = frame_id or 'imu_link', stamp
    return MarkerArray(markers=made)


def _marker(name, number, kind, *, color=WHITE, alpha=1.0, scale=(1.0, 1.0, 1.0)):
    marker = Marker(ns=name, id=number, action=Marker.ADD, color=ColorRGBA(r=color[0], g=color[1], b=color[2], a=alpha))
    marker.type = kind
    marker.scale.x, marker.scale.y, marker.scale.z = map(float, scale)
    marker.pose.orientation.w = 1.0
    return marker


def _at(marker, place):
    marker.pose.position = _point(place)
    return marker


def _point(place):
    return Point(x=float(place[0]), y=float(place[1]), z=float(place[2]))


def _cells(coverage):
    for k, (place, color, size) in enumerate(cells_of(coverage)):
        yield _at(_marker('cells', k, Marker.SPHERE, color=color, alpha=0.9, scale=(size,) * 3), place)


def _seen(coverage):
    if len(coverage.seen):
        marker = _marker('seen', 0, Marker.SPHERE_LIST, color=SEEN, scale=(TINY,) * 3)
        marker.points = [_point(1.1 * RADIUS * up) for up in coverage.seen]
        yield marker
    if coverage.up is not None:
        yield _arrow('up now', np.zeros(3), 0.85 * RADIUS * coverage.up, NOW)


def _next(coverage):
    step = coverage.next
    if step.up is not None:
        yield _arrow('next', np.zeros(3), 1.25 * RADIUS * step.up, ARROW)
    if step.axis is not None and coverage.up is not None and step.up is not None:
        ring = _marker('turn', 0, Marker.LINE_STRIP, color=ARROW, alpha=0.7, scale=(0.012, 0.0, 0.0))
        angles = np.linspace(0, step.angle, 24)
        across = np.cross(step.axis, coverage.up)
        ring.points = [_point(0.7 * RADIUS * (np.cos(a) * coverage.up - np.sin(a) * across)) for a in angles]
        yield ring
    elif step.axis is not None:
        yield _arrow('next', -1.25 * RADIUS * step.axis, 1.25 * RADIUS * step.axis, ARROW)


def _arms(coverage):
    for k, arm in enumerate([] if coverage.arms is None else coverage.arms):
        yield _arrow('arms', np.zeros(3), ARMS_TIMES * arm, tuple(np.eye(3)[k] * 0.9), number=k)


def _arrow(name, start, end, color, number=0):
    marker = _marker(name, number, Marker.ARROW, color=color, scale=(0.025, 0.05, 0.07))
    marker.points = [_point(start), _point(end)]
    return marker


def _text(coverage):
    marker = _marker('text', 0, Marker.TEXT_VIEW_FACING, color=DONE if coverage.done else WHITE, scale=(0.0, 0.0, 0.09))
    marker.text = line_of(coverage)
    return _at(marker, (0.0, 0.0, 1.6 * RADIUS))
