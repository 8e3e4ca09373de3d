"""
An effect: one physical cause of sensor output, its columns, its coefficients and their derivatives.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import cache, partial
from itertools import permutations, product
from typing import Any

import numpy as np

from imu_calibration.effects.expressions import ColumnGroup

AXES = ('x', 'y', 'z')
SENSORS = ('accelerometer', 'gyroscope')
UNITS = {'accelerometer': 'm/s^2', 'gyroscope': 'rad/s'}
"""Sensor -> unit of its readings."""
INPUT_OF = {'accelerometer': 'force_s', 'gyroscope': 'rate_s'}
"""Sensor -> field of a `Reference` with its true input."""
PREFIXES = {'accelerometer': 'accel', 'gyroscope': 'gyro'}
"""Beginning of the names of a sensor's own effects and columns."""
SECTIONS = SENSORS + ('reference',)
"""Sections of a model and of a calibration document."""

VECTOR = AXES
"""Components of an effect with one value for each axis."""
OTHERS = tuple(f'{row}_{column}' for row, column in permutations(AXES, 2))
MATRIX = tuple(row + column for row, column in product(AXES, AXES))
IMPLAUSIBLE_RATIO = 10.0
"""No instrument is known of with an effect beyond this many times the largest plausible size."""
PRODUCTS = tuple(f'{row}_{pair}' for row, pair in product(AXES, ('xy', 'yz', 'xz')))


class Role(Enum):
    """
    Place of an effect in the equation of a sensor's output.

    The equation is ``output = limit(offset + linear @ (input + lever_matrix @ (arm + arms_i)) +
    cross @ force + terms)``.

    A model has at most one effect of a sensor in each place, but any number of terms.
    """

    OFFSET = auto()
    LINEAR = auto()
    CROSS = auto()
    """Response of the gyroscope to specific force."""
    ARMS = auto()
    """One lever arm for each axis."""
    ARM = auto()
    """One lever arm for the triad."""
    LIMIT = auto()
    """Largest reading: the output is clipped there, which is censoring and no column."""
    DELAY = auto()
    """By how much the stamps are late."""
    TILT = auto()
    """Tilt of the table."""
    TERM = auto()
    """A term, or a warp, in none of the other places."""


Values = dict[str, np.ndarray]
"""Effect name -> values of the effects of a sensor; column group -> coefficients."""


@dataclass(frozen=True, eq=False)
class Lag:
    """A weighted mean of delays, all proportional to the first value of the effect."""

    pairs: Sequence[tuple[float, float]] = ((1.0, 1.0),)
    """(weight, delay in units of the first value) of each."""
    factor: Callable | None = None
    """``factor(time, values) -> (n,)``, for delays that change with time; None: constant."""

    @property
    def single(self) -> 'Lag':
        """The single delay whose first derivative is that of the mean."""
        return Lag(factor=self.factor)

    def delays(self, time: np.ndarray, values: np.ndarray) -> list[tuple[float, np.ndarray]]:
        """Return (weight, delay in s, shape () or (n,)) of each delay."""
        size = values[0] * (1.0 if self.factor is None else self.factor(time, values))
        return [(weight, size * delay) for weight, delay in self.pairs]


@dataclass(frozen=True, eq=False, kw_only=True)
class Effect:
    """
    One physical cause of sensor output.

    A *sensor* effect acts on one sensor. It has column groups (`effects.expressions`) and computes,
    from the values of all parameters of the sensor, the coefficients of these columns, so that
    ``output = sum(columns @ coefficients)``. Products of parameters (matrix times arm) become
    coefficients of columns of their own; a triangular factor of the columns is then an exact
    summary of the data.

    A *reference* effect (and a sensor's own lag) instead changes the motion that is the sensor's
    input: `warp` gives another table and motion, or the delays of a lag, over which the reference
    is the weighted mean.

    All properties of an effect are fields here; none is derived from its name.
    """

    name: str
    """Published name."""
    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    components: tuple = VECTOR
    """Component labels; the parameter is called SENSOR.EFFECT.COMPONENT."""
    shape: tuple = (3,)
    """Shape of the value in a calibration document."""
    unit: str | tuple
    """SI unit of every component (or a tuple, one each)."""
    tolerance: float
    """
    Standard deviation up to which a component counts as determined; a user's file of tolerances
    overrides it.
    """
    tolerance_reason: str = ''
    """Source of the tolerance; printed with it in config/tolerances.yaml."""
    prior: Any = 0.0
    """
    Prior value of every component (or a sequence, one each); where columns depend on it they are
    first linearised here.
    """
    prior_sd: Any
    """Standard deviation of the prior (or a sequence, one each)."""
    explanation: str
    """One sentence for a test engineer."""
    title: str = ''
    """Heading in a report; derived from the name where empty."""
    motion: tuple
    """Standard motions (`effects.motions`) that show it."""
    compensation: str = 'exact'
    """
    'exact' (inverted), 'flagged' (cannot be inverted, output marked) or 'none' (belongs to the
    table or the session).
    """
    role: Role = Role.TERM
    """Its place in the sensor's equation."""
    groups: tuple = ()
    """The ColumnGroups that its coefficients multiply."""
    group_sensors: tuple = ()
    """
    Sensor that each of the groups belongs to, where they differ; empty: all sensors that it acts
    on.
    """
    coefficients: Callable | None = None
    """
    ``coefficients(effect, values, point) -> {group name: (n_columns, 3)}`` with `values` as
    `Values`.
    """
    warp: Callable | Lag | None = None
    """A `Lag`, or ``warp(table, motion, values) -> (table, motion)``."""
    derivative: Callable | None = None
    """
    ``derivative(ref) -> (n, 3 size)``: the same as the central difference of `warp` for the true
    input, where it has a closed form.
    """
    acts_on: tuple = SENSORS
    """Sensors that a warp concerns."""
    needs: tuple = ()
    """
    Data it needs: 'temperature', 'cooling' (it turned), 'vibration' (now more, now less),
    'rotation', 'dynamic', 'joints'.
    """
    step: float = 1e-4
    """Step of the central difference that turns a warp into columns."""
    plausible: tuple = ()
    """(Grade of instruments, largest plausible size in `unit`, source); empty: unknown."""
    time_constant: bool = False
    """
    Whether the last component is a time constant, s, on which the columns depend, and all preceding
    ones are amplitudes.
    """
    located: bool = False
    """
    Whether the last component is the time of a step, s: a search estimates it, least squares does
    not.
    """
    sudden: bool = False
    """Whether its value may change at one moment."""
    nonnegative: bool = False
    """Whether the values cannot be negative, e.g. lags."""
    set_up_fault: Callable[[str, float, float], str] | None = None
    """
    ``set_up_fault(component, value, sd) -> text``: how a significant value is reported, where it is
    a common fault of clocks or zeros that the user can correct; None for others.
    """
    smooth: bool = False
    """Whether it changes smoothly in time: any other smooth curve resembles it."""
    zero_sums: tuple[tuple[int, ...], ...] = ()
    """
    Groups of parameters, each with a sum that gravity does not determine: it acts as a bias,
    because ``f_x^2 + f_y^2 + f_z^2 = g^2``, or as a turn about the force, which no sensor reads.
    By convention each sum is zero, to its tolerance, unless other data determine it.
    """
    against: tuple = ()
    """
    Abscissa of its residual plot: 'time', 'temperature', 'force', 'rate', 'angle'; empty: its own
    signal.
    """
    lower_order: str = ''
    """
    Effect of the same sensor that a model with it has too: the vertex of a parabola is a
    convention, ``(x - r)^2 = (x - s)^2 + 2 (s - r) (x - s) + constant``.
    """
    contained_in: str = ''
    """Effect of the same sensor of which it is a special case."""
    known_size: bool = False
    """
    Whether the plausible size is the true one, as for the Earth's rate: a larger value is no
    explanation.
    """
    moot: Callable | None = None
    """``moot(table) -> (why, what to do) or None``: why it cannot be tested with this table."""
    in_reference: bool = False
    """
    Whether a document lists an effect of a sensor under `reference`: it belongs to the table and
    the session.
    """
    input_order: int | None = None
    """
    Order of the tensor in the true input that the values of each output form: 0 where they belong
    to the output, as along its own axis; 1 a vector; 2 a symmetric tensor (xx, yy, zz, xy, yz, xz).
    None where a rotation of the axes of the true input mixes them with other effects.
    """
    input_places: tuple[int, ...] = ()
    """
    Places of the values among the components of the tensors of all outputs, where the effect has
    only some of them; empty: all. The other components are zero in the axes of the effect.
    """
    nuisance: bool = False
    """Whether it is a nuisance parameter, estimated but not requested."""
    definition: dict | None = None
    """
    The plain data that it was made of (`effects.catalogue`), which may travel in documents; None
    for the catalogue's own.
    """

    @property
    def key(self) -> tuple[str, str]:
        """(sensor, name), its key in models and catalogues."""
        return self.sensor, self.name

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that the effect acts on."""
        return (self.sensor,) if self.sensor in SENSORS else self.acts_on

    @property
    def size(self) -> int:
        """Return the number of parameters."""
        return len(self.components)

    @property
    def heading(self) -> str:
        """Its title, or a title from its name."""
        return self.title or self.name.replace('_', ' ')

    @property
    def section(self) -> str:
        """Section of the document that lists it."""
        return 'reference' if self.in_reference else self.sensor

    def groups_of(self, sensor: str) -> tuple[ColumnGroup, ...]:
        """Return the groups of columns of a sensor."""
        if not self.group_sensors:  # each group belongs to all sensors that the effect acts on
            return self.groups
        pairs = zip(self.groups, self.group_sensors)
        return tuple(group for group, group_sensor in pairs if group_sensor == sensor)

    @property
    def timed(self) -> bool:
        """Whether its last component is a time constant or the time of a step."""
        return self.time_constant or self.located

    @property
    def n_amplitudes(self) -> int:
        """Number of components without the time constant or the time of a step."""
        return self.size - self.timed

    @property
    def relinearised(self) -> bool:
        """Whether its columns depend on its own value."""
        return self.warp is not None or self.time_constant

    @property
    def shared(self) -> bool:
        """Whether its values enter the coefficients of other effects."""
        return self.role in (Role.LINEAR, Role.ARMS, Role.ARM)

    @property
    def largest(self) -> float:
        """Largest plausible size, infinite if unknown."""
        return self.plausible[1] if self.plausible else np.inf

    def surpasses(self, amplitudes: np.ndarray, sd: np.ndarray | float = 0.0) -> bool:
        """
        Return whether an amplitude exceeds those of all known instruments by three sd.
        """
        return bool(np.max(np.abs(amplitudes) - 3 * sd) > IMPLAUSIBLE_RATIO * self.largest)

    def prior_values(self) -> np.ndarray:
        """Return the prior values, shape (size,)."""
        return np.full(self.size, self.prior, float)

    def prior_sds(self) -> np.ndarray:
        """Return the standard deviations of the prior, shape (size,)."""
        return np.full(self.size, self.prior_sd, float)

    def tolerances(self, amplitude: float) -> np.ndarray:
        """
        Return the tolerance of each component from that of an amplitude, shape (size,).

        An error d of the time constant T changes ``a (1 - exp(-t / T))`` by at most ``a d / (e T)``
        (at t = T), with the prior's sd of a and the prior T.
        """
        tolerances = np.full(self.size, amplitude, float)
        if self.time_constant:
            tolerances[-1] *= np.e * self.prior_values()[-1] / self.prior_sds()[0]
        return tolerances

    def amplitudes(self, values: Any) -> Any:
        """Return the values without the time constant or the time of a step."""
        return values[: self.n_amplitudes]

    def at_time_constant(self, constant: float) -> np.ndarray:
        """
        Return the prior values with another time constant `constant`, s, shape (size,).

        It is a point of linearisation of a bank of time constants.
        """
        return np.append(self.prior_values()[:-1], constant)

    def in_other_axes(self, values: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """
        Return the values for a true input ``rotation v`` in place of v, shape (size,).

        For a row u and a tensor T of one output: ``u rotation'`` and ``rotation T rotation'``. Of
        an effect with `input_places` only these components are kept.
        """
        if self.input_places:
            return self._all_components(values, rotation)[list(self.input_places)]
        return self._turned(values, rotation)

    def lost_in_other_axes(self, values: np.ndarray, rotation: np.ndarray) -> float:
        """Return the largest component that `in_other_axes` does not keep."""
        components = np.abs(self._all_components(values, rotation))
        components[list(self.input_places)] = 0.0
        return float(components.max())

    def _all_components(self, values: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return all components, in other axes, of tensors that have those of `input_places`."""
        width = 3 if self.input_order == 1 else len(PRODUCT_PAIRS)
        components = np.zeros(len(AXES) * width)
        components[list(self.input_places)] = values
        return self._turned(components, rotation)

    def _turned(self, values: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return the components of complete tensors in other axes, as `in_other_axes` states."""
        if self.input_order == 1:
            return (values.reshape(-1, 3) @ rotation.T).ravel()
        if self.input_order == 2:
            turned = []
            for row in values.reshape(-1, len(PRODUCT_PAIRS)):
                # A product of two components occurs twice in the tensor.
                tensor = np.zeros((3, 3), values.dtype)
                for value, (j, k) in zip(row, PRODUCT_PAIRS, strict=True):
                    tensor[j, k] += 0.5 * value
                    tensor[k, j] += 0.5 * value
                tensor = rotation @ tensor @ rotation.T
                for j, k in PRODUCT_PAIRS:
                    turned.append(tensor[j, k] if j == k else 2.0 * tensor[j, k])
            return np.array(turned)
        return values

    def param_names(self) -> list[str]:
        """Return SENSOR.EFFECT.COMPONENT for each parameter."""
        return [f'{self.sensor}.{self.name}.{component}' for component in self.components]

    def unit_of(self, index: int) -> str:
        """Return the unit of component `index`."""
        return self.unit if isinstance(self.unit, str) else self.unit[index]


PRODUCT_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Axes of the factors of the six products of two components."""
_IS_MIXED = [first != second for first, second in PRODUCT_PAIRS]
MIXED_PRODUCTS = tuple(np.flatnonzero(np.tile(_IS_MIXED, len(AXES))).tolist())
"""Places of `PRODUCTS` among the six products of each output."""
OTHER_AXES = tuple(np.flatnonzero(~np.eye(len(AXES), dtype=bool)).tolist())
"""Places of `OTHERS` among the three inputs of each output."""
TRIPLES = (
    (0, 0, 0),
    (1, 1, 1),
    (2, 2, 2),
    (0, 0, 1),
    (0, 0, 2),
    (1, 1, 0),
    (1, 1, 2),
    (2, 2, 0),
    (2, 2, 1),
    (0, 1, 2),
)
"""Axes of the factors of the ten products of three components."""
TEMPERATURE_RISE = 'temperature_c - temperature_ref_c'
INPUT = {'accelerometer': 'force', 'gyroscope': 'rate'}
"""Sensor -> beginning of the names of the groups that are made of its true input."""
_VECTOR = {'accelerometer': ('f_x', 'f_y', 'f_z'), 'gyroscope': ('w_x', 'w_y', 'w_z')}
"""Sensor -> names of the components of its true input in the text of a column."""


def _input_groups(
    ending: str, texts: Callable[[Sequence[str]], Iterable[str]]
) -> dict[str, ColumnGroup]:
    """
    Return {sensor: group of columns that are made of the components of its true input}.

    ``texts(names of the components)`` gives the text of each column; `ending` is that of the name.
    """
    groups = {}
    for sensor in SENSORS:
        groups[sensor] = ColumnGroup(INPUT[sensor] + ending, tuple(texts(_VECTOR[sensor])))
    return groups


def _products(axes_of_factors: Sequence[tuple[int, ...]], names: Sequence[str]) -> list[str]:
    """Return the text of a product of components for each tuple of axes."""
    products = []
    for axes in axes_of_factors:
        products.append(' * '.join(names[axis] for axis in axes))
    return products


CONSTANT = ColumnGroup('one', ('1',))
TIME = ColumnGroup('time', ('time',))
TRUE_INPUT = _input_groups('', lambda v: v)
SQUARES = _input_groups('_squares', partial(_products, PRODUCT_PAIRS))
CUBES = _input_groups('_cubes', partial(_products, TRIPLES))
SIGNED = _input_groups('_signed', lambda v: [f'sign({vi}) * {vj}' for vi, vj in product(v, v)])
"""Column 3 i + j: |u.v| for an input axis u close to axis i is sign(v_i) (u.v)."""
THERMAL = _input_groups('_temperature', lambda v: [f'{vi} * ({TEMPERATURE_RISE})' for vi in v])
TEMPERATURE = ColumnGroup('temperature', (TEMPERATURE_RISE,))
TEMPERATURE_SQUARED = ColumnGroup('temperature_squared', (f'({TEMPERATURE_RISE}) ** 2',))
VIBRATION = ColumnGroup('vibration', tuple(f'vibration_{a}' for a in AXES))
BRANCH = ColumnGroup('thermal_branch', ('thermal_branch',))
LEVER = ColumnGroup(
    'lever',
    (
        '-(w_y * w_y + w_z * w_z)',
        'w_x * w_y - alpha_z',
        'w_x * w_z + alpha_y',
        'w_x * w_y + alpha_z',
        '-(w_x * w_x + w_z * w_z)',
        'w_y * w_z - alpha_x',
        'w_x * w_z - alpha_y',
        'w_y * w_z + alpha_x',
        '-(w_x * w_x + w_y * w_y)',
    ),
)
"""Entries of ``[alpha x] + [omega x]^2`` by rows (Zhang 2017, eq. 11)."""
ATTITUDE = ColumnGroup('attitude', tuple(f'c_{entry}' for entry in MATRIX))
LOAD = {
    'accelerometer': ColumnGroup('load_turns_force', SQUARES['accelerometer'].text),
    'gyroscope': ColumnGroup(
        'load_turns_rate', tuple(f'f_{a} * w_{b}' for a, b in product(AXES, AXES))
    ),
}
"""
Columns of a mount that bends with load: force and rate are measured in a frame that rotates with
the force.
"""
CHANGE_COLUMNS = {
    'accelerometer': ColumnGroup(
        'force_change', ('f_y * w_z - f_z * w_y', 'f_z * w_x - f_x * w_z', 'f_x * w_y - f_y * w_x')
    ),
    'gyroscope': ColumnGroup('rate_change', tuple(f'alpha_{a}' for a in AXES)),
}
"""The true input's derivative in time, of the force as gravity gives it to a sensor that turns."""
WARM_UP = {
    sensor: ColumnGroup(f'{short}_warm_up', ('-expm1(-time / tau)',), f'{short}_bias_drift')
    for sensor, short in PREFIXES.items()
}


def power_coefficients(axes: np.ndarray, products: Sequence[tuple[int, ...]]) -> np.ndarray:
    """
    Return the coefficients of products of k components of v that give (u_i . v)^k.

    There is one sum for each row u_i of `axes`, and the result has shape (n_products, 3).

    The coefficient of ``v_a v_b ...`` is ``u_a u_b ...`` times the number of orders of its factors
    (multinomial theorem).
    """
    n_orders = [_number_of_orders(factors) for factors in products]
    return (axes[:, np.array(products)].prod(axis=2) * n_orders).T


@cache
def _number_of_orders(factors: tuple[int, ...]) -> int:
    return len(set(permutations(factors)))


def signed_coefficients(axes: np.ndarray) -> np.ndarray:
    """
    Return the coefficients of `SIGNED` that give |u_i . v| for each row u_i of `axes`.

    That is u_ij in row 3 i + j and column i, zero elsewhere, shape (9, 3).
    """
    block = np.zeros((3, 3, 3), axes.dtype)
    block[np.arange(3), :, np.arange(3)] = axes
    return block.reshape(9, 3)


def amplitude_coefficients(
    effect: Effect, values: Values, point: dict[str, Any], *, own_axis: bool = False
) -> Values:
    """
    Return values that are the coefficients of columns: ``output_i = sum_k value_ik column_k``.

    With `own_axis` column i has the value of axis i, and no other axis. With a time constant T, the
    last value, there are also the derivatives of the columns by it at T0 of `point`, with the
    coefficients ``value_ik (T - T0)``.
    """
    effect_values = values[effect.name]
    amplitudes = effect_values[:-1] if effect.time_constant else effect_values
    block = np.diag(amplitudes) if own_axis else amplitudes.reshape(3, -1).T
    if effect.time_constant:
        change = effect_values[-1] - point[effect.name][-1]
        block = np.concatenate([block, block * change])
    return {effect.groups[0].name: block}


def along_axis_coefficients(
    effect: Effect, values: Values, point: dict[str, Any], *, function: Callable
) -> Values:
    """
    Return the coefficients of ``value_i g(u_i . v)`` with the unit input axis u_i of element i.

    The axes are the rows of the matrix, normalised. ``function(axes)`` gives the coefficients of
    the columns for g, as `power_coefficients` does.
    """
    matrix = values['matrix'].reshape(3, 3)
    input_axes = matrix / np.sqrt((matrix**2).sum(axis=1))[:, None]
    return {effect.groups[0].name: function(input_axes) * values[effect.name][None, :]}


def product_coefficients(effect: Effect, values: Values, point: dict[str, Any]) -> Values:
    """Return values as coefficients of the three mixed products; those of the squares are 0."""
    block = values[effect.name].reshape(3, 3).T
    return {effect.groups[0].name: np.concatenate([np.zeros((3, 3), block.dtype), block])}


def cross_axis_coefficients(effect: Effect, values: Values, point: dict[str, Any]) -> Values:
    """Return two values of each axis as coefficients of the columns of the two other axes."""
    block = np.zeros((3, 3), values[effect.name].dtype)
    block[~np.eye(3, dtype=bool)] = values[effect.name]
    return {effect.groups[0].name: block.T}


def matrix_coefficients(effect: Effect, values: Values, point: dict[str, Any]) -> Values:
    """Return the sensor's matrix, or for another effect its rows times one value per axis."""
    matrix = values['matrix'].reshape(3, 3)
    if effect.role is not Role.LINEAR:
        matrix = matrix * values[effect.name][:, None]
    return {effect.groups[0].name: matrix.T}


def lever_coefficients(effect: Effect, values: Values, point: dict[str, Any]) -> Values:
    """Return the coefficients of the lever matrix for one arm, or for an arm of each output."""
    arms = values[effect.name].reshape(-1, 3)
    return {LEVER.name: matrix_times_arms(values['matrix'].reshape(3, 3), arms)}


def matrix_times_arms(matrix: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """
    Return the coefficients M_ij r_ik of the lever matrix W_jk for output i, shape (9, 3).

    With the matrix M and the arm r_i of output i, the rows of `arms`, or one row for all outputs
    (Zhang 2017, eq. 11-17 with the true inverse).
    """
    return (matrix[:, :, None] * arms[:, None, :]).reshape(3, 9).T
