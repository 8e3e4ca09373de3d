"""Common interface of live calibrations, and the snapshot that a worker solves."""

from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.by_evidence import EvidentSolution, Solved, ask_kept, solve_by_evidence
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.table_calibration import solve_gathered, solve_in_passes
from imu_calibration.core.settings import setting
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import local_gravity
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.joint_checks import check_units
from imu_calibration.references.options import CalibrationOptions, choose_model
from imu_calibration.references.turntable.session_data import SessionData, WindowStore


@dataclass(frozen=True, eq=False)
class LiveSnapshot:
    """Unchanging copies of the gathered data."""

    gathered: SessionData
    """An earlier run included, with the windows of the search."""
    model: SensorModel
    """The model of its columns."""
    table: Table
    """The reference."""
    options: CalibrationOptions
    """Options of the requested model."""
    extension: ModelExtension
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
        Return (Solution, SessionData, SensorModel of the columns) for other options, as from a recording.

        If the windows are no longer kept, the gathered columns are used.
        """
        check_units(self.gathered, self.model, self.table)
        if not self.store.complete:
            return solve_gathered(self.gathered, self.model, options), self.gathered, self.model

        def solved(model, judged_from):
            known = model is self.model and judged_from == self.gathered.judged_from
            total = self.gathered if known else self.gathered.anew(self.store.reduced(model, self.table, self.session), judged_from)
            return solve_gathered(total, model, options), total
        asked = self.model_for(options)
        return solve_in_passes(self.model if asked.has_columns_of(self.model) else asked, options, solved)

    def evidence(self) -> EvidentSolution:
        """Return the solution with the supported effects, as `calibrate_by_evidence`."""
        if self.store.complete:
            return solve_by_evidence(self.solved(self.options), self.table, self.options, solve_again=self.solved)
        return ask_kept(self.solved(self.extension.options(self.options)), self.table, self.options, known=self.extension)


@dataclass(frozen=True)
class LiveSettings:
    """Solving interval, storage and published data."""

    solve_share: float = setting(0.1, '1', 'largest share of the time for solving after each window', (0.001, 1.0),
                                 'too small: late results; too large: the node uses a whole core', live=True)
    residual_rate: float = setting(20.0, 'Hz', 'residuals published per second of data; 0: none', (0.0, 10000.0),
                                   'too large: publishing needs more time than calibration', live=True)
    store_samples: int = setting(300_000, '1', 'samples in motion kept, '
                                 'so that effects can be added to the model or linearised again (table tilt, delays); '
                                 'about 250 bytes each', (0, 100_000_000),
                                 'too small: effects that the data support cannot be added to the model, '
                                 'and the result on a strongly tilted table is that of the first pass, see diagnostics',
                                 fixed='windows that were not kept are lost')
    diagnosis_period: float = setting(60.0, 's', 'shortest time between diagnoses, in a separate thread with a fifth '
                                      'of the time at most; also when the streams stop and with ~/solve and ~/save; '
                                      'supported effects are added to the model; '
                                      '0: never', (0.0, 86400.0), 'too small: the diagnosis occupies a core', live=True)


@dataclass(frozen=True)
class LiveByHandSettings:
    """Reference and memory of a calibration by hand."""

    gravity: float = setting(0.0, 'm/s^2', 'local gravity, used without a table; 0: the standard gravity, which may be off by 0.02',
                             (0.0, 30.0), 'all three accelerometer scales are wrong together',
                             live=True, session=True)
    latitude: float = setting(100.0, 'deg', 'latitude, used without a table if gravity is 0 (WGS 84 normal gravity); above 90: unknown',
                              (-90.0, 100.0), 'as with a wrong gravity', live=True, session=True)
    height: float = setting(0.0, 'm', 'height above the ellipsoid, used with latitude', (-500.0, 9000.0), '3e-6 m/s^2 of gravity per metre',
                            live=True, session=True)
    hand_samples: int = setting(800_000, '1', 'Imu samples kept without a table, about 60 bytes each (800000: over an hour at 200 Hz); '
                                'beyond them the inside of the longest rest is forgotten, then the oldest', (2000, 100_000_000),
                                'too small: poses are dropped, see diagnostics', live=True)

    def at_place(self, options: CalibrationOptions) -> CalibrationOptions:
        """Return the options with the gravity of these settings and its standard deviation."""
        place = () if self.gravity or self.latitude > 90 else (self.latitude, self.height)
        gravity, spread = local_gravity(self.gravity or None, *place)
        return replace(options, gravity=gravity, gravity_sd=spread)


class SolvePacer:
    """Schedules the next solution so that solving uses at most a given share of the time."""

    def __init__(self, share: float):
        self._share, self._next = share, -np.inf

    def due(self, now: float) -> bool:
        """Return whether enough time has passed; `now` in s of a steady clock."""
        return now >= self._next

    def note(self, start: float, end: float) -> None:
        """Record a solution that was computed from `start` to `end`."""
        self._next = start + (end - start) / self._share
