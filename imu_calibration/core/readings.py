"""
Description of the readings of a recording: unit, scale and offset per sensor, and the axes.

A calibration stores it by value under `readings`, so that every program converts the readings as
the calibration did::

    SI = (reading - offset) / scale

Axes are a statement, not a conversion: values and corrected readings remain in the axes of the
source, to which frame_id and tf belong. Exports to programs with fixed axes convert.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError, shortened
from imu_calibration.core.samples import ImuSamples
from imu_calibration.core.schema import (
    Document,
    mapping,
    maybe,
    number,
    one_or_each,
    require,
    text,
)
from imu_calibration.core.units import DEG, STANDARD_GRAVITY

UNIT_SIZES = {
    'accelerometer': {
        'm/s^2': 1.0,
        'g': STANDARD_GRAVITY,
        'mg': 1e-3 * STANDARD_GRAVITY,
    },
    'gyroscope': {
        'rad/s': 1.0,
        'mrad/s': 1e-3,
        'urad/s': 1e-6,
        'deg/s': DEG,
        'mdeg/s': 1e-3 * DEG,
    },
}
"""Sensor -> unit -> size of the unit in SI."""
SI_UNITS = {'accelerometer': 'm/s^2', 'gyroscope': 'rad/s'}
READING_SPELLINGS = {
    'accelerometer': {
        'm/s2': 'm/s^2',
        'm/s²': 'm/s^2',
        'm/s/s': 'm/s^2',
        'm/(s^2)': 'm/s^2',
        'm/sec^2': 'm/s^2',
        'ms^-2': 'm/s^2',
        'mps2': 'm/s^2',
        'ms2': 'm/s^2',
    },
    'gyroscope': {
        'rads': 'rad/s',
        'rps': 'rad/s',
        'rad/sec': 'rad/s',
        'rads^-1': 'rad/s',
        'µrad/s': 'urad/s',
        'μrad/s': 'urad/s',
        'dps': 'deg/s',
        '°/s': 'deg/s',
        'deg/sec': 'deg/s',
        'degs': 'deg/s',
        'mdps': 'mdeg/s',
    },
}
"""Sensor -> spelling, in lower case -> unit."""
COUNTS = 'counts'
"""Unit of readings with a scale in a file; as an option it needs the scale, counts:16384/g."""
COUNTS_PATTERN = re.compile(r'counts:([-+.\deE]+)/\(?([^()]+)\)?')
INCREMENTS_PATTERN = re.compile(r'increments:([-+.\deE]+)\*(.+)')
"""Increments over one sample, increments:200*m/s^2: 200 times the reading is in m/s^2."""
INCREMENTS_KEY = 'increments'
"""Key of `errors.ERROR_KEYS`, and name of the option, of the samples per second of increments."""
MOST_PER_SECOND = 1e5
"""Samples per second; no inertial sensor gives more."""
UNIT_AGREEMENT = 1e-4
"""Relative difference up to which the scale of a file may differ from that of its unit."""
LARGEST_SCALE = 1e12
"""Scales and offsets above it occur with no converter."""
AXES_OF_CONVENTION = {'flu': ((0, 1), (1, 1), (2, 1)), 'frd': ((0, 1), (1, -1), (2, -1))}
"""Name -> (axis of the source, sign) of forward, left and up."""
FLAT_KEYS = ('accelerometer_offset', 'accelerometer_scale', 'gyroscope_offset', 'gyroscope_scale')
UNIT_KEYS = {'accelerometer': 'accelerometer_unit', 'gyroscope': 'gyroscope_unit'}
"""Sensor -> key of `errors.ERROR_KEYS`, and name of the option, of its unit."""
AXES_KEY = 'axes'
"""Key of `errors.ERROR_KEYS`, and name of the option, of the axes."""
STATED_KEYS = (*UNIT_KEYS.values(), INCREMENTS_KEY)
"""Names of the options that state units."""
Number = float | tuple[float, float, float]
_SCALE = maybe(one_or_each(number(0.0, LARGEST_SCALE, above=True), 1, 3))
_OFFSET = maybe(one_or_each(number(-LARGEST_SCALE, LARGEST_SCALE), 1, 3))
_SENSOR = {'unit': maybe(text(code='unit_unknown')), 'scale': _SCALE, 'offset': _OFFSET}
READINGS_DOCUMENT = Document(
    'readings',
    mapping(
        optional={
            **dict.fromkeys(SI_UNITS, maybe(mapping(optional=_SENSOR, closed=True))),
            **{key: _SCALE if key.endswith('scale') else _OFFSET for key in FLAT_KEYS},
            'axes': maybe(text(code='axes_unknown')),
        },
        closed=True,
    ),
    'correct it',
    dict.fromkeys(('type', 'range', 'length'), 'reading_number'),
    error=InputError,
)
"""The part `readings` of a document, or a file."""


@dataclass(frozen=True)
class SensorUnit:
    """Unit of the readings of one sensor: ``SI = (reading - offset) / scale``."""

    unit: str
    """Unit as it was stated, such as 'g' or 'counts:16384/g'."""
    scale: Number = 1.0
    """Reading per m/s^2 or rad/s, one number or one per axis."""
    offset: Number = 0.0
    """Reading at zero specific force or rate, one number or one per axis."""

    @property
    def per_second(self) -> float:
        """Samples per second of readings that are increments over a sample; 0 for rates."""
        increments = INCREMENTS_PATTERN.fullmatch(self.unit)
        return float(increments[1]) if increments else 0.0

    @property
    def is_si(self) -> bool:
        """Whether the readings are in m/s^2 or rad/s without an offset."""
        return not np.any(self.offset) and bool(np.all(np.equal(self.scale, 1.0)))

    def convert(self, values: np.ndarray) -> np.ndarray:
        """Return readings in SI, shape (..., 3)."""
        return (values - np.asarray(self.offset, float)) / np.asarray(self.scale, float)

    def convert_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Return the covariance of readings, shape (3, 3), in SI: ``cov_ij / (s_i s_j)``."""
        scale = np.broadcast_to(np.asarray(self.scale, float), 3)
        return covariance / np.outer(scale, scale)

    def to_mapping(self) -> dict:
        """Return unit, scale and offset as plain data."""
        return {'unit': self.unit, 'scale': _plain(self.scale), 'offset': _plain(self.offset)}


SI_ACCELEROMETER = SensorUnit(SI_UNITS['accelerometer'])
SI_GYROSCOPE = SensorUnit(SI_UNITS['gyroscope'])


@dataclass(frozen=True)
class RawReadings:
    """Units and axes of the readings of an IMU."""

    accelerometer: SensorUnit = SI_ACCELEROMETER
    """Unit of the specific force."""
    gyroscope: SensorUnit = SI_GYROSCOPE
    """Unit of the angular rate."""
    axes: str = ''
    """'flu', 'frd' or a signed permutation such as 'x,-y,-z'; empty: not stated."""

    @classmethod
    def of_scales(
        cls,
        accelerometer_offset: Number = 0.0,
        accelerometer_scale: Number = 1.0,
        gyroscope_offset: Number = 0.0,
        *,
        gyroscope_scale: Number = 1.0,
    ) -> 'RawReadings':
        """Return the description of readings in volts or counts by offset and reading per SI."""
        return cls(
            _of_scale('accelerometer', accelerometer_scale, accelerometer_offset),
            _of_scale('gyroscope', gyroscope_scale, gyroscope_offset),
        )

    @property
    def is_si(self) -> bool:
        """Whether both sensors are in SI."""
        return self.accelerometer.is_si and self.gyroscope.is_si

    def has_units_of(self, other: 'RawReadings') -> bool:
        """Return whether both sensors have the units of another description, in any axes."""
        return self.accelerometer == other.accelerometer and self.gyroscope == other.gyroscope

    def apply(self, imu: ImuSamples) -> ImuSamples:
        """Return the samples in SI."""
        if self.is_si:
            return imu
        return replace(
            imu,
            force_s=self.accelerometer.convert(imu.force_s),
            rate_s=self.gyroscope.convert(imu.rate_s),
        )

    def convert_message(self, readings: Sequence[float]) -> tuple[float, ...]:
        """Return rate x, y, z and force x, y, z of one message in SI."""
        values = np.asarray(readings, float)
        rate = self.gyroscope.convert(values[:3]).tolist()
        force = self.accelerometer.convert(values[3:]).tolist()
        return (*rate, *force)

    def to_mapping(self) -> dict:
        """Return the part `readings` of a document."""
        document: dict[str, Any] = {
            'accelerometer': self.accelerometer.to_mapping(),
            'gyroscope': self.gyroscope.to_mapping(),
        }
        if self.axes:
            document['axes'] = self.axes
        return document

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any], place: str = 'readings') -> 'RawReadings':
        """
        Return the description in the part `readings` of a document, or in a file.

        Parameters
        ----------
        mapping : mapping
            ``{accelerometer: {unit, scale, offset}, gyroscope: ..., axes}``, all optional, or the
            flat keys ``accelerometer_offset``, ``accelerometer_scale``, ...
        place : str
            Name of the mapping in errors.

        Raises
        ------
        InputError
            When a key is unknown, a unit is unknown, or a number is not usable.

        """
        require(mapping, replace(READINGS_DOCUMENT, name=place))
        units = {}
        for sensor in SI_UNITS:
            entry = mapping.get(sensor)
            flat = {}
            for name in ('scale', 'offset'):
                if f'{sensor}_{name}' in mapping:
                    flat[name] = mapping[f'{sensor}_{name}']
            if entry is not None and flat:
                raise InputError(
                    f'{place} must describe the {sensor} once, it has {sensor} and'
                    f' {sensor}_{next(iter(flat))}; remove one',
                    code='unit_twice',
                )
            units[sensor] = _sensor_unit(sensor, flat if entry is None else entry, place)
        axes = mapping.get('axes') or ''
        return cls(units['accelerometer'], units['gyroscope'], parse_axes(axes) if axes else '')

    def mat_flu_source(self) -> np.ndarray | None:
        """
        Return the matrix from axes of the source to forward-left-up, shape (3, 3).

        None while the axes are not stated. Example: diag(1, -1, -1) for 'frd'.
        """
        return _axes_matrix(self.axes) if self.axes else None


def unit_of(sensor: str, text: str) -> SensorUnit:
    """
    Return the unit of an option.

    Parameters
    ----------
    sensor : str
        'accelerometer' or 'gyroscope'.
    text : str
        'm/s^2', 'g', 'mg', 'rad/s', 'deg/s', 'counts:16384/g', 'counts:16.4/(deg/s)',
        'counts:16.4/dps', ..., or increments of one of them as in 'increments:200*rad/s'.

    Raises
    ------
    InputError
        When there is no such unit.

    """
    unit = _spelled(sensor, text)
    sizes = UNIT_SIZES[sensor]
    if unit in sizes:
        return SensorUnit(unit, 1.0 / sizes[unit])
    increments = INCREMENTS_PATTERN.fullmatch(unit)
    if increments is not None:
        return incremented(unit_of(sensor, increments[2]), _positive(increments[1]))
    counts = COUNTS_PATTERN.fullmatch(unit)
    if counts is not None:
        per = _spelled(sensor, counts[2])
        number = _positive(counts[1])
        if per in sizes and 0.0 < number < LARGEST_SCALE:
            # Brackets around deg/s, as in the option; none around m/s^2.
            label = per if per.isalpha() or sensor == 'accelerometer' else f'({per})'
            return SensorUnit(f'counts:{counts[1]}/{label}', number / sizes[per])
    raise InputError(
        f'the unit of the {sensor} must be {", ".join(sizes)} or counts:NUMBER/UNIT, got'
        f' {shortened(repr(text))}; state one of them',
        key=UNIT_KEYS[sensor],
        code='unit_unknown',
    )


def incremented(unit: SensorUnit, per_second: float) -> SensorUnit:
    """
    Return the unit of increments over one sample, of readings that a unit describes.

    ``SI = per_second (reading - offset) / scale``. The rate of a unit that is one of increments
    already is replaced.

    Raises
    ------
    InputError
        When no sensor has so many samples per second.

    """
    if not 0.0 < per_second <= MOST_PER_SECOND:
        raise InputError(
            f'increments need the samples per second, above 0 and at most {MOST_PER_SECOND:g},'
            f' got {per_second:g}; correct the number',
            key='increments',
            code='increments_rate',
        )
    of_one_sample = INCREMENTS_PATTERN.fullmatch(unit.unit)
    label = of_one_sample[2] if of_one_sample else unit.unit
    factor = (unit.per_second or 1.0) / per_second
    scale = _number(np.asarray(unit.scale, float) * factor)
    return replace(unit, unit=f'increments:{per_second:.12g}*{label}', scale=scale)


def parse_axes(text: str) -> str:
    """
    Return the axes of an option: 'flu', 'frd', or the signed permutation in its plain spelling.

    A signed permutation names the axes of the source that point forward, left and up: 'x,-y,-z' is
    'frd'.

    Raises
    ------
    InputError
        When it is none, or describes left-handed axes.

    """
    name = text.strip().lower()
    if name not in AXES_OF_CONVENTION:
        name = ','.join(part.strip().removeprefix('+') for part in name.split(','))
    if np.linalg.det(_axes_matrix(name)) < 0:
        raise InputError(
            f"axes must be right-handed, '{name}' is left-handed; reverse one sign or exchange two"
            ' axes',
            key=AXES_KEY,
            code='axes_left_handed',
        )
    return name


def combined(
    base: RawReadings,
    *,
    accelerometer_unit: str | None = None,
    gyroscope_unit: str | None = None,
    increments: float | None = None,
    axes: str | None = None,
) -> RawReadings:
    """
    Return a description with the units and axes that options state in place of its own.

    `increments`: samples per second of readings that are increments over a sample.
    """
    if accelerometer_unit:
        base = replace(base, accelerometer=unit_of('accelerometer', accelerometer_unit))
    if gyroscope_unit:
        base = replace(base, gyroscope=unit_of('gyroscope', gyroscope_unit))
    if increments is not None:
        base = replace(
            base,
            accelerometer=incremented(base.accelerometer, increments),
            gyroscope=incremented(base.gyroscope, increments),
        )
    if axes:
        base = replace(base, axes=parse_axes(axes))
    return base


def _axes_matrix(axes: str) -> np.ndarray:
    """Return the matrix from axes of the source to forward-left-up, shape (3, 3)."""
    matrix = np.zeros((3, 3))
    if axes in AXES_OF_CONVENTION:
        for row, (column, sign) in enumerate(AXES_OF_CONVENTION[axes]):
            matrix[row, column] = sign
        return matrix
    parts = axes.split(',')
    for row, part in enumerate(parts[:3]):
        letter = part.removeprefix('-')
        if letter in ('x', 'y', 'z'):
            matrix[row, 'xyz'.index(letter)] = -1.0 if part.startswith('-') else 1.0
    # The determinant is 0 unless each letter occurs once.
    if len(parts) != 3 or abs(abs(np.linalg.det(matrix)) - 1.0) > 0.5:
        raise _axes_error(axes)
    return matrix


def _axes_error(axes: str) -> InputError:
    """Return the error for axes that are no convention and no signed permutation."""
    return InputError(
        'axes must be flu, frd or the axes of the source that point forward, left and up, such as'
        f' x,-y,-z, got {shortened(repr(axes))}; correct them',
        key=AXES_KEY,
        code='axes_unknown',
    )


def _spelled(sensor: str, text: str) -> str:
    """Return a unit in its first spelling; another text without spaces at its ends."""
    text = text.strip()
    return READING_SPELLINGS[sensor].get(text.lower(), text)


def _positive(text: str) -> float:
    """Return a number above zero; NaN for another text."""
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if number > 0.0 else math.nan


def _of_scale(sensor: str, scale: Number, offset: Number) -> SensorUnit:
    """Return the unit of readings that a scale describes; SI where it is 1 without an offset."""
    unit = SensorUnit(COUNTS, _number(scale), _number(offset))
    return replace(unit, unit=SI_UNITS[sensor]) if unit.is_si else unit


def _sensor_unit(sensor: str, entry: Mapping[str, Any], place: str) -> SensorUnit:
    """Return the unit in a mapping of unit, scale and offset, each optional; `place`: its name."""
    place = f'{place}.{sensor}'
    scale = _number_or_none(entry.get('scale'))
    offset = _number_or_none(entry.get('offset'))
    unit = entry.get('unit')
    # By scale and offset only.
    if unit is None:
        return _of_scale(sensor, 1.0 if scale is None else scale, 0.0 if offset is None else offset)
    # By a unit: counts need a scale, any other unit has one, which a stated scale repeats.
    increments = INCREMENTS_PATTERN.fullmatch(unit)
    if unit == COUNTS or (increments and increments[2] == COUNTS):
        if scale is None:
            raise InputError(
                f"'{place}' must have a scale with the unit counts, it has none; add the reading"
                f' per {SI_UNITS[sensor]}, or write counts:NUMBER/UNIT',
                code='scale_missing',
            )
        stated = SensorUnit(unit, scale)
    else:
        stated = unit_of(sensor, unit)
        if scale is not None and not np.allclose(scale, stated.scale, rtol=UNIT_AGREEMENT, atol=0):
            raise InputError(
                f"'{place}.scale' must be that of its unit {unit}, {stated.scale:.6g} per"
                f' {SI_UNITS[sensor]}, got {_plain(scale)}; remove one of them',
                code='unit_scale',
            )
        if scale is not None:
            stated = replace(stated, scale=scale)
    return stated if offset is None else replace(stated, offset=offset)


def _number_or_none(value: Any) -> Number | None:
    """Return the `Number` of a value; None for None."""
    return None if value is None else _number(value)


def _number(value: Any) -> Number:
    """Return a `Number` of a number, or of a list with one or three."""
    if np.size(value) > 1:
        x, y, z = (float(number) for number in value)
        return (x, y, z)
    return float(np.squeeze(value))


def _plain(value: Number) -> float | list[float]:
    """Return a `Number` as plain data: a float, or a list of three."""
    return list(value) if isinstance(value, tuple) else float(value)
