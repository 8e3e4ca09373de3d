"""MCAP files with the layout of a viewer: a recording, a result, an overlay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from imu_calibration.api.calibrate import calibrate_recordings
from imu_calibration.api.choices import Choices
from imu_calibration.api.recordings import Stand, refuse_stand
from imu_calibration.calibration.coverage import (
    Coverage,
    arrows_of,
    label_of,
    seen_of,
    sphere_cells,
)
from imu_calibration.calibration.diagnosis.traces import Traces
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.errors import InputError
from imu_calibration.core.samples import SampleBlock
from imu_calibration.document import files
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.outcome import exit_code, shortcomings
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.estimation.solution import tolerances_of
from imu_calibration.report.diagnosis_page import histogram

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from imu_calibration.preprocessing.window import Window

PARAMETERS_TOPIC, SPHERE_TOPIC = '/imu/parameters', '/imu/coverage'
RESIDUAL_TOPIC, SPECTRUM_TOPIC = '/imu/residual/windows', '/imu/residual/spectrum'
BAND = 1.959964
"""Standard deviations on each side of a value that hold 95 %."""


def parameters(calibration: Calibration, tolerances: np.ndarray) -> dict[str, Any]:
    """
    Return every parameter with tolerance and status as plain data.

    The standard deviation and the band of 95 % are omitted where they are unknown.
    """
    units = []
    for effect in calibration.model.effects:
        units += [effect.unit_of(k) for k in range(effect.size)]
    rows = []
    for index, name in enumerate(calibration.param_names):
        value = float(calibration.values[index])
        sd = float(calibration.sd[index])
        tolerance = float(tolerances[index])
        row: dict[str, Any] = {
            'name': name,
            'value': value,
            'unit': units[index],
            'tolerance': tolerance,
            'status': str(calibration.status[index]),
        }
        if calibration.uncertainty_known and np.isfinite(sd):  # JSON has no infinity
            row |= {
                'sd': sd,
                'low': value - BAND * sd,
                'high': value + BAND * sd,
                'ratio': sd / tolerance,
            }
        rows.append(row)
    return {'parameters': rows}


def residual(result: CalibrationResult) -> dict[str, Any]:
    """
    Return the errors of window means before and after, in order of time, as plain data.

    The sd of each mean from noise is returned too (`floor`).
    """
    errors = result.window_errors()
    windows = []
    for k in np.argsort(errors.time, kind='stable'):
        windows.append(
            {
                'time': float(errors.time[k]),
                'motion': str(errors.kind[k]),
                'before': _by_sensor(errors.before, k),
                'after': _by_sensor(errors.after, k),
                'floor': _by_sensor(errors.floor, k),
            }
        )
    return {'windows': windows}


LONGEST_SEGMENT = 1024
"""
Most samples of a segment: a finer resolution than that of a recording of a minute is not useful.
"""
SHORTEST_SEGMENT = 64
"""Windows with fewer samples are omitted."""


def residual_spectrum(
    result: CalibrationResult, windows: Sequence[Window]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """
    Return (frequency, sensor -> density) of the residuals of the windows with motion.

    By Welch's method [1], the power of segments of one length, each about its mean, is averaged
    over all windows.

    Parameters
    ----------
    result : CalibrationResult
        The calibration that predicts the readings.
    windows : sequence of Window
        Windows with their samples; those at rest are omitted.

    Returns
    -------
    frequency : ndarray
        Above zero, Hz, shape (n,); none where no window is long enough.
    dict
        Sensor -> one-sided amplitude density, (m/s^2)/sqrt(Hz) or (rad/s)/sqrt(Hz), shape (n, 3).

    References
    ----------
    .. [1] P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70-73.

    """
    from scipy.signal import welch  # here, because its import is slow

    windows = [
        window for window in windows if window.kind != 'static' and len(window) >= SHORTEST_SEGMENT
    ]
    if not windows:
        return np.zeros(0), {sensor: np.zeros((0, 3)) for sensor in SENSORS}
    # All spectra have the frequencies of one segment length, so that shorter windows are omitted.
    segment = min(LONGEST_SEGMENT, int(np.median([len(window) for window in windows])))
    windows = [window for window in windows if len(window) >= segment]
    rate = 1 / float(np.median([window.period for window in windows]))
    weights = np.array([len(window) for window in windows], float)
    residuals = [result.residuals_of(window) for window in windows]
    density = {}
    for sensor in SENSORS:
        spectra = []
        for of_window in residuals:
            _, power = welch(of_window[sensor], rate, nperseg=segment, axis=0)
            spectra.append(power)
        density[sensor] = np.sqrt(np.average(spectra, axis=0, weights=weights))[1:]
    return np.fft.rfftfreq(segment, 1 / rate)[1:], density


def _by_sensor(vectors: Mapping[str, np.ndarray], k: int) -> dict[str, dict[str, float]]:
    """Return row k of the vectors (n, 3) of each sensor: sensor -> axis -> component."""
    return {sensor: _by_finite_axis(vectors[sensor][k]) for sensor in SENSORS}


def _by_finite_axis(vector: np.ndarray) -> dict[str, float]:
    """Return axis -> component; unknown ones are omitted, because JSON has no NaN."""
    components = {}
    for axis, component in zip('xyz', vector, strict=True):
        if np.isfinite(component):
            components[axis] = float(component)
    return components


MIN_FILE_SECONDS = 1.0
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
        raise InputError(
            'a view needs foxglove-sdk, which is not installed; install imu_calibration[view]'
        ) from error
    return foxglove


def mcap_bytes(topics: Iterable[tuple[str, Sequence[tuple[float, Any]]]]) -> bytes:
    """
    Return an MCAP of topics with their messages.

    A topic of plain data has the JSON schema of its first message.

    Parameters
    ----------
    topics : iterable of (topic, messages)
        Each message with its log time, s since the first sample; a SceneUpdate, or plain data in SI
        units.

    Raises
    ------
    InputError
        When foxglove-sdk is not installed.

    """
    sdk = foxglove()
    target = BytesIO()
    context = sdk.Context()
    with sdk.open_mcap(target, context=context):
        for topic, messages in topics:
            _, first = messages[0]
            if isinstance(first, dict):
                channel = sdk.Channel(
                    topic,
                    schema={'title': topic.strip('/').replace('/', '.'), **_schema(first)},
                    message_encoding='json',
                    context=context,
                )
            else:
                channel = sdk.channels.SceneUpdateChannel(topic, context=context)
            for time, content in messages:
                channel.log(content, log_time=round(1e9 * time))
    return target.getvalue()


def _schema(content: Any) -> dict[str, Any]:
    """Return the JSON schema of a content."""
    if isinstance(content, dict):
        return {
            'type': 'object',
            'properties': {name: _schema(value) for name, value in content.items()},
        }
    if isinstance(content, list):
        return {'type': 'array', 'items': _schema(next(iter(content), 0.0))}
    return {'type': 'string' if isinstance(content, str) else 'number'}


def scene_of(coverage: Coverage, frame_id: str) -> Any:
    """
    Return the sphere of a coverage as a SceneUpdate.

    It has the cells, earlier up directions, the next motion, the arms, and the line of text.
    """
    messages = foxglove().messages

    def color(rgb):
        """Return a Color."""
        return messages.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=0.9)

    def pose(place, quaternion=(0.0, 0.0, 0.0, 1.0)):
        """Return a Pose."""
        return messages.Pose(
            position=messages.Vector3(**_named(place)),
            orientation=messages.Quaternion(**_named(quaternion)),
        )

    def ball(place, rgb, diameter):
        """Return a sphere."""
        size = messages.Vector3(x=diameter, y=diameter, z=diameter)
        return messages.SpherePrimitive(pose=pose(place), size=size, color=color(rgb))

    def arrow(start, end, rgb):
        """Return an arrow."""
        vector = end - start
        length = float(np.linalg.norm(vector))
        return messages.ArrowPrimitive(
            pose=pose(start, _from_x(vector / length)),
            shaft_length=0.8 * length,
            shaft_diameter=0.025,
            head_length=0.2 * length,
            head_diameter=0.05,
            color=color(rgb),
        )

    # Cells are (place, colour, diameter), as the arguments of `ball`.
    balls = [ball(*cell) for cell in sphere_cells(coverage)]
    seen_places, seen_colour, diameter = seen_of(coverage)
    balls += [ball(place, seen_colour, diameter) for place in seen_places]
    arrows = [arrow(start, end, rgb) for _, start, end, rgb in arrows_of(coverage)]
    label_place, label_colour, line = label_of(coverage)
    text = messages.TextPrimitive(
        pose=pose(label_place), billboard=True, font_size=0.09, color=color(label_colour), text=line
    )
    entity = messages.SceneEntity(
        timestamp=messages.Timestamp(0),
        frame_id=frame_id,
        id='coverage',
        spheres=balls,
        arrows=arrows,
        texts=[text],
    )
    return messages.SceneUpdate(entities=[entity])


def _named(numbers: Iterable[float]) -> dict[str, float]:
    """Return x, y, z and, of a quaternion, w -> number."""
    return dict(zip('xyzw', map(float, numbers)))


def _from_x(direction: np.ndarray) -> np.ndarray:
    """
    Return the quaternion (x, y, z, w) of the shortest turn from x to a unit vector.

    For -x it is half a turn about z.
    """
    quaternion = np.array([0.0, -direction[2], direction[1], 1 + direction[0]])
    if quaternion[3] > 1e-9:
        return quaternion / np.linalg.norm(quaternion)
    return np.array([0.0, 0.0, 1.0, 0.0])


def overlay_topics(
    traces: Traces, joint_names: Sequence[str]
) -> Iterator[tuple[str, list[tuple[float, Any]]]]:
    """
    Yield the topics of `mcap_bytes` for a diagnosis.

    ``/overlay/SENSOR/AXIS`` has measured, simulated_before and simulated_after on the segment with
    the largest difference; ``/residual/SENSOR`` the residual before and after with time, force,
    rate, angles and temperature; ``/residual_spectrum/SENSOR`` and
    ``/residual_histogram/SENSOR/AXIS`` arrays of the same length.
    """
    end = float(traces.time[-1])
    for sensor in SENSORS:
        # 1. Signals on a segment, and residuals of all blocks, over time.
        for axis, segment in zip(AXES, traces.segments.get(sensor, ())):
            names = [name.replace(' ', '_') for name in segment.signals]
            rows = np.column_stack(list(segment.signals.values()))
            messages = []
            for time, row in zip(segment.time.tolist(), rows.tolist()):
                messages.append((time, dict(zip(names, row))))
            yield f'/overlay/{sensor}/{axis}', messages
        messages = []
        for k, time in enumerate(traces.time.tolist()):
            messages.append((time, _residual(traces, sensor, joint_names, k)))
        yield f'/residual/{sensor}', messages
        # 2. Spectrum and histograms belong to the complete time: at its start and at its end.
        if sensor in traces.distances:
            frequency, (before, after), noise = traces.distances[sensor].density()
            content = {
                'frequency': frequency.tolist(),
                'noise': _by_axis(noise),
                'before': _by_axis(before),
                'after': _by_axis(after),
            }
            yield f'/residual_spectrum/{sensor}', [(0.0, content), (end, content)]
        for k, axis in enumerate(AXES):
            middles, counts = histogram(
                {'before': traces.before[sensor][:, k], 'after': traces.after[sensor][:, k]}
            )
            content = {
                'residual': middles.tolist(),
                'before': counts['before'].tolist(),
                'after': counts['after'].tolist(),
            }
            yield f'/residual_histogram/{sensor}/{axis}', [(0.0, content), (end, content)]


def _residual(traces: Traces, sensor: str, joint_names: Sequence[str], k: int) -> dict[str, Any]:
    """Return the residual of block k before and after, with its variables, as plain data."""
    content = {
        'time': float(traces.time[k]),
        'force': _named(traces.force_s[k]),
        'rate': _named(traces.rate_s[k]),
        'angle': dict(zip(joint_names, traces.position[k].tolist())),
        'before': _named(traces.before[sensor][k]),
        'after': _named(traces.after[sensor][k]),
    }
    if traces.temperature_c is not None:
        content['temperature_c'] = float(traces.temperature_c[k])
    return content


def _by_axis(values: np.ndarray) -> dict[str, list[float]]:
    """Return axis -> column of values, shape (n, 3)."""
    return dict(zip(AXES, values.T.tolist()))


@dataclass(frozen=True, eq=False)
class View:
    """View of a calibration."""

    calibration: Calibration
    """The calibration."""
    contents: dict[str, dict[str, Any]]
    """Topic -> content, SI units."""
    coverage: Coverage | None
    """Directions covered by the calibration; None where there is only a file."""
    seconds: float = 0.0
    """Time from the first sample to the middle of the last window, s."""

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return shortcomings(self.calibration)

    @property
    def exit_code(self) -> int:
        """Exit code of the calibration."""
        return exit_code(self.calibration)

    @property
    def lacks(self) -> tuple[str, ...]:
        """Content that cannot be shown, with the reason."""
        if self.coverage is None:
            return (
                'a calibration file contains no residuals: only the parameters are shown; give'
                ' the recording for residuals',
            )
        if SPECTRUM_TOPIC not in self.contents:
            return (
                'no window with motion was long enough for a spectrum, and by hand there is'
                ' none: it is left out',
            )
        return ()

    def save(self, path: str | PathLike, *, force: bool = False) -> None:
        """
        Write the view as MCAP, atomically; an existing file is replaced only with `force`.

        Raises
        ------
        InputError
            When foxglove-sdk is not installed or the place cannot be written.

        """
        files.require_new(path, force=force)
        contents: dict[str, Any] = dict(self.contents)
        if self.coverage is not None:
            frame_id = self.calibration.frame_id or 'imu_link'
            contents[SPHERE_TOPIC] = scene_of(self.coverage, frame_id)
        end = max(self.seconds, MIN_FILE_SECONDS)
        topics = []
        for topic, content in contents.items():  # visible at any playback time
            topics.append((topic, [(0.0, content), (end, content)]))
        files.write_whole(path, mcap_bytes(topics))


def view(
    source: str | PathLike | SampleBlock, table: Stand | None = None, **choices: Unpack[Choices]
) -> View:
    """
    Return the view of a recording, which is calibrated, or of the parameters of a calibration file.

    Parameters
    ----------
    source : path-like or SampleBlock
        A bag or samples in memory, or a calibration.yaml, or the folder that holds it.
    table : path-like, Table or Arm, optional
        The reference of the recording, as for `calibrate`.
    choices
        See `Choices`.

    Raises
    ------
    ImuCalibrationError
        When the recording or the file cannot be used.

    """
    path = None if isinstance(source, SampleBlock) else _document_of(Path(source))
    if path is not None:
        refuse_stand(table, 'a recording, a calibration file was given; omit one')
        calibration = files.read_calibration(path)
        rows = parameters(calibration, tolerances_of(calibration.model))
        return View(calibration, {PARAMETERS_TOPIC: rows}, coverage=None)

    calibrated = calibrate_recordings(source, table, **choices)
    result = calibrated.result
    contents = {
        PARAMETERS_TOPIC: parameters(result.calibration, result.tolerances),
        RESIDUAL_TOPIC: residual(result),
    }
    frequency, density = residual_spectrum(result, result.gathered.kept)
    if len(frequency):
        lines = []
        for k, line_frequency in enumerate(frequency):
            lines.append({'frequency': float(line_frequency), **_by_sensor(density, k)})
        contents[SPECTRUM_TOPIC] = {'lines': lines}
    return View(
        calibration=result.calibration,
        contents=contents,
        coverage=calibrated.reference.coverage(result),
        seconds=contents[RESIDUAL_TOPIC]['windows'][-1]['time'],
    )


def _document_of(path: Path) -> Path | None:
    """Return the calibration file at a path or in a folder; None for a recording."""
    if (path / 'calibration.yaml').is_file():
        return path / 'calibration.yaml'
    return path if path.suffix in ('.yaml', '.yml') else None
