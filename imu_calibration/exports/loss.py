"""The part of a calibration that a program cannot represent, and the resulting error."""

from dataclasses import dataclass

import numpy as np

from imu_calibration.calibration.document import Calibration
from imu_calibration.compensation.compensate import invertible_values
from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.forward_equations import sensor_output
from imu_calibration.exports.affine import Placement, held_values
from imu_calibration.exports.holdings import Holding, holding_of
from imu_calibration.exports.motion import TrialMotion
from imu_calibration.exports.target import Numbers, Readings, Target

NOTHING = 1e-9
"""m/s^2, rad/s; smaller differences are rounding."""


@dataclass(frozen=True)
class LostEffect:
    """An effect of the calibration that a program cannot hold, or not wholly."""

    effect: Effect
    """Which."""
    in_part: bool
    """Whether a part of it is held."""
    rms: float
    """Root mean square of its contribution to the readings, per component, SI."""


@dataclass(frozen=True, eq=False)
class Loss:
    """Loss of an export on a motion."""

    effects: tuple[LostEffect, ...]
    """Effects that are not represented, in the catalogue's order."""
    estimated: tuple[Effect, ...]
    """Effects that the program finds by itself; they count as known here."""
    left: dict[str, float]
    """Sensor -> rms difference per component between the program's readings and the full compensation, SI."""
    raw: dict[str, float]
    """Sensor -> rms difference per component between raw readings and the full compensation, SI."""
    motion: str
    """Description of the motion."""

    @property
    def nothing(self) -> bool:
        """Whether the program's readings equal the full compensation."""
        return not self.effects and max(self.left.values()) < NOTHING


def loss_of(target: Target, calibration: Calibration, numbers: Numbers, *, placement: Placement, motion: TrialMotion) -> Loss:
    """
    Return the loss of a target on a motion.

    Readings are simulated without noise by the model that compensation inverts. The effects that the target estimates are removed from
    them; the target's formula is applied; the result is compared with the true motion in its frame, at its origin.

    Parameters
    ----------
    target : Target
    calibration : Calibration
    numbers : dict
        Content of the target's file.
    placement : Placement
        Frame, origin and axes of its numbers.
    motion : TrialMotion

    """
    model, values = invertible_values(calibration)
    ref, effects = motion.reference, {effect.key: effect for effect in model.effects}
    read = {sensor: sensor_output(model, sensor, values, ref=ref) for sensor in SENSORS}
    without = values.copy()
    estimated = tuple(e for e in effects.values() if holding_of(e, target.estimates) and e.key in calibration.model.slices)
    for effect in estimated:
        without[model.slices[effect.key]] = effect.prior_values()
    seen = {sensor: sensor_output(model, sensor, without, ref=ref) for sensor in SENSORS}
    true = placement.truth(ref.force_s, ref.rate_s, ref.alpha_s)
    if target.whole:
        made = true   # it represents all effects of the full compensation
    else:
        force, rate = placement.readings(*seen.values())
        readings = Readings(force, rate, ref.alpha_s @ placement.mat_ts.T, motion.temperature_c)
        made = target.corrected(numbers, readings)
    lost = () if target.whole else tuple(_lost(calibration, effect, target.holds, motion) for effect in effects.values()
                                         if effect not in estimated and not _whole(calibration, effect, target.holds))
    return Loss(lost, estimated, {s: _rms(m - t) for s, m, t in zip(SENSORS, made, true)},
                {s: _rms(read[s] - t) for s, t in zip(SENSORS, (ref.force_s, ref.rate_s))}, motion.text)


def _whole(calibration, effect, holds: tuple[Holding, ...]):
    values = calibration.values[calibration.model.slices[effect.key]]
    return np.array_equal(held_values(calibration, effect, holding_of(effect, holds)), values)


def _lost(calibration, effect, holds, motion):
    """Return the part of the readings due to the part of an effect that is not represented."""
    model, values = invertible_values(calibration)
    holding, less = holding_of(effect, holds), values.copy()
    less[model.slices[effect.key]] = held_values(calibration, effect, holding)
    change = [sensor_output(model, effect.sensor, v, ref=motion.reference) for v in (values, less)]
    return LostEffect(effect, holding is not None, _rms(change[0] - change[1]))


def _rms(values):
    return float(np.sqrt(np.mean(values**2)))
