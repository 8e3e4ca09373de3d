"""Measurement on a table against the simulation of two models, for plots."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

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
from imu_calibration.references.turntable.window_statistics import measured
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
    # A single model is predicted once: the items 0 and -1 are then the same.
    models = [before] if after is before else [before, after]
    recording = _Recording(windows, table, models)

    # Residuals of the used windows: their sums of squares, and their means over blocks.
    sums = DistanceSums()
    blocks_of_groups: list[ResidualBlocks] = []
    for group in chunks(recording.used_windows()):
        residuals_of_models = [
            residuals(group, table, model.model, values=model.values) for model in models
        ]
        residual_before = residuals_of_models[0]
        residual_after = residuals_of_models[-1]
        for window, stop in zip(group, np.cumsum([len(window) for window in group])):
            rows = slice(stop - len(window), stop)
            before_rows = {sensor: values[rows] for sensor, values in residual_before.items()}
            after_rows = {sensor: values[rows] for sensor, values in residual_after.items()}
            sums.add(window, [before_rows, after_rows], before.noise)
        blocks_of_groups.append(_blocks_of(group, table, before, residual_before, residual_after))
    blocks = _joined(blocks_of_groups)

    # Readings where the residual of each axis is largest, and dead reckoning with both sensors.
    sensors = tuple(before.noise)
    segments = {}
    for sensor in sensors:
        segments[sensor] = []
        for axis in range(3):
            start, stop = _segment_of_largest(blocks.time, blocks.before[sensor][:, axis])
            segments[sensor].append(recording.overlay(sensor, axis, start, stop))
    with_both = len(sensors) == len(SENSORS)
    return Traces(
        **vars(blocks),
        dead_reckoning=_dead_reckoning(recording) if with_both else None,
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
    Return means of the reference and of residuals over blocks of `PLOT_BLOCK_SECONDS`.

    Parameters
    ----------
    windows : sequence of Window
    table : Table
    model : Solution
        The reference is at its values.
    before, after : mapping
        Sensor -> residuals at the samples of all windows, shape (n, 3).

    """
    starts = _block_starts(windows)
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
    """Return all blocks in one object; with temperatures only if each part has them."""
    temperatures = [part.temperature_c for part in parts if part.temperature_c is not None]
    before = {}
    after = {}
    for sensor in parts[0].before:
        before[sensor] = np.concatenate([part.before[sensor] for part in parts])
        after[sensor] = np.concatenate([part.after[sensor] for part in parts])
    arrays = {}
    for name in ('time', 'kind', 'position', 'force_s', 'rate_s', 'samples'):
        arrays[name] = np.concatenate([getattr(part, name) for part in parts])
    return ResidualBlocks(
        temperature_c=np.concatenate(temperatures) if len(temperatures) == len(parts) else None,
        before=before,
        after=after,
        **arrays,
    )


def _segment_of_largest(time: np.ndarray, residual: np.ndarray) -> tuple[float, float]:
    """
    Return start and end of the segment with the largest sum of squared residuals, s.

    Among the segments of `SEGMENT` seconds that begin at a block; `time`, `residual`: of the
    blocks, shape (n,).
    """
    # Sum of the blocks first to stop - 1: sums[stop] - sums[first].
    sums = np.concatenate([[0.0], np.cumsum(residual**2)])
    stop = np.searchsorted(time, time + SEGMENT)
    first = int(np.argmax(sums[stop] - sums[:-1]))
    return time[first] - PLOT_BLOCK_SECONDS, time[first] + SEGMENT


@dataclass(eq=False)
class _Recording:
    """The windows of a recording and the models that predict them."""

    windows: Sequence[Window] | StoredWindows
    """In the order of time, with unused ones."""
    table: Table
    """The reference."""
    models: Sequence[Solution | Calibration]
    """The model before, and the model after if it is another one."""
    spans: list[tuple[float, float]] = field(default_factory=list)
    """First and last time of each window, s; complete after `used_windows`."""

    def used_windows(self) -> Iterator[Window]:
        """Yield the windows that are not unused, and note the times of all of them."""
        self.spans = []
        for number in range(len(self.windows)):
            window = self.windows[number]
            self.spans.append((window.time[0], window.time[-1]))
            if window.kind != 'unused':
                yield window

    def overlay(self, sensor: str, axis: int, start: float, stop: float) -> OverlaySegment:
        """Return measured and predicted readings from `start` to `stop`, s, for one axis."""
        inside = []
        for number, (first, last) in enumerate(self.spans):
            if last >= start and first <= stop:
                inside.append(self.windows[number])
        time = np.concatenate([window.time for window in inside])
        simulated = []
        for model in self.models:
            predicted = predict_windows(inside, self.table, model.model, values=model.values)
            simulated.append(predicted[sensor][:, axis])
        signals = {
            'measured': np.concatenate([measured(window, sensor)[:, axis] for window in inside]),
            'simulated before': simulated[0],
            'simulated after': simulated[-1],
        }
        # About POINTS means, each over `size` samples.
        rows = np.flatnonzero((time >= start) & (time <= stop))
        size = max(1, len(rows) // POINTS)
        rows = rows[: len(rows) // size * size].reshape(-1, size)
        means = {name: signal[rows].mean(axis=1) for name, signal in signals.items()}
        return OverlaySegment(time[rows].mean(axis=1), means)


def _references(
    model: Solution | Calibration,
    table: Table,
    motion: JointMotion,
    temperature: np.ndarray | None,
) -> dict[str, Reference]:
    """Return sensor -> the Reference of its samples at the values of a model."""
    references = References(model.model.at(model.values), table, motion, temperature_c=temperature)
    return {sensor: references.at(sensor) for sensor in SENSORS}


def _block_starts(windows: Sequence[Window]) -> np.ndarray:
    """
    Return the index of the first sample of each block among the samples of all windows.

    Blocks have `PLOT_BLOCK_SECONDS` from the start of their window and end with it.
    """
    is_first = []
    for window in windows:
        number = ((window.time - window.time[0]) / PLOT_BLOCK_SECONDS).astype(int)
        is_first.append(np.diff(number, prepend=-1))
    return np.flatnonzero(np.concatenate(is_first))


def _dead_reckoning(recording: _Recording) -> dict[str, float] | None:
    """
    Return medians of the dead-reckoning errors over stretches of `DEAD_RECKONING` seconds, or None.

    A stretch is a sequence of windows without a gap.
    """
    # Stretches, as the numbers of their windows: each ends when it is long enough, or at a gap.
    spans = recording.spans
    stretches = []
    stretch: list[int] = []
    for number, (first, last) in enumerate(spans):
        if stretch:
            end_before = spans[stretch[-1]][1]
            if not 0 < first - end_before <= MAX_STRETCH_STEP:
                stretch = []
        stretch.append(number)
        if last - spans[stretch[0]][0] > DEAD_RECKONING:
            stretches.append(stretch)
            stretch = []
    if not stretches:
        return None
    evenly = np.linspace(0, len(stretches) - 1, MOST_STRETCHES).round().astype(int)
    chosen = [stretches[number] for number in np.unique(evenly)]
    drifts = []
    for stretch in chosen:
        windows = [recording.windows[number] for number in stretch]
        drifts.append(_drifts(windows, recording.table, recording.models))
    # Shape (n_stretches, n_models, 2).
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
    Return the [velocity, position] error of dead reckoning with each model, m/s and m.

    The errors are those after `DEAD_RECKONING` seconds from the start of the windows, which must
    have no gap.
    """
    motion, temperature, rows = all_samples(windows)
    time = np.concatenate([window.time for window in windows])
    drifts = []
    for model in models:
        error = residuals(windows, table, model.model, values=model.values)
        reference = _references(model, table, motion, temperature)
        # Input of the navigation: true input + matrix^-1 residual.
        navigated = {}
        for sensor in SENSORS:
            matrix = model.model.matrix(sensor, model.values)
            true_input = getattr(reference[sensor], INPUT_OF[sensor])[rows]
            navigated[sensor] = true_input + np.linalg.solve(matrix, error[sensor].T).T
        true = replace(
            reference['accelerometer'].select(rows),
            time=time,
            rate_s=reference['gyroscope'].rate_s[rows],
        )
        first_part = slice(np.searchsorted(time, time[0] + DEAD_RECKONING) + 1)
        errors = dead_reckoning_errors(
            true.select(first_part),
            navigated['accelerometer'][first_part],
            navigated['gyroscope'][first_part],
        )
        drifts.append([float(np.linalg.norm(error[-1])) for error in errors])
    return drifts
