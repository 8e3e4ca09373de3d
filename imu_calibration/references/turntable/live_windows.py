"""Live calibration on a table: windows and solutions while data arrive, as from a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from imu_calibration.calibration.by_evidence import ask_kept, solve_by_evidence
from imu_calibration.calibration.calibrate import conclude
from imu_calibration.calibration.coverage import (
    NOTHING_SEEN,
    Coverage,
    GroupState,
    waiting_groups,
)
from imu_calibration.calibration.from_solution import ModelExtension
from imu_calibration.calibration.live import LiveByHandSettings, LiveSession, LiveSettings
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.solved import Solved
from imu_calibration.core.errors import InputError
from imu_calibration.core.progress import LiveState
from imu_calibration.core.samples import ImuSamples, SampleBlock
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.joint_checks import check_units
from imu_calibration.preprocessing.stamping import StampLine
from imu_calibration.preprocessing.window import Window, WindowSettings
from imu_calibration.references.turntable.collector import (
    LiveCollector,
    copied,
    from_bytes,
    require_columns,
    to_bytes,
)
from imu_calibration.references.turntable.repeated_linearisation import linearise_again
from imu_calibration.references.turntable.requested_model import choose_model
from imu_calibration.references.turntable.session_data import SessionData, WindowStore, merge
from imu_calibration.references.turntable.table_calibration import (
    SolvedWindows,
    solve_in_passes,
    solved_windows,
)
from imu_calibration.references.turntable.table_coverage import table_coverage
from imu_calibration.references.turntable.window_observations import TableResult, WindowObservations


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
        return (
            model.with_reference_temperature(self.temperature_c)
            if model.needs_temperature and self.temperature_c is not None
            else model
        )

    def solved(self, options: CalibrationOptions) -> SolvedWindows:
        """
        Return the solution for other options, as from a recording.

        If the windows are no longer kept, the gathered columns are used.
        """
        check_units(self.gathered, self.model, self.table)
        if not self.store.complete:
            data = WindowObservations(self.table, self.gathered, self.model)
            return solved_windows(data, options)
        asked = self.model_for(options)
        model = self.model if asked.has_columns_of(self.model) else asked
        return solve_in_passes(self, model, options)

    def solved_at(
        self, model: SensorModel, options: CalibrationOptions, *, judged_from: float
    ) -> SolvedWindows:
        """Reduce the stored windows once more, if other columns or a part of them are wanted."""
        total = self.gathered
        if model is not self.model or judged_from != self.gathered.judged_from:
            reduced = self.store.reduced(model, self.table, self.session)
            total = self.gathered.anew(reduced, judged_from)
        return solved_windows(WindowObservations(self.table, total, model), options)

    def evidence(self) -> Solved[Solution]:
        """Return the solution with the supported effects, as `calibrate_by_evidence`."""
        if self.store.complete:
            return solve_by_evidence(self, self.options)
        return ask_kept(
            self.solved(self.extension.options(self.options)), self.options, known=self.extension
        )


HELD_BACK = 200
"""Blocks that wait for the first temperature at most, when a thermal effect needs one."""


class LiveCalibration(LiveSession):
    """
    One live session: `push` for new blocks, `solve` when it is due.

    Windows are found and reduced by the same objects as for recordings, and solved by the same
    functions, so that the result is that of `calibrate_by_evidence` on the same samples, after the
    search of effects (`last`, `LiveSnapshot.evidence`) and `adopt`. Memory is bounded: samples in
    reduced form, a bounded store of windows for columns that must be computed again.

    Parameters
    ----------
    table : Table
        The reference.
    options : CalibrationOptions
        Model and settings of the estimate.
    settings : LiveSettings
    saved : bytes, optional
        The bytes from `saved` of an earlier run; this session is then merged with it, at its
        reference temperature.

    Raises
    ------
    DocumentError
        When the earlier run gathered another model, or `saved` is damaged.

    """

    def __init__(
        self,
        table: Table,
        options: CalibrationOptions = CalibrationOptions(),
        settings: LiveSettings = LiveSettings(),
        *,
        saved: bytes | None = None,
    ):
        self.table = table
        self.options = options
        self.settings = settings
        self.earlier, known, extension = (
            (None, None, ModelExtension()) if saved is None else from_bytes(saved)
        )
        self.extension = ModelExtension() if options.as_asked else extension
        """Effects added to the requested model."""
        self._asked = choose_model(self.extension.options(options), table)
        self._waiting: list[SampleBlock] = []
        self._collector: LiveCollector | None = None
        self._first_temperature_c: float | None = None
        self.result: TableResult | None = None
        self.last: LiveSnapshot | None = None
        """The data of the last solution."""
        self.needs_linearising = False
        """
        Whether the last solution is outside the validity of its linearisation, and the store is too
        small to linearise again.
        """
        asked = self._asked
        if known is not None:
            if asked.needs_temperature:
                self._first_temperature_c = known.temperature_ref_c
                asked = asked.with_reference_temperature(known.temperature_ref_c)
            require_columns(known, asked)
        if known is not None or not asked.needs_temperature:
            self._begin(asked)

    observations = WindowObservations.unit
    needs_joints = True

    @property
    def n_windows(self) -> int:
        """Windows gathered so far, those of an earlier run included."""
        parts = (self.earlier, self._collector and self._collector.gathered)
        return sum(sum(part.accumulator.windows.values()) for part in parts if part)

    @property
    def counts(self) -> dict[str, int]:
        """Samples of this run by their use."""
        if self._collector is None:
            return {}
        self._collector.update_counts()
        return dict(self._collector.gathered.counts)

    @property
    def stamping(self) -> StampLine | None:
        """How the stamps of the IMU are (`stamping.StampLine`); None while that is not known."""
        return None if self._collector is None else self._collector.gatherer.cleaner.stamping

    @property
    def needs_temperature(self) -> bool:
        """Whether a requested effect depends on temperature."""
        return self._asked.needs_temperature

    @property
    def frame_id(self) -> str:
        """Frame of the sensor; '' before the first message."""
        known = []
        for part in (self.earlier, self._collector and self._collector.gathered):
            if part:
                known.append(part.frame_id)
        return next(filter(None, known), '')

    def change(self, settings: LiveSettings | WindowSettings | LiveByHandSettings) -> bool:
        """
        Use other settings from now on, those of gravity without effect.

        Return whether the windows have to be solved again.

        Raises an InputError when they cannot be changed any more.
        """
        if isinstance(settings, LiveSettings):
            self.settings = settings
        elif isinstance(settings, WindowSettings):
            if self._collector is not None:
                self._collector.gatherer.change(settings)
            self.options = replace(self.options, windows=settings)
        return False

    @property
    def diagnosis_period(self) -> float:
        """Shortest time between diagnoses while it runs, s; 0: none."""
        return self.settings.diagnosis_period

    def diagnosed(self, state: LiveState) -> LiveState | None:
        """Return the shown state of the diagnosis."""
        return state

    @property
    def model(self) -> SensorModel | None:
        """
        The model of the gathered columns.

        None while a thermal effect waits for the first temperature.
        """
        return None if self._collector is None else self._collector.model

    def push(self, block: SampleBlock) -> list[Window]:
        """
        Process a block and return the windows that it completed (list of Window).

        Raises
        ------
        InputError
            When the joint states do not contain the table's joints.

        """
        if (
            self._first_temperature_c is None
            and block.temperature is not None
            and len(block.temperature)
        ):
            self._first_temperature_c = float(block.temperature.temperature_c[0])
        if self._collector is None:
            return self._push_before_temperature(block)
        return self._collector.push(block)

    def _push_before_temperature(self, block: SampleBlock) -> list:
        self._waiting.append(block)
        del self._waiting[:-HELD_BACK]
        if self._first_temperature_c is None:
            return []
        self._begin(self._asked.with_reference_temperature(self._first_temperature_c))
        # Made by `_begin`.
        assert self._collector is not None
        blocks, self._waiting = self._waiting, []
        return list(chain.from_iterable(map(self._collector.push, blocks)))

    def _begin(self, model: SensorModel) -> None:
        session = 0
        if self.earlier is not None:
            session = 1 + max((row.session for row in self.earlier.accumulator.rows), default=-1)
        store = WindowStore(self.settings.store_samples, self.earlier is None)
        self._collector = LiveCollector(
            self.table, model, self.options, session=session, store=store
        )

    def solve(self, pending: bool = False, provenance: dict | None = None) -> TableResult:
        """
        Solve the gathered data and return the CalibrationResult, which is kept in `result`.

        Parameters
        ----------
        pending : bool
            Include the windows that are still open, as at the end of a recording; the session
            itself is unchanged.
        provenance : dict, optional
            For the document.

        Raises
        ------
        NotObservableError
            When no window is complete yet, or no parameter is determined.
        InputError
            When the units are plainly wrong, or the stream holds the readings of two IMUs.

        """
        collector = self._begun()
        collector.gatherer.cleaner.sources.require_one()
        gathered, store = collector.snapshot(pending)
        snapshot = LiveSnapshot(
            self._with_earlier(gathered),
            collector.model,
            self.table,
            self.options,
            self.extension,
            store,
            collector.session,
            self._first_temperature_c,
        )
        options = self.extension.options(self.options)
        solved = snapshot.solved(options)
        extended = replace(
            solved, solution=self.extension.applied(solved.solution), extension=self.extension
        )
        self.result = conclude(extended, options, provenance=provenance)
        self.last = snapshot
        self.needs_linearising = linearise_again(solved.data.model, solved.solution) is not None
        return self.result

    def adopt(self, extension: ModelExtension) -> bool:
        """
        Add the effects that windows of this session support to the model of all further solutions.

        Return whether the model changes.

        No change with the option `as_asked`, or when windows that need other columns are no longer
        kept.
        """
        collector = self._collector
        if (
            collector is None
            or self.last is None
            or self.options.as_asked
            or extension.is_nothing
            and self.extension.is_nothing
        ):
            return False
        model = self.last.model_for(extension.options(self.options))
        if not model.has_columns_of(collector.model):
            if not collector.store.complete:
                return False
            collector.take_model(model)
        self.extension = extension
        return True

    def gathered(self, pending: bool = False) -> SessionData:
        """Return all gathered data, an earlier run included, to be saved."""
        if self._collector is None:
            return self.earlier or SessionData()
        return self._with_earlier(self._collector.snapshot(pending)[0])

    def saved(self, pending: bool = False) -> bytes:
        """Return all gathered data as bytes, for another run (`collector.to_bytes`)."""
        return to_bytes(self.gathered(pending), self._begun().model, self.extension)

    def _begun(self) -> LiveCollector:
        if self._collector is None:
            raise InputError(
                'a thermal effect needs temperatures, none were received; publish imu/temperature'
                ' or omit the effect',
                code='temperature_missing',
            )
        return self._collector

    def _with_earlier(self, gathered: SessionData) -> SessionData:
        if self.earlier is None:
            return gathered
        return merge([copied(self.earlier), gathered])

    def residuals(self, windows: Sequence[Window]) -> ImuSamples | None:
        """
        Return measured minus predicted of windows from `push`, as ImuSamples.

        Or None before the first solution.

        Every k-th sample, so that there are at most `residual_rate` per second.
        """
        if self.result is None or not windows or not self.settings.residual_rate:
            return None
        return ImuSamples.concatenate([self._residual(window) for window in windows])

    def _residual(self, window: Window) -> ImuSamples:
        every = max(int(np.ceil(1.0 / max(window.period * self.settings.residual_rate, 1e-9))), 1)
        some = slice(every // 2 if len(window) > every // 2 else 0, None, every)
        # Residuals exist after a solution of the gathered windows.
        assert self.result is not None and self._collector is not None
        # Of all samples, because a lag interpolates between them.
        residuals = self.result.residuals_of(window)
        absent = np.full((len(window), 3), np.nan)
        return ImuSamples(
            window.stamp_ns[some],
            residuals.get('accelerometer', absent)[some],
            residuals.get('gyroscope', absent)[some],
            self._collector.gathered.frame_id,
        )

    def coverage(self) -> Coverage:
        """Return the Coverage: the gain of each attitude, and the motion with the largest gain."""
        return (
            replace(NOTHING_SEEN, frame_id=self.frame_id)
            if self.result is None
            else table_coverage(self.result, self.frame_id)
        )

    def waiting(self) -> list[GroupState]:
        """Return the state of every effect before the first solution."""
        return [] if self.model is None else waiting_groups(self.model)
