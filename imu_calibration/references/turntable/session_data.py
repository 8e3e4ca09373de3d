"""Data of sessions on a table: windows stored, held out for the proof, merged."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from imu_calibration.calibration.gathered_data import GatheredData
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.forward_equations import References, columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.gauss_newton import after_one_step
from imu_calibration.estimation.prior import fixed_parameters, make_prior
from imu_calibration.estimation.rows import flat
from imu_calibration.estimation.scaled_solve import triangular
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.joint_motion import JointMotion
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.joint_checks import check_units
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.accumulator import (
    Accumulator,
    chosen_columns,
    restrict,
    selected_columns,
    stack,
)
from imu_calibration.references.turntable.estimation.weighted_system import WeightedSystem
from imu_calibration.references.turntable.noise_model import noise_of_windows
from imu_calibration.references.turntable.window_statistics import (
    N_AXES,
    WindowStatistics,
    count_pieces,
    pieces_at_rest,
    reduce_window,
)

STATIC_MOST = 4096
"""Static windows kept at most."""


class WindowStore:
    """
    All windows of a session as long as they fit, none of them afterwards.

    A static window is stored as its reduced form with one row of motion; of other windows every
    sample is kept.

    Parameters
    ----------
    most : int
        Samples in moving windows that are kept at most.
    complete : bool
        False when windows were missed already, as after a restart.

    """

    def __init__(self, most: int, complete: bool = True):
        self._most = most
        self._entries = []
        self._n_samples = 0
        self._n_static = 0
        self.complete = complete and most > 0

    def copy(self) -> 'WindowStore':
        """Return a copy that shares the windows."""
        twin = copy(self)
        twin._entries = list(self._entries)
        return twin

    def add(self, window: Window, reduced: WindowStatistics) -> None:
        """
        Add a copy of one window (`owned_window`), and its statistics.

        When it does not fit, discard all windows.
        """
        if not self.complete:
            return
        if window.kind == 'static':
            self._n_static += 1
            temperature = (
                None if window.temperature_c is None else np.array([window.temperature_c.mean()])
            )
            self._entries.append((reduced, window.motion, temperature))
        else:
            self._n_samples += len(window)
            self._entries.append(window)
        if self._n_samples > self._most or self._n_static > STATIC_MOST:
            self.complete, self._entries = False, []

    def reduced(self, model: SensorModel, table: Table, session: int) -> Iterator[WindowStatistics]:
        """
        Yield all windows in order with the columns of `model`.

        As `references.turntable.collector` reduces them.
        """
        for entry in self._entries:
            if isinstance(entry, Window):
                yield reduce_window(entry, model, table, session=session)
            else:
                yield _again(entry, model, table)


def _again(
    entry: tuple[WindowStatistics, JointMotion, np.ndarray | None], model: SensorModel, table: Table
) -> WindowStatistics:
    """Return a static window's statistics with recomputed columns."""
    reduced, motion, temperature = entry
    references = References(model, table, motion, temperature_c=temperature)
    sensors = {}
    for name, known in reduced.sensors.items():
        mean = np.concatenate([columns(references, name).mean(axis=0), known.mean[-3:]])
        # At rest there are no centred rows, but their width is that of the columns.
        sensors[name] = replace(known, mean=mean, within=np.zeros((0, len(mean))))
    return replace(
        reduced,
        sensors=sensors,
        pieces={
            name: pieces_at_rest(known.mean, reduced.duration) for name, known in sensors.items()
        },
    )


def owned_window(window: Window) -> Window:
    """
    Return a copy of the window in separate memory: slices would keep the complete chunk in memory.
    """
    motion = JointMotion.concatenate([window.motion])
    temperature = None if window.temperature_c is None else np.array(window.temperature_c)
    return Window(
        window.kind,
        window.stamp_ns.copy(),
        window.time.copy(),
        window.force_s.copy(),
        window.rate_s.copy(),
        motion,
        temperature,
        joint_step=window.joint_step,
        absent=window.absent,
    )


KEPT_IN_MEMORY = 250_000
"""Samples of `KeptWindows` at most, some 50 MB: 40 minutes at 100 Hz."""


@dataclass(eq=False)
class KeptWindows:
    """The used windows of a recording; of a long recording none."""

    windows: list[Window] = field(default_factory=list)
    """In the order of time; none where there were too many."""
    n_samples: int = 0
    """Samples of all used windows so far."""

    @property
    def is_complete(self) -> bool:
        """Whether all used windows are kept."""
        return self.n_samples <= KEPT_IN_MEMORY

    def used(self) -> Iterator[Window]:
        """Yield the windows."""
        yield from self.windows

    def clear(self) -> None:
        """Remove all windows."""
        self.windows, self.n_samples = [], 0

    def extend(self, windows: Iterable[Window]) -> None:
        """Append the used ones of some windows."""
        for window in windows:
            if window.kind == 'unused':
                continue
            self.n_samples += len(window.time)
            if self.is_complete:
                self.windows.append(owned_window(window))
            else:
                self.windows = []


TABLE_FOLDS = 8
"""Folds of the cross-validation."""
BLOCKS = 3 * TABLE_FOLDS
"""Blocks that are resampled for an interval; block k belongs to fold k modulo TABLE_FOLDS."""


@dataclass(eq=False)
class HeldOutBlock:
    """Every so many-th window of each kind."""

    accumulator: Accumulator = field(
        default_factory=lambda: Accumulator(in_blocks=False, share=BLOCKS)
    )
    """For fitting."""
    pieces: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """(sensor, regime) -> triangular factor of the rows of short pieces, for judging."""
    counts: dict[str, int] = field(default_factory=dict)
    """Regime -> number of pieces."""
    judged: int = 0
    """Windows with pieces for judging."""
    earlier: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """As `pieces`, of the windows that are not judged."""

    def add(self, window: WindowStatistics, judged: bool = True) -> None:
        """Add a window, and its pieces if it is judged."""
        self.accumulator.add(window)
        pieces = self.pieces if judged else self.earlier
        for sensor, of_regimes in window.pieces.items():
            for regime, rows in of_regimes.items():
                factor = rows if len(rows) <= rows.shape[1] else triangular(rows)
                stack(pieces, (sensor, regime), factor)
        if not judged:
            return
        self.judged += 1
        for regime, rows in next(iter(window.pieces.values())).items():
            count = count_pieces(window.duration) if window.kind == 'static' else len(rows)
            self.counts[regime] = self.counts.get(regime, 0) + count

    def merge(self, other: 'HeldOutBlock') -> None:
        """Add the content of another block."""
        self.accumulator.merge(other.accumulator)
        for key, factor in other.pieces.items():
            stack(self.pieces, key, factor)
        for key, factor in other.earlier.items():
            stack(self.earlier, key, factor)
        for regime, count in other.counts.items():
            self.counts[regime] = self.counts.get(regime, 0) + count
        self.judged += other.judged

    def copy(self) -> 'HeldOutBlock':
        """Return an independent copy."""
        return HeldOutBlock(
            self.accumulator.copy(),
            dict(self.pieces),
            dict(self.counts),
            self.judged,
            dict(self.earlier),
        )

    def restricted(self, wide: SensorModel, narrow: SensorModel) -> 'HeldOutBlock':
        """Return the block with the columns of the model `narrow` only."""
        chosen = {
            sensor: np.concatenate([columns[:-N_AXES], np.arange(-2 * N_AXES, 0)])
            for sensor, columns in selected_columns(wide, narrow).items()
        }
        return HeldOutBlock(
            restrict(self.accumulator, wide, narrow),
            chosen_columns(self.pieces, chosen),
            self.counts,
            self.judged,
            chosen_columns(self.earlier, chosen),
        )


@dataclass(eq=False)
class HeldOut:
    """
    Blocks of windows.

    Undivided windows of each kind are assigned to blocks in turn, so that every block has windows
    of each kind, and memory does not grow with the session.
    """

    blocks: list[HeldOutBlock] = field(
        default_factory=lambda: [HeldOutBlock() for _ in range(BLOCKS)]
    )

    def add(self, window: WindowStatistics, judged: bool = True) -> None:
        """Add a window, and its pieces if it is judged."""
        dealt = sum(block.accumulator.windows.get(window.kind, 0) for block in self.blocks)
        self.blocks[dealt % BLOCKS].add(window, judged)

    def merge(self, other: 'HeldOut') -> None:
        """Add the content of another object; its windows follow the existing ones."""
        for mine, its in zip(self.blocks, other.blocks):
            mine.merge(its)

    def copy(self) -> 'HeldOut':
        """Return an independent copy."""
        return HeldOut([block.copy() for block in self.blocks])

    def restricted(self, wide: SensorModel, narrow: SensorModel) -> 'HeldOut':
        """Return the same with the columns of the model `narrow` only."""
        return (
            self
            if wide is narrow
            else HeldOut([block.restricted(wide, narrow) for block in self.blocks])
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors with pieces for judging."""
        found: set[str] = set()
        for block in self.blocks:
            found.update(sensor for sensor, _ in block.pieces)
        return tuple(sensor for sensor in SENSORS if sensor in found)

    @property
    def n_windows(self) -> int:
        """Windows dealt out."""
        return sum(sum(block.accumulator.windows.values()) for block in self.blocks)

    @property
    def n_judged(self) -> int:
        """Windows with kept pieces."""
        return sum(block.judged for block in self.blocks)

    def values_without(self, solution: Solution) -> list[np.ndarray]:
        """
        Return the parameters without each fold.

        One Gauss-Newton step from the solution, on the rows of the remaining folds.

        Noise and held parameters are those of the solution; a parameter that only the fold
        determines is set to its prior.
        """
        model = solution.model
        prior = make_prior(solution.model)
        values = solution.values
        free = ~fixed_parameters(model) & ~solution.held
        parts = [
            _linearised(self.blocks[fold::TABLE_FOLDS], solution) for fold in range(TABLE_FOLDS)
        ]
        known = np.column_stack([prior.root, prior.root @ (prior.mean - values)])
        found = []
        for fold in range(TABLE_FOLDS):
            rows = np.concatenate([known, *(part for k, part in enumerate(parts) if k != fold)])
            found.append(after_one_step(values, rows[:, :-1][:, free], rows[:, -1], free=free))
        return found


def _linearised(blocks: Sequence[HeldOutBlock], solution: Solution) -> np.ndarray:
    """
    Return the triangular factor of ``[columns | residual]``.

    It covers all windows of some blocks, weighed by noise.
    """
    n_params = len(solution.values)
    rows = []
    for block in blocks:
        if block.accumulator.rows:
            system = WeightedSystem(block.accumulator, solution.model)
            factors = {
                sensor: system.factors(sensor, noise)
                for sensor, noise in noise_of_windows(solution).items()
            }
            rows.append(flat(system.linearise(solution.values, factors).equations))
    return triangular(np.concatenate(rows)) if rows else np.zeros((0, n_params + 1))


MAX_KEPT_SAMPLES = 100_000
"""Most samples kept of a recording."""
MAX_LIVE_SAMPLES = 30_000
"""
Most samples kept of a live session; a diagnosis needs about 1.5 kB of memory for each of them.
"""


class DecimatedWindows:
    """
    Every so many-th window of each kind, so that memory and the time of a search are bounded.

    The selection depends only on the recording. Above `most` samples every second window of each
    kind is removed.
    """

    def __init__(self, most: int = MAX_KEPT_SAMPLES) -> None:
        self.most = most
        self.n_samples = 0
        self._stride = 1
        self._counts = {}
        self._kept = []

    def add(self, window: Window) -> None:
        """Add a window in order of time, as a copy in separate memory (`owned_window`)."""
        number = self._counts[window.kind] = self._counts.get(window.kind, -1) + 1
        if number % self._stride:
            return
        self._kept.append((number, window))
        self.n_samples += len(window.time)
        while self.n_samples > self.most and len(self._kept) > 1:
            self._stride *= 2
            self._kept = [
                (number, window) for number, window in self._kept if number % self._stride == 0
            ]
            self.n_samples = sum(len(window.time) for _, window in self._kept)

    def copy(self) -> 'DecimatedWindows':
        """Return an independent copy; the windows are shared."""
        twin = copy(self)
        twin._counts, twin._kept = dict(self._counts), list(self._kept)
        return twin

    @property
    def windows(self) -> list[Window]:
        """The windows kept, in order of time."""
        return [window for _, window in self._kept]


KEPT_SAMPLES = 200_000
"""Samples of moving windows kept for plots and for the autocorrelation of residuals."""
MOST_ASKED = 4
"""Most recordings with windows kept for the search of effects."""
KEPT_POSES = 2000
"""Most static windows with kept joint positions."""


@dataclass(eq=False)
class SessionData(GatheredData):
    """Reduced data of a recording on a table."""

    accumulator: Accumulator = field(default_factory=Accumulator)
    """The least-squares system."""
    held_out: HeldOut = field(default_factory=HeldOut)
    """The same windows in folds for cross-validation."""
    spreads: list[DecimatedWindows] = field(default_factory=lambda: [DecimatedWindows()])
    """
    Windows for the search of effects, of each of the recordings with most samples, the largest
    first; empty without a search.
    """
    poses: list = field(default_factory=list)
    """(time, session, joint positions) of each static window."""
    judged_from: float = 0.0
    """Windows from this time on are judged by a proof, s."""

    def take(self, window: WindowStatistics) -> None:
        """Add a reduced window."""
        self.accumulator.add(window)
        self.held_out.add(window, window.time >= self.judged_from)

    def anew(self, windows: Iterable[WindowStatistics], judged_from: float = 0.0) -> 'SessionData':
        """Return the same with the windows reduced again."""
        fresh = replace(
            self, accumulator=Accumulator(), held_out=HeldOut(), judged_from=judged_from
        )
        for window in windows:
            fresh.take(window)
        return fresh

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without usable readings, which have no rows."""
        rows = self.accumulator.rows
        return tuple(sensor for sensor in SENSORS if rows and sensor not in rows[0].sensors)

    @property
    def moving(self) -> list:
        """
        Moving windows with all their kept samples; live, the windows of the search of effects.
        """
        windows = chain.from_iterable(spread.windows for spread in self.spreads)
        return self.kept or [window for window in windows if window.kind != 'static']


def merge(parts: Iterable[SessionData]) -> SessionData:
    """Merge the reduced data of several recordings: the merge step of calibration."""
    parts = list(parts)
    total = parts[0]
    for part in parts[1:]:
        total.accumulator.merge(part.accumulator)
        total.held_out.merge(part.held_out)
        windows = total.kept + part.kept  # up to KEPT_SAMPLES samples
        ends = np.cumsum([len(window.time) for window in windows])
        total.kept, total.poses = (
            windows[: int(np.searchsorted(ends, KEPT_SAMPLES, side='right'))],
            total.poses + part.poses,
        )
        total.spreads = sorted(total.spreads + part.spreads, key=lambda spread: -spread.n_samples)[
            :MOST_ASKED
        ]
        total.counts = {
            key: total.counts.get(key, 0) + part.counts.get(key, 0)
            for key in {**total.counts, **part.counts}
        }
        total.largest_rate = max(total.largest_rate, part.largest_rate)
        total.largest_force = max(total.largest_force, part.largest_force)
        total.frame_id = total.frame_id or part.frame_id
        total.findings += part.findings
        total.unusable = {**part.unusable, **total.unusable}
        ranges = [r for r in (total.temperature_c, part.temperature_c) if r]
        total.temperature_c = (
            (min(r[0] for r in ranges), max(r[1] for r in ranges)) if ranges else None
        )
        if part.first_stamp_ns is not None and part.last_stamp_ns is not None:
            total.first_stamp_ns = (
                part.first_stamp_ns if total.first_stamp_ns is None else total.first_stamp_ns
            )
            total.last_stamp_ns = (
                (total.last_stamp_ns or total.first_stamp_ns)
                + part.last_stamp_ns
                - part.first_stamp_ns
            )
    return total


@contextmanager
def naming(names: Sequence[str], session: int) -> Iterator[None]:
    """Put the name of a recording before its errors where there are several recordings."""
    try:
        yield
    except ImuCalibrationError as error:
        if len(names) < 2:
            raise
        raise error.named(names[session]) from error


def join(
    parts: Sequence[SessionData], names: Sequence[str], *, model: SensorModel, table: Table
) -> SessionData:
    """
    Return the merged SessionData of several recordings.

    Parameters
    ----------
    parts : list of SessionData
        One per recording, in order.
    names : sequence of str
        Names of the recordings.
    model : SensorModel
        Defines the columns.
    table : Table
        The reference.

    Raises
    ------
    InputError
        When a recording has no window, another frame than the first, or other units or axes than
        the table (`check_units`), with its name.

    """
    for session, part in enumerate(parts):
        with naming(names, session):
            check_units(part, model, table)
        if len(parts) > 1:
            part.findings = tuple(finding.named(names[session]) for finding in part.findings)
            _require_like_the_first(parts[0], part, names[0], names[session])
    return merge(parts)


def _require_like_the_first(
    first: SessionData, part: SessionData, first_name: str, name: str
) -> None:
    if not part.accumulator.rows:
        raise InputError(
            f'{name}: every recording must contain a static window, spin or dynamic segment, this'
            ' one has none; omit it'
        )
    if part.absent != first.absent:
        raise InputError(
            f'{name}: all recordings must have the same sensors, this one has no'
            f' {" and no ".join(part.absent) or "absent sensor"}, {first_name} has no'
            f' {" and no ".join(first.absent) or "absent sensor"}; calibrate them one by one',
            code='other_sensors',
        )
    if part.frame_id != first.frame_id:
        raise InputError(
            f'{name}: all recordings must be of one IMU, '
            f"the frame is '{part.frame_id}' here and '{first.frame_id}' in {first_name}; "
            'calibrate different IMUs one by one'
        )
