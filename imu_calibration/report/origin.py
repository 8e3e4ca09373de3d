"""Origin of the calibration: recording, table, settings, used and dropped samples."""

from functools import singledispatch
from typing import Any

from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.table_result import TableResult
from imu_calibration.core.settings import describe
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.report.numbers import fixed, in_unit, text


def recording_facts(result: CalibrationResult) -> list[tuple[str, str]]:
    """Return (item, value) of the recording, for the head of the page."""
    calibration, conditions = result.calibration, result.calibration.conditions
    bags = calibration.provenance.get('bags') or []
    facts = [('recording', ', '.join(bag['name'] for bag in bags) or 'not named'),
             ('date', str(conditions.get('date') or 'unknown').replace('T', ' ').replace('Z', ' UTC')),
             ('length', _duration(conditions.get('duration_s'))), ('frame', calibration.frame_id or 'not named'),
             ('reference', result.reference)]
    facts += [(name, str(calibration.provenance[name])) for name in ('serial', 'operator') if calibration.provenance.get(name)]
    if conditions.get('largest_rate'):
        facts.append(('fastest turn', in_unit(conditions['largest_rate'], 'rad/s')))
    if conditions.get('temperature_range_c'):
        facts.append(('temperature', ' to '.join(fixed(t, 1) for t in conditions['temperature_range_c']) + ' °C'))
    return facts


def _duration(seconds):
    if seconds is None:
        return 'unknown'
    minutes, rest = divmod(round(seconds), 60)
    return f'{minutes} min {rest} s' if minutes else f'{rest} s'


def origin_section(result: CalibrationResult) -> dict[str, Any]:
    """Return the tables of windows, drops, settings, table description and provenance."""
    calibration, statistics = result.calibration, result.calibration.statistics
    used = [(kind, count, (statistics.get('samples_used') or {}).get(kind, ''))
            for kind, count in (statistics.get('windows') or {}).items()]
    stream = statistics.get('stream') or {}
    kept_out = [(reason, count) for reason, count in stream.items() if reason not in dict(statistics.get('windows') or {}) and count]
    bags = [(bag['name'], bag['sha256']) for bag in calibration.provenance.get('bags') or []]
    return {'windows': used, 'kept_out': kept_out, 'dropped': list((statistics.get('dropped') or {}).items()),
            'warnings': [found['text'] for found in statistics.get('preflight') or []], 'settings': _settings(result.options),
            'table': table_rows(result), 'bags': bags, 'software': calibration.provenance.get('software', ''), 'gauge': calibration.gauge,
            'model': [(sensor, ' + '.join(getattr(calibration.model, sensor)) or 'nothing')
                      for sensor in ('accelerometer', 'gyroscope', 'reference')]}


def _settings(options):
    """Return (name, value, unit, meaning, whether it was changed) of the settings in force."""
    options = options or CalibrationOptions()
    values = [(item, getattr(options.windows, item.name)) for item in describe(options.windows)]
    return [(item.name, text(value), item.unit, item.text, value != item.default) for item, value in values]


def _joint(joint):
    said = [f'{"turns about" if joint.turns else "slides along"} ({", ".join(text(a) for a in joint.axis)})']
    if any(joint.xyz):
        said.append(f'at ({", ".join(text(a) for a in joint.xyz)}) m')
    if any(joint.rpy_deg):
        said.append(f'turned by roll, pitch, yaw ({", ".join(text(a) for a in joint.rpy_deg)})°')
    if joint.mimic is not None:
        said.append(f'follows {joint.mimic.joint} times {text(joint.mimic.multiplier)}')
    return ', '.join(said)


@singledispatch
def table_rows(_result: CalibrationResult) -> list[tuple[str, ...]]:
    """Return (item, value) of the table; empty for a calibration without a table."""
    return []


@table_rows.register
def _(result: TableResult):
    table = result.table
    rows = [(f'joint {joint.name}', _joint(joint)) for joint in table.joints]
    if table.joint_error_rad or table.joint_error_m:
        rows.append(('joints may be off by', ' and '.join(in_unit(value, unit) for value, unit in (
            (table.joint_error_rad, 'rad'), (table.joint_error_m, 'm')) if value) + ' (sd)'))
    rows += [('up', f'({", ".join(text(a) for a in table.up)})'),
             ('gravity', f'{fixed(table.gravity_value, 5)} m/s²' + (' as given' if table.gravity is not None else ', WGS 84 normal gravity')
              + (f', sd {text(table.gravity_sd_value)} m/s²' if table.gravity_sd_value else ''))]
    rows.append(('place', 'not given: Earth rate is estimated' if table.latitude is None
                 else f'latitude {text(table.latitude, 5)}°'
                 + (f', azimuth {text(table.azimuth_deg, 4)}°' if table.azimuth_deg is not None else ', azimuth not given')))
    rows.append(('mount', f'roll, pitch, yaw ({", ".join(text(a) for a in table.mount_rpy_deg)})°'
                 + ('; place not given' if table.mount_xyz is None else f'; at ({", ".join(text(a) for a in table.mount_xyz)}) m')))
    return rows
