"""Effects with a time constant are tested at each of a bank of time constants, where their columns are linear in the amplitudes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.forward_equations import effect_slopes
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import Reference

WIDE = 10.0
"""
Standard deviations of amplitudes in a bank, times the effect's own: neighbours share one curve with opposite signs, and where the prior
constrained them the estimated noise changed; from a factor of six on it does not.
"""


@dataclass(frozen=True, eq=False)
class BankEntry:
    """One effect at one time constant."""

    effect: Effect
    """It."""
    number: int
    """Number of the time constant."""
    point: dict
    """Point of linearisation."""
    used: tuple
    """(ColumnGroup, columns that the amplitudes multiply), ..."""
    slopes: np.ndarray
    """d(coefficients) / d(amplitudes), shape (n_columns, 3, n_amplitudes)."""
    label: str
    """Effect name and number of the time constant."""

    @property
    def param_names(self) -> list[str]:
        """Names of the amplitudes."""
        return [f'{self.label}.{component}' for component in self.effect.amplitudes(self.effect.components)]

    @property
    def prior_sd(self) -> np.ndarray:
        """Standard deviations of the amplitudes before any data."""
        return WIDE * self.effect.amplitudes(self.effect.prior_sds())

    def columns(self, ref: Reference) -> np.ndarray:
        """Return the columns that the amplitudes multiply, shape (n, n_columns)."""
        return np.concatenate([group.columns(ref, self.point)[:, rows] for group, rows in self.used], axis=1)


def make_bank(effects: Sequence[Effect], constants: np.ndarray, model: SensorModel, *, values: np.ndarray) -> dict[str, list[BankEntry]]:
    """Return sensor -> list of BankEntry for the `effects` that have a time constant, at `values` of a model for the rest of the sensor."""
    bank = {sensor: [] for sensor in SENSORS}
    for effect in effects:
        if effect.time_constant:
            bank[effect.sensor] += [_entry(effect, number, constant, model, values) for number, constant in enumerate(constants)]
    return bank


def _entry(effect, number, constant, model, values):
    own = effect.at_time_constant(constant)
    point = {**model.full_point(), effect.name: own}
    slopes = effect_slopes(effect, {**model.values_of(effect.sensor, values), effect.name: own}, point)[1]
    amplitudes = {name: effect.amplitudes(np.moveaxis(block, -1, 0)) for name, block in slopes.items()}
    used = [(group, np.flatnonzero(np.any(amplitudes[group.name] != 0, axis=(0, 2)))) for group in effect.groups]
    joined = np.concatenate([amplitudes[group.name][:, rows] for group, rows in used], axis=1)
    return BankEntry(effect, number, point, tuple(used), np.moveaxis(joined, 0, -1), f'{effect.name}@{number}')
