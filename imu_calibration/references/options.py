"""Options of the estimate and of its assessment, and the model for them."""

from dataclasses import dataclass, field, replace

import numpy as np

from imu_calibration.allan.figures import NoiseFigures, bias_processes
from imu_calibration.core.readings import RawReadings
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.effects.sensor_model import (
    DEFAULT_MODEL,
    SensorModel,
    parse_effects,
    parse_reference,
    with_common_arm,
)
from imu_calibration.estimation.noise_model import BiasProcess
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import WindowSettings
from imu_calibration.references.turntable.session_data import SessionData


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of the estimate and of its assessment."""

    accelerometer_model: str | None = None
    """
    Named model or names joined by '+'; None: bias+matrix, and accel_size_effect when the rotation
    shows it.
    """
    gyroscope_model: str | None = None
    """The same; None: bias+matrix."""
    reference_model: str | None = None
    """
    Effects of table and clock joined by '+', or 'none'; None: table_tilt, and earth_rate
    unless latitude and azimuth are known.
    """
    tolerances: dict = field(default_factory=dict)
    """{section: {effect: tolerance}}."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: RawReadings | None = None
    """For recordings in volts or counts."""
    gravity: float | None = None
    """
    Local gravity where there is no table, m/s^2; None: the standard gravity, with its uncertainty.
    """
    catalogue: Catalogue = CATALOGUE
    """The effects that there are."""
    noise: NoiseFigures | None = None
    """The noise of this IMU at rest; None: bias processes estimated from the recording."""
    as_asked: bool = False
    """Whether the requested model is used unchanged, without a search of effects."""
    added: tuple[tuple[str, str], ...] = ()
    """(sensor, effect) that a recording demands on top."""
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Effect -> values of the first linearisation."""
    gravity_sd: float = 0.0
    """Standard deviation of `gravity`, m/s^2."""

    @property
    def bias_processes(self) -> dict[str, tuple[BiasProcess, ...]]:
        """Sensor -> its bias processes if measured separately."""
        return {} if self.noise is None else bias_processes(self.noise)


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
