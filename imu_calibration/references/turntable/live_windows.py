"""Live calibration on a table: windows and solutions while data arrive, as from a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.by_evidence import search_again, solve_by_evidence
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
from imu_calibration.preprocessing.stamping import StampLine
from imu_calibration.preprocessing.window import Window, WindowSettings
from imu_calibration.references.turntable.collector import (
    LiveCollector,
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
    """State of a live session at one time, which later samples do not change."""

    gathered: SessionData
    """Reduced windows of this run and of an earlier one, and the windows for the search."""
    model: SensorModel
    """The model of the columns of `gathered`."""
    table: Table
    """The reference."""
    options: CalibrationOptions
    """Options of the requested model."""
    extension: ModelExtension
    """Effects added to the requested model."""
    store: WindowStore
    """All windows of this run with their samples, as long as they fit."""
    session: int
    """Number of this run among the recordings in `gathered`."""
    temperature_c: float | None
    """The first temperature, degrees Celsius; None: no temperature received."""

    def model_for(self, options: CalibrationOptions) -> SensorModel:
        """Return the model that options request, at the first temperature if it needs one."""
        model = choose_model(options, self.table)
        if model.needs_temperature and self.temperature_c is not None:
            return model.with_reference_temperature(self.temperature_c)
        return model

    def solved(self, options: CalibrationOptions) -> SolvedWindows:
        """
        Return the solution of the model that options request.

        With all windows stored, columns are computed and linearised again as from a recording.
        Otherwise the gathered columns are solved once.
        """
        self.gathered.require_units(self.model, self.table)
        if not self.store.complete:
            data = WindowObservations(self.table, self.gathered, self.model)
            return solved_windows(data, options)
        model = self.model_for(options)
        if model.has_columns_of(self.model):
            model = self.model  # the gathered columns serve for the first pass
        return solve_in_passes(self, model, options)

    def solved_at(
        self, model: SensorModel, options: CalibrationOptions, *, judged_from: float
    ) -> SolvedWindows:
        """
        Return the solution with the columns of a model; see `WindowSource.solved_at`.

        The stored windows are reduced again if the model or the judged part is a different one.
        """
        gathered = self.gathered
        if model is not self.model or judged_from != gathered.judged_from:
            windows = self.store.reduced(model, self.table, self.session)
            gathered = gathered.with_windows(windows, judged_from)
        return solved_windows(WindowObservations(self.table, gathered, model), options)

    def evidence(self) -> Solved[Solution]:
        """Return the solution with the supported effects, as `calibrate_by_evidence`."""
        if self.store.complete:
            return solve_by_evidence(self, self.options)
        return search_again(
            self.solved(self.extension.options(self.options)), self.options, known=self.extension
        )


MAX_EARLY_BLOCKS = 200
"""Most blocks kept until the first temperature, when a thermal effect needs one."""


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
        earlier_run = None if saved is None else from_bytes(saved)
        self.earlier: SessionData | None = None
        """The reduced windows of the earlier run; they are never changed."""
        self.extension = ModelExtension()
        """Effects added to the requested model."""
        if earlier_run is not None:
            self.earlier = earlier_run.gathered
            if not options.as_asked:
                self.extension = earlier_run.extension
        self._requested_model = choose_model(self.extension.options(options), table)
        """With the added effects, at a nominal reference temperature."""
        self._early_blocks: list[SampleBlock] = []
        """Blocks before the first temperature, which the collector gets when it begins."""
        self._collector: LiveCollector | None = None
        """Finds and reduces windows; None while a thermal effect waits for a temperature."""
        self._first_temperature_c: float | None = None
        """Reference temperature of thermal effects; None before the first temperature."""
        self.result: TableResult | None = None
        """The last solution."""
        self.last: LiveSnapshot | None = None
        """The data of the last solution."""
        self.needs_linearising = False
        """
        Whether the last solution is outside the validity of its linearisation, and the store is too
        small to linearise again.
        """
        # Windows are collected from now on, unless a thermal effect waits for a temperature.
        model = self._requested_model
        if earlier_run is not None:
            if model.needs_temperature:
                self._first_temperature_c = earlier_run.model.temperature_ref_c
                model = model.with_reference_temperature(earlier_run.model.temperature_ref_c)
            require_columns(earlier_run.model, model)
        if earlier_run is not None or not model.needs_temperature:
            self._begin(model)

    observations = WindowObservations.unit
    needs_joints = True

    @property
    def n_windows(self) -> int:
        """Windows gathered so far, those of an earlier run included."""
        return sum(sum(run.accumulator.windows.values()) for run in self._runs())

    def _runs(self) -> list[SessionData]:
        """Return the data of the earlier run and of this one, where they exist."""
        runs = []
        if self.earlier is not None:
            runs.append(self.earlier)
        if self._collector is not None:
            runs.append(self._collector.gathered)
        return runs

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
        return self._requested_model.needs_temperature

    @property
    def frame_id(self) -> str:
        """Frame of the sensor; '' before the first message."""
        for run in self._runs():
            if run.frame_id:
                return run.frame_id
        return ''

    def change(self, settings: LiveSettings | WindowSettings | LiveByHandSettings) -> bool:
        """
        Use other settings from now on, and return whether the windows have to be solved again.

        That is never so on a table; its description has the gravity, and settings of gravity
        are ignored. Raises an InputError for settings that can no longer be changed.
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
        temperature = block.temperature
        if self._first_temperature_c is None and temperature is not None and len(temperature):
            self._first_temperature_c = float(temperature.temperature_c[0])
        if self._collector is None:
            return self._push_before_temperature(block)
        return self._collector.push(block)

    def _push_before_temperature(self, block: SampleBlock) -> list[Window]:
        """
        Keep a block until the first temperature, then process all kept blocks.

        Returns the windows that they completed.
        """
        self._early_blocks.append(block)
        del self._early_blocks[:-MAX_EARLY_BLOCKS]
        if self._first_temperature_c is None:
            return []
        model = self._requested_model.with_reference_temperature(self._first_temperature_c)
        collector = self._begin(model)
        early_blocks = self._early_blocks
        self._early_blocks = []
        windows = []
        for early_block in early_blocks:
            windows += collector.push(early_block)
        return windows

    def _begin(self, model: SensorModel) -> LiveCollector:
        """Make the collector of this run, with the columns of a model, and return it."""
        session = 0
        if self.earlier is not None:
            session = 1 + max((row.session for row in self.earlier.accumulator.rows), default=-1)
        store = WindowStore(self.settings.store_samples, self.earlier is None)
        self._collector = LiveCollector(
            self.table, model, self.options, session=session, store=store
        )
        return self._collector

    def solve(self, pending: bool = False, provenance: dict | None = None) -> TableResult:
        """
        Solve the gathered data and return the result, which is kept in `result`.

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
        collector = self._require_collector()
        collector.gatherer.cleaner.sources.require_one()
        gathered, store = collector.snapshot(pending)
        snapshot = LiveSnapshot(
            gathered=self._with_earlier(gathered),
            model=collector.model,
            table=self.table,
            options=self.options,
            extension=self.extension,
            store=store,
            session=collector.session,
            temperature_c=self._first_temperature_c,
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
        # Effects are adopted after a solution only, from its diagnosis.
        if collector is None or self.last is None:
            return False
        if self.options.as_asked:
            return False
        if extension.is_nothing and self.extension.is_nothing:
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
        return to_bytes(self.gathered(pending), self._require_collector().model, self.extension)

    def _require_collector(self) -> LiveCollector:
        """Return the collector; raises an InputError while no temperature was received."""
        if self._collector is None:
            raise InputError(
                'a thermal effect needs temperatures, none were received; publish imu/temperature'
                ' or omit the effect',
                code='temperature_missing',
            )
        return self._collector

    def _with_earlier(self, gathered: SessionData) -> SessionData:
        """Return data of this run merged with those of the earlier run."""
        if self.earlier is None:
            return gathered
        return merge([self.earlier, gathered])

    def residuals(self, windows: Sequence[Window]) -> ImuSamples | None:
        """
        Return measured minus predicted samples of windows from `push`.

        Every k-th sample of a window, so that there are at most `residual_rate` per second. None
        before the first solution.
        """
        if self.result is None or not windows or not self.settings.residual_rate:
            return None
        return ImuSamples.concatenate([self._residual(window) for window in windows])

    def _residual(self, window: Window) -> ImuSamples:
        """Return every k-th residual of a window, NaN for a sensor without readings."""
        stride = max(int(np.ceil(1.0 / max(window.period * self.settings.residual_rate, 1e-9))), 1)
        middle = stride // 2  # of each `stride` samples, one of which is published
        published = slice(middle if len(window) > middle else 0, None, stride)
        # Residuals exist after a solution of the gathered windows.
        assert self.result is not None and self._collector is not None
        # Of all samples, because a lag interpolates between them.
        residuals = self.result.residuals_of(window)
        absent = np.full((len(window), 3), np.nan)
        return ImuSamples(
            window.stamp_ns[published],
            residuals.get('accelerometer', absent)[published],
            residuals.get('gyroscope', absent)[published],
            self._collector.gathered.frame_id,
        )

    def coverage(self) -> Coverage:
        """Return the Coverage: the gain of each attitude, and the motion with the largest gain."""
        if self.result is None:
            return replace(NOTHING_SEEN, frame_id=self.frame_id)
        return table_coverage(self.result, self.frame_id)

    def waiting(self) -> list[GroupState]:
        """Return the state of every effect before the first solution."""
        return [] if self.model is None else waiting_groups(self.model)
