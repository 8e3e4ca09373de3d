"""A model is a list of effects: its parameters, its columns, its prediction."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import find_effect
from imu_calibration.effects.regressors import WIDTH
from imu_calibration.errors import InputError
from imu_calibration.reference.joint import JointNames

NAMED_MODELS = {
    'axial': ('bias', 'matrix'),
    'pendulous': ('bias', 'matrix', 'accel_cross_product'),
    'size_effect': ('bias', 'matrix', 'accel_size_effect'),
    'rate': ('bias', 'matrix'),
    'extended_rate': ('bias', 'matrix', 'gyro_rate_product'),
}
"""Models with a name: Avrutov 2017 eq. 1, eq. 4; Zhang 2017 eq. 11-17; Avrutov 2017 eq. 7, eq. 10."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Columns of one sensor: which effects make them and where their coefficients stand."""

    effects: tuple
    """Effects that concern the sensor."""
    rows: dict
    """Group name -> slice of the columns."""
    width: int
    """Number of columns."""
    point: dict
    """Where the columns were linearised."""


@dataclass(frozen=True, eq=False)
class SensorModel:
    """
    Effects of accelerometer, gyroscope and reference, with a fixed order of parameters.

    `point` holds values of the effects whose columns depend on their own value (delays, lags, tilts, time constants).
    The columns are exact there; away from it they are the first derivative.
    """

    accelerometer: tuple = ('bias', 'matrix')
    """Names of the accelerometer's effects."""
    gyroscope: tuple = ('bias', 'matrix')
    """Names of the gyroscope's effects."""
    reference: tuple = ()
    """Names of the effects of table and clock."""
    joint_names: JointNames = ('outer', 'middle', 'inner')
    """Joints of the table; a plain sequence of names is taken for turning joints of which no two neighbours are parallel."""
    temperature_ref_c: float = 25.0
    """Temperature at which thermal effects vanish, degrees Celsius."""
    point: dict = field(default_factory=dict)
    """Where the columns were linearised: effect name -> values."""
    folded_arms: np.ndarray | None = None
    """
    Arms, shape (3, 3), for which the columns of a warp hold its change of the lever-arm terms too; None: that change has columns of its
    own. Folded, the columns are fewer and exact at these arms only, as everything is exact at `point` only.
    """

    def __post_init__(self):
        object.__setattr__(self, 'joint_names', JointNames.of(self.joint_names))

    def __reduce__(self):
        """Travel to other processes without what was worked out: effects hold functions that cannot be sent."""
        return SensorModel, tuple(getattr(self, f.name) for f in fields(self))

    @cached_property
    def effects(self):
        """Effects in parameter order."""
        return [find_effect(sensor, name, self.joint_names)
                for sensor in SENSORS + ('reference',) for name in getattr(self, sensor)]

    @cached_property
    def param_names(self):
        """Names in parameter order."""
        return [name for effect in self.effects for name in effect.param_names()]

    @cached_property
    def slices(self):
        """Slice of the parameter vector for each (sensor, effect name)."""
        ends = np.cumsum([0] + [effect.size for effect in self.effects])
        return {(e.sensor, e.name): slice(a, b) for e, a, b in zip(self.effects, ends, ends[1:])}

    def prior(self):
        """Return prior values and prior standard deviations, both shape (n_params,)."""
        values = np.concatenate([effect.prior_values() for effect in self.effects])
        return values, np.concatenate([prior_sds(effect) for effect in self.effects])

    def start(self):
        """Return the values to start from: the prior's, with time constants where they act."""
        values = self.prior()[0]
        for effect in self.effects:
            values[self.slices[effect.sensor, effect.name]] = start_values(effect, self.point)
        return values

    def values_of(self, sensor, values):
        """Return {effect name: values} that concern `sensor`, its own and the reference's."""
        return {e.name: values[self.slices[e.sensor, e.name]] for e in self.effects if e.sensor in (sensor, 'reference')}

    def with_effect(self, sensor, name):
        """Return the model extended by one effect."""
        return replace(self, **{sensor: getattr(self, sensor) + (name,)})

    def without(self, sensor, name):
        """Return the model without one effect."""
        return replace(self, **{sensor: tuple(known for known in getattr(self, sensor) if known != name)})

    def concerning(self, sensor):
        """Return the effects that contribute columns to `sensor`."""
        return [e for e in self.effects if e.sensor == sensor or (e.sensor == 'reference' and sensor in e.acts_on)]

    def groups(self, sensor):
        """Return the column groups of `sensor` in order, each once: (name, width)."""
        names = {}
        for effect in self.concerning(sensor):
            for group in effect.groups:
                names.setdefault(group, WIDTH[group])
            if effect.warp is not None:
                names['warp:' + effect.name] = 3 * effect.size
                if sensor == 'accelerometer' and effect.derivative is None and self.has_arms and self.folded_arms is None:
                    names['warp_lever:' + effect.name] = 9 * effect.size
        return list(names.items())

    @property
    def has_arms(self):
        """Whether the accelerometers have lever arms, whose terms a warp changes too."""
        return bool({'accel_size_effect', 'lever_arm'} & set(self.accelerometer))

    def layout(self, sensor):
        """Return where the coefficients of each group stand (worked out once per sensor)."""
        if sensor not in self._layouts:
            rows, start = {}, 0
            for name, width in self.groups(sensor):
                rows[name] = slice(start, start + width)
                start += width
            self._layouts[sensor] = Layout(tuple(self.concerning(sensor)), rows, start, self.full_point())
        return self._layouts[sensor]

    @cached_property
    def _layouts(self):
        return {}

    def warp_point(self, effect):
        """Return the values at which `effect`'s columns are taken."""
        return np.atleast_1d(np.asarray(self.point.get(effect.name, start_values(effect, self.point)), float))

    @property
    def relinearised(self):
        """Effects whose columns depend on their own value."""
        return [e for e in self.effects if e.warp is not None or e.name.endswith('_bias_drift')]

    def at(self, values):
        """Return the same model linearised at `values`."""
        moved = {e.name: np.array(values[self.slices[e.sensor, e.name]], float) for e in self.relinearised}
        return replace(self, point={**self.point, **moved})

    def full_point(self):
        """Return what the column groups need to know besides the reference."""
        drifts = {e.name: start_values(e, self.point) for e in self.effects if e.name.endswith('_bias_drift')}
        return {**drifts, **self.point, 'temperature_ref_c': self.temperature_ref_c}


def prior_sds(effect):
    """Return the prior standard deviations of an effect, shape (size,)."""
    sds = np.full(effect.size, effect.prior_sd)
    if effect.components[-1] == 'time_constant' and effect.size > 1:
        sds[-1] = 1000.0
    return sds


def start_values(effect, point):
    """Return where an effect is linearised when nothing is known yet."""
    if effect.name in point:
        return np.atleast_1d(np.asarray(point[effect.name], float))
    values = effect.prior_values()
    if effect.components[-1] == 'time_constant' and effect.size > 1:
        values[-1] = 300.0
    return values


def parse_effects(sensor, text, joint_names=('outer', 'middle', 'inner')):
    """
    Return effect names from a named model or names joined by '+'.

    Raises
    ------
    InputError
        When a name is unknown or the model lacks bias or matrix.

    """
    names = NAMED_MODELS.get(text) or tuple(part.strip() for part in text.split('+'))
    for name in names:
        find_effect(sensor, name, joint_names)
    if 'matrix' not in names or 'bias' not in names:
        raise InputError(f"the {sensor} model must contain bias and matrix, got '{text}'; write bias+matrix+...")
    return names
