"""MCAP for Foxglove: a schema for every topic, the sphere as a SceneUpdate; the only user of foxglove-sdk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.calibration.coverage import ARMS_TIMES, ARROW, RADIUS, SEEN, TINY, WHITE, Coverage, cells_of, line_of
from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import SENSORS

if TYPE_CHECKING:
    from imu_calibration.calibration.result import CalibrationResult
    from imu_calibration.document.calibration import Calibration
    from imu_calibration.preprocessing.window import Window


PARAMETERS, RESIDUAL, SPECTRUM, SPHERE = '/imu/parameters', '/imu/residual/windows', '/imu/residual/spectrum', '/imu/coverage'
BAND = 1.959964
"""Standard deviations on each side of a value that hold 95 %."""
NUMBER, TEXT = {'type': 'number'}, {'type': 'string'}


def _object(**properties):
    return {'type': 'object', 'properties': properties}


def _list(**properties):
    return {'type': 'array', 'items': _object(**properties)}


AXES = _object(x=NUMBER, y=NUMBER, z=NUMBER)
SENSOR_AXES = _object(accelerometer=AXES, gyroscope=AXES)
SCHEMAS = {
    PARAMETERS: {'title': 'imu_calibration.Parameters', **_object(parameters=_list(
        name=TEXT, value=NUMBER, sd=NUMBER, low=NUMBER, high=NUMBER, unit=TEXT, tolerance=NUMBER, ratio=NUMBER, status=TEXT))},
    RESIDUAL: {'title': 'imu_calibration.Residual', **_object(windows=_list(
        time=NUMBER, motion=TEXT, before=SENSOR_AXES, after=SENSOR_AXES, floor=SENSOR_AXES))},
    SPECTRUM: {'title': 'imu_calibration.Spectrum', **_object(lines=_list(frequency=NUMBER, accelerometer=AXES, gyroscope=AXES))},
}
"""Topic -> JSON schema; SI units, times in s since the first sample."""


def parameters(calibration: Calibration, tolerances: np.ndarray) -> dict[str, Any]:
    """Return every parameter with tolerance and status; without bands where the uncertainty of the values is unknown."""
    units = [effect.unit_of(k) for effect in calibration.model.effects for k in range(effect.size)]
    rows: list[dict[str, Any]] = [{'name': name, 'value': float(value), 'unit': unit, 'tolerance': float(tolerance), 'status': str(status)}
            for name, value, unit, tolerance, status in
            zip(calibration.param_names, calibration.values, units, tolerances, calibration.status, strict=True)]
    for row, sd in zip(rows, map(float, calibration.sd)):
        if calibration.uncertainty_known and np.isfinite(sd):   # JSON has no infinity
            row.update(sd=sd, low=row['value'] - BAND * sd, high=row['value'] + BAND * sd, ratio=sd / row['tolerance'])
    return {'parameters': rows}


def residual(result: CalibrationResult) -> dict[str, Any]:
    """Return the errors of window means before and after, and the expected residual from noise, in the order of time."""
    errors = result.window_errors()
    return {'windows': [{'time': float(errors.time[k]), 'motion': str(errors.kind[k]), **{
        which: _by_sensor(getattr(errors, which), k) for which in ('before', 'after', 'floor')}}
        for k in np.argsort(errors.time, kind='stable')]}


def spectrum(result: CalibrationResult, windows: Sequence[Window]) -> dict[str, Any]:
    """Return the amplitude density of the residuals within windows with motion; no lines where none is long enough."""
    from imu_calibration.calibration.residual_spectrum import residual_spectrum
    frequency, density = residual_spectrum(result, windows)
    return {'lines': [{'frequency': float(f), **_by_sensor(density, k)} for k, f in enumerate(frequency)]}


def _by_sensor(vectors, k):
    return {sensor: _axes(vectors[sensor][k]) for sensor in SENSORS}


def _axes(vector):
    """Return the components by axis; unknown ones are omitted, because JSON has no NaN."""
    return {axis: float(part) for axis, part in zip('xyz', vector, strict=True) if np.isfinite(part)}


SHORTEST = 1.0
"""Seconds of a file at least: a player wants a beginning and an end."""


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


def foxglove_bytes(contents: Mapping[str, dict[str, Any]], coverage: Coverage | None, frame_id: str, *, seconds: float = 0.0) -> bytes:
    """
    Return an MCAP with the same messages at its beginning and at its end: they are visible at any playback time.

    Parameters
    ----------
    contents : mapping
        Topic of `SCHEMAS` -> content.
    coverage : Coverage or None
        The sphere.
    frame_id : str
        Frame of the sphere.
    seconds : float
        Length of the recording.

    """
    sdk, whole = foxglove(), BytesIO()
    context = sdk.Context()
    with sdk.open_mcap(whole, context=context):
        shown = [(channel_of(sdk, topic, context), content) for topic, content in contents.items()]
        if coverage is not None:
            shown.append((channel_of(sdk, SPHERE, context), scene_of(coverage, frame_id)))
        for time in (0.0, max(seconds, SHORTEST)):
            for channel, content in shown:
                channel.log(content, log_time=round(1e9 * time))
    return whole.getvalue()


def channel_of(sdk: Any, topic: str, context: Any) -> Any:
    """Return a channel of a topic in a context of foxglove-sdk."""
    if topic == SPHERE:
        return sdk.channels.SceneUpdateChannel(topic, context=context)
    return sdk.Channel(topic, schema=SCHEMAS[topic], message_encoding='json', context=context)


def scene_of(coverage: Coverage, frame_id: str) -> Any:
    """Return the sphere as a SceneUpdate: the cells, earlier up directions, the next motion, the arms, the line of text."""
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
