"""
Calibration during the motion, its settings and snapshots.

Windows and solutions while data arrive, with the same result as offline.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import numpy as np

from imu_calibration.calibration.coverage import Coverage, GroupState, group_states
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.core.progress import LiveState
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.core.settings import height_setting, setting
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.rotations import gravity_of_settings
from imu_calibration.preprocessing.stamping import StampLine
from imu_calibration.preprocessing.window import WindowSettings

Place = tuple[float | None, float]
"""Local gravity (None: unknown) and its standard deviation, m/s^2."""


@dataclass(frozen=True)
class LiveSettings:
    """Solving interval, storage and published data."""

    solve_share: float = setting(
        0.1,
        '1',
        'largest share of the time for solving after each window',
        (0.001, 1.0),
        'too small: late results; too large: the node uses a whole core',
        live=True,
    )
    residual_rate: float = setting(
        20.0,
        'Hz',
        'residuals published per second of data; 0: none',
        (0.0, 10000.0),
        'too large: publishing needs more time than calibration',
        live=True,
    )
    store_samples: int = setting(
        300_000,
        '1',
        'samples in motion kept, '
        'so that effects can be added to the model or linearised again (table tilt, delays); '
        'about 250 bytes each',
        (0, 100_000_000),
        'too small: effects that the data support cannot be added to the model, '
        'and the result on a strongly tilted table is that of the first pass, see diagnostics',
        fixed='windows that were not kept are lost',
    )
    diagnosis_period: float = setting(
        60.0,
        's',
        'shortest time between diagnoses, in a separate thread with a fifth '
        'of the time at most; also when the streams stop and with ~/solve and ~/save; '
        'supported effects are added to the model; '
        '0: never',
        (0.0, 86400.0),
        'too small: the diagnosis occupies a core',
        live=True,
    )


@dataclass(frozen=True)
class LiveByHandSettings:
    """Local gravity, and memory of a calibration by hand."""

    gravity: float = setting(
        0.0,
        'm/s^2',
        'local gravity; a table_file must state none, or the same; 0: that of table_file, otherwise'
        ' the standard gravity, which may be off by 0.02',
        (0.0, 30.0),
        'all three accelerometer scales are wrong together',
        live=True,
        session=True,
    )
    latitude: float = setting(
        100.0,
        'deg',
        'latitude, used as gravity is, if that is 0 (WGS 84 normal gravity); above 90: unknown',
        (-90.0, 100.0),
        'as with a wrong gravity',
        live=True,
        session=True,
    )
    height: float = height_setting(session=True)
    hand_samples: int = setting(
        800_000,
        '1',
        'Imu samples kept without a table, about 60 bytes each (800000: over an hour at 200 Hz); '
        'beyond them the inside of the longest rest is forgotten, then the oldest',
        (2000, 100_000_000),
        'too small: poses are dropped, see diagnostics',
        live=True,
    )

    @property
    def place(self) -> Place:
        """The local gravity (None: unknown) and its standard deviation, m/s^2."""
        gravity, gravity_sd = gravity_of_settings(self.gravity, self.latitude, self.height)
        return gravity or None, gravity_sd

    def at_place(self, options: CalibrationOptions) -> CalibrationOptions:
        """Return the options with the gravity of these settings and its standard deviation."""
        gravity, gravity_sd = self.place
        return replace(options, gravity=gravity, gravity_sd=gravity_sd)


class SolvePacer:
    """Schedules the next solution so that solving uses at most a given share of the time."""

    def __init__(self, share: float):
        self._share = share
        # Time from which the next solution is due, s.
        self._next = -np.inf

    def due(self, now: float) -> bool:
        """Return whether enough time has passed; `now` in s of a steady clock."""
        return now >= self._next

    def note(self, start: float, end: float) -> None:
        """Record a solution that was computed from `start` to `end`."""
        self._next = start + (end - start) / self._share


class LiveSession(Protocol):
    """
    A calibration during the motion: `push` for arriving samples, `solve` when it is due.

    A reference overrides what it has: diagnosis, coverage before a solution, a status.
    """

    observations: ClassVar[str]
    """Unit of the data: 'windows' or 'poses'."""
    needs_joints: ClassVar[bool]
    """Whether joint states are needed."""
    options: CalibrationOptions
    """Options of the requested model."""
    settings: LiveSettings
    result: CalibrationResult[Any] | None
    """The last solution."""
    last: Any = None
    """Data of the last solution for a diagnosis; None where there is none."""
    needs_linearising: bool = False
    """Whether the last solution is outside the validity of its linearisation."""

    @property
    def n_windows(self) -> int:
        """Windows or poses so far."""

    @property
    def n_covered(self) -> int:
        """Observations that the coverage shows before they are solved."""
        return 0

    @property
    def model(self) -> SensorModel | None:
        """The model, as far as known before a solution."""

    @property
    def frame_id(self) -> str:
        """Frame of the sensor; '' before the first message."""

    @property
    def stamping(self) -> StampLine | None:
        """How the stamps of the IMU are; None while that is not known."""

    @property
    def counts(self) -> dict[str, int]:
        """Samples by their use."""

    @property
    def needs_temperature(self) -> bool:
        """Whether a requested effect depends on temperature."""
        return False

    @property
    def diagnosis_period(self) -> float:
        """Shortest time between diagnoses while it runs, s; 0: none."""
        return 0.0

    def diagnosed(self, state: LiveState) -> LiveState | None:
        """Return the shown state of the diagnosis; None without one."""
        return None

    def adopt(self, extension: ModelExtension) -> bool:
        """Add the effects of a diagnosis; return whether the model changes."""
        return False

    def change(self, settings: LiveSettings | WindowSettings | LiveByHandSettings) -> bool:
        """Use other settings from now on; return whether the data have to be solved again."""

    def push(self, block: SampleBlock) -> Sequence[Any]:
        """Process a block and return the windows or poses that it completed."""

    def solve(
        self, pending: bool = False, provenance: dict | None = None
    ) -> CalibrationResult[Any]:
        """Solve the data and return the result; `pending`: as at the end of a recording."""

    def saved(self, pending: bool = False) -> bytes:
        """Return the data as bytes, for another run."""

    def residuals(self, observations: Sequence[Any]) -> ImuSamples | None:
        """Return measured minus predicted of observations from `push`; None before a solution."""

    def waiting(self) -> list[GroupState]:
        """Return the state of every effect before the first solution."""

    def groups(self) -> list[GroupState]:
        """Return the state of every effect."""
        return self.waiting() if self.result is None else group_states(self.result)

    def coverage(self) -> Coverage:
        """Return the directions that the calibration covers, and the next motion."""

    def status(self, hints: dict[str, str] | None = None) -> LiveState | None:
        """Return the progress; None where the states of the effects have it."""
        return None
