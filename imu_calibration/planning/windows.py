"""Information of windows of planned motions: rows of the means, and information of the variation within, in planning coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.columns import columns
from imu_calibration.estimation.noise_model import NoiseModel
from imu_calibration.planning.coordinates import Coordinates
from imu_calibration.reference.joint_motion import JointMotion
from imu_calibration.reference.table import Table
from imu_calibration.segmentation.window_settings import WindowSettings
from imu_calibration.simulation.motion_builder import Profile, Segment

SAMPLING = 16.0
"""Instants per second at which columns are evaluated: a turn at 300 deg/s has 19."""
LEAST_INSTANTS = 4
"""Instants of a rest, where columns are all one and the bias wanders, and of the shortest motion."""
BLOCK = 8192
"""Instants whose columns are held in memory at a time."""
WINDOWS = {'rest': 'static', 'spin': 'spin'}
"""Segment -> window; all remaining segments are dynamic."""


@dataclass(frozen=True, eq=False)
class PlannedWindow:
    """One window of a planned motion, as the calibration will cut it."""

    kind: str
    """As the calibration will call it."""
    middle: float
    """Time since the motion began, s."""
    length: float
    """s, with the lost time before it."""
    samples: float
    """Number of samples in it."""
    means: dict[str, np.ndarray]
    """Sensor -> rows of the means, shape (3, n)."""
    variance: dict[str, np.ndarray]
    """Sensor -> variance of the means in addition to the bias in the middle of the window, shape (3,)."""
    within: np.ndarray
    """Information of the samples about their means, of both sensors together, shape (n, n)."""


class WindowPredictor:
    """
    Works out windows of planned motions from the columns of the model.

    Parameters
    ----------
    table : Table
    coordinates : Coordinates
        The model at its point of linearisation, with the units of its parameters.
    noise : dict
        Sensor -> NoiseModel of single samples.
    rate : float
        Samples per second.
    settings : WindowSettings
        How the calibration will cut windows.

    """

    def __init__(self, table: Table, coordinates: Coordinates, noise: dict[str, NoiseModel], *, rate: float,
                 settings: WindowSettings = WindowSettings()):
        self.table, self.coordinates, self.noise, self.rate, self.settings = table, coordinates, noise, rate, settings

    def predict(self, motions: Sequence[tuple[Segment, ...]]) -> list[list[PlannedWindow]]:
        """Return the windows of each of several motions, a tuple of segments each."""
        cuts = [list(self._cut(segments)) for segments in motions]
        flat = [cut for one in cuts for cut in one]
        blocks = np.cumsum([len(cut[0]) for cut in flat]) // BLOCK
        wander = cache(self._wander)   # many motions last equally long, at least a move and its way back
        windows = iter([window for block in np.unique(blocks)
                        for window in self._windows([flat[k] for k in np.flatnonzero(blocks == block)], wander)])
        return [[next(windows) for _ in one] for one in cuts]

    def _windows(self, cuts, wander):
        motion = JointMotion.joined([cut[0] for cut in cuts])
        edges = np.cumsum([0] + [len(cut[0]) for cut in cuts])
        model = self.coordinates.folded
        temperature = np.full(len(motion), model.temperature_ref_c) if model.needs_temperature else None
        designs = {sensor: columns(model, sensor, self.table, motion=motion, temperature_c=temperature) for sensor in SENSORS}
        return [self._window(cut, {s: designs[s][a:b] for s in SENSORS}, wander) for cut, a, b in zip(cuts, edges, edges[1:], strict=False)]

    def _cut(self, segments) -> Iterator[tuple[JointMotion, str, float, float, float]]:
        """Yield (motion at some instants, kind, middle, length with settling, seconds of data) of each window."""
        begin = 0.0
        for segment in segments:
            kind = WINDOWS.get(segment.kind, 'dynamic')
            lost = 0.0 if kind == 'dynamic' else self.settings.settling
            seconds = segment.duration - lost
            if seconds >= getattr(self.settings, f'{kind}_minimum'):
                count = LEAST_INSTANTS if kind == 'static' else max(int(np.ceil(seconds * SAMPLING)), LEAST_INSTANTS)
                time = lost + (np.arange(count) + 0.5) / count * seconds
                yield Profile('', (segment,)).at(time), kind, begin + lost + seconds / 2, segment.duration, seconds
            begin += segment.duration

    def _wander(self, sensor, count, seconds):
        """Return how the bias wanders within a window: variances and the directions that they belong to."""
        return np.linalg.eigh(self.noise[sensor].wander_within(((np.arange(count) + 0.5) / count - 0.5) * seconds))

    def _window(self, cut, designs, wander_of):
        motion, kind, middle, length, seconds = cut
        samples, count = seconds * self.rate, len(motion)
        means, variance, within = {}, {}, np.zeros((self.coordinates.size,) * 2)
        for sensor, design in designs.items():
            slope, noise = self.coordinates.slopes[sensor], self.noise[sensor]
            means[sensor], variance[sensor] = np.empty((3, slope.shape[2])), np.empty(3)
            reference = noise.reference.variance([kind], np.array([seconds]))[0]
            wander, turned = wander_of(sensor, count, seconds)
            rows, ones = turned.T @ design, turned.sum(axis=0)
            for axis in range(3):
                weight = 1 / (noise.low_variance[axis] * count / samples + wander)
                variance[sensor][axis] = 1 / (weight @ ones**2)
                mean = variance[sensor][axis] * ((weight * ones) @ rows)
                centred = (rows - np.outer(ones, mean)) @ slope[:, axis]
                variance[sensor][axis] += reference
                means[sensor][axis] = mean @ slope[:, axis]
                within += centred.T @ (centred * weight[:, None])
        return PlannedWindow(kind, middle, length, samples, means, variance, within)
