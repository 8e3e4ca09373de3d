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
    Return the model that options request, with the size effect of the accelerometer by default.

    `settle_model` removes the size effect after the windows are gathered, if the rotation does not
    determine it. With an unknown place of the mount, it includes a common `lever_arm`, and the
    origin is the mean of the three sensitive points.
    """
    names = table.joint_names
    effects = {}
    for sensor, text in (
        ('accelerometer', options.accelerometer_model),
        ('gyroscope', options.gyroscope_model),
    ):
        effects[sensor] = parse_effects(
            sensor, text or DEFAULT_MODEL[sensor], names, catalogue=options.catalogue
        )
    model = SensorModel(
        effects['accelerometer'],
        effects['gyroscope'],
        reference=parse_reference(options.reference_model, table),
        joint_names=names,
        catalogue=options.catalogue,
    )
    if table.mount_xyz is None:
        model = with_common_arm(model)
    for sensor, name in options.added:
        if (sensor, name) not in model.slices:
            model = model.with_effect(sensor, name)
    in_model = {effect.name for effect in model.effects}
    point = {name: value for name, value in options.point.items() if name in in_model}
    return replace(model, point={**model.point, **point})


def settle_model(
    model: SensorModel, options: CalibrationOptions, gathered: SessionData
) -> SensorModel:
    """
    Return the model without the size effect if it is neither requested nor determined.

    Only windows with a rotation determine it.
    """
    if options.accelerometer_model is not None:
        return model
    samples = gathered.accumulator.samples
    if samples.get('spin') or samples.get('dynamic'):
        return model
    return model.without_arms()
