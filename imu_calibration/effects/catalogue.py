"""The catalogue of effects: declared once for simulation, calibration, compensation, diagnosis and planning."""

from functools import lru_cache

from imu_calibration.effects.base import AXES, SENSORS, Effect
from imu_calibration.effects.reference_effects import reference_effects
from imu_calibration.effects.sensor_effects import ACCELEROMETER, GYROSCOPE
from imu_calibration.errors import InputError

__all__ = ['AXES', 'SENSORS', 'Effect', 'catalogue', 'find_effect', 'owner_of']


@lru_cache(maxsize=8)
def catalogue(joint_names=('outer', 'middle', 'inner')):
    """Return every effect by (sensor, name) for a table with these joints."""
    every = ACCELEROMETER + GYROSCOPE + reference_effects(joint_names)
    return {(effect.sensor, effect.name): effect for effect in every if effect.size}


def find_effect(sensor, name, joint_names=('outer', 'middle', 'inner')):
    """Return the effect `name` of `sensor`, or raise `InputError` with the names there are."""
    effects = catalogue(joint_names)
    if (sensor, name) not in effects:
        known = sorted(known_name for known_sensor, known_name in effects if known_sensor == sensor)
        raise InputError(f"the {sensor} has no effect '{name}'; choose from {', '.join(known)}")
    return effects[sensor, name]


def owner_of(name, joint_names=('outer', 'middle', 'inner')):
    """Return the sensor that an effect name belongs to ('bias' and 'matrix' belong to both and are refused)."""
    owners = [sensor for sensor, known in catalogue(joint_names) if known == name]
    if len(owners) != 1:
        known = sorted({known for _, known in catalogue(joint_names)} - {'bias', 'matrix'})
        raise InputError(f"effect '{name}' is unknown or ambiguous; choose from {', '.join(known)}")
    return owners[0]
