"""A model is a list of effects: its parameters, its columns, its prediction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from imu_calibration.core.errors import InputError
from imu_calibration.effects.base import SECTIONS, SENSORS, Effect, Role
from imu_calibration.effects.catalogue import CATALOGUE, JOINTS, Catalogue
from imu_calibration.effects.expressions import ColumnCentre, ColumnGroup
from imu_calibration.kinematics.joint import JointNames
from imu_calibration.kinematics.table import Table

BASE = ('bias', 'matrix')
"""Effects that every sensor has."""
NAMED_MODELS = {
    'axial': BASE,
    'pendulous': (*BASE, 'accel_cross_product'),
    'size_effect': (*BASE, 'accel_size_effect'),
    'rate': BASE,
    'extended_rate': (*BASE, 'gyro_rate_product'),
}
"""
Models with a name: Avrutov 2017 eq. 1, eq. 4; Zhang 2017 eq. 11-17; Avrutov 2017 eq. 7, eq. 10.
"""
G_SENSITIVE = (*BASE, 'gyro_g_sensitivity')
"""Gyroscope model by hand when the poses require it."""
BARE = 'axial'
"""Name of the model from which a diagnosis starts; further effects need evidence."""
DEFAULT_MODEL = {'accelerometer': 'size_effect', 'gyroscope': 'rate'}
"""Default model of a recording on a table."""


def parse_effects(
    sensor: str, text: str, joint_names: Sequence[str] = JOINTS, *, catalogue: Catalogue = CATALOGUE
) -> tuple[str, ...]:
    """
    Return effect names from a named model or names joined by '+'.

    Raises
    ------
    InputError
        When a name is unknown or the model lacks bias or matrix.

    """
    names = NAMED_MODELS.get(text) or tuple(part.strip() for part in text.split('+'))
    for name in names:
        catalogue.find(sensor, name, joint_names, models=NAMED_MODELS if name == text else ())
    if not set(BASE) <= set(names):
        raise InputError(
            f"the {sensor} model must contain bias and matrix, got '{text}'; write bias+matrix+..."
        )
    return names


def parse_reference(text: str | None, table: Table) -> tuple[str, ...]:
    """
    Return effect names of table and clock from names joined by '+' or 'none'.

    None: the tilt, the Earth's rate unless the table defines it, and errors of the joints where the
    table has their tolerances.
    """
    if text is not None:
        return tuple(name for name in text.split('+') if name not in ('', 'none'))
    joints = table.joint_names
    candidates = ['table_tilt']
    if joints.angle_sd and joints.angles:
        candidates.append('axis_non_orthogonality')
    if joints.angle_sd and joints.zeros:
        candidates.append('encoder_zero')
    if joints.place_sd and joints.places:
        candidates.append('axis_offset')
    candidates.append('earth_rate')
    return tuple(name for name in candidates if not _is_moot(name, table))


def _is_moot(name: str, table: Table) -> bool:
    """Return whether a reference effect cannot be tested with a table (`Effect.moot`)."""
    moot = CATALOGUE.find('reference', name).moot
    return moot is not None and moot(table) is not None


def with_common_arm(model: 'SensorModel') -> 'SensorModel':
    """
    Return the model with a common lever arm in addition to the arms of the size effect.

    A model without a size effect is unchanged.
    """
    if model.find('accelerometer', Role.ARMS) and not model.find('accelerometer', Role.ARM):
        return model.with_effect('accelerometer', 'lever_arm')
    return model


WARP, WARP_LEVER = 'warp:', 'warp_lever:'
"""
Beginnings of the names of columns that a warp makes: its change of the true input, and of the
lever-arm terms.
"""


@dataclass(frozen=True, eq=False)
class ColumnLayout:
    """Columns of one sensor: their effects and the positions of their coefficients."""

    effects: tuple[Effect, ...]
    """Effects that concern the sensor."""
    groups: dict[str, ColumnGroup]
    """Group name -> ColumnGroup, without the columns of warps."""
    rows: dict[str, slice]
    """Group name -> slice of the columns, which are the rows of the coefficients."""
    width: int
    """Number of columns."""
    point: dict[str, Any]
    """Where the columns were linearised (`SensorModel.full_point`)."""


@dataclass(frozen=True, eq=False)
class SensorModel:
    """
    Effects of accelerometer, gyroscope and reference, with a fixed order of parameters.

    `point` holds values of the effects with columns that depend on their own value (delays, lags,
    tilts, time constants). The columns are exact there; away from it they are the first derivative.
    """

    accelerometer: tuple = BASE
    """Names of the accelerometer's effects."""
    gyroscope: tuple = BASE
    """Names of the gyroscope's effects."""
    reference: tuple = ()
    """Names of the effects of table and clock."""
    joint_names: JointNames = JOINTS  # type: ignore[assignment]   # made one at once
    """
    Joints of the table; a plain sequence of names means turning joints without parallel neighbours.
    """
    temperature_ref_c: float = 25.0
    """Temperature at which thermal effects vanish, degrees Celsius."""
    point: dict = field(default_factory=dict)
    """Where the columns were linearised: effect name -> values."""
    folded_arms: np.ndarray | None = None
    """
    Arms, shape (3, 3), for which the columns of a warp include its change of the lever-arm terms;
    None: that change has separate columns. Folded, the columns are fewer and exact at these arms
    only, as all columns are exact at `point` only.
    """
    catalogue: Catalogue = CATALOGUE
    """Where the effects are declared."""
    centre: dict[str, ColumnCentre] = field(default_factory=dict)
    """Column group -> the part that is subtracted from its columns."""

    def __post_init__(self):
        object.__setattr__(self, 'joint_names', JointNames.of(self.joint_names))

    def __reduce__(self):
        """Pickle without cached values: effects contain functions that cannot be pickled."""
        return SensorModel, tuple(getattr(self, f.name) for f in fields(self))

    @cached_property
    def effects(self) -> list[Effect]:
        """Effects in parameter order."""
        effects = []
        for section in SECTIONS:
            for name in getattr(self, section):
                effects.append(self.catalogue.find(section, name, self.joint_names))
        return effects

    @cached_property
    def param_names(self) -> list[str]:
        """Names in parameter order."""
        names = []
        for effect in self.effects:
            names += effect.param_names()
        return names

    @cached_property
    def slices(self) -> dict[tuple[str, str], slice]:
        """Slice of the parameter vector for each (sensor, effect name)."""
        ends = np.cumsum([0] + [effect.size for effect in self.effects])
        return {effect.key: slice(a, b) for effect, a, b in zip(self.effects, ends, ends[1:])}

    def has_columns_of(self, other: 'SensorModel') -> bool:
        """
        Return whether another model has the same columns: equal effects, linearised equally.
        """
        for section in SECTIONS:
            if tuple(getattr(self, section)) != tuple(getattr(other, section)):
                return False
        for name in ('joint_names', 'temperature_ref_c', 'definitions'):
            if getattr(self, name) != getattr(other, name):
                return False
        if self.point.keys() != other.point.keys():
            return False
        return all(np.array_equal(self.point[name], other.point[name]) for name in self.point)

    def find(self, sensor: str, role: Role) -> Effect | None:
        """Return the effect of a sensor in a place of its equation, or None."""
        return next((e for e in self.effects if e.sensor == sensor and e.role is role), None)

    def matrix(self, sensor: str, values: np.ndarray) -> np.ndarray:
        """Return the matrix of a sensor, shape (3, 3); every model has one."""
        return values[self.slices[self.effect_of(sensor, Role.LINEAR).key]].reshape(3, 3)

    def effect_of(self, sensor: str, role: Role) -> Effect:
        """Return the effect that a model is known to have in a place of a sensor's equation."""
        effect = self.find(sensor, role)
        assert effect is not None, f'the model must have a {role.name} of the {sensor}'
        return effect

    def part(self, sensor: str, role: Role) -> slice:
        """
        Return the slice of the parameter vector of the effect in a place of a sensor's equation.

        The slice is empty if the model has no such effect.
        """
        effect = self.find(sensor, role)
        return slice(0, 0) if effect is None else self.slices[effect.key]

    def value(self, sensor: str, role: Role, values: np.ndarray) -> np.ndarray | None:
        """
        Return the values of the effect in a place of a sensor's equation in its documented shape.

        None if the model has no such effect.
        """
        effect = self.find(sensor, role)
        return None if effect is None else values[self.slices[effect.key]].reshape(effect.shape)

    @property
    def definitions(self) -> dict[str, Any]:
        """
        Plain data of the effects that were added to the catalogue, by name.

        A document needs them in addition to the names.
        """
        return self.catalogue.definitions({effect.name for effect in self.effects})

    @property
    def further(self) -> list[Effect]:
        """Effects that are neither offset nor linear response."""
        return [e for e in self.effects if e.role not in (Role.OFFSET, Role.LINEAR)]

    @property
    def needs_temperature(self) -> bool:
        """Whether an effect depends on temperature."""
        return any('temperature' in effect.needs for effect in self.effects)

    def uses(self, quantity: str) -> bool:
        """Return whether a column is made of a quantity of `expressions.QUANTITIES`."""
        for effect in self.effects:
            if any(quantity in group.uses for group in effect.groups):
                return True
        return False

    @cached_property
    def requested(self) -> np.ndarray:
        """
        Mask of the parameters of interest; table, clock and the common arm are nuisances.

        Shape (n_params,).
        """
        return self.mask(lambda effect: not effect.nuisance)

    def mask(self, is_chosen: Callable[[Effect], bool]) -> np.ndarray:
        """Return a mask of the parameters of the chosen effects, shape (n_params,)."""
        return np.repeat([is_chosen(e) for e in self.effects], [e.size for e in self.effects])

    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """
        Return prior values and prior standard deviations, both shape (n_params,).

        The prior time of a step is that of its columns.
        """
        values = []
        sds = []
        for effect in self.effects:
            effect_values = effect.prior_values()
            if effect.located:
                effect_values[-1] = self.point_of(effect)[-1]
            values.append(effect_values)
            sds.append(effect.prior_sds())
        return np.concatenate(values), np.concatenate(sds)

    def start(self) -> np.ndarray:
        """Return the values to start from: the prior's, or the point of the columns."""
        return np.concatenate([self.point_of(effect) for effect in self.effects])

    def start_from(self, other: 'SensorModel', other_values: np.ndarray) -> np.ndarray:
        """
        Return values to start from, shape (n_params,), with those of another model where it can.

        An effect that both models have gets its values of `other_values`, which are in the order of
        the parameters of `other`; any other effect gets those of `start`.
        """
        values = self.start()
        for effect in other.effects:
            if effect.key in self.slices:
                values[self.slices[effect.key]] = other_values[other.slices[effect.key]]
        return values

    def values_of(self, sensor: str, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return {effect name: values} of the effects of `sensor` and of the reference."""
        values_by_name = {}
        for effect in self.effects:
            if effect.sensor in (sensor, 'reference'):
                values_by_name[effect.name] = values[self.slices[effect.key]]
        return values_by_name

    def with_effect(self, sensor: str, name: str) -> 'SensorModel':
        """Return the model extended by one effect."""
        return replace(self, **{sensor: getattr(self, sensor) + (name,)})

    def with_sized_effect(
        self, values: np.ndarray, sensor: str, name: str, *, size: np.ndarray
    ) -> tuple['SensorModel', np.ndarray]:
        """
        Return (the model extended by one effect, its parameters).

        They are `values` of this model's effects, and `size` of the new one.
        """
        model = self.with_effect(sensor, name)
        extended = model.start_from(self, values)
        extended[model.slices[sensor, name]] = size
        return model, extended

    def with_role(self, sensor: str, role: Role) -> 'SensorModel':
        """
        Return the model extended by the catalogue's effect for a place of a sensor's equation.
        """
        effects = self.catalogue.effects(self.joint_names).values()
        name = next(e.name for e in effects if e.sensor == sensor and e.role is role)
        return self.with_effect(sensor, name)

    def with_reference_temperature(self, temperature_c: float) -> 'SensorModel':
        """
        Return the model whose thermal effects vanish at the whole degree nearest to a temperature.
        """
        return replace(self, temperature_ref_c=float(round(temperature_c)))

    def without(self, sensor: str, *names: str) -> 'SensorModel':
        """Return the model without the effects of a sensor that are named."""
        remaining = tuple(name for name in getattr(self, sensor) if name not in names)
        sections: dict[str, Any] = {sensor: remaining}
        return replace(self, **sections)

    def without_arms(self) -> 'SensorModel':
        """Return the model without lever arms."""
        return self.without('accelerometer', *(effect.name for effect in self.arms))

    @property
    def arms(self) -> list[Effect]:
        """Effects that are lever arms of the accelerometers."""
        return [e for e in self.effects if e.role in (Role.ARMS, Role.ARM)]

    def concerning(self, sensor: str) -> list[Effect]:
        """Return the effects that contribute columns to `sensor`."""
        return [effect for effect in self.effects if sensor in effect.sensors]

    def groups(self, sensor: str) -> list[tuple[str, int]]:
        """Return the columns of `sensor` in order: (group name, width)."""
        return [(name, rows.stop - rows.start) for name, rows in self.layout(sensor).rows.items()]

    def layout(self, sensor: str) -> ColumnLayout:
        """
        Return the columns of a sensor and the positions of their coefficients (cached).

        A warp of n values has ``3 n`` columns, the derivative of the true input by each value, and
        ``9 n`` of the lever matrix where these are separate.

        Raises
        ------
        InputError
            When two effects call different columns by one name.

        """
        if sensor not in self._layouts:
            groups: dict[str, ColumnGroup] = {}
            widths: dict[str, int] = {}  # group name -> number of columns, in their order
            for effect in self.concerning(sensor):
                for group in effect.groups_of(sensor):
                    if groups.setdefault(group.name, group) != group:
                        raise InputError(
                            f"effect '{effect.name}' must call its columns otherwise than"
                            f" '{group.name}', which other columns are called; rename it",
                            code='column_name_taken',
                        )
                    widths[group.name] = group.width
                if effect.warp is not None:
                    widths[WARP + effect.name] = 3 * effect.size
                    # A warp also changes the lever-arm terms of the accelerometer. A closed
                    # derivative has none, and folded arms are part of the first columns.
                    separate_lever = effect.derivative is None and self.folded_arms is None
                    if sensor == SENSORS[0] and self.arms and separate_lever:
                        widths[WARP_LEVER + effect.name] = 9 * effect.size
            ends = np.cumsum([0, *widths.values()])
            rows = {name: slice(int(a), int(b)) for name, a, b in zip(widths, ends, ends[1:])}
            self._layouts[sensor] = ColumnLayout(
                tuple(self.concerning(sensor)), groups, rows, int(ends[-1]), self.full_point()
            )
        return self._layouts[sensor]

    @cached_property
    def _layouts(self) -> dict[str, ColumnLayout]:
        """Sensor -> its layout, once `layout` has made it."""
        return {}

    def columns_of(self, sensor: str, role: Role) -> slice:
        """
        Return the slice of the columns of the effect in a place of a sensor's equation.
        """
        effect = self.find(sensor, role)
        if effect is None:
            raise KeyError(f'the {sensor} has no {role}')
        return self.layout(sensor).rows[effect.groups[0].name]

    def point_of(self, effect: Effect) -> np.ndarray:
        """
        Return the values at which `effect`'s columns are linearised; default: its prior values.
        """
        values = self.point.get(effect.name)
        if values is None:
            return effect.prior_values()
        return np.atleast_1d(np.asarray(values, float))

    @property
    def relinearised(self) -> list[Effect]:
        """Effects whose columns depend on their own value."""
        return [e for e in self.effects if e.relinearised]

    def at(self, values: np.ndarray) -> 'SensorModel':
        """Return the same model linearised at `values`."""
        moved = {e.name: np.array(values[self.slices[e.key]], float) for e in self.relinearised}
        return replace(self, point={**self.point, **moved})

    def full_point(self) -> dict[str, Any]:
        """
        Return the data on which columns depend in addition to the reference.

        They are effect name -> values of linearisation, the reference temperature, and the centres.
        """
        settling = {e.name: self.point_of(e) for e in self.effects if e.time_constant}
        point = {**settling, **self.point, 'temperature_ref_c': self.temperature_ref_c}
        if self.centre:
            point['centre'] = self.centre
        return point


def linear_names(sensor: str) -> np.ndarray:
    """Return the parameter names of a sensor's matrix, shape (3, 3)."""
    model = SensorModel()
    return np.array(model.param_names)[model.part(sensor, Role.LINEAR)].reshape(3, 3)
