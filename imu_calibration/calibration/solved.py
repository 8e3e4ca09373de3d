"""A solution with the data that it was solved from, for any reference."""

from dataclasses import dataclass
from typing import Generic, Protocol

from imu_calibration.calibration.from_solution import Estimate, ModelExtension
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import Observations
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.selection.selected_effects import SelectedEffects


@dataclass(frozen=True, eq=False)
class Solved(Generic[Estimate]):
    """A solution with the data that it was solved from, and the search that chose its model."""

    solution: Estimate
    """Estimate of all parameters."""
    data: Observations[Estimate]
    """What the reference gathered."""
    extension: ModelExtension = ModelExtension()
    """Effects that the search added; nothing without a search."""
    search: SelectedEffects | None = None
    """Result of the search; None without one, or with too few data."""

    @property
    def model(self) -> SensorModel:
        """The model of the solution."""
        return self.solution.model


class ModelSource(Protocol[Estimate]):
    """Recordings of one IMU with a reference, or a live session."""

    def solved(self, options: CalibrationOptions) -> Solved[Estimate]:
        """Return the solution of the model that options request, at a valid linearisation."""
