"""
Sensing elements: each has a place, an input direction and a physical response.

Written without the catalogue of effects.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, lfilter, lfilter_zi

TEMPERATURE_REF_C = 25.0


@dataclass(eq=False)
class Triad:
    """
    Three sensing elements of one kind.

    Coefficients are those of the output, per unit of the input along the element's own axis.
    """

    bias: np.ndarray
    """Output at zero input, shape (3,)."""
    matrix: np.ndarray
    """Row i: scale factor times the direction in which element i senses, shape (3, 3)."""
    arms: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Row i: where element i sits, from the reference point, m."""
    quadratic: np.ndarray | float = 0.0
    cubic: np.ndarray | float = 0.0
    asymmetry: np.ndarray | float = 0.0
    """Part of the response that does not change sign with the input."""
    products: np.ndarray | None = None
    """Response of element i to the products xy, yz, xz of the input, shape (3, 3)."""
    to_force: np.ndarray | None = None
    """Response of gyroscope i to specific force, shape (3, 3)."""
    to_force_squared: np.ndarray | None = None
    """
    Response of gyroscope i to xx, yy, zz, xy, yz, xz of specific force, shape (3, 6): its elements
    yield unlike.
    """
    thermal_bias: np.ndarray | float = 0.0
    thermal_bend: np.ndarray | float = 0.0
    """Bias by the square of the temperature."""
    thermal_scale: np.ndarray | float = 0.0
    hysteresis: np.ndarray | float = 0.0
    """
    Half of what the bias differs between the branches of warming up and cooling: strain that grains
    of unlike friction let go one after the other.
    """
    rectifies: np.ndarray | float = 0.0
    """
    Bias by the mean square of vibration: of an accelerometer along its own axis, shape (3,), of a
    gyroscope along each, shape (3, 3).
    """
    drift: np.ndarray | float = 0.0
    drift_constant: float = 1.0
    """Bias warm-up: drift (1 - exp(-t / constant))."""
    trend: np.ndarray | float = 0.0
    """Change of the bias per second."""
    low_pass: float = 0.0
    """Time constant of the filter behind the elements, s."""
    low_pass_order: int = 1
    """Number of equal first-order stages; their time constants add up to `low_pass`."""
    second_order: float = 0.0
    """Delay of a Butterworth filter of second order behind the elements, s."""
    late: float = 0.0
    """By how much the output is old when it is stamped, s."""
    crosstalk: np.ndarray | None = None
    """
    What of each other element's change in time comes onto element i, through the capacitance
    between their wires, s, shape (3, 2).
    """
    limit: float = np.inf
    """The output cannot leave [-limit, limit]."""

    @property
    def lags(self):
        """Whether the output depends on what was before."""
        return bool(self.low_pass or self.second_order or self.late or self.crosstalk is not None)

    def respond(self, inputs, time, temperature_c, force_s):
        """
        Return the output before filter and limit, shape (n, 3).

        Parameters
        ----------
        inputs : list of three arrays (n, 3)
            The field (specific force or rate) at each element, in s.

        """
        warm = temperature_c - TEMPERATURE_REF_C
        output = np.empty((len(time), 3))
        strained = _friction(temperature_c, time) if np.any(self.hysteresis) else 0.0
        for i in range(3):
            scale = np.linalg.norm(self.matrix[i])
            along = inputs[i] @ (self.matrix[i] / scale)
            output[:, i] = (
                _of(self.bias, i)
                + scale * (1.0 + _of(self.thermal_scale, i) * warm) * along
                + _of(self.quadratic, i) * along**2
                + _of(self.cubic, i) * along**3
                + _of(self.asymmetry, i) * np.abs(along)
                + _of(self.thermal_bias, i) * warm
                + _of(self.thermal_bend, i) * warm**2
                + _of(self.hysteresis, i) * strained
                - _of(self.drift, i) * np.expm1(-time / self.drift_constant)
                + _of(self.trend, i) * time
            )
            if self.products is not None:
                x, y, z = inputs[i].T
                output[:, i] += (
                    self.products[i, 0] * x * y
                    + self.products[i, 1] * y * z
                    + self.products[i, 2] * x * z
                )
            if self.to_force is not None:
                output[:, i] += force_s @ self.to_force[i]
            if self.to_force_squared is not None:
                x, y, z = force_s.T
                output[:, i] += (
                    np.stack([x * x, y * y, z * z, x * y, y * z, x * z], axis=1)
                    @ self.to_force_squared[i]
                )
        return output


FRICTION = np.linspace(0.3, 1.5, 9)
"""By how much the temperature moves each grain before it slips, K."""


def _friction(temperature_c, time):
    """
    Return the strain of grains that hold until they slip, over its largest, shape (n,).

    Jenkin's elements, spring and slider, side by side.

    Each spring is stretched by the change of the temperature and cannot hold more than its
    friction; it starts without load.
    """
    steps = np.arange(time[0], time[-1] + 0.1, 0.1)
    load, total = np.zeros(len(FRICTION)), []
    for change in np.diff(np.interp(steps, time, temperature_c), prepend=temperature_c[0]):
        load = np.clip(load + change, -FRICTION, FRICTION)
        total.append(load.sum())
    return np.interp(time, steps, np.array(total) / FRICTION.sum())


def _of(value, i):
    return value if np.isscalar(value) else value[i]


def filtered(values, step, triad):
    """Return what comes out behind the elements of a triad: crosstalk, filters, delay."""
    if triad.crosstalk is not None:
        others = np.gradient(values, step, axis=0)[:, [[1, 2], [0, 2], [0, 1]]]
        values = values + (others * triad.crosstalk).sum(axis=2)
    values = low_pass(values, step, triad.low_pass, triad.low_pass_order)
    if triad.second_order:
        values = butterworth(values, step, triad.second_order)
    if triad.late:
        time = step * np.arange(len(values))
        values = CubicSpline(time, values)(np.maximum(time - triad.late, 0.0))
    return values


def butterworth(values, step, delay):
    """
    Return the output of the maximally flat filter ``1 / (1 + d s + d^2 s^2 / 2)``.

    It was in balance at the start, and it is bilinear, on a fine grid.
    """
    system = cont2discrete(([1.0], [0.5 * delay**2, delay, 1.0]), step, 'bilinear')
    above, below = system[0].ravel(), system[1]
    return lfilter(above, below, values, axis=0, zi=lfilter_zi(above, below)[:, None] * values[:1])[
        0
    ]


def low_pass(values, step, time_constant, order=1):
    """
    Return the output of `order` equal first-order stages that were in balance at the start.

    Exact for an input that is linear between the grid points:
    ``y[k+1] = e y[k] + c0 u[k] + c1 u[k+1]``, e = exp(-h / tau), c1 = 1 - tau / h (1 - e), c0 = tau
    / h (1 - e) - e.
    """
    if time_constant == 0.0:
        return values
    tau = time_constant / order
    decay = np.exp(-step / tau)
    rest = -np.expm1(-step / tau) * tau / step
    ahead, behind = 1.0 - rest, rest - decay
    for _ in range(order):
        values, _state = lfilter(
            [ahead, behind], [1.0, -decay], values, axis=0, zi=values[:1] * (1.0 - ahead)
        )
    return values
