"""Data of sessions on a table: windows stored, held out for the proof, merged."""

from collections import Counter
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

MAX_STATIC_WINDOWS = 4096
"""Most static windows of a `WindowStore`."""


@dataclass(frozen=True, eq=False)
class StaticWindow:
    """A static window without its samples, from which other columns can be computed."""

    statistics: WindowStatistics
    """Its statistics with the columns of some model."""
    motion: JointMotion
    """Motion of the joints."""
    temperature_c: np.ndarray | None
    """Mean temperature, shape (1,), degrees Celsius; None: not measured."""

    def reduced(self, model: SensorModel, table: Table) -> WindowStatistics:
        """Return the statistics with the columns of a model."""
        references = References(model, table, self.motion, temperature_c=self.temperature_c)
        sensors = {}
        pieces = {}
        for name, known in self.statistics.sensors.items():
            output = known.mean[-N_AXES:]
            mean = np.concatenate([columns(references, name).mean(axis=0), output])
            # At rest there are no centred rows, but their width is that of the columns.
            sensors[name] = replace(known, mean=mean, within=np.zeros((0, len(mean))))
            pieces[name] = pieces_at_rest(mean, self.statistics.duration)
        return replace(self.statistics, sensors=sensors, pieces=pieces)


class WindowStore:
    """
    All windows of a session as long as they fit, none of them afterwards.

    A static window is stored without its samples; of other windows every sample is kept.

    Parameters
    ----------
    max_samples : int
        Most samples in moving windows.
    complete : bool
        False when windows were missed already, as after a restart.

    """

    def __init__(self, max_samples: int, complete: bool = True):
        self._max_samples = max_samples
        self._windows: list[Window | StaticWindow] = []
        """In the order of time."""
        self._n_samples = 0
        """Samples of the moving windows."""
        self._n_static = 0
        """Number of static windows."""
        self.complete = complete and max_samples > 0
        """Whether all windows of the session are stored."""

    def copy(self) -> 'WindowStore':
        """Return a copy that shares the windows."""
        twin = copy(self)
        twin._windows = list(self._windows)
        return twin

    def add(self, window: Window, reduced: WindowStatistics) -> None:
        """
        Add a window in separate memory (`owned_window`), and its statistics.

        When it does not fit, all windows are discarded.
        """
        if not self.complete:
            return
        if window.kind == 'static':
            self._n_static += 1
            temperature_c = None
            if window.temperature_c is not None:
                temperature_c = np.array([window.temperature_c.mean()])
            self._windows.append(StaticWindow(reduced, window.motion, temperature_c))
        else:
            self._n_samples += len(window)
            self._windows.append(window)
        if self._n_samples > self._max_samples or self._n_static > MAX_STATIC_WINDOWS:
            self.complete = False
            self._windows = []

    def reduced(self, model: SensorModel, table: Table, session: int) -> Iterator[WindowStatistics]:
        """
        Yield the statistics of all windows in order of time, with the columns of a model.

        They equal the ones of `Collector`.
        """
        for window in self._windows:
            if isinstance(window, Window):
                yield reduce_window(window, model, table, session=session)
            else:
                yield window.reduced(model, table)


def owned_window(window: Window) -> Window:
    """
    Return a copy of a window in separate memory.

    Its arrays are slices of a chunk of samples, which would be kept in memory with them.
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
    """The windows of a recording that are not unused; none of a long recording."""

    windows: list[Window] = field(default_factory=list)
    """In the order of time; empty when there were too many."""
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
        self.windows = []
        self.n_samples = 0

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
    """
    One block of windows, for the fit of parameters and for the judgement of others.

    Pieces are the means of short pieces of a window (`WindowStatistics.pieces`). They are stored as
    triangular factors, with the same sum of squared errors for any parameters.
    """

    accumulator: Accumulator = field(
        default_factory=lambda: Accumulator(in_blocks=False, share=BLOCKS)
    )
    """Statistics of all its windows, from which parameters are estimated."""
    pieces: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """(sensor, regime) -> triangular factor of the pieces of judged windows."""
    counts: dict[str, int] = field(default_factory=dict)
    """Regime -> number of pieces of judged windows."""
    judged: int = 0
    """Number of judged windows."""
    earlier: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    """As `pieces`, of the windows before `SessionData.judged_from`, which are not judged."""

    def add(self, window: WindowStatistics, judged: bool = True) -> None:
        """Add a window, and its pieces if it is judged."""
        self.accumulator.add(window)
        pieces = self.pieces if judged else self.earlier
        for sensor, rows_of_regimes in window.pieces.items():
            for regime, rows in rows_of_regimes.items():
                factor = rows if len(rows) <= rows.shape[1] else triangular(rows)
                stack(pieces, (sensor, regime), factor)
        if not judged:
            return
        self.judged += 1
        # Both sensors have the same pieces; that of a window at rest is one weighted row.
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
        return replace(
            self,
            accumulator=self.accumulator.copy(),
            pieces=dict(self.pieces),
            counts=dict(self.counts),
            earlier=dict(self.earlier),
        )

    def restricted(self, wide: SensorModel, narrow: SensorModel) -> 'HeldOutBlock':
        """Return the block with the columns of the model `narrow` only."""
        chosen = {}
        for sensor, indices in selected_columns(wide, narrow).items():
            # The rows of pieces end with the derivative of the input and the output.
            chosen[sensor] = np.concatenate([indices[:-N_AXES], np.arange(-2 * N_AXES, 0)])
        return replace(
            self,
            accumulator=restrict(self.accumulator, wide, narrow),
            pieces=chosen_columns(self.pieces, chosen),
            earlier=chosen_columns(self.earlier, chosen),
        )


@dataclass(eq=False)
class HeldOut:
    """
    The windows of a session in blocks, for cross-validation.

    Windows of each kind are assigned to blocks in turn, so that every block has windows of each
    kind.
    """

    blocks: list[HeldOutBlock] = field(
        default_factory=lambda: [HeldOutBlock() for _ in range(BLOCKS)]
    )
    """Block k belongs to fold k modulo `TABLE_FOLDS`."""

    def add(self, window: WindowStatistics, judged: bool = True) -> None:
        """Add a window, and its pieces if it is judged."""
        number_of_kind = sum(block.accumulator.windows.get(window.kind, 0) for block in self.blocks)
        self.blocks[number_of_kind % BLOCKS].add(window, judged)

    def merge(self, other: 'HeldOut') -> None:
        """Add the content of another object; its windows follow the existing ones."""
        for mine, its in zip(self.blocks, other.blocks):
            mine.merge(its)

    def copy(self) -> 'HeldOut':
        """Return an independent copy."""
        return HeldOut([block.copy() for block in self.blocks])

    def restricted(self, wide: SensorModel, narrow: SensorModel) -> 'HeldOut':
        """Return the same with the columns of the model `narrow` only."""
        if wide is narrow:
            return self
        return HeldOut([block.restricted(wide, narrow) for block in self.blocks])

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors with pieces for judging."""
        with_pieces: set[str] = set()
        for block in self.blocks:
            with_pieces.update(sensor for sensor, _ in block.pieces)
        return tuple(sensor for sensor in SENSORS if sensor in with_pieces)

    @property
    def n_windows(self) -> int:
        """Number of windows in all blocks."""
        return sum(sum(block.accumulator.windows.values()) for block in self.blocks)

    @property
    def n_judged(self) -> int:
        """Number of judged windows."""
        return sum(block.judged for block in self.blocks)

    def values_without(self, solution: Solution) -> list[np.ndarray]:
        """
        Return the parameters estimated without each fold, each shape (n_params,).

        One Gauss-Newton step from the solution, with the rows of the remaining folds and of the
        prior. Noise and held parameters are those of the solution; a parameter that only the fold
        determines is set to its prior.
        """
        model = solution.model
        prior = make_prior(solution.model)
        values = solution.values
        free = ~fixed_parameters(model) & ~solution.held
        rows_of_folds = [
            _linearised(self.blocks[fold::TABLE_FOLDS], solution) for fold in range(TABLE_FOLDS)
        ]
        # Rows [design | residual] of the prior and of the remaining folds.
        prior_rows = np.column_stack([prior.root, prior.root @ (prior.mean - values)])
        values_without = []
        for fold in range(TABLE_FOLDS):
            others = (rows for number, rows in enumerate(rows_of_folds) if number != fold)
            equations = np.concatenate([prior_rows, *others])
            design = equations[:, :-1][:, free]
            residual = equations[:, -1]
            values_without.append(after_one_step(values, design, residual, free=free))
        return values_without


def _linearised(blocks: Sequence[HeldOutBlock], solution: Solution) -> np.ndarray:
    """
    Return the triangular factor of ``[design | residual]`` of the windows of some blocks.

    The rows are in units of their noise; shape (at most n_params + 1, n_params + 1).
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
    Every k-th window of each kind, so that memory and the time of a search are bounded.

    The selection depends only on the recording: k is doubled whenever there are more than
    `max_samples` samples.
    """

    def __init__(self, max_samples: int = MAX_KEPT_SAMPLES) -> None:
        self.max_samples = max_samples
        self.n_samples = 0
        """Samples of the kept windows."""
        self._stride = 1
        """The number k."""
        self._last_numbers: dict[str, int] = {}
        """Kind -> number of its last window, from 0."""
        self._kept: list[tuple[int, Window]] = []
        """(number among the windows of its kind, window) of each kept window."""

    def add(self, window: Window) -> None:
        """Add the next window in order of time, in separate memory (`owned_window`)."""
        number = self._last_numbers.get(window.kind, -1) + 1
        self._last_numbers[window.kind] = number
        if number % self._stride:
            return
        self._kept.append((number, window))
        self.n_samples += len(window.time)
        while self.n_samples > self.max_samples and len(self._kept) > 1:
            self._stride *= 2
            self._kept = [
                (number, window) for number, window in self._kept if number % self._stride == 0
            ]
            self.n_samples = sum(len(window.time) for _, window in self._kept)

    def copy(self) -> 'DecimatedWindows':
        """Return an independent copy; the windows are shared."""
        twin = copy(self)
        twin._last_numbers = dict(self._last_numbers)
        twin._kept = list(self._kept)
        return twin

    @property
    def windows(self) -> list[Window]:
        """The windows kept, in order of time."""
        return [window for _, window in self._kept]


KEPT_SAMPLES = 200_000
"""Samples of moving windows kept for plots and for the autocorrelation of residuals."""
MAX_SEARCHED = 4
"""Most recordings with windows kept for the search of effects."""
KEPT_POSES = 2000
"""Most static windows with kept joint positions."""


@dataclass(eq=False)
class SessionData(GatheredData):
    """Reduced windows of one or more recordings on a table."""

    accumulator: Accumulator = field(default_factory=Accumulator)
    """Statistics of all windows, from which parameters are estimated."""
    held_out: HeldOut = field(default_factory=HeldOut)
    """The same windows in blocks for cross-validation."""
    for_search: list[DecimatedWindows] = field(default_factory=lambda: [DecimatedWindows()])
    """
    Windows for the search of effects: one item for each of the `MAX_SEARCHED` recordings with most
    samples, the largest first; without windows where there is no search.
    """
    poses: list[tuple[float, int, np.ndarray]] = field(default_factory=list)
    """(time, session, joint positions) of each static window."""
    sessions_of_kept: list[int] = field(default_factory=list)
    """Number of the recording of each window of `kept`."""
    judged_from: float = 0.0
    """Windows from this time on are judged by a proof, s."""
    has_known_units: bool = False
    """Whether `require_units` has accepted these windows."""

    def require_units(self, model: SensorModel, table: Table) -> None:
        """
        Refuse units and axes other than those of the table; see `check_units`.

        Windows are compared with the joints once, not again when other columns are computed.
        """
        if not self.has_known_units:
            check_units(self, model, table)
            self.has_known_units = True

    def take(self, window: WindowStatistics) -> None:
        """Add a reduced window."""
        self.accumulator.add(window)
        self.held_out.add(window, window.time >= self.judged_from)

    def with_windows(
        self, windows: Iterable[WindowStatistics], judged_from: float = 0.0
    ) -> 'SessionData':
        """Return these data with other statistics of the same windows."""
        gathered = replace(
            self, accumulator=Accumulator(), held_out=HeldOut(), judged_from=judged_from
        )
        for window in windows:
            gathered.take(window)
        return gathered

    @property
    def absent(self) -> tuple[str, ...]:
        """Sensors without usable readings, which have no rows."""
        rows = self.accumulator.rows
        return tuple(sensor for sensor in SENSORS if rows and sensor not in rows[0].sensors)

    @property
    def moving(self) -> list[Window]:
        """
        Moving windows with their samples: the kept ones, or else those for the search of effects.
        """
        if self.kept:
            return self.kept
        windows = chain.from_iterable(kept.windows for kept in self.for_search)
        return [window for window in windows if window.kind != 'static']


def merge(parts: Sequence[SessionData]) -> SessionData:
    """Return the data of several recordings as those of one; `parts` are not changed."""
    first = parts[0]
    total = replace(first, accumulator=first.accumulator.copy(), held_out=first.held_out.copy())
    for part in parts[1:]:
        total.has_known_units &= part.has_known_units
        total.accumulator.merge(part.accumulator)
        total.held_out.merge(part.held_out)
        total.poses = total.poses + part.poses

        # The first windows, up to KEPT_SAMPLES samples.
        windows = total.kept + part.kept
        ends = np.cumsum([len(window.time) for window in windows])
        n_kept = int(np.searchsorted(ends, KEPT_SAMPLES, side='right'))
        total.kept = windows[:n_kept]
        total.sessions_of_kept = (total.sessions_of_kept + part.sessions_of_kept)[:n_kept]

        largest_first = sorted(total.for_search + part.for_search, key=lambda kept: -kept.n_samples)
        total.for_search = largest_first[:MAX_SEARCHED]
        counts = Counter(total.counts)
        counts.update(part.counts)
        total.counts = dict(counts)
        total.largest_rate = max(total.largest_rate, part.largest_rate)
        total.largest_force = max(total.largest_force, part.largest_force)
        total.frame_id = total.frame_id or part.frame_id
        total.findings += part.findings
        total.unusable = {**part.unusable, **total.unusable}
        total.temperature_c = _joint_range(total.temperature_c, part.temperature_c)

        # The duration is the sum of the durations.
        if part.first_stamp_ns is not None and part.last_stamp_ns is not None:
            if total.first_stamp_ns is None:
                total.first_stamp_ns = part.first_stamp_ns
            end_ns = total.last_stamp_ns or total.first_stamp_ns
            total.last_stamp_ns = end_ns + part.last_stamp_ns - part.first_stamp_ns
    return total


def _joint_range(
    first: tuple[float, float] | None, second: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Return the smallest and the largest value of two ranges, one or both of which may be None."""
    if not first or not second:
        return first or second
    return min(first[0], second[0]), max(first[1], second[1])


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
    named_parts = []
    for session, part in enumerate(parts):
        with naming(names, session):
            part.require_units(model, table)
        if len(parts) > 1:
            _require_like_the_first(parts[0], part, names[0], names[session])
            findings = tuple(finding.named(names[session]) for finding in part.findings)
            part = replace(part, findings=findings)
        named_parts.append(part)
    return merge(named_parts)


def _require_like_the_first(
    first: SessionData, part: SessionData, first_name: str, name: str
) -> None:
    """Raise an InputError unless a recording has windows, and sensors and frame of the first."""
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
