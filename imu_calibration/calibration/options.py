"""What to estimate and how to judge it, and the model that follows from it."""

from dataclasses import dataclass, field

from imu_calibration.effects.sensor_model import SensorModel, parse_effects
from imu_calibration.segmentation.window_settings import WindowSettings


@dataclass(frozen=True)
class CalibrationOptions:
    """What to estimate and how to judge it."""

    accelerometer_model: str | None = None
    """Named model or names joined by '+'; None: bias+matrix, and accel_size_effect when the rotation shows it."""
    gyroscope_model: str | None = None
    """The same; None: bias+matrix."""
    reference_model: str | None = None
    """Effects of table and clock joined by '+', or 'none'; None: table_tilt, and earth_rate when latitude or azimuth is unknown."""
    tolerances: dict = field(default_factory=dict)
    """{section: {effect: tolerance}}."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: object | None = None
    """NominalScaling for recordings in volts or counts."""


def choose_model(options, table, temperature_c=None):
    """
    Return the model whose columns are gathered; `settle_model` takes out what the rotation does not show.

    With an unknown place of the mount, the size effect comes with a common `lever_arm` and the origin is the mean of the three
    sensitive points.
    """
    names = table.joint_names
    accelerometer = parse_effects('accelerometer', options.accelerometer_model or 'bias+matrix+accel_size_effect', names)
    gyroscope = parse_effects('gyroscope', options.gyroscope_model or 'bias+matrix', names)
    if 'accel_size_effect' in accelerometer and table.mount_xyz is None and 'lever_arm' not in accelerometer:
        accelerometer += ('lever_arm',)
    if options.reference_model is None:
        reference = ('table_tilt',) + (('earth_rate',) if table.latitude is None or table.azimuth_deg is None else ())
    else:
        reference = tuple(name for name in options.reference_model.split('+') if name not in ('', 'none'))
    reference_c = 25.0 if temperature_c is None else float(round(temperature_c))
    return SensorModel(accelerometer, gyroscope, reference, names, reference_c)


def settle_model(model, options, gathered):
    """Return the model without the size effect when nobody asked for it and the recording holds no rotation that shows it."""
    if options.accelerometer_model is not None:
        return model
    if gathered.accumulator.samples.get('spin', 0) + gathered.accumulator.samples.get('dynamic', 0) == 0:
        return model.without('accelerometer', 'accel_size_effect').without('accelerometer', 'lever_arm')
    return model
