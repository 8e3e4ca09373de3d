"""Which effects of the catalogue a program can represent, by their role in the sensor's equation and by their columns."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.effects import regressors
from imu_calibration.effects.base import SENSORS, Effect, Role
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.column_group import ColumnGroup


@dataclass(frozen=True)
class Holding:
    """Effects of one kind of one sensor."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    role: Role = Role.TERM
    """Their place in the sensor's equation."""
    groups: tuple[ColumnGroup, ...] = ()
    """Columns of effects that are terms."""
    own_axis: bool = False
    """Whether of a matrix only the diagonal can be held."""

    def covers(self, effect: Effect) -> bool:
        """Return whether an effect is of this kind."""
        return effect.sensor == self.sensor and effect.role is self.role and (self.role is not Role.TERM or effect.groups == self.groups)

    def held(self, values: np.ndarray) -> np.ndarray:
        """Return the representable part of an effect's values, shape as given."""
        return np.diag(np.diag(values.reshape(3, 3))).reshape(values.shape) if self.own_axis else values

    @property
    def effect(self) -> Effect:
        """The catalogue's effect of this kind."""
        return next(effect for effect in CATALOGUE.effects().values() if self.covers(effect))


def _both(**kind) -> tuple[Holding, ...]:
    return tuple(Holding(sensor, **kind) for sensor in SENSORS)


OFFSETS = _both(role=Role.OFFSET)
MATRICES = _both(role=Role.LINEAR)
SCALES = _both(role=Role.LINEAR, own_axis=True)
THERMAL_OFFSETS = _both(groups=(regressors.TEMPERATURE,))
G_SENSITIVITY = (Holding('gyroscope', Role.CROSS),)
ARMS = (Holding('accelerometer', Role.ARMS),)
SLOW_OFFSETS = OFFSETS + THERMAL_OFFSETS
"""Effects that an estimator with biases in its state estimates itself."""


def of(sensor: str, holdings: tuple[Holding, ...]) -> tuple[Holding, ...]:
    """Return the holdings of one sensor."""
    return tuple(holding for holding in holdings if holding.sensor == sensor)


def holding_of(effect: Effect, holdings: tuple[Holding, ...]) -> Holding | None:
    """Return the holding that covers an effect, or None."""
    return next((holding for holding in holdings if holding.covers(effect)), None)
