"""A bounded store of windows, for effects that are linearised again without a second pass over the recording."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from imu_calibration.effects.forward_equations import columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.pieces import pieces_at_rest
from imu_calibration.estimation.window_statistics import WindowStatistics, reduce_window
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window

STATIC_MOST = 4096
"""Static windows kept at most."""


class WindowStore:
    """
    All windows of a session as long as they fit, none of them afterwards.

    A static window is stored as its reduced form with one row of motion; of other windows every sample is kept.

    Parameters
    ----------
    most : int
        Samples in moving windows that are kept at most.
    complete : bool
        False when windows were missed already, as after a restart.

    """

    def __init__(self, most: int, complete: bool = True):
        self._most, self._entries, self._n_samples, self._n_static = most, [], 0, 0
        self.complete = complete and most > 0

    def copy(self) -> 'WindowStore':
        """Return a copy that shares the windows."""
        twin = WindowStore(self._most, self.complete)
        twin._entries, twin._n_samples, twin._n_static = list(self._entries), self._n_samples, self._n_static
        return twin

    def add(self, window: Window, reduced: WindowStatistics) -> None:
        """Add a copy of one window (`owned_window`), and its statistics; when it does not fit, discard all windows."""
        if not self.complete:
            return
        if window.kind == 'static':
            self._n_static += 1
            temperature = None if window.temperature_c is None else np.array([window.temperature_c.mean()])
            self._entries.append((reduced, window.motion, temperature))
        else:
            self._n_samples += len(window)
            self._entries.append(window)
        if self._n_samples > self._most or self._n_static > STATIC_MOST:
            self.complete, self._entries = False, []

    def reduced(self, model: SensorModel, table: Table, session: int) -> Iterator[WindowStatistics]:
        """Yield all windows in order with the columns of `model`, as `calibration.collector` reduces them."""
        for entry in self._entries:
            if isinstance(entry, Window):
                yield reduce_window(entry, model, table, session=session, with_pieces=True)
            else:
                yield _again(entry, model, table)


def _again(entry, model, table):
    """Return a static window's statistics with recomputed columns."""
    reduced, motion, temperature = entry
    sensors = {name: replace(known, mean=np.concatenate([columns(model, name, table, motion=motion, temperature_c=temperature).mean(axis=0),
                                                         known.mean[-3:]]))
               for name, known in reduced.sensors.items()}
    return replace(reduced, sensors=sensors, pieces={name: pieces_at_rest(known.mean, reduced.duration) for name, known in sensors.items()})


def owned_window(window: Window) -> Window:
    """Return a copy of the window in separate memory: slices would keep the complete chunk in memory."""
    motion = JointMotion.joined([window.motion])
    temperature = None if window.temperature_c is None else np.array(window.temperature_c)
    return Window(window.kind, window.stamp_ns.copy(), window.time.copy(), window.force_s.copy(), window.rate_s.copy(), motion, temperature,
                  joint_step=window.joint_step)
