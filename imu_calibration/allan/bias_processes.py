"""
The slow part of identified noise as sums of first-order Gauss-Markov processes, which estimators can include as states.

A random walk of density K is one that does not forget within the session, ``sd^2 = K^2 time / 2``; flicker of instability B is one in
every ratio r of times, ``sd^2 = B^2 ln(r) / pi``, since ``integral 2 sd^2 time / (1 + (w time)^2) d ln(time) / ln(r) = B^2 / w``.

The bias of a calibration is then the mean of the hours around the session; its standard deviation is the variation within them.
"""

import numpy as np

from imu_calibration.allan.figures import NoiseFigures
from imu_calibration.allan.processes import FLICKER, RANDOM_WALK
from imu_calibration.effects.base import SENSORS
from imu_calibration.estimation.noise_model import BiasProcess

RATIO = 4.0
"""Of neighbouring times: the density ripples by a hundredth."""
TIMES = RATIO ** np.arange(1, 8)
"""s: from the length of windows to four times that of sessions of an hour."""


def bias_processes(figures: NoiseFigures) -> dict[str, tuple[BiasProcess, ...]]:
    """
    Return sensor -> its bias processes, from the mean of the axes' variances; empty for a sensor without slow noise.

    Figures that are held do not enter: a bound is no measurement.
    """
    return {sensor: _processes([{p.name: (p, c) for p, c in axis.processes()} for axis in figures.sensor(sensor)]) for sensor in SENSORS}


def _processes(axes):
    share = 1.0 / len(axes)
    flicker, walk = (share * sum(axis[name][1] for axis in axes if name in axis) for name in (FLICKER.name, RANDOM_WALK.name))
    variances = {time: flicker * np.log(RATIO) / np.pi for time in TIMES}
    variances[TIMES[-1]] += walk * TIMES[-1] / 2.0
    for axis in axes:
        if 'gauss_markov' in axis:
            process, coefficient = axis['gauss_markov']
            variances[process.time] = variances.get(process.time, 0.0) + share * coefficient
    return tuple(BiasProcess(float(np.sqrt(variance)), float(time)) for time, variance in sorted(variances.items()) if variance > 0)
