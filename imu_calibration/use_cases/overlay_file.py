"""MCAP of a simulation over the measurement for Foxglove: the content of the overlay of a diagnosis report, as JSON with schemas."""

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np

from imu_calibration.calibration.diagnosis.traces import Traces
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.report.overlay import WHEN, histogram
from imu_calibration.use_cases.foxglove_file import foxglove

OVERLAY, RESIDUAL, SPECTRUM, HISTOGRAM = '/overlay', '/residual', '/residual_spectrum', '/residual_histogram'


def overlay_bytes(traces: Traces, joint_names: Sequence[str]) -> bytes:
    """
    Return the MCAP; SI units, log times in s since the first sample.

    ``/overlay/SENSOR/AXIS`` has measured, simulated_before and simulated_after on the segment with the largest difference;
    ``/residual/SENSOR`` the residual before and after with time, force, rate, angles and temperature; ``/residual_spectrum/SENSOR`` and
    ``/residual_histogram/SENSOR/AXIS`` arrays of the same length.

    Raises
    ------
    InputError
        When foxglove-sdk is not installed.

    """
    sdk, whole = foxglove(), BytesIO()
    context = sdk.Context()
    with sdk.open_mcap(whole, context=context):
        for topic, messages in _topics(traces, joint_names):
            channel = sdk.Channel(topic, schema={'title': topic.strip('/').replace('/', '.'), **_schema(messages[0][1])},
                                  message_encoding='json', context=context)
            for time, content in messages:
                channel.log(content, log_time=round(1e9 * time))
    return whole.getvalue()


def _topics(traces, joint_names):
    """Yield (topic, [(time, content)])."""
    end = float(traces.time[-1])
    for sensor in SENSORS:
        for axis, segment in zip(AXES, traces.segments.get(sensor, ())):
            names = [name.replace(' ', '_') for name in segment.signals]
            rows = np.column_stack(list(segment.signals.values()))
            yield f'{OVERLAY}/{sensor}/{axis}', [(time, dict(zip(names, row))) for time, row in zip(segment.time.tolist(), rows.tolist())]
        yield f'{RESIDUAL}/{sensor}', [(float(traces.time[k]), _residual(traces, sensor, joint_names, k)) for k in range(len(traces.time))]
        if sensor in traces.distances:
            frequency, density, noise = traces.distances[sensor].density()
            yield f'{SPECTRUM}/{sensor}', [(time, {'frequency': frequency.tolist(), 'noise': _by_axis(noise),
                                                   **{when: _by_axis(own) for when, own in zip(WHEN, density)}}) for time in (0.0, end)]
        for k, axis in enumerate(AXES):
            middles, counts = histogram({when: getattr(traces, when)[sensor][:, k] for when in WHEN})
            content = {'residual': middles.tolist(), **{when: own.tolist() for when, own in counts.items()}}
            yield f'{HISTOGRAM}/{sensor}/{axis}', [(time, content) for time in (0.0, end)]


def _residual(traces, sensor, joint_names, k):
    found = {'time': float(traces.time[k]), 'force': _vector(traces.force_s[k]), 'rate': _vector(traces.rate_s[k]),
             'angle': dict(zip(joint_names, traces.position[k].tolist())),
             **{when: _vector(getattr(traces, when)[sensor][k]) for when in WHEN}}
    return found if traces.temperature_c is None else found | {'temperature_c': float(traces.temperature_c[k])}


def _vector(values):
    return dict(zip(AXES, values.tolist()))


def _by_axis(values):
    return dict(zip(AXES, values.T.tolist()))


def _schema(content: Any) -> dict[str, Any]:
    """Return the JSON schema of a content."""
    if isinstance(content, dict):
        return {'type': 'object', 'properties': {name: _schema(value) for name, value in content.items()}}
    return {'type': 'array', 'items': {'type': 'number'}} if isinstance(content, list) else {'type': 'number'}
