"""The target of an export: one record of all properties of a program, its formula included."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from imu_calibration.allan.figures import Densities
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.exports.affine import AffineImu, Holding, Placement, as_mounted

Numbers = dict[str, Any]
"""Name in the file -> number, list or mapping, in the units of the program."""


class Readings(NamedTuple):
    """Readings of an IMU, in the axes of a program."""

    force: np.ndarray
    """Measured specific force, m/s^2, shape (n, 3)."""
    rate: np.ndarray
    """Measured rate, rad/s, shape (n, 3)."""
    alpha: np.ndarray
    """True angular acceleration in the program's frame, rad/s^2, shape (n, 3): estimators have it from their trajectory."""
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
    """Whether the random walks are known: a noise document has them, a calibration has the white noise only."""


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
    lacks: tuple[Holding, ...] = ()
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
    holds: tuple[Holding, ...] = ()
    """Effects that it can hold."""
    estimates: tuple[Holding, ...] = ()
    """Effects that it estimates at run time: no loss, independent of the file."""
    whole: bool = False
    """Whether it has the complete document: `numbers` are then the document's mapping."""
    placement: Callable[[AffineImu], Placement] = as_mounted
    """Its frame, origin and axes of readings."""
    numbers: Callable[[AffineImu], Numbers] = lambda _imu: {}
    """The numbers of an IMU in its placement."""
    corrected: Callable[[Numbers, Readings], tuple[np.ndarray, np.ndarray]] = lambda _numbers, readings: (readings.force, readings.rate)
    """The program's own formula: specific force and rate that it makes of readings with these numbers."""
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
    """The IMU of numbers, in the program's placement: the other way of `numbers`."""
    back: Callable[[AffineImu], Placement] = as_mounted
    """The placement of our calibration against an IMU that was read."""
    axes: str = 'mount'
    """The axes of an imported calibration, named as its gauge."""
    ignored: Callable[[Numbers], list[str]] = lambda _numbers: []
    """Numbers that the program ignores, and its limits, a line each."""
    hint: str = ''
    """Instructions for the file or the program."""

    @property
    def only_noise(self) -> bool:
        """Whether it uses noise only, without the calibration."""
        return self.noise is not None and not self.holds and not self.whole
