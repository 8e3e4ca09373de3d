"""What an effect is: one physical cause of sensor output, declared once."""

from dataclasses import dataclass
from typing import Callable

import numpy as np

AXES = ('x', 'y', 'z')
SENSORS = ('accelerometer', 'gyroscope')

VECTOR = AXES
MATRIX = tuple(row + column for row in AXES for column in AXES)
PRODUCTS = tuple(f'{row}_{pair}' for row in AXES for pair in ('xy', 'yz', 'xz'))


@dataclass(frozen=True, eq=False)
class Effect:
    """
    One physical cause of sensor output.

    A *sensor* effect acts on one sensor. It names column groups of `effects.regressors` and gives, for values of the
    whole sensor's parameters, the coefficients of those columns, so that ``output = sum(columns @ coefficients)``. Products
    of parameters (matrix times arm) become coefficients of columns of their own; a triangular factor of the columns is
    then an exact summary of the data.

    A *reference* effect (and a sensor's own lag) instead changes the motion that the sensor is thought to have felt: `warp`
    gives tables and motions with weights, of which the reference is the weighted mean.
    """

    name: str
    """Published name."""
    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    components: tuple
    """Component labels; the parameter is called SENSOR.EFFECT.COMPONENT."""
    shape: tuple
    """Shape of the value in a calibration document."""
    unit: str
    """SI unit of every component (or a tuple, one each)."""
    tolerance: float
    """Standard deviation up to which a component counts as determined; overridden by config/tolerances.yaml."""
    prior_sd: float
    """Standard deviation of the prior, around `prior`."""
    explanation: str
    """One sentence for a test engineer."""
    motion: tuple
    """Standard motions (`observability.MOTIONS`) that show it."""
    compensation: str
    """'exact' (inverted), 'flagged' (cannot be inverted, output marked) or 'none' (belongs to the table or the session)."""
    prior: float = 0.0
    """Prior value of every component ('matrix' has the identity)."""
    groups: tuple = ()
    """Column groups, names in `effects.regressors.GROUPS`."""
    coefficients: Callable | None = None
    """``coefficients(values, point) -> {group: (n_columns, 3)}`` with `values` a dict effect name -> array of the sensor."""
    warp: Callable | None = None
    """``warp(table, motion, values) -> [(weight, table, motion), ...]``."""
    derivative: Callable | None = None
    """``derivative(ref) -> (n, 3 size)``: the same as the central difference of `warp` for the true input, where it has a closed form."""
    acts_on: tuple = SENSORS
    """Sensors that a warp concerns."""
    needs: tuple = ()
    """Data it needs: 'temperature', 'rotation', 'dynamic', 'joints'."""
    step: float = 1e-4
    """Step of the central difference that turns a warp into columns."""
    plausible: tuple = ()
    """Plausible size by grade: (grade, largest, source), in `unit`."""

    @property
    def size(self):
        """Return the number of parameters."""
        return len(self.components)

    def prior_values(self):
        """Return the prior values, shape (size,)."""
        if self.name == 'matrix':
            return np.eye(3).ravel()
        return np.full(self.size, self.prior)

    def param_names(self, sensor=None):
        """Return SENSOR.EFFECT.COMPONENT for each parameter."""
        return [f'{sensor or self.sensor}.{self.name}.{component}' for component in self.components]

    def unit_of(self, index):
        """Return the unit of component `index`."""
        return self.unit if isinstance(self.unit, str) else self.unit[index]
