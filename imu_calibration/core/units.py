"""
Constants, and printed values in customary units with as many digits as their sd supports.

The customary units are never used in arithmetic.
"""

import math

import numpy as np

STANDARD_GRAVITY = 9.80665
"""m/s^2: the g of people's units, never the gravity of a place."""
STANDARD_GRAVITY_SD = 0.02
"""Standard deviation of an unknown local gravity, m/s^2."""
GRAVITY_PLACE_SHARE = 0.005
"""Share by which gravity differs between places: 9.78 to 9.83 m/s^2."""
MILLI_G = 1e-3 * STANDARD_GRAVITY
MICRO_G = 1e-6 * STANDARD_GRAVITY
HOTTEST_C = 200.0
"""No IMU works above this temperature; a larger reading is in kelvin, degrees C."""
DEG = math.pi / 180
DEG_H = DEG / 3600
ARCMIN = DEG / 60


NOISE_QUANTITY = 'noise'
"""The quantity of noise figures, which have the units of data sheets."""
_SHOWN = {
    '': {
        'm/s^2': (1e3 / STANDARD_GRAVITY, 'mg'),
        'rad/s': (1 / DEG, 'deg/s'),
        'm': (1e3, 'mm'),
        'rad': (60 / DEG, 'arcmin'),
        's': (1e3, 'ms'),
        '(rad/s)^-1': (1e2 * DEG, '% per deg/s'),
        '(rad/s)/(m/s^2)': (STANDARD_GRAVITY / DEG, '(deg/s)/g'),
        'm/s^2/K': (1e3 / STANDARD_GRAVITY, 'mg/K'),
        'rad/s/K': (1 / DEG, '(deg/s)/K'),
        '1/K': (1e6, 'ppm/K'),
        'rad/turn': (1 / DEG, 'deg per turn'),
        'rad per turn': (1 / DEG, 'deg per turn'),
        'm/s^2/s': (60e3 / STANDARD_GRAVITY, 'mg/min'),
        'rad/s/s': (60 / DEG, '(deg/s)/min'),
        's/s': (1e6, 'ppm'),
    },
    'accelerometer': {
        '(m/s^2)^-1': (1e3 * STANDARD_GRAVITY, 'mg/g²'),
        '(m/s^2)^-2': (1e3 * STANDARD_GRAVITY**2, 'mg/g³'),
    },
    'gyroscope': {
        '(m/s^2)^-1': (1e2 * STANDARD_GRAVITY, '% per g'),
        '(m/s^2)^-2': (1e2 * STANDARD_GRAVITY**2, '% per g²'),
    },
    NOISE_QUANTITY: {
        'm/s^2/sqrt(Hz)': (1e6 / STANDARD_GRAVITY, 'µg/√Hz'),
        'm/s^3/sqrt(Hz)': (1e6 / STANDARD_GRAVITY, 'µg/√s'),
        'm/s^2': (1e6 / STANDARD_GRAVITY, 'µg'),
        'm/s': (1e6, 'µm/s'),
        'm/s^2/K': (1e6 / STANDARD_GRAVITY, 'µg/K'),
        'm/s^3': (3600e6 / STANDARD_GRAVITY, 'µg/h'),
        'rad/s/sqrt(Hz)': (60 / DEG, 'deg/√h'),
        'rad/s^2/sqrt(Hz)': (60 * 3600 / DEG, 'deg/h/√h'),
        'rad/s': (3600 / DEG, 'deg/h'),
        'rad': (3600 / DEG, 'arcsec'),
        'rad/s/K': (3600 / DEG, '(deg/h)/K'),
        'rad/s^2': (3600 * 3600 / DEG, '(deg/h)/h'),
        's': (1.0, 's'),
    },
    'time_constant': {'s': (1.0, 's')},
    'time': {'s': (1.0, 's')},
}
"""Quantity ('' for all), component or sensor -> SI unit -> (factor, customary unit)."""


OTHER_UNITS = {'g': 1 / STANDARD_GRAVITY, 'mg': 1e3 / STANDARD_GRAVITY}
"""Units of specific force that drivers publish by mistake, per m/s^2."""


def unit_of_rest(length: float) -> str:
    """
    Return the unit other than m/s^2 in which gravity has this length within a fifth; '' for none.
    """
    for unit, scale in OTHER_UNITS.items():
        if 0.8 < length / (scale * STANDARD_GRAVITY) < 1.25:
            return unit
    return ''


def for_people(unit: str, quantity: str = '') -> tuple[float, str]:
    """
    Return (factor, unit) that converts an SI value to its customary unit.

    (1, unit) where that is the SI unit.

    Parameters
    ----------
    unit : str
        SI unit.
    quantity : str
        `NOISE_QUANTITY`, or a parameter, whose name begins with its sensor: '(m/s^2)^-1' is mg/g²
        of an accelerometer and % per g of a gyroscope.

    """
    sensor = quantity.partition('.')[0]
    component = quantity.rpartition('.')[2]
    for kind in (component, sensor, ''):
        if unit in _SHOWN.get(kind, {}):
            return _SHOWN[kind][unit]
    return 1.0, unit


def decimals(sd: float) -> int:
    """Return the number of decimals that shows two digits of a standard deviation."""
    return int(max(0, min(12, 1 - np.floor(np.log10(sd) + 1e-9))))


def with_sd(value: float, sd: float) -> tuple[str, str]:
    """
    Return value and standard deviation as text.

    The text has no more digits than the standard deviation supports.
    """
    if not np.isfinite(sd) or sd <= 0:
        return f'{value:.6g}', f'{sd:.2g}'
    places = decimals(sd)
    return f'{value:.{places}f}', f'{sd:.{places}f}'


def significant(value: float, digits: int = 3) -> str:
    """
    Return a number as plain text with `digits` significant digits.

    Powers of ten only where zeros would not help.
    """
    if value == 0 or not np.isfinite(value):
        return f'{value:g}'
    if not 1e-4 <= abs(value) < 1e6:
        return f'{value:.{digits - 1}e}'
    exponent = int(np.floor(np.log10(abs(value))))
    return f'{value:.{max(0, digits - 1 - exponent)}f}'


def error_text(value: float, unit: str, digits: int = 3) -> str:
    """
    Return the text of an error in the customary unit of its SI unit, with `digits` digits.
    """
    factor, shown = for_people(unit)
    return f'{significant(value * factor, digits)} {shown}'
