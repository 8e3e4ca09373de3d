"""Collection of windows from blocks of samples, and the state of a session as a file."""

import copy
import io
import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.calibration.from_solution import ModelChanges, ModelExtension
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.documents import load_arrays
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.core.readings import RawReadings
from imu_calibration.core.samples import BlockSource, ImuSamples, SampleBlock
from imu_calibration.effects.base import SECTIONS
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.stream_cleaning import NO_RANGES, Watcher
from imu_calibration.preprocessing.window import StoredWindows, Window, WindowSettings
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.turntable.accumulator import Accumulator, WindowBlock
from imu_calibration.references.turntable.session_data import (
    KEPT_POSES,
    KEPT_SAMPLES,
    MAX_LIVE_SAMPLES,
    DecimatedWindows,
    HeldOut,
    HeldOutBlock,
    KeptWindows,
    SessionData,
    WindowStore,
    naming,
    owned_window,
)
from imu_calibration.references.turntable.window_statistics import (
    SensorStatistics,
    WindowStatistics,
    reduce_window,
)

SAVED_FORMAT = 'imu_calibration/accumulator/4'
SAVED_PARTS = (
    'accumulator',
    'held_out',
    'poses',
    'counts',
    'frame_id',
    'first_stamp_ns',
    'last_stamp_ns',
    'largest_rate',
    'largest_force',
    'temperature_c',
    'judged_from',
)
"""Saved fields of a `SessionData`; windows with samples are not saved."""
SAVED_PLAIN = (str, int, float, type(None))
SAVED_TYPES: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        dict,
        tuple,
        Counter,
        Accumulator,
        WindowBlock,
        WindowStatistics,
        SensorStatistics,
        HeldOut,
        HeldOutBlock,
        JointNames,
        ModelChanges,
        ModelExtension,
    )
}
"""Types that an archive may contain, in addition to arrays and plain values."""
MOST_EMPTY = 10**4
"""Values of an archive at most that need no byte of it: a damaged header may state any number."""
SAVED_DEPTH = 16
"""Containers around one number of an archive at most: each counts its values once more."""


def to_bytes(
    gathered: SessionData, model: SensorModel, extension: ModelExtension = ModelExtension()
) -> bytes:
    """
    Return a `SessionData` as an npz archive, with exact numbers and without pickled objects.

    The archive has two arrays: `numbers`, all arrays of the data in one line, and `header`, JSON
    text with the plain values and the structure (`_packed`).

    Parameters
    ----------
    gathered : SessionData
        Of which the fields `SAVED_PARTS` are saved.
    model : SensorModel
        The model of its columns.
    extension : ModelExtension
        Effects added to the requested model, saved without `clipped`: the solution of windows
        without clipped samples is computed again.

    """
    # Filled by `_packed`. Of the catalogue only the definitions of the user's effects are needed.
    arrays: list[np.ndarray] = []
    session_fields = {name: getattr(gathered, name) for name in SAVED_PARTS}
    model_fields = {f.name: getattr(model, f.name) for f in fields(model) if f.name != 'catalogue'}
    content = (
        session_fields,
        model_fields,
        model.definitions,
        replace(extension, clipped=None),
    )
    header = json.dumps({'format': SAVED_FORMAT, 'content': _packed([content], arrays)})
    target = io.BytesIO()
    np.savez(
        target,
        header=np.frombuffer(header.encode(), np.uint8),
        numbers=np.concatenate([np.zeros(0), *map(np.ravel, arrays)]),
    )
    return target.getvalue()


def _packed(values: Sequence[Any], arrays: list[np.ndarray]) -> list:
    """
    Return the values of one column as nested plain lists, which `_unpacked` reverses.

    The structure is written once for all values of a column. The possible results are::

        ['plain', values]                       text, numbers and None
        ['mixed', number of each value's kind, [packed values of each kind]]
        ['array', shape (n, ...)]               the values are appended to `arrays` as one array
        ['list', length of each value, packed items of all values]
        [type name, n, [packed column of each field], packed keys]   tuples, dicts, dataclasses
    """
    if all(issubclass(kind, SAVED_PLAIN) for kind in set(map(type, values))):
        return ['plain', values]

    # Values of different structure: a column for each structure.
    kinds = [_kind(value) for value in values]
    if len(set(kinds)) > 1:
        values_of_kind: dict[Any, list] = {}
        for value, kind in zip(values, kinds):
            values_of_kind.setdefault(kind, []).append(value)
        order = list(values_of_kind)
        return [
            'mixed',
            [order.index(kind) for kind in kinds],
            [_packed(alike, arrays) for alike in values_of_kind.values()],
        ]

    # Values of the structure of the first one.
    first = values[0]
    if isinstance(first, np.ndarray):
        arrays.append(np.array(values))
        return ['array', arrays[-1].shape]
    if isinstance(first, list):
        return [
            'list',
            [len(value) for value in values],
            _packed(list(chain.from_iterable(values)), arrays),
        ]

    # Tuples, dicts with the same keys, and dataclasses: a column for each field.
    keys: tuple = ()
    rows: Iterable[Iterable] = values
    if isinstance(first, dict):
        keys = tuple(first)
        rows = [value.values() for value in values]
    elif not isinstance(first, tuple):
        rows = [vars(value).values() for value in values]
    return [
        type(first).__name__,
        len(values),
        [_packed(column, arrays) for column in zip(*rows)],
        _packed(keys, arrays),
    ]


def _kind(value: Any) -> Any:
    """
    Return the structure that values of one column must share.

    The shape of an array, type and keys of a dict, the length of a tuple, None for plain values,
    otherwise the type.
    """
    if isinstance(value, np.ndarray):
        return value.shape
    if isinstance(value, dict):
        return type(value), *value
    if isinstance(value, tuple):
        return len(value)
    return None if isinstance(value, SAVED_PLAIN) else type(value)


class _SavedNumbers(io.BytesIO):
    """The numbers of an archive as a file, with a limit for the values of all its columns."""

    def __init__(self, data: bytes, most_values: int):
        super().__init__(data)
        self._most_values = most_values
        """The limit, for the message."""
        self._remaining = most_values
        """Values that further columns may still have."""

    def count(self, n_values: int) -> None:
        """Count the values of a column; raises ValueError above the limit."""
        self._remaining -= n_values
        if n_values < 0 or self._remaining < 0:
            raise ValueError(
                f'an archive of its size must have at most {self._most_values} values, got more'
            )


def _unpacked(column: list, numbers: _SavedNumbers) -> list:
    """
    Return the values of a column from the lists that `_packed` wrote.

    Their arrays are the next ones of the file `numbers`.
    """
    # The meaning of the second item depends on the name, see `_packed`: values, shape, lengths,
    # numbers of kinds, or the number of values.
    name, size, *parts = column
    if name == 'plain':
        return size
    if name == 'array':
        numbers.count(size[0])
        return list(np.frombuffer(numbers.read(8 * math.prod(size))).reshape(size))
    if name == 'list':
        items = iter(_unpacked(parts[0], numbers))
        return [list(islice(items, length)) for length in size]
    if name != 'mixed':
        numbers.count(size)
    columns = [_unpacked(part, numbers) for part in parts[0]]
    if name == 'mixed':
        values_of_kind = [iter(values) for values in columns]
        return [next(values_of_kind[number]) for number in size]

    # Objects from the columns of their fields; without fields there are `size` empty ones.
    kind: Any = SAVED_TYPES[name]
    rows = list(zip(*columns, strict=True)) or [()] * size
    # The test narrows the type to an instance or a class; only classes are saved.
    construct: Any = kind
    if is_dataclass(kind):
        return [construct(*row) for row in rows]
    keys = _unpacked(parts[1], numbers)
    return [kind(dict(zip(keys, row)) if issubclass(kind, dict) else row) for row in rows]


class SavedSession(NamedTuple):
    """Content of an archive."""

    gathered: SessionData
    """The reduced windows."""
    model: SensorModel
    """The model of their columns."""
    extension: ModelExtension
    """Effects added to the requested model."""


def from_bytes(data: bytes) -> SavedSession:
    """
    Return the content of an archive of `to_bytes`.

    Raises
    ------
    DocumentError
        When the bytes are no such archive.

    """
    try:
        with load_arrays(data) as arrays:
            header = json.loads(bytes(arrays['header']).decode())
            if header.get('format') != SAVED_FORMAT:
                raise DocumentError(
                    f"an accumulator must have the format '{SAVED_FORMAT}', got "
                    f'{shortened(repr(header.get("format")))}; remove the file'
                )
            size = arrays['header'].nbytes + arrays['numbers'].nbytes
            numbers = _SavedNumbers(arrays['numbers'].tobytes(), MOST_EMPTY + SAVED_DEPTH * size)
            (content,) = _unpacked(header['content'], numbers)
            session_fields, model_fields, definitions, extension = content
            catalogue = CATALOGUE.with_definitions(definitions)
            model = SensorModel(**model_fields, catalogue=catalogue)
            return SavedSession(SessionData(**session_fields), model, extension)
    except ImuCalibrationError:
        raise
    except Exception as error:  # damaged archives, arrays and headers raise many kinds
        raise DocumentError(
            f'a saved accumulator must be a whole file of {SAVED_FORMAT}, this file of {len(data)}'
            f' bytes is damaged or has a different format ({shortened(str(error), 200)}); remove'
            ' the file',
            code='accumulator_damaged',
        ) from error


def require_columns(known: SensorModel, model: SensorModel) -> None:
    """
    Raise a DocumentError unless a saved accumulator has the columns of `model`.

    `known`: the model of the columns of the accumulator.
    """
    if not known.has_columns_of(model):
        raise DocumentError(
            'a saved accumulator must contain the columns of the requested model, it has'
            f' {_effects_text(known)}, requested is {_effects_text(model)}; start without resume,'
            ' or with the old model',
            code='other_model',
        )


def _effects_text(model: SensorModel) -> str:
    """Return the effects of each section and the reference temperature, for a message."""
    effects = ' / '.join('+'.join(getattr(model, sensor)) or 'none' for sensor in SECTIONS)
    return f'{effects} at {model.temperature_ref_c:g} C'


@dataclass(frozen=True)
class GatherStep:
    """How recordings are read and reduced; it can be sent to another process or machine."""

    table: Table
    """The reference."""
    model: SensorModel
    """Defines the columns."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: RawReadings | None = None
    """For recordings in volts or counts."""
    names: tuple = ()
    """
    Names of the recordings for messages; with several of them an error names the one at fault.
    """
    keep_for_search: bool = False
    """Whether windows are kept for the search of effects."""
    judged_from: float = 0.0
    """Windows from this time on are judged by a proof, s."""

    def gather(self, source: BlockSource, session: int) -> SessionData:
        """Return the data of the recording with number `session`, with the usual checks."""
        with naming(self.names, session):
            return self.read(source, session, Preflight(self.table.gravity_value, one_sensor=True))

    def blocks(self, source: BlockSource) -> Iterable[SampleBlock]:
        """Return the blocks of a recording; a subclass may change them."""
        return source

    def read(
        self,
        source: BlockSource,
        session: int,
        preflight: Preflight,
        *,
        windows: StoredWindows | KeptWindows | list | None = None,
    ) -> SessionData:
        """
        Return the SessionData of a recording, which is read once for its windows and the checks.

        Where the checks find parts without readings, or a sensor that cannot be used, it is read
        again without them. All windows, unused ones too, are appended to `windows`, which must be
        empty.

        Raises
        ------
        InputError
            At the end of the recording, when it cannot give a right result (`preflight`).

        """
        gathered = self._gather(source, session, (preflight,), windows=windows)
        if len(preflight.without_readings) or preflight.unusable:
            if windows is not None:
                windows.clear()
            gathered = self._gather(
                source,
                session,
                watchers=(),  # the checks have seen all samples
                windows=windows,
                without=preflight.without_readings,
                unusable=tuple(preflight.unusable),
            )
        gathered.findings = preflight.findings
        gathered.unusable = preflight.unusable
        return gathered

    def _gather(
        self,
        source: BlockSource,
        session: int,
        watchers: Sequence[Watcher],
        *,
        windows: StoredWindows | KeptWindows | list | None,
        without: np.ndarray = NO_RANGES,
        unusable: Sequence[str] = (),
    ) -> SessionData:
        """Return the data of a recording without the samples of `without` and `unusable`."""
        collector = Collector(
            self,
            session=session,
            watchers=watchers,
            windows=windows,
            without=without,
            unusable=unusable,
        )
        for block in self.blocks(source):
            collector.push(block)
        return collector.finish()


class Collector:
    """
    Finds the windows in blocks of samples and adds their statistics to a `SessionData`.

    The same object serves bags and live topics.

    Parameters
    ----------
    step : GatherStep
        How the recording is reduced.
    session : int
        Number of the recording.
    watchers : sequence of Watcher
        Checks that see the cleaned samples.
    windows : optional
        Receives all windows with their samples, unused ones too.
    without : array, shape (n, 2)
        Ranges of stamps whose samples are omitted, ns.
    unusable : sequence of str
        Sensors that are omitted.

    """

    def __init__(
        self,
        step: GatherStep,
        *,
        session: int = 0,
        watchers: Sequence[Watcher] = (),
        windows: StoredWindows | KeptWindows | list | None = None,
        without: np.ndarray = NO_RANGES,
        unusable: Sequence[str] = (),
    ):
        self.step = step
        self.session = session
        self.windows = windows
        # Cleans the samples, joins the streams and finds the windows.
        self.gatherer = MotionGatherer(
            step.table,
            step.windows,
            windows is not None,
            nominal=step.nominal,
            watchers=watchers,
            without=without,
            unusable=unusable,
        )
        self.gathered = SessionData(judged_from=step.judged_from)

    @property
    def model(self) -> SensorModel:
        """Defines the columns; in a live session it may change."""
        return self.step.model

    def push(self, block: SampleBlock) -> list[Window]:
        """Process a block and return the windows that it completed."""
        if block.imu is not None and len(block.imu):
            self._note_imu(block.imu)
        if block.temperature is not None and len(block.temperature):
            self._note_temperature(block.temperature.temperature_c)
        return self._take(self.gatherer.push(block))

    def finish(self) -> SessionData:
        """Close the last window and return the gathered data."""
        self._take(self.gatherer.finish())
        self.update_counts()
        return self.gathered

    def update_counts(self) -> None:
        """Bring the counts up to date."""
        counts = Counter(self.gatherer.counts)
        counts.update(self.gatherer.cleaner.lost)
        self.gathered.counts = dict(counts)

    def _note_imu(self, imu: ImuSamples) -> None:
        """Update the frame and the first and last stamp."""
        gathered = self.gathered
        if gathered.first_stamp_ns is None:
            gathered.first_stamp_ns = int(imu.stamp_ns[0])
            gathered.frame_id = imu.frame_id
        gathered.last_stamp_ns = max(int(imu.stamp_ns[-1]), gathered.last_stamp_ns or 0)

    def _note_temperature(self, temperature_c: np.ndarray) -> None:
        """Extend the range of temperatures."""
        finite = temperature_c[np.isfinite(temperature_c)]
        if len(finite):
            low, high = self.gathered.temperature_c or (np.inf, -np.inf)
            self.gathered.temperature_c = (
                float(min(low, finite.min())),
                float(max(high, finite.max())),
            )

    def _take(self, windows: Sequence[Window]) -> list[Window]:
        """Add all windows except unused ones to the gathered data, and return them."""
        if self.windows is not None:
            self.windows.extend(windows)
        used = [window for window in windows if window.kind != 'unused']
        for window in used:
            self._add(window)
        return used

    def _add(self, window: Window) -> None:
        """Add the statistics, the pose and the largest readings of a window."""
        reduced = reduce_window(window, self.model, self.step.table, session=self.session)
        gathered = self.gathered
        gathered.take(reduced)
        largest_force = float(np.max(np.abs(window.force_s)))
        gathered.largest_force = max(gathered.largest_force, largest_force)
        if window.kind == 'static':
            gathered.poses.append((reduced.time, self.session, np.array(window.motion.position[0])))
            del gathered.poses[:-KEPT_POSES]
        else:
            largest_rate = float(np.sqrt((window.rate_s**2).sum(axis=1).max()))
            gathered.largest_rate = max(gathered.largest_rate, largest_rate)
        self._store(window, reduced)

    def _store(self, window: Window, _reduced: WindowStatistics) -> None:
        """Keep the samples of moving windows for plots, and windows for the search of effects."""
        kept = self.gathered.kept
        if window.kind != 'static':
            n_samples = sum(len(w.time) for w in kept) + len(window.time)
            if n_samples <= KEPT_SAMPLES:
                kept.append(window)
                self.gathered.sessions_of_kept.append(self.session)
        if self.step.keep_for_search:
            self.gathered.for_search[0].add(owned_window(window))


class LiveCollector(Collector):
    """
    A Collector of a live session: its memory is bounded, and its model may change.

    Parameters
    ----------
    table : Table
        The reference.
    model : SensorModel
        Defines the columns.
    options : CalibrationOptions
        Settings of windows and readings.
    session : int
        Number of the recording.
    store : WindowStore
        Receives the windows with their samples, from which other columns can be computed.

    """

    def __init__(
        self,
        table: Table,
        model: SensorModel,
        options: CalibrationOptions,
        *,
        session: int,
        store: WindowStore,
    ):
        super().__init__(
            GatherStep(table, model, options.windows, options.nominal), session=session
        )
        self.store = store
        self.gathered.for_search = [DecimatedWindows(MAX_LIVE_SAMPLES)]

    def _store(self, window: Window, reduced: WindowStatistics) -> None:
        """Keep a copy of a window for other columns and for the search of effects."""
        kept = owned_window(window)
        self.store.add(kept, reduced)
        self.gathered.for_search[0].add(kept)

    def take_model(self, model: SensorModel) -> None:
        """
        Gather the columns of another model from now on.

        The statistics of all stored windows are computed again.
        """
        windows = self.store.reduced(model, self.step.table, self.session)
        self.gathered = self.gathered.with_windows(windows)
        self.step = replace(self.step, model=model)

    def snapshot(self, pending: bool) -> tuple[SessionData, WindowStore]:
        """
        Return copies of the gathered data and of the store.

        With `pending`, open windows are closed in the copies.
        """
        twin = copy.copy(self)
        # What is shared is never changed in place.
        gathered = self.gathered
        twin.gathered = replace(
            gathered,
            accumulator=gathered.accumulator.copy(),
            held_out=gathered.held_out.copy(),
            poses=list(gathered.poses),
            kept=[],
            sessions_of_kept=[],
            counts=dict(gathered.counts),
            for_search=[kept.copy() for kept in gathered.for_search],
        )
        twin.store = self.store.copy()
        if pending:
            twin.gatherer = copy.deepcopy(self.gatherer)
            twin.finish()
        else:
            twin.update_counts()
        return twin.gathered, twin.store
