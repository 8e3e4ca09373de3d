"""Normal matrices ``[design | residual]' V^-1 [design | residual]`` of windows of a reduced recording, weighed with a noise."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.estimation.whitening import Whitening
from imu_calibration.selection.parameter_space import ParameterSpace


def normal_matrix(space: ParameterSpace, noise: dict[str, NoiseModel], select: np.ndarray | None = None) -> np.ndarray:
    """Return the normal matrix of the windows `select` (mask; all where not given), shape (q + 1, q + 1)."""
    return within_matrix(space, noise, select) + mean_matrix(space, {sensor: white_means(space, noise, sensor) for sensor in SENSORS},
                                                             select)


def within_matrix(space: ParameterSpace, noise: dict[str, NoiseModel], select: np.ndarray | None = None, *,
                  sensors: Sequence[str] = SENSORS) -> np.ndarray:
    """Return the part of the normal matrix from within the windows."""
    total = np.zeros((space.size + 1, space.size + 1))
    for sensor in sensors:
        for axis in range(3):
            at = space.places(sensor, axis)
            total[np.ix_(at, at)] += within_of_axis(space, noise[sensor], sensor, axis=axis, select=select)
    return total


def within_of_axis(space: ParameterSpace, noise: NoiseModel, sensor: str, *, axis: int, select: np.ndarray | None = None) -> np.ndarray:
    """Return the same of one axis over its own columns, ``space.places(sensor, axis)``."""
    total, kind = np.zeros((len(space.places(sensor, axis)),) * 2), space.recording.kind
    chosen = space.recording.moving if select is None else select & space.recording.moving
    for name in np.unique(kind[chosen]):
        total += space.within_sum(sensor, axis, chosen & (kind == name)) / noise.row_variance(name)[axis]
    return total


def matrix_of_each(space: ParameterSpace, noise: dict[str, NoiseModel]) -> np.ndarray:
    """Return the normal matrix of each window, shape (k, q + 1, q + 1)."""
    moving, kind = space.recording.moving, space.recording.kind
    total = np.zeros((len(kind), space.size + 1, space.size + 1))
    for sensor in SENSORS:
        variance = np.array([noise[sensor].row_variance(name) for name in kind[moving]]).reshape(-1, 3)
        for axis, rows in enumerate(white_means(space, noise, sensor)):
            at = space.places(sensor, axis)
            own = rows[:, :, None] * rows[:, None, :]
            own[moving] += np.concatenate(list(space.within_each(sensor, axis, moving))) / variance[:, axis, None, None]
            total[:, at[:, None], at] += own
    return total


def mean_matrix(space: ParameterSpace, white: dict[str, list[np.ndarray]], select: np.ndarray | None = None) -> np.ndarray:
    """Return the part from the means of the windows, from sensor -> `white_means`."""
    total = np.zeros((space.size + 1, space.size + 1))
    for sensor, axes in white.items():
        for axis, rows in enumerate(axes):
            rows, at = rows if select is None else rows[select], space.places(sensor, axis)
            total[np.ix_(at, at)] += rows.T @ rows
    return total


def scatter_of_each(space: ParameterSpace, noise: dict[str, NoiseModel], values: np.ndarray) -> dict[str, np.ndarray]:
    """Return sensor -> factor of each window's scatter within, at parameters (q,), over its kind, shape (k, 3)."""
    recording, found, reduced = space.recording, {}, space.reduced(range(space.size), values)
    for sensor in SENSORS:
        usual = np.array([noise[sensor].row_variance(name) for name in recording.kind]) * np.maximum(recording.count - 1, 1)[:, None]
        at = [space.places(sensor, axis) for axis in range(3)]
        own = [space.slopes_within(sensor, axis, reduced[at[axis]]) @ reduced[at[axis]] for axis in range(3)]
        found[sensor] = np.maximum(np.stack(own, axis=1) / usual, 1.0)
    return found


def white_means(space: ParameterSpace, noise: dict[str, NoiseModel], sensor: str, *, scatter: np.ndarray | None = None) -> list[np.ndarray]:
    """
    Return for each axis the mean rows, turned into independent rows of unit variance, shape (k, q_a + 1).

    `scatter`: factor of each window's scatter within over its kind, shape (k, 3).
    """
    recording, own = space.recording, noise[sensor]
    variance = own.variance_beside_bias(recording.kind, recording.count, recording.duration, keys=recording.keys) + own.offset_sd**2
    if scatter is not None:
        variance = variance + (scatter - 1) * own.mean_variance(recording.kind, recording.count)
    return [Whitening(variance[:, axis:axis + 1], recording.time, recording.sessions, processes=own.bias_processes)(rows[:, None])[:, 0]
            for axis, rows in enumerate(space.mean[sensor])]
