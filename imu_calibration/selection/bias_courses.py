"""Courses of a bias in time that a wander is compared with: the temperature's past, and steps."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

TEMPERATURE_LAGS = (15, 30, 45, 60, 90, 120, 180, 300)
"""Times by which the output may follow the temperature late, s."""
LEAST_WARMING = 0.5
"""Least change of the temperature, K, whose past and rate are compared with a bias."""
LEAST_PART = 8
"""Fewest windows before and after a step."""


@dataclass(frozen=True, eq=False)
class TemperatureCourse:
    """A function of the temperature up to the time of each of k windows."""

    name: str
    """As printed."""
    values: np.ndarray
    """In units of the range of the temperature, a rate per second, shape (k,)."""
    known: np.ndarray
    """True for the windows for which the recording contains it, shape (k,)."""


def relative_temperature(temperature: np.ndarray) -> np.ndarray | None:
    """
    Return the temperature about its mean as a share of its span, shape (k,).

    None where it is not known throughout, or changes too little.
    """
    if not np.all(np.isfinite(temperature)) or np.ptp(temperature) <= LEAST_WARMING:
        return None
    return (temperature - temperature.mean()) / np.ptp(temperature)


def temperature_courses(time: np.ndarray, temperature: np.ndarray) -> Iterator[TemperatureCourse]:
    """
    Yield the rate of the temperature, its earlier values, and its values through a thermal mass.

    A sensor is warmer or colder than its thermometer as long as heat flows. A thermal mass with the
    time constant tau has the temperature ``tau dm/dt = T - m``, with m = T at the first window.

    Parameters
    ----------
    time, temperature : ndarray, shape (k,)
        s, in order, and degrees Celsius.

    """
    warm = relative_temperature(temperature)
    if warm is None:
        return

    # The rate over twice the shortest lag, so that noise of the thermometer averages.
    shortest = TEMPERATURE_LAGS[0]
    later = np.interp(time + shortest, time, warm)
    rate = (later - np.interp(time - shortest, time, warm)) / (2 * shortest)
    within = (time - time[0] >= shortest) & (time[-1] - time >= shortest)
    yield TemperatureCourse('temperature rate', rate, within)
    for lag in TEMPERATURE_LAGS:
        known = time - time[0] >= lag
        # At a longer lag the temperature would be known for less than half of the windows.
        if 2 * np.count_nonzero(known) < len(time):
            return
        earlier = np.interp(time - lag, time, warm)
        yield TemperatureCourse(f'the temperature {lag} s earlier', earlier, known)
        lagging = _through_thermal_mass(time, warm, tau=lag)
        yield TemperatureCourse(f'the temperature with a lag of {lag} s', lagging, known)


def step_places(windows: np.ndarray, most: int, *, least: int = LEAST_PART) -> np.ndarray:
    """
    Return up to `most` of the numbers `windows`, evenly spread, after which a step is tested.

    At least `least` of the windows are before and after each step.
    """
    places = windows[least - 1 : -least] if least else windows
    if len(places) > most:
        places = places[np.unique(np.linspace(0, len(places) - 1, most).astype(int))]
    return places


def _through_thermal_mass(time: np.ndarray, warm: np.ndarray, *, tau: float) -> np.ndarray:
    """
    Return the temperature m of a thermal mass at the times, ``tau dm/dt = warm - m``, shape (k,).

    It equals `warm` at the first time; `warm` changes linearly between the times.
    """
    mass = np.empty_like(warm)
    mass[0] = warm[0]
    for k in range(1, len(time)):
        step = time[k] - time[k - 1]
        slope = (warm[k] - warm[k - 1]) / step
        # T(t) - slope tau is a solution; the distance from it decays.
        distance = mass[k - 1] - (warm[k - 1] - slope * tau)
        mass[k] = warm[k] - slope * tau + distance * np.exp(-step / tau)
    return mass
