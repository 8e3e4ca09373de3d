"""Accumulated factors of windows, and attitudes of rests in them."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.scaled_solve import triangular
from imu_calibration.references.turntable.window_statistics import (
    SensorStatistics,
    WindowStatistics,
)

MAX_MEAN_ROWS = 4096
"""
Mean rows kept one by one; beyond it the windows are thinned by joining neighbours of the same kind.
"""
MAX_ACCUMULATOR_BLOCKS = 48
"""
Largest number of separate blocks of consecutive windows; beyond it neighbours are joined in pairs,
to half this number at least.
"""
LEAST_ROWS = 16
"""
Rows that an accumulator keeps however many share the memory: neighbours of the same kind must be
among them.
"""


class _CentredRows:
    """Addition of the centred rows of windows to their triangular factors."""

    within: dict[tuple[str, str], np.ndarray]
    """(sensor, kind) -> triangular factor of the centred rows."""
    slow: dict[tuple[str, str], np.ndarray]
    """
    (sensor, kind) -> triangular factor of the means of short pieces of the centred rows, see
    `SensorStatistics`.
    """

    def _stack_window(self, window: WindowStatistics) -> None:
        """Add the centred rows of a window."""
        for sensor, statistics in window.sensors.items():
            stack(self.within, (sensor, window.kind), statistics.within)
            if statistics.slow is not None and statistics.slow_rows:
                stack(self.slow, (sensor, window.kind), statistics.slow)

    def _stack_all_of(self, other: '_CentredRows') -> None:
        """Add the centred rows of another object."""
        for key, factor in other.within.items():
            stack(self.within, key, factor)
        for key, factor in other.slow.items():
            stack(self.slow, key, factor)


@dataclass(eq=False)
class WindowBlock(_CentredRows):
    """The centred rows of consecutive windows, for statistics of parts of a recording."""

    session: int
    """Recording of the first window."""
    start: float
    """Middle of the first window, s."""
    windows: int
    """Number of windows."""
    within: dict = field(default_factory=dict)
    """As in `Accumulator`."""
    slow: dict = field(default_factory=dict)
    """As in `Accumulator`."""

    def add(self, window: WindowStatistics) -> None:
        """Add the centred rows of one window."""
        self._stack_window(window)
        self.windows += 1

    def copy(self) -> 'WindowBlock':
        """Return an independent copy; factors are never changed in place."""
        return replace(self, within=dict(self.within), slow=dict(self.slow))

    def joined(self, other: 'WindowBlock') -> 'WindowBlock':
        """Return this block and the one after it as one."""
        both = self.copy()
        both.windows += other.windows
        both._stack_all_of(other)
        return both


@dataclass(eq=False)
class Accumulator(_CentredRows):
    """
    Sufficient statistics of any number of windows for least squares.

    Mean rows remain single, because their weights are correlated through the bias process between
    windows. The centred rows of each kind of window are one triangular factor per sensor.
    """

    rows: list[WindowStatistics] = field(default_factory=list)
    """Windows in order of time with their mean rows (WindowStatistics with empty `within`)."""
    within: dict = field(default_factory=dict)
    """(sensor, kind) -> triangular factor of the centred rows."""
    slow: dict = field(default_factory=dict)
    """(sensor, kind) -> triangular factor of the slow parts of the centred rows."""
    slow_rows: Counter = field(default_factory=Counter)
    """Kind -> number of rows in `slow`."""
    samples: Counter = field(default_factory=Counter)
    """Kind -> number of samples."""
    windows: Counter = field(default_factory=Counter)
    """Kind -> number of windows."""
    blocks: list[WindowBlock] = field(default_factory=list)
    """The same centred rows in blocks of consecutive windows, in order of time."""
    block_length: int = 1
    """Windows per block."""
    in_blocks: bool = True
    """Whether blocks are kept; without them standard deviations include noise only."""
    share: int = 1
    """
    Number of accumulators of one recording; each keeps at most `MAX_MEAN_ROWS` / `share` mean rows.
    """

    def add(self, window: WindowStatistics) -> None:
        """Add one window (WindowStatistics)."""
        self._stack_window(window)
        any_sensor = next(iter(window.sensors.values()))  # both have the same pieces
        self.slow_rows[window.kind] += any_sensor.slow_rows
        self.samples[window.kind] += window.count
        self.windows[window.kind] += 1
        if self.in_blocks:
            self._add_to_blocks(window)
        self.rows.append(_with_mean_rows_only(window))
        if len(self.rows) > self._capacity:
            self._thin()

    @property
    def _capacity(self) -> int:
        """Number of mean rows above which they are thinned."""
        return max(MAX_MEAN_ROWS // self.share, LEAST_ROWS)

    def copy(self) -> 'Accumulator':
        """Return an independent copy; rows and factors are never changed in place."""
        return replace(
            self,
            rows=list(self.rows),
            within=self.within.copy(),
            slow=self.slow.copy(),
            slow_rows=self.slow_rows.copy(),
            samples=self.samples.copy(),
            windows=self.windows.copy(),
            blocks=[block.copy() for block in self.blocks],
        )

    def merge(self, other: 'Accumulator') -> None:
        """
        Add another accumulator with the same columns.

        Its recordings follow the ones of this accumulator.
        """
        self._stack_all_of(other)
        self.slow_rows.update(other.slow_rows)
        self.samples.update(other.samples)
        self.windows.update(other.windows)
        self.rows.extend(other.rows)
        self.blocks.extend(block.copy() for block in other.blocks if self.in_blocks)
        self.block_length = max(self.block_length, other.block_length)
        self._join_blocks()
        while len(self.rows) > self._capacity:
            self._thin()

    def block_of(self, session: np.ndarray, time: np.ndarray) -> np.ndarray:
        """
        Return the index of the block of each of n windows, shape (n,).

        `session`, `time`: recording and middle of each window, s, shape (n,).
        """
        starts = np.array([(block.session, block.start) for block in self.blocks])
        sessions = starts[:, :1]
        times = starts[:, 1:]
        # Shape (n_blocks, n): whether the block begins after the window.
        later = (sessions > session) | ((sessions == session) & (times > time))
        return np.maximum((~later).sum(axis=0) - 1, 0)

    def _add_to_blocks(self, window: WindowStatistics) -> None:
        """Add the centred rows of a window to the last block, or to a new one if it is full."""
        last = self.blocks[-1] if self.blocks else None
        if last is None or last.windows >= self.block_length or last.session != window.session:
            self.blocks.append(WindowBlock(window.session, window.time, 0))
        self.blocks[-1].add(window)
        self._join_blocks()

    def _join_blocks(self) -> None:
        """Join neighbours in pairs while there are too many blocks."""
        while len(self.blocks) > MAX_ACCUMULATOR_BLOCKS:
            joined = []
            for first, second in zip(self.blocks[::2], self.blocks[1::2], strict=False):
                joined.append(first.joined(second))
            if len(self.blocks) % 2:
                joined.append(self.blocks[-1])
            self.blocks = joined
            self.block_length *= 2

    def _thin(self) -> None:
        """
        Join neighbours of one kind and recording in the older half of the mean rows.

        The mean row of two windows is their mean, and their difference is added to the centred
        rows. Without such neighbours the oldest row is removed.
        """
        # From the oldest row on: a pair becomes one row, a row without a partner remains.
        thinned = []
        index = 0
        older = len(self.rows) // 2
        while index <= min(older, len(self.rows) - 2):
            first, second = self.rows[index : index + 2]
            if (first.kind, first.session) != (second.kind, second.session):
                thinned.append(first)
                index += 1
                continue
            self._stack_difference(first, second)
            thinned.append(_joined(first, second))
            index += 2
        thinned += self.rows[index:]  # the newer half
        if len(thinned) == len(self.rows):
            del thinned[0]
        self.rows = thinned

    def _stack_difference(self, first: WindowStatistics, second: WindowStatistics) -> None:
        """Add the difference of two mean rows to the centred rows, and to those of its block."""
        targets = [self.within]
        if self.blocks:
            (block,) = self.block_of(np.array([first.session]), np.array([first.time]))
            targets.append(self.blocks[int(block)].within)
        for sensor in first.sensors:
            row = _difference(first, second, sensor)
            for factors in targets:
                stack(factors, (sensor, first.kind), row)


def stack(
    factors: dict[tuple[str, str], np.ndarray], key: tuple[str, str], factor: np.ndarray
) -> None:
    """
    Replace a factor R by the triangular factor of the rows of R and of `factor`.

    Without a factor under `key`, the rows are stored unchanged.
    """
    known = factors.get(key)
    if known is None or not len(known):
        factors[key] = factor
    elif len(factor):
        factors[key] = triangular(np.concatenate([known, factor]))


def _difference(first: WindowStatistics, second: WindowStatistics, sensor: str) -> np.ndarray:
    """
    Return the difference of the mean rows of two windows, scaled to the noise of one sample.

    With noise of variance s² the means of n and m samples differ by noise of s² (1/n + 1/m).
    """
    scale = 1 / np.sqrt(1 / first.count + 1 / second.count)
    return scale * (first.sensors[sensor].mean - second.sensors[sensor].mean)[None, :]


def _joined(first: WindowStatistics, second: WindowStatistics) -> WindowStatistics:
    """Return two windows as one, the means weighted by the numbers of samples."""
    total = first.count + second.count
    share_of_first = first.count / total
    share_of_second = second.count / total

    def mean(of_first: np.ndarray, of_second: np.ndarray) -> np.ndarray:
        """Return the mean over the samples of both windows."""
        return share_of_first * of_first + share_of_second * of_second

    sensors = {}
    for sensor, a in first.sensors.items():
        b = second.sensors[sensor]
        sensors[sensor] = SensorStatistics(
            mean(a.mean, b.mean),
            within=a.within[:0],
            noise_variance=mean(a.noise_variance, b.noise_variance),
            inflation=mean(a.inflation, b.inflation),
        )
    return WindowStatistics(
        kind=first.kind,
        time=share_of_first * first.time + share_of_second * second.time,
        duration=first.duration + second.duration,
        count=total,
        sensors=sensors,
        session=first.session,
        encoder_step=max(first.encoder_step, second.encoder_step),
    )


def _with_mean_rows_only(window: WindowStatistics) -> WindowStatistics:
    """Return a window without its centred rows and pieces."""
    sensors = {}
    for name, statistics in window.sensors.items():
        sensors[name] = replace(
            statistics, within=statistics.within[:0].copy(), slow=None, slow_rows=0
        )
    return replace(window, sensors=sensors, pieces={})


def selected_columns(wide: SensorModel, narrow: SensorModel) -> dict[str, np.ndarray]:
    """
    Return sensor -> indices of the columns of a wide model that a narrow model has too.

    A row of the wide model is ``[columns of its groups | three outputs]``. The indices are those of
    the groups of `narrow`, in its order, then the last three.
    """
    chosen = {}
    for sensor in SENSORS:
        columns_of_group = wide.layout(sensor).rows  # name of a group -> slice of the columns
        indices = []
        for name, _ in narrow.groups(sensor):
            columns = columns_of_group[name]
            indices.append(np.arange(columns.start, columns.stop))
        chosen[sensor] = np.concatenate([*indices, [-3, -2, -1]])
    return chosen


def restrict(accumulator: Accumulator, wide: SensorModel, narrow: SensorModel) -> Accumulator:
    """Return an accumulator of the model `wide` with the columns of the model `narrow` only."""
    chosen = selected_columns(wide, narrow)
    blocks = []
    for block in accumulator.blocks:
        within = chosen_columns(block.within, chosen)
        slow = chosen_columns(block.slow, chosen)
        blocks.append(replace(block, within=within, slow=slow))
    return replace(
        accumulator.copy(),
        rows=[restricted_window(row, chosen) for row in accumulator.rows],
        blocks=blocks,
        within=chosen_columns(accumulator.within, chosen),
        slow=chosen_columns(accumulator.slow, chosen),
    )


def chosen_columns(
    factors: dict[tuple[str, str], np.ndarray], chosen: dict[str, np.ndarray]
) -> dict[tuple[str, str], np.ndarray]:
    """Return (sensor, kind) -> factor with the columns `chosen` of the sensor only."""
    return {(sensor, kind): factor[:, chosen[sensor]] for (sensor, kind), factor in factors.items()}


def restricted_window(window: WindowStatistics, chosen: dict[str, np.ndarray]) -> WindowStatistics:
    """Return a reduced window with the columns `chosen` (sensor -> indices) only."""
    sensors = {}
    for name, statistics in window.sensors.items():
        indices = chosen[name]
        sensors[name] = replace(
            statistics,
            mean=statistics.mean[indices],
            within=statistics.within[:, indices],
            slow=None if statistics.slow is None else statistics.slow[:, indices],
        )
    return replace(window, sensors=sensors)
