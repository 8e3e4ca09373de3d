"""Save and load a `Gathered` as bytes, so that an interrupted session can be resumed."""

import io
import json
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.calibration.model_changes import Demand
from imu_calibration.core.errors import DocumentError, ImuCalibrationError, shortened
from imu_calibration.core.regular_files import load_arrays
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import Catalogue
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.accumulator import Accumulator, WindowBlock
from imu_calibration.estimation.window_statistics import SensorStatistics, WindowStatistics
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.references.turntable.gathered import Gathered
from imu_calibration.references.turntable.held_out import HeldOut, HeldOutBlock

FORMAT = 'imu_calibration/accumulator/2'
_MODEL = ('accelerometer', 'gyroscope', 'reference')
_PLAIN = ('counts', 'frame_id', 'first_stamp_ns', 'last_stamp_ns', 'largest_rate', 'largest_force', 'temperature_c')


def to_bytes(gathered: Gathered, model: SensorModel, demand: Demand = Demand()) -> bytes:
    """
    Return a `Gathered` as an npz archive: numbers to the last bit, no pickled objects.

    Parameters
    ----------
    gathered : Gathered
        Its least-squares system, the held-out blocks of the proof, poses and counts; windows with samples are not saved.
    model : SensorModel
        The model of its columns.
    demand : Demand
        Effects added to the requested model.

    """
    names = {name: list(getattr(model, name)) for name in (*_MODEL, 'joint_names')}
    header = {'format': FORMAT, 'model': names | {'joint_errors': model.joint_names.errors},
              'effects': model.definitions, 'demand': demand.to_mapping(),
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
            'within': [list(key) for key in accumulator.within], 'slow': [list(key) for key in accumulator.slow],
            'slow_rows': accumulator.slow_rows, 'block_length': accumulator.block_length,
            'blocks': [_outline(block) for block in accumulator.blocks]}


def _arrays_of(accumulator, label):
    rows = accumulator.rows
    arrays = {f'{label}rows': np.array([(row.time, row.duration, row.encoder_step) for row in rows], float).reshape(-1, 3),
              f'{label}whole': np.array([(row.count, row.session) for row in rows], np.int64).reshape(-1, 2)}
    for sensor in _sensors(rows):
        for name in ('mean', 'noise_variance', 'inflation'):
            arrays[f'{label}{sensor}.{name}'] = np.array([getattr(row.sensors[sensor], name) for row in rows])
    for name in ('within', 'slow'):
        arrays |= {f'{label}{name}.{number}': factor for number, factor in enumerate(getattr(accumulator, name).values())}
    for number, block in enumerate(accumulator.blocks):
        for name in ('within', 'slow'):
            arrays |= {f'{label}block{number}.{name}.{k}': factor for k, factor in enumerate(getattr(block, name).values())}
    return arrays


def from_bytes(data: bytes, model: SensorModel) -> Gathered:
    """
    Return the `Gathered` in an archive.

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
            if header.get('format') != FORMAT:
                raise DocumentError(f"an accumulator must have the format '{FORMAT}', got {shortened(repr(header.get('format')))}; remove "
                                    'the file')
            yield header, arrays
    except ImuCalibrationError:
        raise
    except Exception as error:   # damaged archives, arrays and headers raise many kinds
        raise DocumentError(f'a saved accumulator must be a whole file of {FORMAT}, this file of {len(data)} bytes is damaged or has '
                            f'a different format ({shortened(str(error), 200)}); remove the file', code='accumulator_damaged') from error


def saved_model(data: bytes) -> SensorModel:
    """Return the SensorModel of the columns of a saved accumulator; raises as `from_bytes` when it is damaged."""
    with _reading(data) as (header, _):
        return _model(header)


def saved_demand(data: bytes) -> Demand:
    """Return the effects added to the requested model before a session was saved; raises as `from_bytes` when it is damaged."""
    with _reading(data) as (header, _):
        return Demand.from_mapping(header.get('demand', {}), header['point'])


def _model(header):
    point = {name: np.array(value, float) for name, value in header['point'].items()}
    effects, names = (tuple(header['model'][name]) for name in _MODEL), header['model']['joint_names']
    return SensorModel(*effects, JointNames.of(names, header['model'].get('joint_errors')), header['temperature_ref_c'], point,
                       catalogue=Catalogue.from_definitions(header.get('effects', {})))


def _check(header, model):
    known = _model(header)
    if not known.has_columns_of(model):
        raise DocumentError(f'a saved accumulator must contain the columns of the requested model, it has {_text(known)}, '
                            f'requested is {_text(model)}; start without resume, or with the old model', code='other_model')


def _text(model):
    effects = ' / '.join('+'.join(getattr(model, sensor)) or 'none' for sensor in _MODEL)
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
    return Gathered(Accumulator(**_fields(header, arrays, '')), held_out, poses=poses, judged_from=header.get('judged_from', 0.0), **plain)


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
    within, slow = ({tuple(key): arrays[f'{label}{name}.{number}'] for number, key in enumerate(header[name])}
                    for name in ('within', 'slow'))
    blocks = [_block(outline, f'{label}block{number}', arrays) for number, outline in enumerate(header['blocks'])]
    return {'rows': rows, 'within': within, 'slow': slow, 'slow_rows': header['slow_rows'], 'samples': header['samples'],
            'windows': header['windows'], 'blocks': blocks, 'block_length': header['block_length']}


def _outline(block):
    return {'session': block.session, 'start': block.start, 'windows': block.windows,
            'within': [list(key) for key in block.within], 'slow': [list(key) for key in block.slow]}


def _block(outline, label, arrays):
    within, slow = ({tuple(key): arrays[f'{label}.{name}.{k}'] for k, key in enumerate(outline[name])} for name in ('within', 'slow'))
    return WindowBlock(outline['session'], outline['start'], outline['windows'], within, slow)


def _sensors(rows):
    return sorted(rows[0].sensors) if rows else []
