"""Data of a live session at one time, for a solution and a search of effects while the session runs."""

from collections.abc import Callable
from dataclasses import dataclass

from imu_calibration.calibration.by_evidence import EvidentSolution, Solved, ask_kept, solve_by_evidence
from imu_calibration.calibration.model_changes import Demand
from imu_calibration.calibration.table_calibration import solve_gathered
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.joint_checks import check_units
from imu_calibration.references.options import CalibrationOptions, choose_model
from imu_calibration.references.turntable.gathered import Gathered
from imu_calibration.references.turntable.window_store import WindowStore
from imu_calibration.selection.linearisation import PASSES, linearise_again


@dataclass(frozen=True, eq=False)
class LiveSnapshot:
    """Unchanging copies of the gathered data."""

    gathered: Gathered
    """An earlier run included, with the windows of the search."""
    model: SensorModel
    """The model of its columns."""
    table: Table
    """The reference."""
    options: CalibrationOptions
    """Options of the requested model."""
    demand: Demand
    """Effects added to the model."""
    store: WindowStore
    """The windows of this run, while they are all kept."""
    session: int
    """Number of this run."""
    temperature_c: float | None
    """The first temperature, degrees Celsius; None: no temperature received."""

    def model_for(self, options: CalibrationOptions) -> SensorModel:
        """Return the model of the columns for options."""
        model = choose_model(options, self.table)
        return model.with_reference_temperature(self.temperature_c) if model.needs_temperature and self.temperature_c is not None else model

    def solved(self, options: CalibrationOptions) -> Solved:
        """
        Return (Solution, Gathered, SensorModel of the columns) for other options, as from a recording.

        If the windows are no longer kept, the gathered columns are used.
        """
        model, total, moved = self.model, self.gathered, self.model_for(options)
        check_units(total, model, self.table)
        if not self.store.complete or moved.has_columns_of(model):
            moved = model
        for _ in range(PASSES):
            if moved is not model:
                model, total = moved, total.anew(self.store.reduced(moved, self.table, self.session))
            solution = solve_gathered(total, model, options)
            moved = linearise_again(model, solution)
            if moved is None or not self.store.complete:
                break
        return solution, total, model

    def evidence(self, asking: Callable | None = None) -> EvidentSolution:
        """Return the solution with the supported effects, as `calibrate_by_evidence`; `asking` is called with the completed share."""
        if self.store.complete:
            return solve_by_evidence(self.solved(self.options), self.table, self.options, solve_again=self.solved, asking=asking)
        return ask_kept(self.solved(self.demand.options(self.options)), self.table, self.options, known=self.demand, asking=asking)
