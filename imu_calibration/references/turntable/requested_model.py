"""The model that options request for recordings on a table."""

from dataclasses import replace

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.effects.sensor_model import (
    DEFAULT_MODEL,
    SensorModel,
    parse_effects,
    parse_reference,
    with_common_arm,
)
from imu_calibration.kinematics.table import Table
from imu_calibration.references.turntable.session_data import SessionData


def choose_model(options: CalibrationOptions, table: Table) -> SensorModel:
    """
    Return the model of the gathered columns.

    `settle_model` removes the size effect if the rotation does not determine it.

    With an unknown place of the mount, the size effect includes a common `lever_arm` and the origin
    is the mean of the three sensitive points.
    """
    names = table.joint_names
    asked = {'accelerometer': options.accelerometer_model, 'gyroscope': options.gyroscope_model}
    chosen = {
        sensor: parse_effects(
            sensor, text or DEFAULT_MODEL[sensor], names, catalogue=options.catalogue
        )
        for sensor, text in asked.items()
    }
    model = SensorModel(
        chosen['accelerometer'],
        chosen['gyroscope'],
        reference=parse_reference(options.reference_model, table),
        joint_names=names,
        catalogue=options.catalogue,
    )
    model = with_common_arm(model) if table.mount_xyz is None else model
    for sensor, name in options.added:
        model = model if (sensor, name) in model.slices else model.with_effect(sensor, name)
    known = {effect.name for effect in model.effects}
    point = {name: value for name, value in options.point.items() if name in known}
    return replace(model, point={**model.point, **point})


def settle_model(
    model: SensorModel, options: CalibrationOptions, gathered: SessionData
) -> SensorModel:
    """
    Return the model without the size effect if it is neither requested nor determined.

    The effect is removed if it was not requested and the recording has no rotation that determines
    it.
    """
    turns = any(gathered.accumulator.samples.get(kind) for kind in ('spin', 'dynamic'))
    return model if options.accelerometer_model is not None or turns else model.without_arms()
