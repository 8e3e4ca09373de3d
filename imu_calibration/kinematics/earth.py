"""The Earth as a reference: normal gravity and the Earth's rate in the level frame."""

import numpy as np

from imu_calibration.core.errors import InputError

EARTH_RATE = 7.292115e-5
"""Rate of the Earth against inertial space, rad/s (WGS 84)."""

NORMAL_GRAVITY_ACCURACY = 1e-4
"""Relative standard deviation of the normal gravity of a place: gravity anomalies and an inexact height."""

_SEMI_MAJOR_AXIS = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)
_GRAVITY_EQUATOR = 9.7803253359
_SOMIGLIANA = 0.00193185265241
_ROTATION_RATIO = 0.00344978650684  # m = omega^2 a^2 b / GM


def normal_gravity(latitude_deg: float, height: float = 0.0) -> float:
    """
    Return the normal gravity of the WGS 84 ellipsoid, m/s^2.

    Somigliana's closed form on the ellipsoid, ``g_e (1 + k sin^2) / sqrt(1 - e^2 sin^2)``, with the height correction
    of second order (NIMA TR8350.2, eq. 4-1 and 4-3). The local anomaly, up to 5e-4 m/s^2 in mountains, is not in it.

    Parameters
    ----------
    latitude_deg : float or array
        Geodetic latitude, degrees.
    height : float or array
        Height above the ellipsoid, m.

    """
    sin2 = np.sin(np.radians(latitude_deg)) ** 2
    surface = _GRAVITY_EQUATOR * (1 + _SOMIGLIANA * sin2) / np.sqrt(1 - _ECCENTRICITY_SQUARED * sin2)
    ratio = np.asarray(height, float) / _SEMI_MAJOR_AXIS
    value = surface * (1 - 2 * (1 + _FLATTENING + _ROTATION_RATIO - 2 * _FLATTENING * sin2) * ratio + 3 * ratio ** 2)
    return value if np.ndim(value) else float(value)


def local_gravity(gravity: float | None, latitude_deg: float | None = None, height: float | None = None) -> tuple[float | None, float]:
    """
    Return (gravity, its standard deviation), m/s^2: as given, else the normal gravity of the place; (None, 0.0) without either.

    Parameters
    ----------
    gravity : float or None
        Measured gravity, m/s^2; its standard deviation is taken as zero.
    latitude_deg : float or None
        Geodetic latitude, degrees.
    height : float or None
        Height above the ellipsoid, m; 0 if not given.

    Raises
    ------
    InputError
        If gravity and latitude are both given, a height has no latitude, or the place is not on the Earth.

    """
    if latitude_deg is None:
        if height is not None:
            raise InputError(f'height must come with a latitude, got height {height:g} m alone; give both, or gravity in m/s^2',
                             key='latitude', code='latitude_missing')
        return gravity, 0.0
    if gravity is not None:
        raise InputError(f'the place or gravity must be given, got latitude {latitude_deg:g} deg and gravity {gravity:g} m/s^2; omit one',
                         key='latitude', code='gravity_twice')
    if not (abs(latitude_deg) <= 90 and -500 <= (height or 0.0) <= 9000):
        raise InputError(f'the place must have a latitude of -90 to 90 deg and a height of -500 to 9000 m, got {latitude_deg:g} deg and '
                         f'{height or 0.0:g} m; correct them', key='latitude', code='place_impossible')
    value = normal_gravity(latitude_deg, height or 0.0)
    return value, NORMAL_GRAVITY_ACCURACY * value


def earth_rate_n(latitude_deg: float, azimuth_deg: float) -> np.ndarray:
    """
    Return the Earth's rate in the level frame n, rad/s, shape (3,).

    North lies `azimuth_deg` counter-clockwise of x: ``omega_e (cos(lat) cos(az), cos(lat) sin(az), sin(lat))``.

    Parameters
    ----------
    latitude_deg : float
        Geodetic latitude, degrees.
    azimuth_deg : float
        Heading of the x axis of n, degrees clockwise from true north.

    """
    latitude, azimuth = np.radians(latitude_deg), np.radians(azimuth_deg)
    return EARTH_RATE * np.array([np.cos(latitude) * np.cos(azimuth), np.cos(latitude) * np.sin(azimuth), np.sin(latitude)])
