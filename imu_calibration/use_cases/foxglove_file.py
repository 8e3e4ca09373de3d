"""MCAP as Foxglove wants it: a schema for every topic, the sphere as a SceneUpdate; nothing else of the project knows foxglove-sdk."""

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np

from imu_calibration.calibration.coverage import Coverage
from imu_calibration.calibration.coverage_look import ARMS_TIMES, ARROW, RADIUS, SEEN, TINY, WHITE, cells_of, line_of
from imu_calibration.errors import InputError

PARAMETERS, RESIDUAL, SPECTRUM, SPHERE = '/imu/parameters', '/imu/residual/windows', '/imu/residual/spectrum', '/imu/coverage'
NUMBER, TEXT = {'type': 'number'}, {'type': 'string'}


def _object(**properties):
    return {'type': 'object', 'properties': properties}


AXES = _object(x=NUMBER, y=NUMBER, z=NUMBER)
SENSOR_AXES = _object(accelerometer=AXES, gyroscope=AXES)
SCHEMAS = {
    PARAMETERS: {'title': 'imu_calibration.Parameters', **_object(parameters={'type': 'array', 'items': _object(
        name=TEXT, value=NUMBER, sd=NUMBER, low=NUMBER, high=NUMBER, unit=TEXT, tolerance=NUMBER, ratio=NUMBER, status=TEXT)})},
    RESIDUAL: {'title': 'imu_calibration.Residual', **_object(motion=TEXT, before=SENSOR_AXES, after=SENSOR_AXES, floor=SENSOR_AXES)},
    SPECTRUM: {'title': 'imu_calibration.Spectrum', **_object(lines={'type': 'array', 'items': _object(
        frequency=NUMBER, accelerometer=AXES, gyroscope=AXES)})},
}


def foxglove() -> Any:
    """
    Return the package with its messages and channels.

    Raises
    ------
    InputError
        When it is not installed.

    """
    try:
        import foxglove
        import foxglove.channels
        import foxglove.messages
    except ImportError as error:
        raise InputError('a view needs foxglove-sdk, which is not installed; install imu_calibration[view]') from error
    return foxglove


def foxglove_bytes(messages: Sequence[tuple[str, float, dict[str, Any]]], coverage: Coverage | None, frame_id: str) -> bytes:
    """
    Return an MCAP.

    Parameters
    ----------
    messages : sequence of (topic, time, content)
        Topics of `SCHEMAS`; time in s.
    coverage : Coverage or None
        The sphere, at time zero.
    frame_id : str
        Frame of the sphere.

    """
    sdk, whole = foxglove(), BytesIO()
    context = sdk.Context()
    with sdk.open_mcap(whole, context=context):
        channels = {topic: sdk.Channel(topic, schema=SCHEMAS[topic], message_encoding='json', context=context) for topic in
                    dict.fromkeys(topic for topic, _, _ in messages)}
        if coverage is not None:
            sdk.channels.SceneUpdateChannel(SPHERE, context=context).log(scene_of(coverage, frame_id), log_time=0)
        for topic, time, content in sorted(messages, key=lambda message: message[1]):
            channels[topic].log(content, log_time=round(1e9 * time))
    return whole.getvalue()


def scene_of(coverage: Coverage, frame_id: str) -> Any:
    """Return the sphere as a SceneUpdate: the cells, what has been up, the next motion, the arms, the line of text."""
    found = foxglove().messages

    def color(rgb, alpha=0.9):
        return found.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)

    def pose(place, turn=(0.0, 0.0, 0.0, 1.0)):
        return found.Pose(position=found.Vector3(**_named(place)), orientation=found.Quaternion(**_named(turn)))

    def ball(place, rgb, size):
        return found.SpherePrimitive(pose=pose(place), size=found.Vector3(x=size, y=size, z=size), color=color(rgb))

    def arrow(start, along, rgb):
        length = float(np.linalg.norm(along))
        return found.ArrowPrimitive(pose=pose(start, _from_x(along / length)), shaft_length=0.8 * length, shaft_diameter=0.025,
                                    head_length=0.2 * length, head_diameter=0.05, color=color(rgb))

    step, arms, center = coverage.next, np.zeros((0, 3)) if coverage.arms is None else coverage.arms, np.zeros(3)
    balls = [ball(*cell) for cell in cells_of(coverage)] + [ball(1.1 * RADIUS * up, SEEN, TINY) for up in coverage.seen]
    arrows = [arrow(center, ARMS_TIMES * arm, rgb) for arm, rgb in zip(arms, 0.9 * np.eye(3), strict=False) if arm.any()]
    if step.up is not None:
        arrows.append(arrow(center, 1.25 * RADIUS * step.up, ARROW))
    elif step.axis is not None:
        arrows.append(arrow(-1.25 * RADIUS * step.axis, 2.5 * RADIUS * step.axis, ARROW))
    line = found.TextPrimitive(pose=pose((0.0, 0.0, 1.6 * RADIUS)), billboard=True, font_size=0.09, color=color(WHITE),
                               text=line_of(coverage))
    entity = found.SceneEntity(timestamp=found.Timestamp(0), frame_id=frame_id, id='coverage', spheres=balls, arrows=arrows, texts=[line])
    return found.SceneUpdate(entities=[entity])


def _named(numbers):
    return dict(zip('xyzw', map(float, numbers)))


def _from_x(along):
    """Return the quaternion (x, y, z, w) of the shortest turn from x to a unit vector; half a turn about z where that is -x."""
    turn = np.array([0.0, -along[2], along[1], 1 + along[0]])
    return turn / np.linalg.norm(turn) if turn[3] > 1e-9 else np.array([0.0, 0.0, 1.0, 0.0])
