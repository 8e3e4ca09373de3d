"""Measurement on a table against the simulation of two models, for plots."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from imu_calibration.calibration.diagnosis.traces import (
    DistanceSums,
    OverlaySegment,
    ResidualBlocks,
    Traces,
)
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import INPUT_OF, SENSORS
from imu_calibration.effects.forward_equations import References
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.rotations import Reference
from imu_calibration.kinematics.strapdown import dead_reckoning_errors
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import StoredWindows, Window, all_samples, chunks
from imu_calibration.references.turntable.residuals.residual_blocks import residuals
from imu_calibration.references.turntable.selection.saturation import measured
from imu_calibration.selection.regime_variables import block_means
from imu_calibration.simulation.replay import predict_windows

PLOT_BLOCK_SECONDS = 0.25
"""Residuals are averaged over this time for plots, s."""


DEAD_RECKONING = 50.0
"""Length of dead reckoning, s."""


MAX_STRETCH_STEP = 0.1
"""Longest step between samples of a stretch, s."""


MOST_STRETCHES = 12
"""Stretches of dead reckoning, evenly spread over a longer recording."""


SEGMENT = 10.0
"""Length of the segment with the largest difference, s."""


POINTS = 400
"""Points of that segment in a plot."""


def residual_traces(
    windows: Sequence[Window] | StoredWindows,
    table: Table,
    before: Solution,
    *,
    after: Solution | Calibration,
) -> Traces:
    """
    Return the Traces of two models on a recording.

    Windows are predicted in chunks, so that memory does not grow with the number of samples.

    Parameters
    ----------
    windows : sequence of Window
        Windows of kind 'unused' are used for dead reckoning and segments only.
    table : Table
    before : Solution
        Baseline, with the noise of both sensors.
    after : Solution or Calibration
        Extended model.

    """
    models = [before] if after is before else [before, after]
    sensors = tuple(before.noise)
    sums = DistanceSums()
    spans: list[tuple[float, float]] = []
    parts: list[ResidualBlocks] = []
    for group in chunks(_used(windows, spans)):
        of_models = [residuals(group, table, each.model, values=each.values) for each in models]
        old = of_models[0]
        new = of_models[-1]
        for window, stop in zip(group, np.cumsum([len(window) for window in group])):
            rows = slice(stop - len(window), stop)
            old_rows = {sensor: residual[rows] for sensor, residual in old.items()}
            new_rows = {sensor: residual[rows] for sensor, residual in new.items()}
            sums.add(window, [old_rows, new_rows], before.noise)
        parts.append(_blocks_of(group, table, before, old, new))

    blocks = _joined(parts)
    segments = {}
    for sensor in sensors:
        segments[sensor] = []
        for axis in range(3):
            start, stop = _largest(blocks.time, blocks.before[sensor][:, axis])
            segments[sensor].append(
                _segment(windows, spans, table, models, sensor, axis, start, stop)
            )
    with_both = len(sensors) == len(SENSORS)
    return Traces(
        **vars(blocks),
        dead_reckoning=_dead_reckoning(windows, spans, table, models) if with_both else None,
        segments=segments,
        distances=sums.distances(),
    )


def _blocks_of(
    windows: Sequence[Window],
    table: Table,
    model: Solution,
    before: Mapping[str, np.ndarray],
    after: Mapping[str, np.ndarray],
) -> ResidualBlocks:
    """
    Return the means over the blocks of windows.

    The reference is at the values of a model; `before`, `after`: sensor -> residuals at all
    samples, shape (n, 3).
    """
    starts = _starts(windows)
    lengths = [len(window) for window in windows]
    motion, temperature, rows = all_samples(windows)
    reference = _references(model, table, motion, temperature)
    temperature_c = None
    if temperature is not None:
        temperature_c = block_means(temperature[rows], starts)
    return ResidualBlocks(
        time=block_means(np.concatenate([window.time for window in windows]), starts),
        kind=np.repeat([str(window.kind) for window in windows], lengths)[starts],
        position=block_means(motion.position[rows], starts),
        force_s=block_means(reference['accelerometer'].force_s[rows], starts),
        rate_s=block_means(reference['gyroscope'].rate_s[rows], starts),
        temperature_c=temperature_c,
        before={sensor: block_means(before[sensor], starts) for sensor in model.noise},
        after={sensor: block_means(after[sensor], starts) for sensor in model.noise},
        samples=np.diff(starts, append=sum(lengths)),
    )


def _joined(parts: Sequence[ResidualBlocks]) -> ResidualBlocks:
    """Return the blocks of all parts; the temperature is known only if each part has it."""
    temperatures = [part.temperature_c for part in parts if part.temperature_c is not None]
    before, after = {}, {}
    for sensor in parts[0].before:
        before[sensor] = np.concatenate([part.before[sensor] for part in parts])
        after[sensor] = np.concatenate([part.after[sensor] for part in parts])
    return ResidualBlocks(
        time=np.concatenate([part.time for part in parts]),
        kind=np.concatenate([part.kind for part in parts]),
        position=np.concatenate([part.position for part in parts]),
        force_s=np.concatenate([part.force_s for part in parts]),
        rate_s=np.concatenate([part.rate_s for part in parts]),
        temperature_c=np.concatenate(temperatures) if len(temperatures) == len(parts) else None,
        before=before,
        after=after,
        samples=np.concatenate([part.samples for part in parts]),
    )


def _used(
    windows: Sequence[Window] | StoredWindows, spans: list[tuple[float, float]]
) -> Iterator[Window]:
    """
    Yield the windows that are not unused, and append (first, last) time of every window to `spans`.
    """
    for number in range(len(windows)):
        window = windows[number]
        spans.append((window.time[0], window.time[-1]))
        if window.kind != 'unused':
            yield window


def _largest(time: np.ndarray, residual: np.ndarray) -> tuple[float, float]:
    """
    Return start and end of the segment with the largest residual.

    The segment has `SEGMENT` seconds and the largest sum of squares of a residual.
    """
    sums = np.concatenate([[0.0], np.cumsum(residual**2)])
    stop = np.searchsorted(time, time + SEGMENT)
    first = int(np.argmax(sums[stop] - sums[:-1]))
    return time[first] - PLOT_BLOCK_SECONDS, time[first] + SEGMENT


def _segment(
    windows: Sequence[Window] | StoredWindows,
    spans: Sequence[tuple[float, float]],
    table: Table,
    models: Sequence[Solution | Calibration],
    sensor: str,
    axis: int,
    start: float,
    stop: float,
) -> OverlaySegment:
    inside = [
        windows[k] for k, (first, last) in enumerate(spans) if last >= start and first <= stop
    ]
    time = np.concatenate([window.time for window in inside])
    simulated = [
        predict_windows(inside, table, each.model, values=each.values)[sensor][:, axis]
        for each in models
    ]
    found = {
        'measured': np.concatenate([measured(window, sensor)[:, axis] for window in inside]),
        'simulated before': simulated[0],
        'simulated after': simulated[-1],
    }
    rows = np.flatnonzero((time >= start) & (time <= stop))
    size = max(1, len(rows) // POINTS)
    rows = rows[: len(rows) // size * size].reshape(-1, size)
    return OverlaySegment(
        time[rows].mean(axis=1), {name: signal[rows].mean(axis=1) for name, signal in found.items()}
    )


def _references(
    model: Solution | Calibration,
    table: Table,
    motion: JointMotion,
    temperature: np.ndarray | None,
) -> dict[str, Reference]:
    """Return sensor -> the Reference of its samples at the values of a model."""
    references = References(model.model.at(model.values), table, motion, temperature_c=temperature)
    return {sensor: references.at(sensor) for sensor in SENSORS}


def _starts(windows: Sequence[Window]) -> np.ndarray:
    """
    Return the first sample of each block of the windows in one piece; blocks end with their window.
    """
    places = [
        ((window.time - window.time[0]) / PLOT_BLOCK_SECONDS).astype(int) for window in windows
    ]
    return np.flatnonzero(np.concatenate([np.diff(place, prepend=-1) for place in places]))


def _dead_reckoning(
    windows: Sequence[Window] | StoredWindows,
    spans: Sequence[tuple[float, float]],
    table: Table,
    models: Sequence[Solution | Calibration],
) -> dict[str, float] | None:
    """Return medians over stretches of 50 s without gaps, or None."""
    stretches, run = [], []
    for number, (first, last) in enumerate(spans):
        if run and not 0 < first - spans[run[-1]][1] <= MAX_STRETCH_STEP:
            run = []
        run.append(number)
        if last - spans[run[0]][0] > DEAD_RECKONING:
            stretches.append(run)
            run = []
    if not stretches:
        return None
    places = np.linspace(0, len(stretches) - 1, MOST_STRETCHES).round().astype(int)
    chosen = [stretches[place] for place in np.unique(places)]
    drifts = []
    for stretch in chosen:
        drifts.append(_drifts([windows[number] for number in stretch], table, models))
    velocity, position = np.median(drifts, axis=0).T
    return {
        'seconds': DEAD_RECKONING,
        'position_before': float(position[0]),
        'position_after': float(position[-1]),
        'velocity_before': float(velocity[0]),
        'velocity_after': float(velocity[-1]),
        'stretches': len(chosen),
    }


def _drifts(
    windows: Sequence[Window], table: Table, models: Sequence[Solution | Calibration]
) -> list[list[float]]:
    """
    Return the dead-reckoning errors of velocity and position of each model.

    The errors, in m/s and m, are the ones `DEAD_RECKONING` seconds after the start of some windows.
    """
    motion, temperature, rows = all_samples(windows)
    time = np.concatenate([window.time for window in windows])
    drifts = []
    for model in models:
        error = residuals(windows, table, model.model, values=model.values)
        reference = _references(model, table, motion, temperature)
        # Input of a navigation: the true one plus the residual in its units.
        felt = {}
        for sensor in SENSORS:
            matrix = model.model.matrix(sensor, model.values)
            felt[sensor] = (
                getattr(reference[sensor], INPUT_OF[sensor])[rows]
                + np.linalg.solve(matrix, error[sensor].T).T
            )
        true = replace(
            reference['accelerometer'].select(rows),
            time=time,
            rate_s=reference['gyroscope'].rate_s[rows],
        )
        some = slice(np.searchsorted(time, time[0] + DEAD_RECKONING) + 1)
        errors = dead_reckoning_errors(
            true.select(some), felt['accelerometer'][some], felt['gyroscope'][some]
        )
        drifts.append([float(np.linalg.norm(error[-1])) for error in errors])
    return drifts
