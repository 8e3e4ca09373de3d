"""Options of a calibration by hand: effects, reference."""

from dataclasses import dataclass, field

from imu_calibration.core.errors import InputError
from imu_calibration.core.units import STANDARD_GRAVITY, STANDARD_GRAVITY_SD
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.effects.sensor_model import parse_effects
from imu_calibration.references.options import CalibrationOptions

GRAVITY_LEAST, GRAVITY_MOST = 9.7, 9.9
"""Smallest and largest gravity on the surface of the Earth with a margin, m/s^2: 9.764 on a mountain in Peru, 9.834 in the Arctic."""


@dataclass(frozen=True)
class KnownTurn:
    """A turn of known angle about a fixed body axis."""

    start: int
    """First sample."""
    stop: int
    """After the last sample."""
    axis: tuple
    """Unit vector in the sensor frame; turns counter-clockwise seen from its tip."""
    angle: float
    """rad."""


@dataclass(frozen=True)
class HandOptions:
    """Options passed from the use cases to the equations."""

    gravity: float = STANDARD_GRAVITY
    """Local gravity, m/s^2."""
    gravity_sd: float = 0.0
    """Its standard deviation, m/s^2."""
    tolerances: dict = field(default_factory=dict)
    """{sensor: {effect: sufficient sd}}; by default the catalogue's."""
    accelerometer: tuple[str, ...] | None = None
    """Effects to estimate; None: bias and matrix."""
    gyroscope: tuple[str, ...] | None = None
    """The same; None: bias and matrix, and the g-sensitivity when the poses show it."""
    catalogue: Catalogue = CATALOGUE
    """Declarations of the effects."""


def hand_options(options: CalibrationOptions) -> HandOptions:
    """
    Return the requested options by hand: the standard gravity with its uncertainty if the local one is unknown.

    Raises
    ------
    InputError
        When an effect does not exist, gravity is impossible, or a requested option needs a table.

    """
    if options.noise is not None:
        raise InputError('a separate noise file is for tables only; by hand it must be omitted', key='table',
                         code='table_only')
    asked = (options.accelerometer_model, options.gyroscope_model)
    accelerometer, gyroscope = (None if text is None else parse_effects(sensor, text, catalogue=options.catalogue)
                                for sensor, text in zip(SENSORS, asked, strict=True))
    if options.gravity is not None and not GRAVITY_LEAST <= options.gravity <= GRAVITY_MOST:
        raise InputError(f'gravity must be {GRAVITY_LEAST} to {GRAVITY_MOST} m/s^2, which covers the surface of the Earth, '
                         f'got {options.gravity:g}; give the local gravity in m/s^2, or none', key='gravity')
    gravity, spread = (STANDARD_GRAVITY, STANDARD_GRAVITY_SD) if options.gravity is None else (options.gravity, options.gravity_sd)
    return HandOptions(gravity, spread, tolerances=options.tolerances, accelerometer=accelerometer, gyroscope=gyroscope,
                       catalogue=options.catalogue)
