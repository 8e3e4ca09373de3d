"""Collection of windows from blocks of samples, and the state of a session as a file."""

import copy
import io
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.core.documents import load_arrays
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.core.samples import NominalScaling, SampleBlock
from imu_calibration.effects.base import SECTIONS, SENSORS
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.forward_equations import columns
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import CENTRED_FACTORS, Accumulator, WindowBlock
from imu_calibration.estimation.window_statistics import SensorStatistics, WindowStatistics, joined_motion, reduce_window
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.stream_cleaning import Watcher
from imu_calibration.preprocessing.window import StoredWindows, Window, WindowSettings
from imu_calibration.preprocessing.window_finder import MotionGatherer
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.references.turntable.session_data import (
    KEPT_POSES,
    KEPT_SAMPLES,
    MAX_LIVE_SAMPLES,
    DecimatedWindows,
    HeldOut,
    HeldOutBlock,
    SessionData,
    WindowStore,
    naming,
    owned_window,
)

SAVED_FORMAT = 'imu_calibration/accumulator/2'
_PLAIN = ('counts', 'frame_id', 'first_stamp_ns', 'last_stamp_ns', 'largest_rate', 'largest_force', 'temperature_c')


def to_bytes(gathered: SessionData, model: SensorModel, extension: ModelExtension = ModelExtension()) -> bytes:
    """
    Return a `SessionData` as an npz archive: numbers to the last bit, no pickled objects.

    Parameters
    ----------
    gathered : SessionData
        Its least-squares system, the held-out blocks of the proof, poses and counts; windows with samples are not saved.
    model : SensorModel
        The model of its columns.
    extension : ModelExtension
        Effects added to the requested model.

    """
    names = {name: list(getattr(model, name)) for name in (*SECTIONS, 'joint_names')}
    header = {'format': SAVED_FORMAT, 'model': names | {'joint_errors': model.joint_names.errors},
              'effects': model.definitions, 'demand': extension.to_mapping(),
              'temperature_ref_c': model.temperature_ref_c,
              'point': {name: np.asarray(value, float).tolist() for name, value in model.point.items()},
              **_header_of(gathered.accumulator), 'judged_from': gathered.judged_from,
              'held_out': [_header_of(block.accumulator) | {'pieces': [list(key) for key in block.pieces], 'counts': block.counts,
                                                            'judged': block.judged} for block in gathered.held_out.blocks],
              **{name: getattr(gathered, name) for name in _PLAIN}}
    arrays: dict[str, Any] = {'header': np.frombuffer(json.dumps(header).encode(), np.uint8),
                              **_arrays_of(gathered.accumulator, ''),
                              'pose_times': np.array([(time, session) for time, session, _ in gathered.poses], float).reshape(-1, 2),
                              'poses': np.array([position for _, _, position in gathered.poses], float)}
    for number, block in enumerate(gathered.held_out.blocks):
        arrays |= _arrays_of(block.accumulator, f'held_out{number}.')
        arrays |= {f'held_out{number}.pieces.{k}': factor for k, factor in enumerate(block.pieces.values())}
    target = io.BytesIO()
    np.savez(target, **arrays)
    return target.getvalue()


def _header_of(accumulator):
    return {'samples': accumulator.samples, 'windows': accumulator.windows, 'kinds': [row.kind for row in accumulator.rows],
            'slow_rows': accumulator.slow_rows, 'block_length': accumulator.block_length, **_keys_of(accumulator),
            'blocks': [{'session': block.session, 'start': block.start, 'windows': block.windows, **_keys_of(block)}
                       for block in accumulator.blocks]}


def _keys_of(part: Accumulator | WindowBlock):
    """Return the keys of the factors, in the order of `_factors_of`."""
    return {name: [list(key) for key in getattr(part, name)] for name in CENTRED_FACTORS}


def _factors_of(part: Accumulator | WindowBlock, label):
    return {f'{label}{name}.{k}': factor for name in CENTRED_FACTORS for k, factor in enumerate(getattr(part, name).values())}


def _factors_in(header, arrays, label):
    """Return the fields `CENTRED_FACTORS` of an Accumulator or WindowBlock."""
    return {name: {tuple(key): arrays[f'{label}{name}.{k}'] for k, key in enumerate(header[name])} for name in CENTRED_FACTORS}


def _arrays_of(accumulator, label):
    rows = accumulator.rows
    arrays = {f'{label}rows': np.array([(row.time, row.duration, row.encoder_step) for row in rows], float).reshape(-1, 3),
              f'{label}whole': np.array([(row.count, row.session) for row in rows], np.int64).reshape(-1, 2)}
    for sensor in sorted(rows[0].sensors) if rows else []:
        for name in ('mean', 'noise_variance', 'inflation'):
            arrays[f'{label}{sensor}.{name}'] = np.array([getattr(row.sensors[sensor], name) for row in rows])
    arrays |= _factors_of(accumulator, label)
    for number, block in enumerate(accumulator.blocks):
        arrays |= _factors_of(block, f'{label}block{number}.')
    return arrays


def from_bytes(data: bytes, model: SensorModel) -> SessionData:
    """
    Return the `SessionData` in an archive.

    Raises
    ------
    DocumentError
        When the bytes are no such archive, or it was gathered with another model.

    """
    with _reading(data) as (header, arrays):
        _check(header, model)
        return _gathered(header, arrays)


@contextmanager
def _reading(data):
    """Return (header, arrays) of an archive; raise a DocumentError when it is damaged."""
    try:
        with load_arrays(data) as arrays:
            header = json.loads(bytes(arrays['header']).decode())
            if header.get('format') != SAVED_FORMAT:
                raise DocumentError(f"an accumulator must have the format '{SAVED_FORMAT}', got "
                                    f"{shortened(repr(header.get('format')))}; remove the file")
            yield header, arrays
    except ImuCalibrationError:
        raise
    except Exception as error:   # damaged archives, arrays and headers raise many kinds
        raise DocumentError(f'a saved accumulator must be a whole file of {SAVED_FORMAT}, this file of {len(data)} bytes is damaged or has '
                            f'a different format ({shortened(str(error), 200)}); remove the file', code='accumulator_damaged') from error


def saved_model(data: bytes) -> SensorModel:
    """Return the SensorModel of the columns of a saved accumulator; raises as `from_bytes` when it is damaged."""
    with _reading(data) as (header, _):
        return _model(header)


def saved_extension(data: bytes) -> ModelExtension:
    """Return the effects added to the requested model before a session was saved; raises as `from_bytes` when it is damaged."""
    with _reading(data) as (header, _):
        return ModelExtension.from_mapping(header.get('demand', {}), header['point'])


def _model(header):
    point = {name: np.array(value, float) for name, value in header['point'].items()}
    effects, names = (tuple(header['model'][name]) for name in SECTIONS), header['model']['joint_names']
    return SensorModel(*effects, JointNames.of(names, header['model'].get('joint_errors')), header['temperature_ref_c'], point,
                       catalogue=CATALOGUE.with_definitions(header.get('effects', {})))


def _check(header, model):
    known = _model(header)
    if not known.has_columns_of(model):
        raise DocumentError(f'a saved accumulator must contain the columns of the requested model, it has {_text(known)}, '
                            f'requested is {_text(model)}; start without resume, or with the old model', code='other_model')


def _text(model):
    effects = ' / '.join('+'.join(getattr(model, sensor)) or 'none' for sensor in SECTIONS)
    return f'{effects} at {model.temperature_ref_c:g} C'


def _gathered(header, arrays):
    poses = [(float(time), int(session), position) for (time, session), position in zip(arrays['pose_times'], arrays['poses'])]
    plain = {name: header[name] for name in _PLAIN}
    plain['temperature_c'] = None if plain['temperature_c'] is None else tuple(plain['temperature_c'])
    held_out = HeldOut()   # files of earlier versions have no blocks, and their session is unproven
    for number, known in enumerate(header.get('held_out', ())):
        pieces = {tuple(key): arrays[f'held_out{number}.pieces.{k}'] for k, key in enumerate(known['pieces'])}
        accumulator = replace(held_out.blocks[number].accumulator, **_fields(known, arrays, f'held_out{number}.'))
        held_out.blocks[number] = HeldOutBlock(accumulator, pieces, known['counts'], known['judged'])
    return SessionData(Accumulator(**_fields(header, arrays, '')), held_out, poses=poses,
                       judged_from=header.get('judged_from', 0.0), **plain)


def _fields(header, arrays, label):
    """Return the fields of an Accumulator."""
    numbers, whole = arrays[f'{label}rows'], arrays[f'{label}whole']
    columns = {sensor: [arrays[f'{label}{sensor}.{name}'] for name in ('mean', 'noise_variance', 'inflation')] for sensor in SENSORS
               if f'{label}{sensor}.mean' in arrays.files}
    rows = []
    for k, kind in enumerate(header['kinds']):
        statistics = {sensor: SensorStatistics(mean[k], np.zeros((0, mean.shape[1])), variance[k], inflation[k])
                      for sensor, (mean, variance, inflation) in columns.items()}
        time, duration, *step = map(float, numbers[k])   # files of earlier versions have no steps
        rows.append(WindowStatistics(kind, time, duration, int(whole[k, 0]), statistics, int(whole[k, 1]), *step))
    blocks = [WindowBlock(known['session'], known['start'], known['windows'], **_factors_in(known, arrays, f'{label}block{number}.'))
              for number, known in enumerate(header['blocks'])]
    counts = {name: Counter(header[name]) for name in ('slow_rows', 'samples', 'windows')}
    return {'rows': rows, 'blocks': blocks, 'block_length': header['block_length'], **counts, **_factors_in(header, arrays, label)}


class Collector:
    """Feeds blocks to the window finder and reduces its windows; the same object serves bags and live topics."""

    def __init__(self, table: Table, model: SensorModel, settings: WindowSettings = WindowSettings(), *,
                 nominal: NominalScaling | None = None, session: int = 0, watchers: Sequence[Watcher] = (),
                 windows: list | StoredWindows | None = None, spread: bool = False, judged_from: float = 0.0):
        self.table, self.model, self.session, self.windows, self.spread = table, model, session, windows, spread
        self.gatherer = MotionGatherer(table, settings, windows is not None, nominal=nominal, watchers=watchers)
        self.gathered = SessionData(judged_from=judged_from)

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

    def _note_imu(self, imu):
        found = self.gathered
        if found.first_stamp_ns is None:
            found.first_stamp_ns, found.frame_id = int(imu.stamp_ns[0]), imu.frame_id
        found.last_stamp_ns = max(int(imu.stamp_ns[-1]), found.last_stamp_ns or 0)

    def _note_temperature(self, temperature_c):
        finite = temperature_c[np.isfinite(temperature_c)]
        if len(finite):
            low, high = self.gathered.temperature_c or (np.inf, -np.inf)
            self.gathered.temperature_c = (float(min(low, finite.min())), float(max(high, finite.max())))

    def _take(self, windows):
        if self.windows is not None:
            self.windows.extend(windows)
        return [self._reduce(window) for window in windows if window.kind != 'unused']

    def _reduce(self, window):
        reduced = reduce_window(window, self.model, self.table, session=self.session, with_pieces=True,
                                column_function=self._columns(window))
        found = self.gathered
        found.take(reduced)
        found.largest_force = max(found.largest_force, float(np.max(np.abs(window.force_s))))
        if window.kind == 'static':
            found.poses.append((reduced.time, self.session, np.array(window.motion.position[0])))
            del found.poses[:-KEPT_POSES]
        else:
            found.largest_rate = max(found.largest_rate, float(np.sqrt((window.rate_s**2).sum(axis=1).max())))
        self._store(window, reduced)
        return reduced

    def _columns(self, _window):
        """Return the function that gives the columns of a window."""
        return columns

    def _store(self, window, _reduced: WindowStatistics):
        kept = self.gathered.kept
        if window.kind != 'static' and sum(len(w.time) for w in kept) + len(window.time) <= KEPT_SAMPLES:
            kept.append(window)
        if self.spread:
            self.gathered.spreads[0].add(owned_window(window))


@dataclass(frozen=True)
class GatherStep:
    """The map step with its arguments bound, so that it can be sent to another process or machine."""

    table: Table
    """The reference."""
    model: SensorModel
    """Defines the columns."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: NominalScaling | None = None
    """For recordings in volts or counts."""
    names: tuple = ()
    """Names of the recordings for messages; with several of them an error names the one at fault."""
    spread: bool = False
    """Whether windows are kept for the search of effects."""
    judged_from: float = 0.0
    """Windows from this time on are judged by a proof, s."""

    def __call__(self, numbered: tuple[int, Callable]) -> SessionData:
        """Return the SessionData of a recording, given (its number, callable that yields its blocks)."""
        session, source = numbered
        return naming(self.names, session)(self.read, source(), session, Preflight(self.table.gravity_value))

    def read(self, blocks: Iterable[SampleBlock], session: int, preflight: Preflight, *,
             windows: list | StoredWindows | None = None) -> SessionData:
        """
        Return the SessionData of a recording, which is read once, for its windows and for the checks.

        All windows, unused ones too, are appended to `windows`.

        Raises
        ------
        InputError
            At the end of the recording, when it cannot give a right result (`preflight`).

        """
        collector = Collector(self.table, self.model, self.windows, nominal=self.nominal, session=session, watchers=(preflight,),
                              windows=windows, spread=self.spread, judged_from=self.judged_from)
        for block in blocks:
            collector.push(block)
        gathered = collector.finish()
        gathered.findings = preflight.findings
        return gathered


def columns_at(window: Window, model: SensorModel, *, table: Table, reported: slice) -> dict[str, np.ndarray]:
    """Return sensor -> columns at the samples `reported` of a window."""
    motion, temperature = joined_motion([window])
    if window.kind != 'static':
        motion, temperature = motion.select(reported), None if temperature is None else temperature[reported]
    return {sensor: columns(model, sensor, table, motion=motion, temperature_c=temperature) for sensor in SENSORS}


class LiveCollector(Collector):
    """A Collector that hands completed windows on, with their columns at the samples `reported`, and keeps a bounded number of them."""

    def __init__(self, table: Table, model: SensorModel, options: CalibrationOptions, *, session: int, store: WindowStore,
                 reported: Callable[[Window], slice]):
        super().__init__(table, model, options.windows, nominal=options.nominal, session=session)
        self.store, self._reported, self._completed = store, reported, {}
        self.gathered.spreads = [DecimatedWindows(MAX_LIVE_SAMPLES)]

    def _columns(self, window):
        reported, designs = self._reported(window), {}

        def kept(model, sensor, *arguments, **options):
            found = columns(model, sensor, *arguments, **options)
            designs[sensor] = found if window.kind == 'static' else found[reported].copy()
            return found
        self._completed[window] = reported, designs
        return kept

    def _store(self, window, reduced):
        kept = owned_window(window)
        self.store.add(kept, reduced)
        self.gathered.spreads[0].add(kept)

    def take_model(self, model: SensorModel) -> None:
        """Gather the columns of another model from now on; those of all kept windows are computed again."""
        self.model, self.gathered = model, self.gathered.anew(self.store.reduced(model, self.table, self.session))

    def take_completed(self) -> dict[Window, tuple[slice, dict[str, np.ndarray]]]:
        """Return the windows since the last call, each with the samples for published residuals and their columns."""
        completed, self._completed = self._completed, {}
        return completed

    def snapshot(self, pending: bool) -> tuple[SessionData, WindowStore]:
        """Return copies of the gathered data and of the store; with `pending`, open windows are closed in the copies."""
        twin = copy.copy(self)
        twin.gathered, twin.store, twin._completed = copied(self.gathered), self.store.copy(), {}
        if pending:
            twin.gatherer = copy.deepcopy(self.gatherer)
            twin.finish()
        else:
            twin.update_counts()
        return twin.gathered, twin.store


def copied(gathered: SessionData) -> SessionData:
    """Return a copy that shares only objects that are never changed in place."""
    return replace(gathered, accumulator=gathered.accumulator.copy(), held_out=gathered.held_out.copy(), poses=list(gathered.poses),
                   kept=[], counts=dict(gathered.counts), spreads=[spread.copy() for spread in gathered.spreads])
