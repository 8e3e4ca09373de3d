"""Logs as text with columns, read as a bag."""

from __future__ import annotations

import codecs
import csv
import io
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain
from os import PathLike
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from weakref import finalize

import numpy as np

from imu_calibration.core.documents import open_regular
from imu_calibration.core.errors import InputError, shortened
from imu_calibration.core.progress import remark
from imu_calibration.core.readings import READING_SPELLINGS, SI_UNITS, UNIT_SIZES, unit_of
from imu_calibration.core.samples import (
    EPOCH,
    ImuSamples,
    JointSamples,
    TemperatureSamples,
    stamps_of,
)
from imu_calibration.core.units import DEG, STANDARD_GRAVITY
from imu_calibration.document.files import name_of_path
from imu_calibration.preprocessing.counter_overflow import (
    CounterStamps,
    longer_gaps,
    without_overflows,
)
from imu_calibration.preprocessing.full_scale import relate_turns
from imu_calibration.preprocessing.scan import ChunkSeries
from imu_calibration.preprocessing.sensor_join import (
    JoinedSensors,
    SensorStream,
    finite_stream,
    join_sensors,
)
from imu_calibration.preprocessing.two_sources import TwoSourceSearch
from imu_calibration.preprocessing.value_checks import force_error, median_step, samples_per_second
from msg_adapters.csv_lines import plain_lines, sensor_of_label
from msg_adapters.rosbag2 import Rosbag2
from msg_adapters.storages import suffixes
from msg_adapters.write import write_session

SUFFIXES = ('.csv', '.tsv', '.txt')
HEAD_BYTES = 1 << 16
"""Bytes in which header, delimiter and first rows are found."""
COLUMN_UNITS = {
    'time': {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9, 'min': 60.0, 'h': 3600.0, 'd': 86_400.0},
    'force': UNIT_SIZES['accelerometer'],
    'rate': UNIT_SIZES['gyroscope'],
    'temperature': {'C': 1.0},
    'joint': {'rad': 1.0, 'deg': DEG},
}
"""Quantity -> unit -> size of the unit in SI (degrees Celsius for temperatures)."""
SPELLINGS = {
    'time': {
        'sec': 's',
        'secs': 's',
        'second': 's',
        'seconds': 's',
        'msec': 'ms',
        'millis': 'ms',
        'µs': 'us',
        'μs': 'us',
        'usec': 'us',
        'micros': 'us',
        'nsec': 'ns',
        'nanos': 'ns',
        'minutes': 'min',
        'hours': 'h',
        'days': 'd',
    },
    'force': READING_SPELLINGS['accelerometer'],
    'rate': READING_SPELLINGS['gyroscope'],
    'temperature': dict.fromkeys(('c', '°c', 'degc', 'deg_c', 'celsius'), 'C'),
    'joint': {'rads': 'rad', '°': 'deg', 'degrees': 'deg', 'radians': 'rad'},
}
"""Quantity -> spelling in headers -> unit."""
TICK = re.compile(r'(\d+(?:\.\d+)?)(?:/(\d+))?(s|ms|us|ns)')
"""Tick of a counter as unit of time: 25us, 1/32768s."""
USUAL_TICKS = ('10us', '21.7us', '25us', '25.6us', '1/32768s', '39.0625us', '100us', '10ms')
"""Ticks of counters in IMUs, which are proposed."""
NEAR_TICK = 0.1
"""A measured tick is a usual one within this share: it is known as well as the scales."""
SENSOR_OF = {'force': 'accelerometer', 'rate': 'gyroscope'}
CORRECTED = 'corrected'
"""Word after the unit in the header of a log that holds corrected readings."""
RAW_UNIT = 'raw'
"""Unit of columns that are read without conversion."""
COLUMN_PATTERNS = {
    'time': (
        r'((logging|sensor|device|imu|sample|gps) ?)?time|timestamp|t|epoch|seconds|sec|'
        r'time ?stamp.*|(.* )?stamp|.*elapsed|time ?(since )?start.*|millis|micros|nanos|ms|us|ns|'
        r'rtc ?time|time of day|sample ?time ?fine|(gps )?(sow|i? ?tow)|seconds of week'
    ),
    'force': (
        r'(a|ac|acc|acc smooth|accel|accelerometer|acceleration|f|specific force|a rs'
        r' s|accl|(accelerometer|acc|raw|imu|total) ?accel\w*|(uncomp\w*|uncal\w*) ?acc\w*|'
        r'g ?f(orce)?|(.* )?lin(ear)? ?acc(eleration)?|d ?vel|(delta|d) ?v|delta ?vel(ocity)?|'
        r'vel(ocity)? ?inc(rement)?s?)'
    ),
    'rate': (
        r'(g|w|gy|gyr|gyro|gyro adc|gyroscope|omega|rate|w rs s|'
        r'(ang|angular|rotation|gyro|gyroscope|imu|raw) ?(rate|rotation|gyro\w*)|'
        r'(uncomp\w*|uncal\w*) ?gyr\w*|'
        r'(.* )?ang(ular)? ?vel(ocity)?|(d|delta) ?(theta|ang|angle)|'
        r'(ang|angle|theta) ?inc(rement)?s?)'
    ),
    'temperature': (
        r'((imu|sensor|chip|die|board|device|mpu|gyro\w*|acc\w*) )?(tmp|temp|temperature)'
        r'( (imu|sensor|chip|die))?'
    ),
}
"""
Quantity -> names of its columns, in lower case, without axis and unit; an axis follows for force
and rate.
"""
LONGEST_NUMBER = 100
"""Characters of a cell that is tested for a number; a double has 24."""
LONGEST_COLUMN_NAME = 200
"""Characters of the name of a column; names are matched with expressions that may backtrack."""
PERIODS = (('s', 1.25e-4, 0.11), ('ms', 0.12, 110.0), ('us', 120.0, 1.1e5), ('ns', 1.2e5, 1.1e8))
"""
Unit of time -> range of the median step for rates of 9 to 8000 Hz; the ranges do not overlap within
the usual rates.
"""
GROUPED_NUMBER = re.compile(r'\s*[-+]?\d{1,3}(,\d{3})+\s*')
"""Digits in groups of three: of a quoted cell it is not known whether the comma is decimal."""
COMMENT = re.compile(r'(?:^|\s)#(?!N/A|NAME\?|VALUE!|DIV/0!|REF!|NUM!|NULL!).*')
"""A comment after the cells, which is none of the errors that spreadsheets print."""
DATE = re.compile(r'\s*\d{4}-\d\d-\d\d[T ]\d\d:\d\d')
"""Beginning of a date with time that is read."""
TIME_OF_DAY = re.compile(
    r'\s*(?:\d{1,2}[./-]\d{1,2}[./-]\d{2,4},?[ T]\s*)?(\d{1,2}):(\d\d):(\d\d)(?:[.,:](\d+))?\s*'
    r'(?:([AaPp])\.?[Mm]\.?)?\s*'
)
"""
Time of day: hours, minutes, seconds, decimals, half of the day. A date with the day or the month
first is not read, because the order is unknown; midnights are counted.
"""
DAY_NS = 86_400 * 10**9
NO_TIME = np.iinfo(np.int64).min
"""The value of NaT."""
MAX_TIME_SECONDS = 4e9
"""s; stamps in ns and their differences fit into 64 bits."""
MIN_COMMON_ROWS = 0.5
"""
Share of the rows of the rarer sensor that hold both sensors, below which each sensor has rows of
its own.
"""
GRAVITY_BAND = 1.15
"""The median of the specific force may differ from gravity by this factor."""
RATE_BAND = 1.6
"""The rate that turns gravity may differ from the measured one by this factor."""
OWN_RATE_BAND = 1.25
"""The same, where the units of time and rate are both found from the values."""
TRIED_PERIODS = (0.01, 0.04, 0.0025, 6e-4)
"""Periods with which the turns of gravity are searched, s."""
REMEDY = (
    'state the columns: time=NAME:UNIT force=X,Y,Z:UNIT rate=X,Y,Z:UNIT [temperature=NAME:C]'
    ' [joint.JOINT=NAME:UNIT]'
)


@dataclass(frozen=True)
class LogOptions:
    """What the user states about a text log; see `read_csv`."""

    columns: tuple[str, ...] = ()
    """Assignments QUANTITY=NAMES:UNIT that replace the guess."""
    where: tuple[str, ...] = ()
    """Conditions COLUMN=VALUE on the rows that are read."""
    raw: tuple[str, ...] = ()
    """Quantities that are read without conversion to SI: 'force', 'rate'."""


@dataclass(frozen=True)
class Columns:
    """The columns of one quantity."""

    quantity: str
    """A key of `COLUMN_UNITS`."""
    names: tuple[str, ...]
    """Column names; three for force and rate. A leading minus reverses the sign."""
    unit: str | None = None
    """A unit of the quantity; None: found from the values."""
    joint: str = ''
    """Name of the joint, for joint angles."""
    origin: str = 'header'
    """'header', 'values' or 'given': source of the unit."""

    def __str__(self):
        label = f'joint.{self.joint}' if self.joint else self.quantity
        return f'{label}={",".join(self.names)}:{self.unit} (unit: {self.origin})'


@dataclass(frozen=True, eq=False)
class LogText:
    """The text of a log from which the readings were made."""

    path: Path
    names: tuple[str, ...]
    """Names of all columns, from the header; the last ones may have no cells in the rows."""
    columns: tuple[Columns, ...]
    """Columns that were read, without those of joints."""
    places: dict[str, tuple[int, ...]]
    """Quantity -> indexes of its columns."""
    lines: tuple[str, ...]
    """Rows that were read, as text."""
    row_of_sample: np.ndarray
    """Index into `lines` for each sample, int64, shape (n,)."""
    delimiter: str | None
    """None for white space."""
    decimal_comma: bool
    """Whether numbers have a decimal comma."""


@dataclass(frozen=True, eq=False)
class CsvLog:
    """Content of a log."""

    columns: tuple[Columns, ...]
    """Columns used, with units."""
    imu: ImuSamples
    """Readings in SI."""
    joints: JointSamples | None
    """Joint angles."""
    temperature: TemperatureSamples | None
    """Temperatures."""
    unused: tuple[str, ...]
    """Other columns."""
    n_dropped: int = 0
    """Lines that were left out, because they have too few columns."""
    n_overflows: int = 0
    """Overflows of the counter in the column of time, which are undone."""
    counter_size_ns: int = 0
    """Size of that counter, ns; 0 where it does not overflow."""
    joined: JoinedSensors | None = None
    """How accelerometer and gyroscope were joined, where they have stamps of their own."""
    text: LogText | None = None
    """The rows; of two logs those of the slower sensor."""
    row_names: tuple[str, ...] = ()
    """Conditions on the rows of accelerometer and gyroscope, where a column names the sensor."""


# Readings that are not finite are counted where samples are used.
@np.errstate(over='ignore', invalid='ignore')
def read_csv(
    path: str | PathLike[str],
    columns: Sequence[str] = (),
    where: Sequence[str] = (),
    *,
    raw: Sequence[str] = (),
) -> CsvLog:
    """
    Read a text log with a header line.

    Of a log with a row per sensor, whose name is in a column, both sensors are read and joined as
    two logs are (`read_logs`).

    Parameters
    ----------
    path : path-like
        Text with columns separated by comma, semicolon, tab or spaces.
    columns : sequence of str
        Assignments ``quantity=NAME[,NAME,NAME][:UNIT]`` that replace the guess; the quantity is
        time, force, rate, temperature or joint.JOINT. A name may be the number of a column (1 is
        the first).
    where : sequence of str
        Conditions ``COLUMN=VALUE[,VALUE]``; only the rows that fulfil all are read, such as those
        of one of several IMUs in a log.
    raw : sequence of str
        Quantities, 'force' or 'rate', that are not converted to SI.

    Raises
    ------
    InputError
        When a needed column or unit is neither given, nor in the header, nor determined by the
        values; when the rows are those of two IMUs.

    """
    path = Path(path)
    table = _Table(path)

    # A log with a row per sensor: both sensors are read apart, or one of them is the log.
    row_groups = _rows_of_sensors(table, where)
    if len({group.sensor for group in row_groups}) == 2:
        return _read_sensor_rows(path, row_groups, columns, where, raw=raw)
    if row_groups:
        table = _Table(path, row_groups[0].sensor)
        where = (*where, row_groups[0].condition)

    chosen = _chosen_columns(table, columns, raw)
    table.load([name for each in chosen for name in each.names], where)

    # Values and units, in the order in which a unit may depend on another one.
    by_quantity = {each.quantity: each for each in chosen}
    time, counted = _times(table, by_quantity['time'])
    stamp_ns = counted.stamp_ns
    readings = _sensors(table, by_quantity, stamp_ns, time)
    used = [time, *readings.columns]
    temperature = None
    for each in chosen:
        if each.quantity == 'temperature':
            column = _with_unit(each, lambda: 'C', path)
            temperature = TemperatureSamples(stamp_ns, table.values(column.names)[:, 0])
            used.append(column)
    angles = {}
    for each in chosen:
        if each.quantity == 'joint':
            column = _with_unit(each, lambda: None, path)
            assert column.unit is not None
            unit_rad = COLUMN_UNITS['joint'][column.unit]
            angles[column.joint] = table.values(column.names)[:, 0] * unit_rad
            used.append(column)
    return CsvLog(
        columns=tuple(used),
        imu=readings.imu,
        joints=JointSamples.of_angles(stamp_ns, angles) if angles else None,
        temperature=temperature,
        unused=tuple(_unused_names(table, used)),
        n_dropped=table.n_dropped,
        n_overflows=counted.n_overflows,
        counter_size_ns=counted.size_ns,
        joined=readings.joined,
        text=_text_of(table, used, stamp_ns, readings.joined),
    )


def _chosen_columns(table: _Table, columns: Sequence[str], raw: Sequence[str]) -> list[Columns]:
    """
    Return the Columns of the user, then those of the header for the other quantities and joints.

    `columns` and `raw` as for `read_csv`. Raises InputError where a needed quantity is missing.
    """
    chosen = [table.stated(_parse(text)) for text in columns]
    stated = {(each.quantity, each.joint) for each in chosen}
    for guess in _guess(table, {quantity for quantity, _ in stated}):
        if (guess.quantity, guess.joint) not in stated:
            chosen.append(guess)
    chosen = [_as_raw(each) if each.quantity in raw else each for each in chosen]
    by_quantity = {each.quantity: each for each in chosen}
    missing = _missing_quantity(table, by_quantity, stated=bool(columns))
    if missing:
        raise InputError(
            f'{table.path} must have a column of'
            f' {missing}{"" if missing == "time" else " per axis"}, got the columns'
            f' {shortened(", ".join(table.names), 300)}{_unnamed_axes(table)}; {REMEDY}',
            key='columns',
        )
    return chosen


def _unused_names(table: _Table, used: Iterable[Columns]) -> list[str]:
    """Return the names of the columns of a table that are not `used`."""
    used_names = {name.removeprefix('-') for each in used for name in each.names}
    return [name for name in table.names if name and name not in used_names]


def _as_raw(columns: Columns) -> Columns:
    """Return Columns that are read without conversion, by the unit of an option."""
    if columns.unit is not None and columns.origin == 'given':
        raise InputError(
            f'the unit of {columns.quantity} must be stated once, got {columns.unit} for its'
            ' columns and the unit of the readings; omit one of them',
            key='columns',
            code='unit_twice',
        )
    return replace(columns, unit=RAW_UNIT, origin='given')


def _text_of(
    table: _Table,
    used: Sequence[Columns],
    stamp_ns: np.ndarray,
    joined: JoinedSensors | None,
) -> LogText:
    """
    Return the `LogText` of a table; each sample is one of its rows.

    `used`: Columns that were read; `stamp_ns`: of each row; `joined`: how the samples were made
    from rows of one sensor each, None where each row gave a sample.
    """
    used = tuple(each for each in used if each.quantity != 'joint')
    places = {each.quantity: tuple(map(table.column, each.names)) for each in used}
    row_of_sample = np.arange(len(stamp_ns))
    if joined is not None:
        # Samples have the stamps of the slower sensor: find its first row with each stamp.
        names = next(each.names for each in used if SENSOR_OF.get(each.quantity) == joined.slower)
        rows_of_sensor = np.flatnonzero(np.isfinite(table.values(names)).all(axis=1))
        # `first` has, for each distinct stamp, the place of its first row among `rows_of_sensor`.
        distinct_ns, first = np.unique(stamp_ns[rows_of_sensor], return_index=True)
        stamp_of_sample = np.searchsorted(distinct_ns, joined.imu.stamp_ns)
        row_of_sample = rows_of_sensor[first[stamp_of_sample]]
    return LogText(
        path=table.path,
        names=tuple(table.names),
        columns=used,
        places=places,
        lines=tuple(table.lines),
        row_of_sample=row_of_sample,
        delimiter=table.delimiter,
        decimal_comma=table.decimal_comma,
    )


def _missing_quantity(table: _Table, by_quantity: dict[str, Columns], *, stated: bool) -> str:
    """
    Return the quantity that a log needs and lacks ('time', 'force' or 'rate'), or ''.

    One sensor is enough; three further columns without a known name may be those of the other one,
    unless the columns are `stated`.
    """
    if 'time' not in by_quantity:
        return 'time'
    missing = [quantity for quantity in SENSOR_OF if quantity not in by_quantity]
    if not missing:
        return ''
    if len(missing) == 2:
        return missing[0]
    may_have_both = len(_unused_names(table, by_quantity.values())) >= 3 and not stated
    return missing[0] if may_have_both else ''


def _unnamed_axes(table: _Table) -> str:
    """Return the part of an error that columns x, y, z belong to no sensor; '' without any."""
    unnamed = []
    for name in table.names:
        reading = _reading_of(_words(name)[0])
        if reading and not reading.sensor:
            unnamed.append(name)
    if len(unnamed) < 3:
        return ''
    return (
        f', of which {", ".join(unnamed)} name no sensor; write its name (accelerometer, gyroscope)'
        ' in a column of each row or in the name of the file'
    )


def _times(table: _Table, columns: Columns) -> tuple[Columns, CounterStamps]:
    """Return the Columns of time with the unit, and the stamps of the rows without overflows."""
    values = table.raw(columns.names[0])
    if len(columns.names) == 2:  # seconds and nanoseconds are one time
        values = table.stamps(columns).view('datetime64[ns]')
    _require_distinct_times(values, table.path)
    # SampleTimeFine counts us or 100 us, and its steps would look like those of other units.
    if _words(columns.names[0])[0] in SAMPLE_TIME_FINE:
        columns = _with_unit(columns, lambda: _unit_of_sample_time_fine(values), table.path)
    # No effect on Columns that have a unit by now.
    columns = _with_unit(columns, lambda: _time_unit(values), table.path)
    tick_ns = 1e9 * _time_size(columns.unit)
    # Dates, times of day and pairs of columns are not readings of a counter.
    counter_ns = values * tick_ns if values.dtype.kind == 'f' else None
    return columns, without_overflows(table.stamps(columns), tick_ns, counter_ns)


@dataclass(frozen=True, eq=False)
class _Readings:
    """Readings of the sensors of a log in SI."""

    columns: tuple[Columns, ...]
    """Columns of force and rate, with units."""
    imu: ImuSamples
    """NaN for a sensor without columns."""
    joined: JoinedSensors | None = None
    """Where the sensors have rows of their own."""


def _sensors(
    table: _Table, by_quantity: dict[str, Columns], stamp_ns: np.ndarray, time: Columns
) -> _Readings:
    """Return the `_Readings` of a table with stamps of its rows; `time`: their Columns."""
    # Logs of one sensor: the other one has no readings.
    absent = np.full((len(stamp_ns), 3), np.nan)
    if 'force' not in by_quantity:
        rate = _with_unit(by_quantity['rate'], lambda: None, table.path)
        rate_s = table.values(rate.names) * _size_of(rate)
        return _Readings((rate,), ImuSamples(stamp_ns, absent, rate_s, 'imu_link'))
    raw_force = table.values(by_quantity['force'].names)
    # Force without a unit: increments over a sample have their own error, which must come before
    # that of `_with_unit` for all other readings.
    if by_quantity['force'].unit is None and _force_unit(raw_force) is None:
        _refuse_increments(raw_force, stamp_ns)
    force = _with_unit(by_quantity['force'], lambda: _force_unit(raw_force), table.path)
    force_s = raw_force * _size_of(force)
    if 'rate' not in by_quantity:
        return _Readings((force,), ImuSamples(stamp_ns, force_s, absent, 'imu_link'))
    raw_rate = table.values(by_quantity['rate'].names)

    # Most rows of the rarer sensor have both: each row is a sample.
    has_both = np.isfinite(force_s).all(axis=1) & np.isfinite(raw_rate).all(axis=1)
    accelerometer = finite_stream(stamp_ns, force_s)
    gyroscope = finite_stream(stamp_ns, raw_rate)
    n_of_rarer = min(len(accelerometer.stamp_ns), len(gyroscope.stamp_ns))
    if np.count_nonzero(has_both) >= MIN_COMMON_ROWS * n_of_rarer:
        imu = ImuSamples(stamp_ns, force_s, raw_rate, 'imu_link')
        return _with_rate_unit(force, by_quantity['rate'], imu, path=table.path, time=time)

    # Otherwise each sensor has rows of its own.
    return _joined(force, by_quantity['rate'], accelerometer, gyroscope, path=table.path)


def _joined(
    force: Columns,
    rate: Columns,
    accelerometer: SensorStream,
    gyroscope: SensorStream,
    *,
    path: Path,
) -> _Readings:
    """
    Return the `_Readings` of sensors with separate stamps.

    `accelerometer` in SI, `gyroscope` as in the log.
    """
    joined = join_sensors(accelerometer, gyroscope, 'imu_link')
    return _with_rate_unit(force, rate, joined.imu, path=path, joined=joined)


def _with_rate_unit(
    force: Columns,
    rate: Columns,
    imu: ImuSamples,
    *,
    path: Path,
    time: Columns | None = None,
    joined: JoinedSensors | None = None,
) -> _Readings:
    """
    Return the `_Readings` of samples, after the unit of the rates is found.

    `imu`: force in SI, rates as in the log; `time`: its Columns, where both sensors have one.
    """
    _require_one_imu(imu)
    rate = _with_unit(rate, lambda: _rate_unit(imu.stamp_ns, imu.force_s, imu.rate_s), path)
    if time is not None:
        _require_time_of_turns(time, rate, imu, path)
    return _Readings((force, rate), replace(imu, rate_s=imu.rate_s * _size_of(rate)), joined)


def read_logs(
    paths: Sequence[str | PathLike[str]], columns: Sequence[str] = (), where: Sequence[str] = ()
) -> CsvLog:
    """
    Read one log, or two logs with a sensor each, or a folder with one log per sensor.

    Parameters
    ----------
    paths : sequence of path-like
        A text log; two text logs, of an accelerometer and of a gyroscope; or a folder of them, as
        phones export it.
    columns, where
        As for `read_csv`, for one log.

    Raises
    ------
    InputError
        As `read_csv`; when the logs are not one of each sensor.

    """
    files = [Path(path) for path in paths]
    if len(files) == 1 and not files[0].is_dir():
        return read_csv(files[0], columns, where)
    if columns:
        raise InputError(
            f'columns are stated for one log, got {len(files)} paths; convert one log with the'
            ' columns of both sensors',
            key='columns',
            code='several_logs',
        )
    in_folder = len(files) == 1
    if in_folder:
        files = sorted(path for path in files[0].iterdir() if is_text_log(path))
    logs_of: dict[str, list[_SensorLog]] = {'force': [], 'rate': []}
    for path in files:
        try:
            log = _sensor_log(_Table(path), where)
        except InputError:
            if not in_folder:
                raise
            continue  # a folder has logs of other sensors too
        if log is not None:
            logs_of[log.columns.quantity].append(log)
    if in_folder:
        logs_of['force'] = _with_gravity_only(logs_of['force'])
    for quantity, logs in logs_of.items():
        if len(logs) != 1:
            names = ', '.join(log.table.path.name for log in logs)
            if not logs:
                names = f'none among {shortened(", ".join(path.name for path in files), 200)}'
            raise InputError(
                f'one log of {quantity} is needed, got {names}; name the two logs, accelerometer'
                ' and gyroscope, or one that has both',
                code='several_logs',
            )
    return _log_of_two(logs_of['force'][0], logs_of['rate'][0])


def _with_gravity_only(logs: list[_SensorLog]) -> list[_SensorLog]:
    """Return the logs of force without the linear accelerations that phones add to them."""
    if len(logs) < 2:
        return logs
    return [log for log in logs if log.has_gravity]


def _log_of_two(force: _SensorLog, rate: _SensorLog) -> CsvLog:
    """Return the CsvLog of a log of each sensor."""
    readings = _joined(force.columns, rate.columns, force.stream, rate.stream, path=rate.table.path)
    force_columns, rate_columns = readings.columns
    assert readings.joined is not None
    return CsvLog(
        columns=(force.time, force_columns, rate.time, rate_columns),
        imu=readings.imu,
        joints=None,
        temperature=None,
        unused=(),
        n_dropped=force.table.n_dropped + rate.table.n_dropped,
        n_overflows=force.counted.n_overflows + rate.counted.n_overflows,
        counter_size_ns=max(force.counted.size_ns, rate.counted.size_ns),
        joined=readings.joined,
        text=_text_of_two(force, rate, readings.joined),
    )


@dataclass(frozen=True)
class _SensorRows:
    """The rows of one sensor in a log with a row per sensor."""

    sensor: str
    """'acc' or 'gyro'."""
    name: str
    """Name of the sensor in its column."""
    condition: str
    """COLUMN=VALUE of these rows."""


def _rows_of_sensors(table: _Table, where: Sequence[str]) -> list[_SensorRows]:
    """
    Return the groups of rows, one for each name of a sensor in the first column with such names.

    Groups with "uncalibrated" in their name are left out where the sensor has others. [] for a log
    without such a column.
    """
    for column in table.word_columns:
        cells = table.values_of(column, where)
        groups = []
        for cell in cells:
            sensor = sensor_of_label(cell)
            if sensor:
                groups.append(_SensorRows(sensor, cell, f'{column}={cell}'))
        if not groups:
            continue
        # A column with the same name in all rows, such as that of a device, is not used where the
        # names of the columns have the sensors.
        if len(cells) == 1 and any(guess.quantity in SENSOR_OF for guess in _guess(table)):
            continue
        calibrated = [group for group in groups if 'uncal' not in group.name.lower()]
        sensors = {group.sensor for group in calibrated}
        return calibrated + [group for group in groups if group.sensor not in sensors]
    return []


def _read_sensor_rows(
    path: Path,
    row_groups: list[_SensorRows],
    columns: Sequence[str],
    where: Sequence[str],
    *,
    raw: Sequence[str],
) -> CsvLog:
    """
    Return the CsvLog of a log with a row per sensor.

    `row_groups` are the rows of accelerometer and gyroscope, where a sensor may have several groups
    (raw and corrected readings). The other arguments are those of `read_csv`.
    """
    stated = [_parse(text) for text in columns]
    unread = [each for each in stated if each.quantity not in ('time', *SENSOR_OF)]
    if unread:
        raise InputError(
            f'of a log with a row per sensor time, force and rate are read, got {unread[0]} for'
            f' {path}; omit it, or join the rows of each time',
            key='columns',
            code='sensor_rows',
        )

    # Each group of rows is read like a log of one sensor.
    logs_of: dict[str, list[_SensorLog]] = {'force': [], 'rate': []}
    n_groups_of = Counter(group.sensor for group in row_groups)
    for group in row_groups:
        quantity = 'force' if group.sensor == 'acc' else 'rate'
        stated_for_rows = [each for each in stated if each.quantity in ('time', quantity)]
        table = _Table(path, group.sensor)
        try:
            log = _sensor_log(table, (*where, group.condition), stated_for_rows, raw)
        except InputError:
            # A group that cannot be read, such as linear accelerations of unknown unit, is left
            # out where the sensor has another one.
            if n_groups_of[group.sensor] == 1:
                raise
            continue
        if log is None:
            raise InputError(
                f'{path} must have a column of {quantity} per axis and one of time in the rows'
                f' {group.condition}, got {shortened(", ".join(table.names), 300)}; {REMEDY}',
                key='columns',
                code='sensor_rows',
            )
        logs_of[quantity].append(replace(log, condition=group.condition))

    # One log of each sensor must remain.
    logs_of['force'] = _with_gravity_only(logs_of['force'])
    for quantity, logs in logs_of.items():
        if len(logs) != 1:
            conditions = ', '.join(log.condition for log in logs) or 'none with gravity'
            raise InputError(
                f'one sensor must give the {quantity} in the rows of {path}, got {conditions};'
                ' state the names of accelerometer and gyroscope (COLUMN=NAME,NAME)',
                key='where',
                code='sensor_rows',
            )
    force = logs_of['force'][0]
    rate = logs_of['rate'][0]
    return replace(_log_of_two(force, rate), row_names=(force.condition, rate.condition))


def _text_of_two(force: _SensorLog, rate: _SensorLog, joined: JoinedSensors) -> LogText:
    """
    Return the `LogText` of two logs: the rows of the slower one.

    Three columns for the readings of the other sensor follow, which have no cells in the rows.
    """
    slow, other = force, rate
    if joined.slower == 'gyroscope':
        slow, other = rate, force
    text = _text_of(slow.table, (slow.time, slow.columns), slow.counted.stamp_ns, joined)
    sensor = SENSOR_OF[other.columns.quantity]
    width = len(text.names)
    return replace(
        text,
        names=(*text.names, *(f'{sensor}_{axis}' for axis in 'xyz')),
        columns=(*text.columns, other.columns),
        places={**text.places, other.columns.quantity: tuple(range(width, width + 3))},
    )


@dataclass(frozen=True, eq=False)
class _SensorLog:
    """A log of one sensor."""

    table: _Table
    time: Columns
    columns: Columns
    """Of force, with its unit, or of rate."""
    stream: SensorStream
    """Force in SI; rates as in the log."""
    counted: CounterStamps
    """Stamps of the rows, and the overflows that they are free of."""
    condition: str = ''
    """COLUMN=NAME of its rows, where a column names the sensor."""

    @property
    def has_gravity(self) -> bool:
        """Whether a force has the length of gravity most of the time."""
        unit = _force_unit(self.stream.values)
        return unit == SI_UNITS['accelerometer'] or (self.columns.unit == RAW_UNIT and bool(unit))


def _one_sensor(columns: Iterable[Columns]) -> str | None:
    """Return 'force' or 'rate' for the columns of a log of one sensor; None for another log."""
    quantities = {each.quantity for each in columns}
    sensors = [quantity for quantity in SENSOR_OF if quantity in quantities]
    return sensors[0] if 'time' in quantities and len(sensors) == 1 else None


def _sensor_log(
    table: _Table,
    where: Sequence[str],
    stated: Sequence[Columns] = (),
    raw: Sequence[str] = (),
) -> _SensorLog | None:
    """
    Return the `_SensorLog` of a table; None where it has neither sensor, or both.

    `stated`: Columns of the user; `where` and `raw` as for `read_csv`.
    """
    by_quantity = {each.quantity: table.stated(each) for each in stated}
    for guess in _guess(table, set(by_quantity)):
        by_quantity.setdefault(guess.quantity, guess)
    quantity = _one_sensor(by_quantity.values())
    if quantity is None:
        return None
    columns = by_quantity[quantity]
    if quantity in raw:
        columns = _as_raw(columns)
    table.load([*by_quantity['time'].names, *columns.names], where)
    time, counted = _times(table, by_quantity['time'])
    # Stamps of counted times begin at one value in every log. With the first time added, those of
    # both sensors have a common origin, whichever begins first.
    start_ns = table.start_ns(time)
    counted = replace(counted, stamp_ns=counted.stamp_ns + start_ns)
    values = table.values(columns.names)
    if columns.quantity == 'force':
        columns = _with_unit(columns, lambda: _force_unit(values), table.path)
        values = values * _size_of(columns)
    stream = finite_stream(counted.stamp_ns, values)
    return _SensorLog(table, time, columns, stream, counted)


GAP_PERIODS = 5
"""Longer steps between samples are gaps."""
AUTOPILOT_COLUMNS = {
    'ArduPilot': ('GyrX', 'AccX'),
    'PX4': ('gyro_rad[0]', 'accelerometer_m_s2[0]'),
    'MAVLink': ('xgyro', 'xacc'),
}
"""
Autopilot (or its messages) with forward-right-down readings -> columns of its logs, without the
name of the message before them.
"""


def autopilot_of(path: str | PathLike[str]) -> str:
    """Return the autopilot whose columns a text log has; '' for none, or another file."""
    path = Path(path)
    if not is_text_log(path) or not path.is_file():
        return ''
    names = {re.split('[./: ]', name.strip())[-1] for name in _Table(path).names}
    for autopilot, columns in AUTOPILOT_COLUMNS.items():
        if set(columns) <= names:
            return autopilot
    return ''


def corrected_log(path: str | PathLike[str]) -> Path | None:
    """
    Return the text log whose header states that its readings are corrected; None for none.

    Of a folder with one log per sensor each of them is read.
    """
    path = Path(path)
    if not is_log_folder(path):
        is_log = is_text_log(path) and path.is_file()
        return path if is_log and _states_corrected(_Table(path)) else None
    for log in sorted(filter(is_text_log, path.iterdir())):
        try:
            table = _Table(log)
        except InputError:
            continue  # a folder has logs of other sensors too
        if _one_sensor(_guess(table)) and _states_corrected(table):
            return log
    return None


def _states_corrected(table: _Table) -> bool:
    """Return whether a header states corrected readings."""
    return any(_words(name)[1].endswith(CORRECTED) for name in table.names)


def _require_one_imu(imu: ImuSamples) -> None:
    """Raise where the rows are those of two IMUs; units of force and rate do not matter."""
    sources = TwoSourceSearch()
    good = np.isfinite(imu.force_s).all(axis=1) & np.isfinite(imu.rate_s).all(axis=1)
    sources.push(imu.select(good))
    sources.require_one(key='where')


def _with_unit(columns: Columns, find_unit: Callable[[], str | None], path: Path) -> Columns:
    """
    Return Columns with a unit, that of `find_unit` where neither user nor header states one.

    Raises InputError where that is None.
    """
    if columns.unit is not None:
        return columns
    unit = find_unit()
    if unit is None:
        raise InputError(
            f'the unit of {columns.quantity} in {path} must be stated by the header or follow from'
            f' the values, got columns {", ".join(columns.names)} without one; {REMEDY}',
            key='columns',
        )
    return replace(columns, unit=unit, origin='values')


N_NAMES = {'force': (3,), 'rate': (3,), 'time': (1, 2)}
"""Quantity -> numbers of its columns; one for the other quantities."""


SCALED_UNITS = ('counts:', 'increments:')
"""Beginnings of the units of a sensor that contain a colon."""


def _parse(text: str) -> Columns:
    """Return the Columns of one assignment QUANTITY=NAMES:UNIT; raises InputError."""
    label, _, names_and_unit = text.partition('=')
    quantity, _, joint = label.partition('.')
    name_text, unit = _split_unit(names_and_unit)
    names = tuple(name.strip() for name in name_text.split(',') if name.strip())
    is_known = quantity in COLUMN_UNITS
    has_joint_as_needed = (quantity == 'joint') == bool(joint)
    has_all_names = len(names) in N_NAMES.get(quantity, (1,))
    if not is_known or not has_joint_as_needed or not has_all_names:
        raise InputError(
            'a column assignment must be quantity=NAME[:UNIT] with one name, three for force and'
            f' rate, two for a time in seconds and nanoseconds, got {text!r}; {REMEDY}',
            key='columns',
        )
    known_unit = _known_unit(quantity, unit, text) if unit else None
    return Columns(quantity, names, known_unit, joint, 'given')


def _split_unit(text: str) -> tuple[str, str]:
    """
    Return (names, unit or '') of NAMES:UNIT.

    The last colon is before the unit, except that `SCALED_UNITS` contain a colon.
    """
    scaled = re.fullmatch(f'(.*?):((?:{"|".join(SCALED_UNITS)}).*)', text)
    if scaled:
        return scaled[1], scaled[2]
    names, colon, unit = text.rpartition(':')
    return (names, unit) if colon else (text, '')


def _known_unit(quantity: str, unit: str, assignment: str) -> str:
    """
    Return the unit that the user states for a quantity, in the usual spelling.

    Raises InputError for an unknown one; `assignment`: the whole text, for this error.
    """
    if quantity in SENSOR_OF and unit.startswith(SCALED_UNITS):
        return unit_of(SENSOR_OF[quantity], unit).unit
    unit = SPELLINGS[quantity].get(unit.lower(), unit)
    units = COLUMN_UNITS[quantity]
    if unit in units or (quantity == 'time' and _tick_size(unit)):
        return unit
    ticks = ', or a tick such as 25us or 1/32768s' if quantity == 'time' else ''
    raise InputError(
        f'the unit of {quantity} must be one of {", ".join(units)}{ticks}, got {unit!r};'
        f' correct {assignment!r}',
        key='columns',
    )


def _tick_size(unit: str) -> float:
    """Return the size of a unit of time that is a tick, s; 0.0 for another text."""
    tick = TICK.fullmatch(unit)
    if tick is None:
        return 0.0
    number = float(tick[1])
    divisor = int(tick[2] or 1)
    if not number or not divisor:
        return 0.0
    return number / divisor * COLUMN_UNITS['time'][tick[3]]


def _time_size(unit: str | None) -> float:
    """Return the size of a unit of time, s."""
    assert unit is not None  # after `_with_unit`
    return COLUMN_UNITS['time'].get(unit) or _tick_size(unit)


def _size_of(columns: Columns) -> Any:
    """Return the size in SI of the unit of force or rate, for each axis if it differs."""
    if columns.unit == RAW_UNIT:
        return 1.0
    assert columns.unit is not None  # after `_with_unit`
    return 1.0 / np.asarray(unit_of(SENSOR_OF[columns.quantity], columns.unit).scale)


UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""First bytes of text in UTF-16, as spreadsheets export it."""
COMPRESSORS = {b'\x1f\x8b': 'gzip', b'PK': 'zip', b'\x28\xb5': 'zstd', b'BZ': 'bzip2'}
"""First two bytes -> program that has compressed a file."""


def _without_comment(line: str) -> str:
    """Return a line without its comment; most lines have none."""
    return COMMENT.sub('', line) if '#' in line else line


def _is_utf_8(head: bytes) -> bool:
    """Return whether the first bytes of a file are text in UTF-8, of which the last may be cut."""
    try:
        codecs.getincrementaldecoder('utf-8')().decode(head)
    except UnicodeDecodeError:
        return False
    return True


def _opened(path: Path) -> io.TextIOWrapper:
    """Open a file as text in the encoding that its first bytes show."""
    file = open_regular(path)
    head = file.read(HEAD_BYTES)
    encoding = 'utf-8-sig'
    if head[:2] in UTF_16:
        encoding = 'utf-16'
    elif not _is_utf_8(head):
        encoding = 'cp1252'  # spreadsheets of Western Europe
    file.seek(0)
    return io.TextIOWrapper(file, encoding=encoding, errors='replace')


def _refuse_compressed(path: Path) -> None:
    """Raise InputError for a file that a program of COMPRESSORS has made."""
    with open_regular(path) as file:
        program = COMPRESSORS.get(file.read(2))
        binary = b'\0' in file.read(HEAD_BYTES)
    if program is not None and binary:
        raise InputError(
            f'a text log must not be compressed, {path} is ({program}); decompress it',
            code='csv_compressed',
        )


def split_cells(line: str, delimiter: str | None, path: Path) -> list[str]:
    """Return the cells of a line; `delimiter` None: white space; `path` is named in errors."""
    line = line.lstrip('# ')
    if delimiter is None:
        return line.split()
    reader = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    try:
        return next(reader, [])
    except csv.Error as error:
        raise InputError(
            f'a cell of {path} must have at most {csv.field_size_limit()} characters, got'
            f' a line of {len(line)} characters ({error}); remove this line',
            code='csv_cell',
        ) from error


def _head_lines(path: Path) -> tuple[list[str], bool]:
    """Return the first lines of a text log, and whether the last one is cut off."""
    if not path.is_file():
        raise InputError(f'a text log must be a regular file, got {path}; check the path')
    _refuse_compressed(path)
    with _opened(path) as file:
        head = file.read(HEAD_BYTES)
    lines = plain_lines(head.splitlines())
    if not lines or '\0' in head:
        raise InputError(
            f'{path} must be a text log, got {"an empty file" if not lines else "binary data"};'
            ' check the path'
        )
    return lines, len(head) >= HEAD_BYTES


class _Table:
    """
    Header and columns of a text log.

    `sensor` ('acc' or 'gyro') has the rows that are read, whatever the names of their columns.
    """

    def __init__(self, path: Path, sensor: str = ''):
        self.path = path
        self.sensor = sensor
        # 1. The lines at the beginning of the file as cells, and the first row of numbers.
        lines, is_cut = _head_lines(path)
        self.delimiter = _delimiter(lines)
        """None for white space."""
        rows = [self._cells(line) for line in (lines[:-1] if is_cut else lines)]
        first = _first_row(rows)
        if first is None:
            raise InputError(
                f'{path} must have rows of numbers separated by comma, semicolon, tab or spaces,'
                ' got none; check the file'
            )
        self.first = first
        """Lines in front of the first row of numbers."""
        self.first_row = rows[first]
        """Its cells."""
        # 2. Names of the columns, and the form of their cells.
        cells = chain.from_iterable(rows[first:])
        self.decimal_comma = any(_has_decimal_comma(cell, self.delimiter) for cell in cells)
        self.names = _unique(self._header_names(rows[:first]))
        """Names of the columns, all different."""
        self.dates = {k for k, cell in enumerate(self.first_row) if DATE.match(cell)}
        """Indexes of the columns of dates."""
        self.clocks = {k for k, cell in enumerate(self.first_row) if TIME_OF_DAY.fullmatch(cell)}
        """Indexes of the columns of times of day."""
        self.word_columns = []
        """Names of the columns with a word in each row."""
        for k, name in enumerate(self.names):
            if all(len(row) > k and _is_word(row[k]) for row in rows[first:]):
                self.word_columns.append(name)
        # 3. The content, which is empty before `load`.
        self.n_dropped = 0
        """Rows that `load` left out: too short, or repeated lines of the header."""
        self.lines: list[str] = []
        """Rows that `load` has read."""
        self._values: dict[int, np.ndarray] = {}
        """Index of a column -> values that `load` has read, shape (n,)."""
        self._header_lines = {line.strip() for line in lines[:first]}
        """Lines that some programs repeat between the rows."""

    def _header_names(self, rows: list[list[str]]) -> list[str]:
        """
        Return the names of the columns, with units in brackets, from the rows before the numbers.

        Of the last two rows of full width the second one has units. Without a header the names are
        numbers.
        """
        width = len(self.first_row)
        if not self.first_row[-1].strip():  # rows end with a separator, the header does not
            rows = [[*row, ''] if len(row) == width - 1 else row for row in rows]
        header = [row for row in rows if len(row) == width][-2:]
        if not header:
            return [str(k + 1) for k in range(width)]
        names = []
        for name in header[0]:
            printable_name = ''.join(c if c.isprintable() else ' ' for c in name)
            names.append(re.sub(r'\s+', ' ', printable_name).strip())
        if len(header) == 2:  # names, then units
            units = [_without_brackets(unit) for unit in header[1]]
            names = [
                f'{name} ({unit})' if unit else name
                for name, unit in zip(names, units, strict=True)
            ]
        longest = max(map(len, names))
        if longest > LONGEST_COLUMN_NAME:
            raise InputError(
                f'a column name of {self.path} must have at most {LONGEST_COLUMN_NAME} characters,'
                f' got {longest}; shorten the header',
                code='csv_header',
            )
        return names

    def _cells(self, line: str) -> list[str]:
        """Return the cells of a line."""
        return split_cells(line, self.delimiter, self.path)

    def column(self, name: str) -> int:
        """Return the index of a column by name, also with a minus in front, or by number."""
        name = name if name in self.names else name.removeprefix('-')
        if name in self.names:
            return self.names.index(name)
        if name.isdecimal() and len(name) < 9 and 1 <= int(name) <= len(self.names):
            return int(name) - 1
        raise InputError(
            f'a column must be in {self.path}, got {name!r}; it has'
            f' {shortened(", ".join(self.names), 300)}'
        )

    def stated(self, columns: Columns) -> Columns:
        """
        Return Columns that the user states with the names of this table in place of numbers.

        Of a date and a time of day in two columns the time of day remains: midnights are counted.
        """
        names = []
        for name in columns.names:
            sign = '-' if name.startswith('-') and name not in self.names else ''
            names.append(sign + self.names[self.column(name)])
        if columns.quantity == 'time':
            clocks = [name for name in names if self.column(name) in self.clocks | self.dates]
            names = clocks[-1:] or names
        return replace(columns, names=tuple(names))

    def load(self, names: Iterable[str], where: Sequence[str] = ()) -> None:
        """
        Read the columns; cells without a number become NaN.

        Rows that do not fulfil the conditions `where` are left out.
        """
        wanted = sorted({self.column(name) for name in names})
        # Lines that end before the last of these columns are left out.
        selected = self._selected(self._rows, where)
        self.lines = self._complete(selected, wanted[-1] + 1)
        numbers = [k for k in wanted if k not in self.dates | self.clocks]
        self._values = dict(zip(numbers, self._numbers(numbers).T, strict=True))
        for k in set(wanted) - set(numbers):
            cells = [self._cells(line)[k] for line in self.lines]
            self._values[k] = _dates(cells) if k in self.dates else _times_of_day(cells)
        if min(map(len, self._values.values())) < 2:
            raise InputError(
                f'{self.path} must have at least two rows of numbers, got fewer; check the file'
            )

    def _numbers(self, columns: Sequence[int]) -> np.ndarray:
        """Return columns of numbers by their indexes, shape (n, len(columns)); no number: NaN."""
        options: dict[str, Any] = {
            'usecols': columns,
            'delimiter': self.delimiter,
            'encoding': 'utf-8-sig',
            'comments': None,
        }
        number_lines = [self._as_numbers(line) for line in self.lines]
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', UserWarning)  # files without rows
            try:
                data = np.loadtxt(number_lines, ndmin=2, **options)
            except ValueError:  # empty cells, text such as "nan" in other languages
                data = np.genfromtxt(number_lines, invalid_raise=False, **options)
                data = data.reshape(-1, len(columns))
        if columns and len(data) != len(self.lines):
            # Readings and times would belong to different rows.
            raise InputError(
                f'each row of {self.path} must have the columns that are read, {len(self.lines)}'
                f' rows gave {len(data)} samples; remove text between the rows',
                code='csv_rows',
            )
        return data

    @cached_property
    def _rows(self) -> list[str]:
        """The lines of the rows; the file is read once for the names of sensors and the columns."""
        with _opened(self.path) as file:
            return plain_lines(file.read().splitlines())[self.first :]

    def values_of(self, name: str, where: Sequence[str]) -> list[str]:
        """Return the different cells of a column in the rows that fulfil `where`, sorted."""
        rows = self._selected(self._rows, where)
        return sorted({cell for _, cell in self._column_of(rows, name)})

    def _as_numbers(self, line: str) -> str:
        """Return a line without comment, with cells that have no quotes, and decimal points."""
        line = _without_comment(line)
        if '"' not in line:
            comma = self.decimal_comma and self.delimiter != ','
            return line.replace(',', '.') if comma else line
        plain = []
        for cell in self._cells(line):
            if self.decimal_comma:
                cell = cell.replace(',', '.')
            # Text may contain the delimiter.
            plain.append(cell.replace(self.delimiter or ' ', ''))
        return (self.delimiter or ' ').join(plain)

    def _complete(self, lines: Iterable[str], width: int) -> list[str]:
        """
        Return the lines with at least `width` cells; the other ones are counted in `n_dropped`.

        Empty lines and comments are left out without a count.
        """
        complete = []
        for line in lines:
            plain = _without_comment(line)
            if not plain.strip():
                continue
            if line.strip() in self._header_lines:
                self.n_dropped += 1
                continue
            if self.delimiter is not None and '"' not in plain:
                n_cells = plain.count(self.delimiter) + 1
            else:
                n_cells = len(self._cells(plain))
            if n_cells >= width:
                complete.append(line)
            else:
                self.n_dropped += 1
        return complete

    def _column_of(self, lines: Iterable[str], name: str) -> Iterator[tuple[str, str]]:
        """Yield (line, its cell in a column) of the lines that have the column."""
        column = self.column(name)
        for line in lines:
            # Cells without quotes are separated without the slower csv module.
            cells = self._cells(line) if '"' in line else line.lstrip('# ').split(self.delimiter)
            if column < len(cells):
                yield line, cells[column].strip()

    def _selected(self, lines: list[str], where: Sequence[str]) -> list[str]:
        """
        Return the lines that fulfil all conditions COLUMN=VALUE[,VALUE], as text or numbers.

        Raises InputError when no line is left.
        """
        for condition in where:
            name, equals, value = condition.partition('=')
            if not equals or not value.strip():
                raise InputError(
                    f'a condition must be COLUMN=VALUE, got {condition!r}; correct it',
                    code='where',
                )
            value = value.strip()
            # A value may contain a comma.
            accepted = (value, *value.split(','))
            selected = []
            cell_counts = Counter()
            for line, cell in self._column_of(lines, name.strip()):
                cell_counts[cell] += 1
                if any(_same(cell, each) for each in accepted):
                    selected.append(line)
            if not selected:
                usual = ', '.join(cell for cell, _ in cell_counts.most_common(5))
                raise InputError(
                    f'rows of {self.path} must fulfil {condition}, got none; {name} is'
                    f' {shortened(usual, 100)}; correct the column or its value',
                    code='where',
                )
            lines = selected
        return lines

    def values(self, names: Sequence[str]) -> np.ndarray:
        """Return columns, shape (n, len(names)); a minus before a name reverses the sign."""
        columns = []
        for name in names:
            is_reversed = name not in self.names and name.startswith('-')
            sign = -1.0 if is_reversed else 1.0
            columns.append(sign * self._values[self.column(name)])
        return np.column_stack(columns)

    def raw(self, name: str) -> np.ndarray:
        """Return one column as read, float or datetime64."""
        return self._values[self.column(name)]

    def start_ns(self, time: Columns) -> int:
        """Return the first of the Columns of time, ns; 0 for dates and times since 1970."""
        values = self.raw(time.names[0])
        if len(time.names) == 2 or values.dtype.kind == 'M':
            return 0
        start = float(values[0]) * _time_size(time.unit)
        return 0 if start > EPOCH else round(start * 1e9)

    def stamps(self, time: Columns) -> np.ndarray:
        """
        Return stamps in ns of the Columns of time, int64, shape (n,); raises InputError.

        Two columns are seconds and nanoseconds.
        """
        if len(time.names) == 2:
            seconds_and_ns = self.values(time.names)
            # Neither of the two numbers is larger than seconds may be.
            self._require_times(time, (np.abs(seconds_and_ns) < MAX_TIME_SECONDS).all(axis=1))
            seconds, nanoseconds = seconds_and_ns.astype(np.int64).T
            return seconds * 10**9 + nanoseconds
        values = self.raw(time.names[0])
        if values.dtype.kind == 'M':
            self._require_times(time, ~np.isnat(values))
            return values.astype(np.int64)
        unit_s = _time_size(time.unit)
        self._require_times(time, np.abs(values * unit_s) < MAX_TIME_SECONDS)
        return stamps_of(values, unit_s)

    def _require_times(self, time: Columns, is_time: np.ndarray) -> None:
        """Raise InputError unless each row has a time; `is_time`: bool, shape (n,)."""
        n_bad = np.count_nonzero(~is_time)
        if n_bad == len(is_time):
            cell = self.first_row[self.column(time.names[0])].strip()
            raise InputError(
                f'the time in {self.path} must be a number, a date with time or a time of day'
                f' (HH:MM:SS.sss), the format of {shortened(cell, 60)!r} was not understood; name'
                ' another column with time=NAME:UNIT',
                key='columns',
                code='csv_format',
            )
        if n_bad:
            raise InputError(
                f'the time of every row of {self.path} must be a number below {MAX_TIME_SECONDS:g}'
                f' s, got {n_bad} without one; remove these rows',
                code='csv_time',
            )


def _has_decimal_comma(cell: str, delimiter: str | None) -> bool:
    """Return whether a cell is a number with a decimal comma, without doubt."""
    if not re.fullmatch(r'\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*', cell):
        return False
    # In a quoted cell between commas, 1,234 may be a thousand.
    return delimiter != ',' or not GROUPED_NUMBER.fullmatch(cell)


def _unique(names: list[str]) -> list[str]:
    """Return names in which repeated ones are followed by their number of column."""
    counts = Counter(names)
    return [name if counts[name] == 1 else f'{name} [{k + 1}]' for k, name in enumerate(names)]


def _dates(cells: list[str]) -> np.ndarray:
    """Return dates with time as datetime64[ns], shape (n,); NaT where a cell is none."""
    time_zone = re.compile(r'\s*(Z|[+-]\d\d:?\d\d)$')
    texts = [time_zone.sub('', cell.strip()).replace(' ', 'T') for cell in cells]
    try:
        return np.array(texts, 'datetime64[ns]')
    except ValueError:
        pass
    # One of them is no date: find which.
    dates = np.full(len(texts), np.datetime64('NaT'), 'datetime64[ns]')
    for k, text in enumerate(texts):
        with suppress(ValueError):
            dates[k] = np.datetime64(text, 'ns')
    return dates


def _times_of_day(cells: list[str]) -> np.ndarray:
    """
    Return times of day as datetime64[ns] from the midnight before the first one, shape (n,).

    A step back by more than half a day is a midnight. NaT where a cell is no time of day.
    """
    time_ns = np.full(len(cells), NO_TIME, np.int64)
    for k, cell in enumerate(cells):
        match = TIME_OF_DAY.fullmatch(cell)
        if match:
            hours, minutes, seconds, fraction, half = match.groups(default='')
            hour = int(hours)
            if half:  # 12 am is midnight, 12 pm is noon
                hour = hour % 12 + 12 * (half in 'Pp')
            time_s = 3600 * hour + 60 * int(minutes) + int(seconds)
            time_ns[k] = time_s * 10**9 + int(fraction[:9].ljust(9, '0'))
    is_time = time_ns != NO_TIME
    time_of_day_ns = time_ns[is_time]
    steps_ns = np.diff(time_of_day_ns, prepend=time_of_day_ns[:1])
    n_midnights = np.cumsum(steps_ns < -DAY_NS // 2)
    time_ns[is_time] = time_of_day_ns + DAY_NS * n_midnights
    return time_ns.view('datetime64[ns]')


def _delimiter(lines: list[str]) -> str | None:
    """
    Return the delimiter that gives the same number of columns, at least four, in most lines.

    None for white space.
    """

    def agreement(delimiter: str | None) -> int:
        """Return the number of lines with the most frequent width; 0 if that is below four."""
        counts = Counter(len(line.split(delimiter)) for line in lines[:50] if line.strip())
        width, n_lines = counts.most_common(1)[0]
        return n_lines if width >= 4 else 0

    return max((';', '\t', ',', None), key=agreement)


def _first_row(rows: list[list[str]]) -> int | None:
    """
    Return the index of the first row of numbers, or None.

    A header may have numbers too, and has more words than most rows.
    """
    n_numbers = [sum(map(_numeric, row)) for row in rows]
    n_words = [sum(map(_is_word, row)) for row in rows]
    # Of the rows with at least two numbers: a single one may be part of a title.
    usual_n_numbers = Counter(number for number in n_numbers if number >= 2).most_common(1)
    if not usual_n_numbers:
        return None
    usual_n_words = Counter(n_words).most_common(1)[0][0]
    for k, row in enumerate(rows):
        # A time and three axes are four numbers; a narrower row has fewer, and so has a log whose
        # usual rows have fewer.
        has_numbers = n_numbers[k] >= min(4, len(row), usual_n_numbers[0][0])
        if len(row) > 1 and has_numbers and n_words[k] <= usual_n_words:
            return k
    return None


def _is_word(cell: str) -> bool:
    """Return whether a cell is text that begins with a letter, no missing number."""
    text = cell.strip().strip('"')
    return text[:1].isalpha() and text.lower() not in ('nan', 'inf', 'null', 'na')


def _same(cell: str, value: str) -> bool:
    """Return whether a cell has a value, as text or as a number."""
    value = value.strip()
    return cell == value or (_numeric(cell) and _numeric(value) and float(cell) == float(value))


def _without_brackets(text: str) -> str:
    """Return text without the brackets around it: (m/(s^2)) is m/(s^2)."""
    text = text.strip()
    while len(text) >= 2 and text[0] + text[-1] in ('()', '[]'):
        text = text[1:-1].strip()
    return text


def _numeric(cell: str) -> bool:
    """Return whether a cell is one number, with a decimal point or comma."""
    if len(cell) > LONGEST_NUMBER:
        return False
    return re.fullmatch(r'\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?\s*', cell) is not None


AxisSets = dict[str, dict[str, Columns]]
"""Set of axes of one quantity (`_Reading.group`) -> axis -> its column."""


def _guess(table: _Table, stated: Iterable[str] = frozenset()) -> list[Columns]:
    """
    Return the Columns that the header names, without force or rate if they are `stated`.

    Raises InputError for several sets of axes of one sensor.
    """
    axis_sets: dict[str, AxisSets] = {'force': {}, 'rate': {}}
    single_columns: dict[str, Columns] = {}  # quantity without axes -> its column
    joints = []
    for name in table.names:
        words, unit_text = _words_in(table, name)
        # 1. A column of one number: a joint, a time or a temperature.
        joint = re.fullmatch(r'joint[ ._](\w+?)(?: (?:position|angle))?', words)
        if joint:
            joints.append(Columns('joint', (name,), _unit('joint', unit_text), joint.group(1)))
        for quantity in ('time', 'temperature'):
            unit = _unit(quantity, unit_text)
            # T (°C) is no time, and temp (F) is not read as °C.
            has_fitting_unit = not unit_text or unit
            if has_fitting_unit and re.fullmatch(COLUMN_PATTERNS[quantity], words):
                # The first column with the name.
                single_columns.setdefault(quantity, Columns(quantity, (name,), unit))
        # 2. An axis of a sensor. The rows of a stated sensor need no name of it in their columns.
        reading = _reading_of(words)
        if reading is None:
            continue
        sensor = table.sensor or reading.sensor
        for quantity, sets in axis_sets.items():
            if re.fullmatch(COLUMN_PATTERNS[quantity], sensor):
                unit = _unit(quantity, unit_text)
                if unit is None and re.fullmatch(r'g ?f(orce)?', sensor):
                    unit = 'g'
                column = Columns(quantity, (name,), unit)
                sets.setdefault(reading.group, {})[reading.axis] = column

    # 3. The time: seconds and nanoseconds, else a column with a usual name, else the only one that
    #    may be it.
    time = _seconds_and_nanoseconds(table) or single_columns.get('time') or _unnamed_time(table)
    if time is not None:
        single_columns['time'] = time
    columns = [*single_columns.values(), *joints]
    # 4. The only set of three axes of each sensor.
    for quantity, sets in axis_sets.items():
        if quantity not in stated:
            columns += _only_set(table.path, quantity, sets)
    return columns


def _words_in(table: _Table, name: str) -> tuple[str, str]:
    """
    Return words and unit of a column as `_words`, after names that are too short are completed.

    A column x, y or z gets the sensor of its unit, else the words of the name of the file, which
    then has the readings of one sensor.
    """
    words, unit_text = _words(name)
    axis_name = re.fullmatch(r'([xyz])(?: axis)?', words)
    if axis_name:
        sensor = _sensor_of_unit(unit_text) or _words(table.path.stem)[0]
        words = f'{sensor} {axis_name[1]}'
    # T in °C is a temperature, no time.
    if words in ('t', 't imu') and _unit('temperature', unit_text):
        words = 'temperature'
    return words, unit_text


def _only_set(path: Path, quantity: str, sets: AxisSets) -> list[Columns]:
    """
    Return the Columns of the only set with three axes; [] without one, InputError for several.

    A unit that only some axes have is not used.
    """
    complete = {key: axes for key, axes in sets.items() if len(axes) == 3}
    if len(complete) > 1 and quantity == 'force':
        complete = _with_gravity(complete)
    names = [tuple(axes[axis].names[0] for axis in 'xyz') for axes in complete.values()]
    if len(names) > 1:
        raise InputError(
            f'{path} must have one column of {quantity} per axis, got {len(names)}'
            f' sets, as of several IMUs: {"; ".join(map(", ".join, names))}; {REMEDY}',
            key='columns',
            code='several_sets',
        )
    if not names:
        return []
    (axes,) = complete.values()
    units = {column.unit for column in axes.values()}
    return [Columns(quantity, names[0], units.pop() if len(units) == 1 else None)]


@dataclass(frozen=True)
class _Reading:
    """The parts of the name of a column with one axis of a sensor."""

    sensor: str
    """Name of the sensor or quantity, such as 'acc'."""
    axis: str
    """'x', 'y' or 'z'."""
    group: str
    """Equal for the axes of one set; numbers distinguish sensors, "raw" from converted ones."""


DECORATION = r'(?:raw|cal|out|ln cal|wr cal|ln raw|wr raw|ln|wr)'
"""Words after the axis that loggers add; LN and WR: low noise and wide range."""


def _reading_of(words: str) -> _Reading | None:
    """
    Return the `_Reading` of a name in lower-case words, None for a name without an axis.

    ``'imu1 accel x raw'`` gives ``_Reading('accel', 'x', 'imu1accelraw')``.
    """
    bare, decoration = _without_decoration(words)
    # An axis in front becomes the last word: x acc, xacc, x ang rate, raw imu x acc.
    bare = re.sub(r'^(?:(?:.* )?imu\d? )?([xyz]) ?(acc\w*|gyr\w*|ang \w+)$', r'\2 \1', bare)
    bare = re.sub(r'^([xyz]) (.*)$', r'\2 \1', bare)
    bare, device_name = _without_device(bare)
    axis = re.fullmatch(r'(.*?) ?([xyz])', bare)
    if axis is None:
        return None
    group = re.sub(r'[^a-z0-9]', '', device_name + axis[1] + decoration)
    return _Reading(axis[1], axis[2], group)


def _without_decoration(words: str) -> tuple[str, str]:
    """
    Return (name without the additions of a logger, these additions).

    ``'acc x raw'`` gives ``('acc x', 'raw')``, ``'shimmer a1 accel ln x cal'`` gives
    ``('accel x', 'lncal')``.
    """
    suffix = re.search(rf'(?<= ){DECORATION}$', words)
    decoration = suffix[0] if suffix else ''
    bare = words.removesuffix(decoration).strip()
    ranged = re.fullmatch(r'(?:shimmer \w+ )?(.*) (ln|wr) ([xyz])', bare)
    if ranged:
        bare = f'{ranged[1]} {ranged[3]}'
        decoration = ranged[2] + decoration
    return re.sub(r'^shimmer \w+ ', '', bare), decoration


def _without_device(bare: str) -> tuple[str, str]:
    """
    Return (name without the one of several IMUs that it names, the name or number of this IMU).

    ``'imu1 ax'`` gives ``('ax', 'imu1')``, ``'acc1 x'`` gives ``('acc x', '1')`` and ``'ax 1'``
    gives ``('ax', '1')``.
    """
    device_name = ''
    device = re.fullmatch(r'((?:imu|sensor|mpu|device) ?\d+) (.*)', bare)
    if device:
        device_name = device[1]
        bare = device[2]
    numbered = re.fullmatch(r'(\D+?) ?(\d+) ?([xyz]?)', bare)
    if numbered:
        bare = f'{numbered[1]} {numbered[3]}'.strip()
        device_name += numbered[2]
    return bare, device_name


def _sensor_of_unit(unit_text: str) -> str:
    """Return the sensor that has a unit, 'acc' or 'gyro'; '' for an unknown or missing unit."""
    for quantity, sensor in (('force', 'acc'), ('rate', 'gyro')):
        if unit_text and _unit(quantity, unit_text):
            return sensor
    return ''


def _with_gravity(sets: AxisSets) -> AxisSets:
    """
    Return the sets of force without the linear accelerations that a phone adds to them.

    Keys: `_Reading.group`, such as 'linacc'; of a g-force ('gf...') only its set is returned.
    """
    with_gravity = {key: axes for key, axes in sets.items() if not key.startswith('lin')}
    g_force = {key: axes for key, axes in with_gravity.items() if key.startswith('gf')}
    return g_force or with_gravity or sets


STAMP_NAMES = ('', 'header stamp', 'stamp', 'time', 'field header stamp')
"""Names of a stamp in two columns, before the word for seconds or nanoseconds."""


def _seconds_and_nanoseconds(table: _Table) -> Columns | None:
    """Return the Columns of a stamp in two columns, seconds and nanoseconds; None without them."""
    # Name of the stamp -> is_nano -> name of the column.
    columns_of: dict[str, dict[bool, str]] = {}
    for name in table.names:
        words = re.sub(r'[\s_./:-]+', ' ', name.lower()).strip()
        match = re.fullmatch(r'(.*?) ?(secs?|seconds|nsecs?|nano ?secs?|nanoseconds)', words)
        if match is not None and match[1] in STAMP_NAMES:
            is_nano = match[2].startswith('n')
            columns_of.setdefault(match[1], {})[is_nano] = name
    for columns in columns_of.values():
        if len(columns) == 2:
            return Columns('time', (columns[False], columns[True]), 'ns')
    return None


def _unnamed_time(table: _Table) -> Columns | None:
    """
    Return the column of time where no usual name has it; None if several may be it.

    The only one with times of day or dates, else with a unit of time in brackets, else with "time"
    and "stamp" in its name.
    """
    clocks = [table.names[k] for k in sorted(table.clocks | table.dates)]
    with_unit = []
    stamps = []
    for name in table.names:
        words, unit_text = _words(name)
        if re.search(r'[(\[]', name) and _unit('time', unit_text):
            with_unit.append(name)
        if re.search('time ?stamp', words):
            stamps.append(name)
    for names in (clocks, with_unit, stamps):
        if len(names) == 1:
            return Columns('time', (names[0],), _unit('time', _words(names[0])[1]))
    return None


ELEMENT = re.compile(r'(.*\S)\[([012])\]')
"""
Elements of an array are axes: gyro[0] is x. A space before the bracket marks a repeated name.
"""


def _words(name: str) -> tuple[str, str]:
    """
    Return (name of a column in lower-case words without its unit, text of the unit or '').

    ``'AccX (m/s^2)'`` gives ``('acc x', 'm/s^2')``; ``'gyro[0]'`` gives ``('gyro x', '')``.
    """
    element = ELEMENT.fullmatch(name)
    if element:
        words, unit = _words(element.group(1))
        return f'{words} {"xyz"[int(element.group(2))]}', unit
    text, unit = _without_unit(name)
    text = re.sub(r'(?<=[a-z])(?=[A-Z])', ' ', text)
    unit = unit.lower().replace('m_s2', 'm/s2').replace('m_s_2', 'm/s2').replace('_s', '/s')
    return re.sub(r'[\s_./-]+', ' ', text).strip().lower(), unit


def name_with_unit(name: str, quantity: str, unit: str) -> str:
    """Return the name of a column that states this unit; unchanged where it does already."""
    if _unit(quantity, _words(name)[1]) == unit:
        return name
    element = ELEMENT.fullmatch(name)
    if element:
        return f'{name_with_unit(element[1], quantity, unit)}[{element[2]}]'
    return f'{_without_unit(name)[0].strip()} ({unit})'


UNIT_SUFFIX = re.compile(
    r'_(m_s2|mps2|m_s_2|rad_s|rads|deg_s|dps|mdps|mg|(?<=\w\w_)g|[mun]?sec|ms|us|ns|deg|rad|deg_?c|celsius|c|s)$',
    re.IGNORECASE,
)
"""Unit after an underscore: acc_x_mg. At least two characters are before a g: a_g is no unit."""
UNIT_ENDING = re.compile(
    r'(?<=temp)((?:deg)?c)$|(?<=temperature)((?:deg)?c)$|(?<=time)([mun]s)$', re.IGNORECASE
)
"""Unit without an underscore: tempC, timems."""


def _without_unit(name: str) -> tuple[str, str]:
    """Return (name without its unit, text of the unit or ''): in brackets, or as a suffix."""
    bracket = re.search(r'[(\[](.*?)[)\]]\s*(?:\[\d+\])?$', name)
    unit = bracket.group(1) if bracket else ''
    text = name[: bracket.start()] if bracket else name
    if not unit:
        suffix = UNIT_SUFFIX.search(text) or UNIT_ENDING.search(text)
        if suffix:
            unit = suffix.group().removeprefix('_')
            text = text[: suffix.start()]
    # The name is the unit.
    if not unit and text.lower() in ('millis', 'micros', 'nanos', 'ms', 'us', 'ns'):
        unit = text
    return text, unit


def _unit(quantity: str, text: str) -> str | None:
    """Return the unit of a quantity by its spelling in a header, or None."""
    text = text.strip().removesuffix(CORRECTED).replace(' ', '')
    if quantity == 'time' and _tick_size(text):
        return text
    unit_of_spelling = {unit.lower(): unit for unit in COLUMN_UNITS[quantity]}
    return (unit_of_spelling | SPELLINGS[quantity]).get(text)


MIN_DISTINCT_TIMES = 0.1
"""Least share of different times: below, they were written with too few digits, or never set."""
MIN_ROWS_OF_TIMES = 20
"""Rows from which the share is tested."""


def _require_distinct_times(values: np.ndarray, path: Path) -> None:
    """Refuse times, float or datetime64, that are equal in nearly all rows."""
    # Cells that are no time are refused with their own cause.
    values = values[~np.isnan(values)] if values.dtype.kind == 'f' else values[~np.isnat(values)]
    n_distinct = len(np.unique(values))
    if len(values) < MIN_ROWS_OF_TIMES or n_distinct >= MIN_DISTINCT_TIMES * len(values):
        return
    fault = 'all stamps are equal' if n_distinct == 1 else f'only {n_distinct} stamps differ'
    raise InputError(
        f'the time in {path} must differ from row to row, {fault} in {len(values)} rows, the first'
        f' is {values[0]}: written with too few digits?; export the time with nine digits after'
        ' the second, or name another column with time=NAME:UNIT',
        key='columns',
        code='stamps_equal',
    )


def _time_unit(values: np.ndarray) -> str | None:
    """Return the unit in which the median step is that of an IMU, or None."""
    if values.dtype.kind == 'M':
        return 'ns'
    usual_step = median_step(values)
    for unit, low, high in PERIODS:
        if low <= usual_step <= high:
            return unit
    return None


SAMPLE_TIME_FINE = ('sample time fine', 'sampletimefine')
SLOWEST_TICKS = 4000
"""
Median step of SampleTimeFine: from it on microseconds (Xsens DOT, at most 250 Hz), below ticks of
100 us (MTi, at least 2.5 Hz).
"""


def _unit_of_sample_time_fine(values: np.ndarray) -> str:
    """Return the unit of a column SampleTimeFine of an Xsens log."""
    return 'us' if median_step(values) >= SLOWEST_TICKS else '100us'


def _require_time_of_turns(time: Columns, rate: Columns, imu: ImuSamples, path: Path) -> None:
    """
    Refuse stamps with a unit found from the values, if the rates turn gravity by another clock.

    The turns of gravity per sample give the product of period and unit of the rates; with the unit
    of the rates in the header, the period follows, and thereby the unit of time. A unit of the
    rates that was found from the values too must agree well, because a wrong tick of a counter
    has the same effect as another unit of the rates.

    `imu`: force in SI, rates as in the log.
    """
    if time.origin != 'values' or imu.stamp_ns[0] == imu.stamp_ns[-1]:
        return
    if rate.unit == RAW_UNIT:  # converted later, with the unit that the user states
        return
    period_s = float(np.median(np.diff(imu.stamp_ns))) * 1e-9
    if period_s <= 0.0:
        return
    unit_s = _time_size(time.unit)
    unit_rad_s = _size_of(rate)
    band = OWN_RATE_BAND if rate.origin == 'values' else RATE_BAND
    # The unit of the rates with which they turn gravity by these stamps, rad/s: it is theirs where
    # the stamps are right.
    factor = _turning_factor(imu.stamp_ns, imu.force_s, imu.rate_s)
    if factor is not None and 1 / band < factor / unit_rad_s < band:
        return

    # The period with which they turn gravity in their unit, and the unit of time that gives it.
    true_period_s = _period_of_turns(imu, unit_rad_s)
    if true_period_s is None:
        return
    tick_s = true_period_s / period_s * unit_s
    if abs(np.log(tick_s / unit_s)) < np.log(band):
        return
    usual = [tick for tick in USUAL_TICKS if abs(tick_s / _tick_size(tick) - 1.0) < NEAR_TICK]
    ticks = ' or '.join(usual) or f'{tick_s * 1e6:.3g}us'
    raise InputError(
        f'the unit of time in {path} must agree with the turns of gravity, {time.names[0]} was read'
        f' in {time.unit}, a rate in {rate.unit} fits ticks of about {tick_s * 1e6:.3g} us; convert'
        f' it with the column stated: time={time.names[0]}:{ticks}, or state the unit of the rate',
        key='columns',
        code='time_ticks',
    )


def _period_of_turns(imu: ImuSamples, unit_rad_s: Any) -> float | None:
    """
    Return the sampling period with which the rates turn the force, s; None for too few turns.

    A wrong period may hide the turns, therefore stamps with the periods of usual IMUs are tried.
    The factor is proportional to 1 / period.
    """
    number = np.arange(len(imu.stamp_ns))
    for period_s in TRIED_PERIODS:
        stamp_ns = np.round(number * (period_s * 1e9)).astype(np.int64)
        factor = _turning_factor(stamp_ns, imu.force_s, imu.rate_s)
        if factor is not None:
            return factor / unit_rad_s * period_s
    return None


def _force_unit(force: np.ndarray) -> str | None:
    """Return the unit in which the median length of readings, (n, 3), is that of gravity."""
    length = float(np.nanmedian(np.linalg.norm(force, axis=1)))
    for unit, size in COLUMN_UNITS['force'].items():
        if 1 / GRAVITY_BAND < length * size / STANDARD_GRAVITY < GRAVITY_BAND:
            return unit
    return None


def _refuse_increments(force: np.ndarray, stamp_ns: np.ndarray) -> None:
    """Raise InputError for readings, (n, 3), that are increments over one sample."""
    length = float(np.nanmedian(np.linalg.norm(force, axis=1)))
    error = force_error(length, 'in the log', per_second=samples_per_second(stamp_ns))
    if error is not None and error.code == 'increments':
        raise error


def _turning_factor(stamp_ns: np.ndarray, force_s: np.ndarray, rate: np.ndarray) -> float | None:
    """
    Return the size in rad/s of the unit of `rate` with which the rates turn the force.

    None where the force does not turn enough. `rate`: readings in any unit, (n, 3).
    """
    series = ChunkSeries()
    good = np.isfinite(force_s).all(axis=1) & np.isfinite(rate).all(axis=1)
    series.push(stamp_ns[good], np.concatenate([force_s[good].T, rate[good].T]))
    turning = relate_turns(series.chunks())
    return None if turning is None else turning.factor


def _rate_unit(stamp_ns: np.ndarray, force_s: np.ndarray, rate: np.ndarray) -> str | None:
    """Return the unit in which the rates turn gravity as the accelerometer measures it, or None."""
    factor = _turning_factor(stamp_ns, force_s, rate)
    if factor is None:
        return None
    for unit, size in COLUMN_UNITS['rate'].items():
        if 1 / RATE_BAND < factor / size < RATE_BAND:
            return unit
    return None


def is_text_log(path: str | PathLike[str]) -> bool:
    """Return whether a path has the name of a text log."""
    return Path(path).suffix.lower() in SUFFIXES


def is_log_folder(path: str | PathLike[str]) -> bool:
    """Return whether a path is a folder of text logs, as phones export it, and no bag."""
    folder = Path(path)
    if not folder.is_dir() or (folder / 'metadata.yaml').exists():
        return False
    files = list(folder.iterdir())
    has_storage_file = any(file.suffix in suffixes() for file in files)
    return any(map(is_text_log, files)) and not has_storage_file


def require_no_rows(options: LogOptions, path: str | PathLike[str]) -> None:
    """Refuse columns and conditions on rows for a recording that is no text log."""
    for code, stated in (('where', options.where), ('columns', options.columns)):
        if stated:
            raise InputError(
                f'columns and rows are those of a text log ({", ".join(SUFFIXES)}), got'
                f' {shortened(" ".join(stated), 100)} for {path}; omit them',
                code=code,
            )


def read_directly(path: Path, options: LogOptions) -> CsvLog:
    """
    Read a text log or a folder of them without `convert`, and report how it is read.

    See `read_csv` and `read_logs`.
    """
    if not path.is_dir():
        log = read_csv(path, options.columns, options.where, raw=options.raw)
    elif options.raw:
        raise InputError(
            f'units are stated for one text log, got the folder {path}; convert it first',
            code='several_logs',
        )
    else:
        log = read_logs([path], options.columns, options.where)
    name = name_of_path(path)
    remark(f'{name} is read as {"; ".join(map(str, log.columns))}')
    if log.row_names:
        remark(f'{name} has a row per sensor, read are {" and ".join(log.row_names)}')
    if log.joined is not None:
        remark(f'{name}: {log.joined.text}')
    if log.n_dropped:
        remark(f'{name}: {log.n_dropped} lines with too few columns are left out')
    if log.n_overflows:
        steps = np.diff(log.imu.stamp_ns)
        n_gaps = int(np.count_nonzero(steps > GAP_PERIODS * np.median(steps)))
        longer = longer_gaps(log.counter_size_ns, n_gaps)
        remark(f'{name}: the counter of time overflows {log.n_overflows} times: undone{longer}')
    return log


class CsvBag(Rosbag2):
    """
    A text log, or a folder of one per sensor, converted into a temporary bag.

    Raises
    ------
    InputError
        When columns or units are ambiguous; `csv_log.read_csv` with explicit columns reads such a
        log.

    """

    def __init__(self, path: Path, options: LogOptions):
        logs = filter(is_text_log, path.iterdir()) if path.is_dir() else [path]
        status = [log.stat() for log in logs]
        modified_ns = max(each.st_mtime_ns for each in status)
        size = sum(each.st_size for each in status)
        self.converted = _converted(path, modified_ns, size, options)
        super().__init__(self.converted.bag)
        self.path = path


class ConvertedLog:
    """
    The temporary bag of a text log; its folder is removed with the last reference, or at exit.
    """

    def __init__(self, path: Path, options: LogOptions):
        log = read_directly(path, options)
        folder = mkdtemp(prefix='imu_calibration_')
        finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.bag = Path(folder, 'log')
        write_session(self.bag, log.imu, log.joints, temperature=log.temperature, storage='mcap')


@lru_cache(maxsize=1)
def _converted(path: Path, _modified_ns: int, _size: int, options: LogOptions) -> ConvertedLog:
    """
    Return the ConvertedLog of a log that was modified at this time and has this size.

    A verb opens a recording several times, and converts an unchanged file once.
    """
    return ConvertedLog(path, options)
