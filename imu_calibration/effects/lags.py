"""Lags of the sensors: a filter or a delay between input and output."""

from collections.abc import Sequence

import numpy as np

from imu_calibration.effects.base import SENSORS, SHORT, Effect
from imu_calibration.kinematics.joint_motion import JointMotion, shifted
from imu_calibration.kinematics.table import Table

FIRST_ORDER = tuple(zip(*reversed(np.polynomial.laguerre.laggauss(5))))
"""(weight, delay) pairs that make an exponential lag a weighted mean of delays: int e^-x f(t - tau x) dx."""


def _second_order():
    """
    Return (weight, delay) pairs of the maximally flat second-order filter, in units of its delay.

    ``1 / (1 + d s + d^2 s^2 / 2)`` has the impulse response ``2 e^-x sin x``, x = t / d, whose moments of order k over k! follow from the
    denominator. The weights match the first five: the error is 6e-5 where frequency times delay is 0.3 rad, and joints' noise is not
    amplified.
    """
    moments = [1.0, 1.0]
    for order in range(2, 5):
        moments.append(order * moments[-1] - 0.5 * order * (order - 1) * moments[-2])
    nodes = np.linspace(0.0, 3.5, len(moments))
    return tuple(zip(np.linalg.solve(np.vander(nodes, increasing=True).T, moments), nodes))


SECOND_ORDER = _second_order()
_KINDS = {
    'bandwidth': ('time_constant', FIRST_ORDER, 'has a first-order low-pass filter: '
                  'its output has a lag and a smaller amplitude at high frequency'),
    'delay': ('delay', ((1.0, 1.0),), 'sends its output late, and the other sensor does not: a pure delay of its own'),
    'filter': ('delay', SECOND_ORDER, 'has a second-order (Butterworth) low-pass filter: its output has a lag, '
               'and an unchanged amplitude up to near its edge'),
}
"""Ending of the name -> (component, (weight, delay) pairs, description). All have the same first derivative."""


class _Lag:
    """A weighted mean of delays, all of which are in proportion to one value."""

    def __init__(self, pairs):
        self.pairs = pairs

    @property
    def single(self) -> '_Lag':
        """The delay of the same first derivative."""
        return _Lag(((1.0, 1.0),))

    def __call__(self, table: Table, motion: JointMotion, values: np.ndarray) -> list[tuple[float, Table, JointMotion]]:
        """Return (weight, table, motion) of each."""
        return [(weight, table, shifted(motion, values[0] * delay)) for weight, delay in self.pairs]


def _lag_effect(sensor, ending):
    component, pairs, does = _KINDS[ending]
    return Effect(
        name=lag_name(sensor, ending), sensor=sensor, components=(component,), shape=(), unit='s', nonnegative=True, in_reference=True,
        explanation=f'The {sensor} {does}.', tolerance=1e-4, prior_sd=0.1, plausible=(('consumer', 0.05, 'field catalogue 6.3: 5-250 Hz'),),
        tolerance_reason=('1 mg while the specific force changes by 100 m/s^3' if sensor == 'accelerometer'
                          else '0.1 deg/s while the rate changes by 1000 deg/s^2'),
        motion=('oscillate_fast',), compensation='none', warp=_Lag(pairs), acts_on=(sensor,), needs=('joints', 'dynamic'), step=2e-4)


def lag_name(sensor: str, ending: str) -> str:
    """Return the name of the lag of a sensor: of 'bandwidth', 'delay' or 'filter'."""
    return f'{SHORT[sensor]}_{ending}'


LAGS = tuple(_lag_effect(sensor, ending) for ending in _KINDS for sensor in SENSORS)
"""
First-order filter, pure delay and second-order filter of each sensor; collinear where small, separable where large.
"""

CLOCK = 'time_offset'
"""Common lag of both sensors: an offset of the clocks."""
CLOCKS = frozenset({'clock_rate', 'clock_step'})
"""Lags of both sensors that change with time."""
FAMILY = frozenset({CLOCK, *(effect.name for effect in LAGS)})
"""Effects with one first derivative."""


def total_lags(names: Sequence[str], values: np.ndarray, covariance: np.ndarray) -> dict[str, tuple[float, float]]:
    """
    Return sensor -> (total lag of its output, standard deviation), s, of sensors with a lag.

    The first derivative of all descriptions is the same, so this repeats where their names and shares do not.

    Parameters
    ----------
    names : sequence of str
        Parameters, ``sensor.effect.component``.
    values, covariance : array, shape (n,) and (n, n)

    """
    found = {}
    for sensor in SENSORS:
        own = np.array([part[1] in FAMILY and part[0] in (sensor, 'reference') for part in (name.split('.') for name in names)], float)
        if own.any():
            found[sensor] = (float(own @ values), float(np.sqrt(own @ covariance @ own)))
    return found
