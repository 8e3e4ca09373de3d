"""A model is a list of effects: its parameters, its columns, its prediction."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from imu_calibration import effects as catalogue_of
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.regressors import GROUPS, WIDTH
from imu_calibration.errors import InputError
from imu_calibration.reference import Reference, lever_matrix
from imu_calibration.turntable import reference_motion

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
    joint_names: tuple = ('outer', 'middle', 'inner')
    """Joints of the table."""
    temperature_ref_c: float = 25.0
    """Temperature at which thermal effects vanish, degrees Celsius."""
    point: dict = field(default_factory=dict)
    """Where the columns were linearised: effect name -> values."""

    def __reduce__(self):
        """Travel to other processes without what was worked out: effects hold functions that cannot be sent."""
        return SensorModel, tuple(getattr(self, f.name) for f in fields(self))

    @cached_property
    def effects(self):
        """Effects in parameter order."""
        return [catalogue_of.find_effect(sensor, name, self.joint_names)
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
                if sensor == 'accelerometer' and effect.derivative is None and self.has_arms:
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
        catalogue_of.find_effect(sensor, name, joint_names)
    if 'matrix' not in names or 'bias' not in names:
        raise InputError(f"the {sensor} model must contain bias and matrix, got '{text}'; write bias+matrix+...")
    return names


def warps_act(model):
    """Tell whether any warp has a point other than zero, so that the sensors feel another motion than the table's."""
    return any(effect.warp is not None and np.any(model.warp_point(effect)) for effect in model.effects)


def warped_reference(model, sensor, table, motion, temperature_c=None, values=None, skip=None):
    """
    Return the reference that `sensor` is thought to have felt, with every warp of the model at its point.

    Parameters
    ----------
    values : dict, optional
        Effect name -> values that replace the point of those effects.

    """
    branches = [(1.0, table, motion)]
    for effect in model.concerning(sensor):
        if effect.warp is None:
            continue
        at = (values or {}).get(effect.name)
        at = model.warp_point(effect) if at is None else np.atleast_1d(at)
        if not np.any(at):
            continue
        branches = [(weight * w, t, m) for weight, a, b in branches for w, t, m in effect.warp(a, b, at)]
    references = [(weight, reference_motion(t, m, temperature_c)) for weight, t, m in branches]
    return mean_reference(references, motion)


def mean_reference(weighted, motion):
    """Return the weighted mean of references (a lag is a mean over delays); attitude from the last, which moves little."""
    if len(weighted) == 1:
        return weighted[0][1]
    total = sum(weight for weight, _ in weighted)
    first = weighted[0][1]
    mean = {name: sum(weight * getattr(ref, name) for weight, ref in weighted) / total for name in ('force_s', 'rate_s', 'alpha_s', 'mat_sn')}
    return Reference(motion.time, mean['mat_sn'], mean['force_s'], mean['rate_s'], mean['alpha_s'], first.gravity, first.temperature_c, motion)


INPUT_OF = {'accelerometer': 'force_s', 'gyroscope': 'rate_s'}


def columns(model, sensor, table, motion, temperature_c=None, ref=None):
    """
    Return the regressors of `sensor`, shape (n, n_columns), in the order of ``model.groups(sensor)``.

    A warp contributes, per parameter, the three components of the derivative of the true input (`force_s` or `rate_s`);
    its coefficients are matrix times parameter. The derivative is a central difference of the exact kinematics.
    """
    ref = warped_reference(model, sensor, table, motion, temperature_c) if ref is None else ref
    if ref.temperature_c is None and any(name.endswith('temperature') for name, _ in model.groups(sensor)):
        raise InputError('a thermal effect needs temperatures, none came; record imu/temperature or leave the effect out')
    point, parts = model.full_point(), []
    warps = {e.name: e for e in model.concerning(sensor) if e.warp is not None}
    for name, _ in model.groups(sensor):
        kind, _, owner = name.partition(':')
        if kind == 'warp':
            parts += warp_columns(model, warps[owner], sensor, table, motion, ref)
        elif kind != 'warp_lever':
            parts.append(GROUPS[name](ref, point))
    return np.concatenate(parts, axis=1)


def warp_columns(model, effect, sensor, table, motion, ref):
    """
    Return the columns of a warp: d(true input)/d(parameter), shape (n, 3 size), and d(lever matrix)/d(parameter) where arms are modelled.
    """
    if effect.derivative is not None:
        return [effect.derivative(ref)]
    inputs, levers = [], []
    for above, below, width in _central_steps(effect, model.warp_point(effect)):
        high, low = (warped_reference(model, sensor, table, motion, values={effect.name: at}) for at in (above, below))
        inputs.append((getattr(high, INPUT_OF[sensor]) - getattr(low, INPUT_OF[sensor])) / width)
        if sensor == 'accelerometer' and model.has_arms:
            turns = [lever_matrix(end.rate_s, end.alpha_s).reshape(-1, 9) for end in (high, low)]
            levers.append((turns[0] - turns[1]) / width)
    return [np.concatenate(part, axis=1) for part in (inputs, levers) if part]


def _central_steps(effect, at):
    """Yield (values above, values below, distance) for the derivative by each parameter; time constants stay positive."""
    for index in range(effect.size):
        step = np.zeros(effect.size)
        step[index] = effect.step
        below = at - step
        if effect.components[index] == 'time_constant':
            step[index] = min(effect.step, 0.5 * at[index]) if at[index] > 0 else effect.step
            below = at - step if at[index] > 0 else at
        yield at + step, below, (at + step - below)[index]


def coefficients(model, sensor, values):
    """Return the coefficients of the columns for a parameter vector (real or complex), shape (n_columns, 3)."""
    of_sensor, layout = model.values_of(sensor, values), model.layout(sensor)
    total = np.zeros((layout.width, 3), values.dtype)
    for effect in layout.effects:
        _add_coefficients(total, model, effect, of_sensor, layout)
    return total


def _add_coefficients(total, model, effect, of_sensor, layout):
    """Add one effect's coefficients in place."""
    if effect.warp is not None:
        change = of_sensor[effect.name] - model.warp_point(effect)
        matrix = of_sensor['matrix'].reshape(3, 3)
        total[layout.rows['warp:' + effect.name]] += (change[:, None, None] * matrix.T[None]).reshape(-1, 3)
        if 'warp_lever:' + effect.name in layout.rows:
            products = (matrix[:, :, None] * _all_arms(of_sensor)[:, None, :]).reshape(3, 9).T
            total[layout.rows['warp_lever:' + effect.name]] += (change[:, None, None] * products[None]).reshape(-1, 3)
    elif effect.coefficients is not None:
        for group, block in effect.coefficients(of_sensor, layout.point).items():
            total[layout.rows[group]] += block


def _all_arms(of_sensor):
    """Return the arms from the reference point, shape (3, 3)."""
    arms = of_sensor['accel_size_effect'].reshape(3, 3) if 'accel_size_effect' in of_sensor else np.zeros((3, 3))
    return arms + of_sensor['lever_arm'] if 'lever_arm' in of_sensor else arms


SHARED = ('matrix', 'accel_size_effect', 'lever_arm')
"""Effects whose values enter the coefficients of others."""


def coefficient_jacobian(model, sensor, values):
    """
    Return d(coefficients)/d(values) by complex steps, shape (n_columns, 3, n_params).

    Besides its own values an effect's coefficients depend on the sensor's matrix and, for warps, on its arms.
    """
    layout, step = model.layout(sensor), 1e-30
    jacobian = np.zeros((layout.width, 3, len(values)))
    for effect in layout.effects:
        concerned = layout.effects if effect.name in SHARED else (effect,)
        part = model.slices[effect.sensor, effect.name]
        for index in range(part.start, part.stop):
            moved = values.astype(complex)
            moved[index] += 1j * step
            of_sensor, total = model.values_of(sensor, moved), np.zeros((layout.width, 3), complex)
            for other in concerned:
                _add_coefficients(total, model, other, of_sensor, layout)
            jacobian[:, :, index] = total.imag / step
    return jacobian


def predict(model, values, table, motion, temperature_c=None):
    """
    Return what the IMU of this model would read, (force, rate), each shape (n, 3): the forward equations.

    Warps are taken exactly at `values`; saturation clips the result.
    """
    exact = model.at(values)
    outputs = []
    for sensor in SENSORS:
        output = columns_at_point(exact, sensor, table, motion, temperature_c) @ coefficients_at_point(exact, sensor, values)
        outputs.append(clip(exact, sensor, values, output))
    return tuple(outputs)


def columns_at_point(model, sensor, table, motion, temperature_c=None, ref=None):
    """Return the columns without the warps' derivatives, which have zero coefficients at the point itself."""
    ref = warped_reference(model, sensor, table, motion, temperature_c) if ref is None else ref
    point = model.full_point()
    return np.concatenate([GROUPS[name](ref, point) for name, _ in model.groups(sensor) if name in GROUPS], axis=1)


def coefficients_at_point(model, sensor, values):
    """Return the coefficients that belong to `columns_at_point`."""
    rows = np.concatenate([np.full(width, name in GROUPS) for name, width in model.groups(sensor)])
    return coefficients(model, sensor, values)[rows]


def clip(model, sensor, values, output):
    """Clip the output at the saturation level, when the model has one."""
    name = {'accelerometer': 'accel_saturation', 'gyroscope': 'gyro_saturation'}[sensor]
    if (sensor, name) not in model.slices:
        return output
    level = float(values[model.slices[sensor, name]][0])
    return np.clip(output, -level, level)


def sensor_output(model, sensor, values, ref):
    """
    Return the output for a given true motion, without warps: what compensation inverts, shape (n, 3).

    Parameters
    ----------
    ref : Reference
        True specific force, rate and angular acceleration in the sensor frame.

    """
    return columns_at_point(model, sensor, None, None, ref=ref) @ coefficients_at_point(model, sensor, values)
