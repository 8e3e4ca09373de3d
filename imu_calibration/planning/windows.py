"""What windows of planned motions say: rows of the window means and information of what varies within, in planning coordinates."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

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
"""Instants per second at which columns are taken: a turn at 300 deg/s has 19."""
WINDOWS = {'rest': 'static', 'spin': 'spin'}
"""Segment -> window; everything else is dynamic."""


@dataclass(frozen=True, eq=False)
class PlannedWindow:
    """One window of a planned motion, as the calibration will cut it."""

    middle: float
    """Time since the motion began, s."""
    length: float
    """s, with what is lost before it."""
    samples: float
    """Number of samples in it."""
    means: dict[str, np.ndarray]
    """Sensor -> rows of the means, shape (3, n)."""
    within: dict[str, np.ndarray]
    """Sensor -> information of what varies within, for the noise of that sensor, shape (n, n)."""


class WindowPredictor:
    """
    Works out windows of planned motions from the columns of the model.

    Parameters
    ----------
    table : Table
    coordinates : Coordinates
        The model where it is linearised, and what its parameters are measured in.
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
        if not flat:
            return [[] for _ in cuts]
        motion = JointMotion(*(np.concatenate([getattr(cut[0], field.name) for cut in flat]) for field in fields(JointMotion)))
        edges = np.cumsum([0] + [len(cut[0]) for cut in flat])
        model = self.coordinates.model
        temperature = np.full(len(motion), model.temperature_ref_c) if model.needs_temperature else None
        designs = {sensor: columns(model, sensor, self.table, motion=motion, temperature_c=temperature) for sensor in SENSORS}
        windows = iter([self._window(cut, {s: designs[s][a:b] for s in SENSORS})
                        for cut, a, b in zip(flat, edges, edges[1:], strict=False)])
        return [[next(windows) for _ in one] for one in cuts]

    def _cut(self, segments) -> Iterator[tuple[JointMotion, float, float, float]]:
        """Yield (motion at some instants, middle, length with what settles, seconds of data) of each window."""
        begin = 0.0
        for segment in segments:
            kind = WINDOWS.get(segment.kind, 'dynamic')
            lost = 0.0 if kind == 'dynamic' else self.settings.settling
            seconds = segment.duration - lost
            if seconds >= getattr(self.settings, f'{kind}_minimum'):
                count = 1 if kind == 'static' else max(int(np.ceil(seconds * SAMPLING)), 4)
                time = lost + (np.arange(count) + 0.5) / count * seconds
                yield Profile('', (segment,)).at(time), begin + lost + seconds / 2, segment.duration, seconds
            begin += segment.duration

    def _window(self, cut, designs):
        motion, middle, length, seconds = cut
        samples = seconds * self.rate
        means, within = {}, {}
        for sensor, design in designs.items():
            slope = self.coordinates.slopes[sensor]
            mean = design.mean(axis=0)
            means[sensor] = np.einsum('c,cap->ap', mean, slope)
            total = np.zeros((slope.shape[2],) * 2)
            if len(design) > 1:
                centred = design - mean
                gram = centred.T @ centred * (samples / len(design))
                for axis in range(3):
                    total += slope[:, axis].T @ gram @ slope[:, axis] / self.noise[sensor].low_variance[axis]
            within[sensor] = total
        return PlannedWindow(middle, length, samples, means, within)
