"""
Target of an export: representable effects, frames, formula, file; text that it writes and reads.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.allan.figures import Densities
from imu_calibration.core.documents import from_text, plain, to_text
from imu_calibration.core.errors import InputError, printable, shortened
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.exports.affine import AffineImu, Capability, Placement, as_mounted
from imu_calibration.effects.base import SENSORS
from imu_calibration.kinematics.rotations import lever_matrix

AXIS_LETTERS = 'XYZ'
"""Axes in the names of parameters."""


def commented(lines: list[str]) -> str:
    """Return lines as comments; a name in a line cannot end the comment."""
    return ''.join(f'# {printable(line)}'.rstrip() + '\n' for line in lines)


def yaml_file(comments: list[str], mapping: dict[str, Any], head: str = '') -> str:
    """Return a YAML file with comments before the content; `head` is a line that must be first."""
    return head + commented(comments) + to_text(plain(mapping))


def read_yaml(content: bytes, what: str) -> dict[str, Any]:
    """Return the mapping in a YAML file; the line ``%YAML:1.0`` of OpenCV may precede it."""
    lines = text_of(content, what).splitlines()
    body = '\n'.join(line for line in lines if not line.startswith('%YAML'))
    return from_text(body, what)


def read_json(content: bytes, what: str) -> dict[str, Any]:
    """Return the mapping in a JSON file."""
    try:
        mapping = json.loads(
            text_of(content, what),
            parse_int=lambda digits: int(digits) if len(digits) < 100 else float(digits),
        )
    except (ValueError, RecursionError) as error:
        raise InputError(
            f'the {what} must be JSON: {shortened(str(error))}; give another file'
        ) from error
    if not isinstance(mapping, dict):
        raise InputError(
            f'the {what} must hold a mapping, got {type(mapping).__name__}; give another file'
        )
    return mapping


def text_of(content: bytes, what: str) -> str:
    """Return a file's text."""
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise InputError(
            f'the {what} must be a text file, it is none; give another file'
        ) from error


def numbers_at(
    mapping: dict[str, Any], name: str, shape: tuple[int, ...], *, what: str
) -> np.ndarray:
    """
    Return an entry of a mapping as an array of a shape.

    Raises
    ------
    InputError
        When it is missing, or not finite numbers, as many as the shape has.

    """
    try:
        array = np.asarray(mapping[name], float)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(
            f"the {what} must have '{name}', numbers of shape {shape}, got"
            f' {shortened(repr(mapping.get(name)))}; correct it'
        ) from error
    if array.size != np.prod(shape, dtype=int) or not np.all(np.isfinite(array)):
        raise InputError(
            f"'{name}' of the {what} must be finite numbers of shape {shape}, got"
            f' {shortened(repr(mapping[name]))}; correct it'
        )
    return array.reshape(shape)


def section(mapping: dict[str, Any], name: str, what: str) -> dict[str, Any]:
    """Return the entry of a mapping that must be a mapping too."""
    entry = mapping.get(name)
    if not isinstance(entry, dict):
        raise InputError(
            f"the {what} must have a section '{name}', got {shortened(repr(entry))}; give another"
            ' file'
        )
    return entry


def read_parameters(content: bytes, what: str) -> dict[str, float]:
    """
    Return {name: value} from a list of parameters, one a line, comments after ``#``.

    The last field of a line is the value in ArduPilot's lists (``NAME,VALUE``), the fourth in
    QGroundControl's (``vehicle component NAME VALUE type``).
    """
    parameters = {}
    for line in text_of(content, what).splitlines():
        fields = re.split(r'[\s,=]+', line.partition('#')[0].strip())
        # The first field in capitals is the name, the next one the value.
        pairs = [
            pair for pair in zip(fields, fields[1:]) if re.fullmatch('[A-Z][A-Z0-9_]+', pair[0])
        ]
        if not pairs:
            continue
        name, value = pairs[0]
        try:
            parameters[name] = float(value)
        except ValueError as error:
            raise InputError(
                f"the {what} must give '{name}' a number, got {shortened(value)}; correct it"
            ) from error
    if not parameters:
        raise InputError(
            f'the {what} must hold parameters, one NAME and value a line, it holds none; give'
            ' another file'
        )
    return parameters


def vector_of(parameters: Mapping[str, float], name: str, missing: float = 0.0) -> np.ndarray:
    """
    Return the parameters of the three axes, shape (3,); `missing` is the default of each.

    The letter of the axis replaces ``*`` in the name.
    """
    return np.array([parameters.get(name.replace('*', axis), missing) for axis in AXIS_LETTERS])


def refuse_curved(parameters: dict[str, float], beginnings: list[str]) -> None:
    """
    Refuse thermal polynomials of an order that the catalogue does not have.

    Raises
    ------
    InputError
        When a parameter with one of these beginnings is not zero.

    """
    curved = []
    for name, value in parameters.items():
        if name.startswith(tuple(beginnings)) and value:
            curved.append(name)
    if curved:
        raise InputError(
            f'thermal offsets must be linear in the temperature to be read, got {curved[0]} ='
            f' {parameters[curved[0]]:g}; set it to 0, or calibrate with a temperature topic',
            code='not_linear',
        )


Numbers = dict[str, Any]
"""Name in the file -> number, list or mapping, in the units of the program."""


class Readings(NamedTuple):
    """Readings of an IMU, in the axes of a program."""

    force: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Measured rate, rad/s, shape (n, 3)."""
    alpha: np.ndarray
    """
    True angular acceleration in the program's frame, rad/s^2, shape (n, 3): estimators have it from
    their trajectory.
    """
    temperature_c: np.ndarray
    """Degrees Celsius, shape (n,)."""


@dataclass(frozen=True)
class Noise:
    """White noise and random walk of both sensors, and the rate at which they are used."""

    accelerometer: Densities
    """Continuous, m/s^2/sqrt(Hz) and m/s^3/sqrt(Hz)."""
    gyroscope: Densities
    """Continuous, rad/s/sqrt(Hz) and rad/s^2/sqrt(Hz)."""
    rate: float
    """Sampling rate, Hz."""
    walk_known: bool = True
    """
    Whether the random walks are known: a noise document has them, a calibration has the white noise
    only.
    """


EXPORT_INVERSION_STEPS = 30
"""
Fixed-point steps of the inversion: arms and g-sensitivity couple both sensors by small numbers.
"""


def inverted(imu: AffineImu, readings: Readings) -> tuple[np.ndarray, np.ndarray]:
    """
    Return true (force, rate) of readings, the inverse of `AffineImu`.

    With ``c = matrix^-1 (readings - bias - thermal (T - T0))`` of each sensor and the lever matrix
    L, a fixed-point iteration solves::

        rate = c_gyro - matrix_gyro^-1 cross force
        force_i = c_accel_i - (L arm_i)_i

    Outside the temperature range the thermal part is that of its nearer end.
    """
    low, high = imu.temperature_range_c or (-np.inf, np.inf)
    warmth = np.clip(readings.temperature_c, low, high) - imu.temperature_ref_c
    linear = []  # c of accelerometer and gyroscope
    for sensor, raw in zip(SENSORS, (readings.force, readings.rate)):
        offset_free = raw - imu.bias[sensor] - np.outer(warmth, imu.thermal[sensor])
        linear.append(offset_free @ np.linalg.inv(imu.matrix[sensor]).T)
    linear_force, linear_rate = linear
    cross = np.linalg.solve(imu.matrix['gyroscope'], imu.cross)
    force = linear_force
    for _ in range(EXPORT_INVERSION_STEPS):
        rate = linear_rate - force @ cross.T
        at_arms = np.einsum('nij,ij->ni', lever_matrix(rate, readings.alpha), imu.arms)
        force = linear_force - at_arms
    return force, rate


@dataclass(frozen=True, eq=False)
class Page:
    """Input of a writer."""

    numbers: Numbers
    """Of the calibration, by `Target.numbers`."""
    noise: Numbers | None
    """Of the noise, by `Target.noise`; None: not known."""
    comments: list[str]
    """Lines before the numbers."""
    calibration: Calibration
    """The exported calibration."""
    rate: float | None
    """Sampling rate, Hz, where known."""


@dataclass(frozen=True, eq=False)
class Read:
    """Content of a file."""

    numbers: Numbers
    """As `Target.numbers` makes them."""
    lacks: tuple[Capability, ...] = ()
    """Effects that the program supports and this file lacks."""
    sample_sd: dict[str, float] = field(default_factory=dict)
    """Sensor -> standard deviation of the noise of a sample, where the file has it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """A program with IMU parameters."""

    name: str
    """Identifier on the command line."""
    title: str
    """Title to print."""
    formula: str
    """How the program uses the numbers, in its own names."""
    source: str
    """Where that was read: project, file."""
    holds: tuple[Capability, ...] = ()
    """Effects that it can hold."""
    estimates: tuple[Capability, ...] = ()
    """Effects that it estimates at run time: no loss, independent of the file."""
    whole: bool = False
    """Whether it has the complete document: `numbers` are then the document's mapping."""
    placement: Callable[[AffineImu], Placement] = as_mounted
    """Its frame, origin and axes of readings."""
    numbers: Callable[[AffineImu], Numbers] = lambda _imu: {}
    """The numbers of an IMU in its placement."""
    noise: Callable[[Noise], Numbers] | None = None
    """The noise in its names and units; None: it uses none."""
    noise_is: str = ''
    """Which noise that is: continuous or discrete, with units."""
    needs_walk: bool = True
    """Whether its noise includes random walks, which only a noise document has."""
    suffix: str = '.yaml'
    """Ending of its files."""
    write: Callable[[Page], str | bytes] | None = None
    """The file; None: its files are read only."""
    read: Callable[[bytes, Any], Read] | None = None
    """``read(content, path)``; None: its files have no calibration."""
    imu: Callable[[Numbers], AffineImu] | None = None
    """The IMU of numbers, in the program's placement: the inverse of `numbers`."""
    back: Callable[[AffineImu], Placement] = as_mounted
    """The placement of our calibration against an IMU that was read."""
    forward_right_down: bool = False
    """Whether its readings are forward-right-down: the axes of the calibration must be stated."""
    axes: str = 'mount'
    """The axes of an imported calibration, named as its gauge."""
    ignored: Callable[[Numbers], list[str]] = lambda _numbers: []
    """Numbers that the program ignores, and its limits, a line each."""
    hint: str = ''
    """Instructions for the file or the program."""

    def corrected(self, numbers: Numbers, readings: Readings) -> tuple[np.ndarray, np.ndarray]:
        """Return specific force and rate that the program makes of readings with these numbers."""
        if self.imu is None:
            return readings.force, readings.rate
        return inverted(self.imu(numbers), readings)

    @property
    def only_noise(self) -> bool:
        """Whether it uses noise only, without the calibration."""
        return self.noise is not None and not self.holds and not self.whole
