"""Options of the estimate and of its assessment, and the model for them."""

from dataclasses import dataclass, field

import numpy as np

from imu_calibration.allan.figures import NoiseFigures, bias_processes
from imu_calibration.core.readings import RawReadings
from imu_calibration.effects.catalogue import CATALOGUE, Catalogue
from imu_calibration.estimation.sensor_noise import BiasProcess
from imu_calibration.preprocessing.window import WindowSettings


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
