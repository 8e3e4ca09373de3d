"""MCAP files with the layout of a viewer: a recording, a result, an overlay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
from imu_calibration.use_cases.calibrate import calibrate_recordings
from imu_calibration.use_cases.choices import Choices
from imu_calibration.use_cases.recordings import Stand, refuse_stand

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from imu_calibration.preprocessing.window import Window

PARAMETERS_TOPIC, SPHERE_TOPIC = '/imu/parameters', '/imu/coverage'
RESIDUAL_TOPIC, SPECTRUM_TOPIC = '/imu/residual/windows', '/imu/residual/spectrum'
BAND = 1.959964
"""Standard deviations on each side of a value that hold 95 %."""


def parameters(calibration: Calibration, tolerances: np.ndarray) -> dict[str, Any]:
    """
    Return every parameter with tolerance and status.

    Without bands where the uncertainty of the values is unknown.
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
    Return the errors of window means before and after, in the order of time.

    The expected residual from noise is returned too.
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
"""Windows with fewer samples are left out."""


def residual_spectrum(
    result: CalibrationResult, windows: Sequence[Window]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """
    Return (frequency, sensor -> density) of the residuals of the windows with motion among some.

    Welch's method [1]: the power of segments of one length, each about its own mean, averaged over
    all windows.

    Parameters
    ----------
    result : CalibrationResult
        The calibration that predicts them.
    windows : sequence of Window
        With their samples.

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
    segment = min(LONGEST_SEGMENT, int(np.median([len(window) for window in windows])))
    windows = [window for window in windows if len(window) >= segment]
    rate = 1 / float(np.median([window.period for window in windows]))
    weights = np.array([len(window) for window in windows], float)
    residuals = [result.residuals_of(window) for window in windows]
    density = {}
    for sensor in SENSORS:
        spectra = [welch(own[sensor], rate, nperseg=segment, axis=0)[1] for own in residuals]
        density[sensor] = np.sqrt(np.average(spectra, axis=0, weights=weights))[1:]
    return np.fft.rfftfreq(segment, 1 / rate)[1:], density


def _by_sensor(vectors, k):
    return {sensor: _axes(vectors[sensor][k]) for sensor in SENSORS}


def _axes(vector):
    """Return the components by axis; unknown ones are omitted, because JSON has no NaN."""
    return {
        axis: float(part) for axis, part in zip('xyz', vector, strict=True) if np.isfinite(part)
    }


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
    whole = BytesIO()
    context = sdk.Context()
    with sdk.open_mcap(whole, context=context):
        for topic, messages in topics:
            if isinstance(first := messages[0][1], dict):
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
    return whole.getvalue()


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
    Return the sphere as a SceneUpdate.

    The cells, earlier up directions, the next motion, the arms, the line of text.
    """
    found = foxglove().messages

    def color(rgb):
        return found.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=0.9)

    def pose(place, turn=(0.0, 0.0, 0.0, 1.0)):
        return found.Pose(
            position=found.Vector3(**_named(place)), orientation=found.Quaternion(**_named(turn))
        )

    def ball(place, rgb, size):
        return found.SpherePrimitive(
            pose=pose(place), size=found.Vector3(x=size, y=size, z=size), color=color(rgb)
        )

    def arrow(start, along, rgb):
        length = float(np.linalg.norm(along))
        return found.ArrowPrimitive(
            pose=pose(start, _from_x(along / length)),
            shaft_length=0.8 * length,
            shaft_diameter=0.025,
            head_length=0.2 * length,
            head_diameter=0.05,
            color=color(rgb),
        )

    balls = [ball(*cell) for cell in sphere_cells(coverage)]
    seen, colour_of_seen, diameter = seen_of(coverage)
    balls += [ball(place, colour_of_seen, diameter) for place in seen]
    above, colour_of_line, line = label_of(coverage)
    arrows = [arrow(start, end - start, rgb) for _, start, end, rgb in arrows_of(coverage)]
    text = found.TextPrimitive(
        pose=pose(above), billboard=True, font_size=0.09, color=color(colour_of_line), text=line
    )
    entity = found.SceneEntity(
        timestamp=found.Timestamp(0),
        frame_id=frame_id,
        id='coverage',
        spheres=balls,
        arrows=arrows,
        texts=[text],
    )
    return found.SceneUpdate(entities=[entity])


def _named(numbers):
    return dict(zip('xyzw', map(float, numbers)))


def _from_x(along):
    """
    Return the quaternion (x, y, z, w) of the shortest turn from x to a unit vector.

    Half a turn about z where that is -x.
    """
    turn = np.array([0.0, -along[2], along[1], 1 + along[0]])
    return turn / np.linalg.norm(turn) if turn[3] > 1e-9 else np.array([0.0, 0.0, 1.0, 0.0])


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
        # Spectrum and histograms belong to the whole time.
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


def _residual(traces, sensor, joint_names, k):
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


def _by_axis(values):
    return dict(zip(AXES, values.T.tolist()))


@dataclass(frozen=True, eq=False)
class View:
    """View of a calibration."""

    calibration: Calibration
    """The calibration."""
    contents: dict[str, dict[str, Any]]
    """Topic -> content, SI units."""
    coverage: Coverage | None
    """The sphere; None where only a file is known."""
    seconds: float = 0.0
    """Until the middle of the last window."""

    @property
    def reasons(self) -> list[str]:
        """Why the exit code is 3, a line each."""
        return shortcomings(self.calibration)

    @property
    def exit_code(self) -> int:
        """That of the calibration."""
        return exit_code(self.calibration)

    @property
    def lacks(self) -> tuple[str, ...]:
        """Content that cannot be shown, with the reason."""
        if self.coverage is None:
            return (
                (
                    'a calibration file contains no residuals: only the parameters are shown; give'
                    ' the recording for residuals'
                ),
            )
        if SPECTRUM_TOPIC not in self.contents:
            return (
                (
                    'no window with motion was long enough for a spectrum, and by hand there is'
                    ' none: it is left out'
                ),
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
        shown: dict[str, Any] = dict(self.contents)
        if self.coverage is not None:
            shown[SPHERE_TOPIC] = scene_of(self.coverage, self.calibration.frame_id or 'imu_link')
        end = max(self.seconds, MIN_FILE_SECONDS)
        topics = []
        for topic, content in shown.items():  # visible at any playback time
            topics.append((topic, [(0.0, content), (end, content)]))
        files.write_whole(path, mcap_bytes(topics))


def view(
    source: str | PathLike | SampleBlock, table: Stand | None = None, **choices: Unpack[Choices]
) -> View:
    """
    Return the view of a recording, which is calibrated, or of a calibration file.

    Only its parameters.

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
    if path is None:
        made = calibrate_recordings(source, table, **choices)
        result = made.result
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
            result.calibration,
            contents,
            made.reference.coverage(result),
            contents[RESIDUAL_TOPIC]['windows'][-1]['time'],
        )
    refuse_stand(table, 'a recording, a calibration file was given; omit one')
    calibration = files.read_calibration(path)
    return View(
        calibration,
        {PARAMETERS_TOPIC: parameters(calibration, tolerances_of(calibration.model))},
        None,
    )


def _document_of(path):
    """Return the calibration file that a path means, None where it means a recording."""
    path = path / 'calibration.yaml' if (path / 'calibration.yaml').is_file() else path
    return path if path.suffix in ('.yaml', '.yml') else None
