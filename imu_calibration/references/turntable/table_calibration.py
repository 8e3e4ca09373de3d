"""Calibration on a table."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from imu_calibration.calibration.calibrate import conclude
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.solved import Solved
from imu_calibration.core.errors import DocumentError, InputError
from imu_calibration.core.processes import in_processes
from imu_calibration.core.progress import counter, report
from imu_calibration.core.samples import BlockSource
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.trust import judged_from_of, latest_settling
from imu_calibration.effects.base import Role
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.window import StoredWindows
from imu_calibration.references.turntable.accumulator import restrict
from imu_calibration.references.turntable.collector import GatherStep, from_bytes
from imu_calibration.references.turntable.estimation.solver import solve
from imu_calibration.references.turntable.repeated_linearisation import (
    MAX_TABLE_PASSES,
    linearise_again,
)
from imu_calibration.references.turntable.requested_model import choose_model, settle_model
from imu_calibration.references.turntable.session_data import KeptWindows, SessionData, join
from imu_calibration.references.turntable.shrinkage import shrunk
from imu_calibration.references.turntable.uncorrected_windows import end_of
from imu_calibration.references.turntable.window_observations import WindowObservations
from imu_calibration.references.turntable.window_statistics import reduce_window
from imu_calibration.selection.questions import at_time_constants

if TYPE_CHECKING:  # in the standard library from Python 3.11 on
    from typing_extensions import Self


@dataclass(frozen=True, eq=False)
class SolvedWindows(Solved[Solution]):
    """A solution of windows on a table."""

    data: WindowObservations
    """The windows."""

    @property
    def model(self) -> SensorModel:
        """The model of the columns of the windows."""
        return self.data.model


def solved_windows(data: WindowObservations, options: CalibrationOptions) -> SolvedWindows:
    """Return the solution of windows (`solve_gathered`)."""
    return SolvedWindows(solve_gathered(data.gathered, data.model, options), data)


class WindowSource(Protocol):
    """Windows that are reduced again in each pass: of recordings, or of a live session."""

    def solved(self, options: CalibrationOptions) -> SolvedWindows:
        """Return the solution of the model that options request, at a valid linearisation."""

    def solved_at(
        self, model: SensorModel, options: CalibrationOptions, *, judged_from: float
    ) -> SolvedWindows:
        """
        Return the solution with the columns of a model.

        Windows from the time `judged_from` (s) on are kept for the proof.
        """


@dataclass(frozen=True, eq=False)
class TableRecordings:
    """Recordings of one IMU on a table, which each pass reads."""

    sources: Sequence[BlockSource]
    """The recordings."""
    table: Table
    """The reference."""
    names: tuple[str, ...]
    """Names of the recordings for messages."""
    jobs: int = 1
    """Number of processes that read them."""
    keep_windows: bool = True
    """Whether windows are kept for the search of effects."""

    @classmethod
    def of(
        cls,
        sources: Sequence[BlockSource],
        table: Table,
        *,
        jobs: int = 1,
        names: Sequence[str] | None = None,
    ) -> 'Self':
        """Return recordings with their numbers as names where none are given."""
        numbered = [f'recording {number}' for number in range(1, len(sources) + 1)]
        return cls(sources, table, tuple(names or numbered), jobs)

    def solved(self, options: CalibrationOptions) -> SolvedWindows:
        """Return the solution of the model that options request, at a valid linearisation."""
        model = choose_model(options, self.table)
        if model.needs_temperature:
            model = model.with_reference_temperature(_first_temperature(self.sources))
        return solve_in_passes(self, model, options)

    def solved_at(
        self, model: SensorModel, options: CalibrationOptions, *, judged_from: float
    ) -> SolvedWindows:
        """Read all recordings once; see `WindowSource.solved_at`."""
        # The search has its windows when effects are added.
        keep_windows = self.keep_windows and not (options.added or options.as_asked)
        step = GatherStep(
            self.table,
            model,
            options.windows,
            options.nominal,
            names=self.names,
            keep_for_search=keep_windows,
            judged_from=judged_from,
        )
        parts = self.reduced(step)
        gathered = join(parts, self.names, model=model, table=self.table)
        report('solving')
        return solved_windows(WindowObservations(self.table, gathered, model), options)

    def reduced(self, step: GatherStep) -> list[SessionData]:
        """Return the windows of each recording, reduced with the columns of a model."""
        numbered = [(source, session) for session, source in enumerate(self.sources)]
        advance = counter('recordings', len(numbered) if self.jobs > 1 else 0)
        return in_processes(step.gather, numbered, self.jobs, advance=advance)


@dataclass(frozen=True, eq=False)
class RecordingReadOnce(TableRecordings):
    """A recording that is read once; later passes reduce its windows of the first pass again."""

    windows: StoredWindows | KeptWindows = field(default_factory=StoredWindows)
    """Its windows; empty before the first pass."""
    first_pass: list[SessionData] = field(default_factory=list)
    """The data of the first pass; empty before it."""

    def reduced(self, step: GatherStep) -> list[SessionData]:
        """Return the windows of the recording, reduced with the columns of a model."""
        if self.first_pass and self.windows.is_complete:
            reduced = (
                reduce_window(window, step.model, step.table) for window in self.windows.used()
            )
            return [self.first_pass[0].with_windows(reduced, step.judged_from)]
        self.windows.clear()
        self.first_pass.clear()
        (source,) = self.sources
        self.first_pass.append(step.read(source, 0, self.checks(step), windows=self.windows))
        return [*self.first_pass]

    def checks(self, step: GatherStep) -> Preflight:
        """Return the checks that see the samples while the recording is read."""
        return Preflight(step.table.gravity_value, one_sensor=True)


@dataclass(frozen=True, eq=False)
class StoredRecording(RecordingReadOnce):
    """A recording that is read once, with all windows in a temporary file."""

    windows: StoredWindows = field(default_factory=StoredWindows)
    """All its windows, unused ones too."""


@dataclass(frozen=True, eq=False)
class KeptRecording(RecordingReadOnce):
    """A recording that is read once, unless it is long: then each pass reads it."""

    windows: KeptWindows = field(default_factory=KeptWindows)
    """Its windows without unused ones."""


@dataclass(frozen=True, eq=False)
class WatchedRecording(KeptRecording):
    """A recording with given checks for the first pass; their findings are read by the caller."""

    preflight: Preflight = field(default_factory=Preflight)
    """The checks."""

    def checks(self, step: GatherStep) -> Preflight:
        """Return the given checks in the first pass, and new ones in later passes."""
        was_used = bool(self.preflight.streams)
        return super().checks(step) if was_used else self.preflight


def solve_in_passes(
    source: WindowSource, model: SensorModel, options: CalibrationOptions
) -> SolvedWindows:
    """
    Return the solution of a model, with columns that are linearised close to it.

    Each pass reduces all windows with the columns of a model. Where a drift has settled, the last
    third of the recording is judged; its start follows from the solution of a pass.
    """
    # Until the linearisation is valid at the solution, and the judged part is the one that follows
    # from it.
    next_model = _at_time_constants(source, model, options)
    judged_from = 0.0
    for _ in range(MAX_TABLE_PASSES):
        model = next_model
        solved = source.solved_at(model, options, judged_from=judged_from)
        solution = solved.solution
        linearised = linearise_again(model, solution)
        latest = latest_settling(solution.model, solution.values, solution.sd)
        last_third = judged_from_of(latest, end_of(solved.data.gathered.accumulator))
        if linearised is None and judged_from == last_third:
            break
        next_model = linearised or model
        judged_from = last_third
    return solved


def _at_time_constants(
    source: WindowSource, model: SensorModel, options: CalibrationOptions
) -> SensorModel:
    """
    Return the model with the columns of requested warm-ups at their best time constants.

    Several time constants are tried, because the iteration from the prior does not converge to one
    that is several times shorter; the best one has the smallest residuals of window means.
    """
    for effect in model.effects:
        if effect.time_constant and effect.name not in options.point:
            gathered = source.solved_at(model, options, judged_from=0.0).data.gathered
            trials = at_time_constants(model, effect, end_of(gathered.accumulator))
            residuals_of_means = []
            for trial in trials:
                solution = source.solved_at(trial, options, judged_from=0.0).solution
                _, of_means = solution.residual_rms[effect.sensor]
                residuals_of_means.append(of_means)
            model = trials[int(np.argmin(residuals_of_means))]
    return model


def _first_temperature(sources: Sequence[BlockSource]) -> float:
    """Return the first temperature of the first recording."""
    for block in sources[0]:
        if block.temperature is not None and len(block.temperature):
            return float(block.temperature.temperature_c[0])
    raise InputError(
        'a thermal effect needs temperatures, the recording has none; record imu/temperature or'
        ' omit the effect',
        key='temperature_topic',
        code='temperature_missing',
    )


def solve_gathered(
    gathered: SessionData, model: SensorModel, options: CalibrationOptions = CalibrationOptions()
) -> Solution:
    """
    Return the solution of gathered windows for the effects that options request.

    `model`: the model of their columns. The size effect of the accelerometer is removed where it
    was not requested and is not determined; effects that were not requested are shrunk.
    """
    narrow = settle_model(model, options, gathered)
    accumulator = gathered.accumulator
    if narrow is not model:
        accumulator = restrict(accumulator, model, narrow)
    solution = solve(accumulator, narrow, bias_processes=options.bias_processes)
    if options.accelerometer_model is None and _size_effect_unseen(solution):
        smaller = narrow.without_arms()
        solution = solve(
            restrict(accumulator, narrow, smaller), smaller, bias_processes=options.bias_processes
        )
    return shrunk(solution, _by_default(solution.model, options))


def calibration_of_saved(
    data: bytes, table: Table, options: CalibrationOptions = CalibrationOptions()
) -> Calibration:
    """
    Return the calibration of a saved live session (`LiveCalibration.saved`).

    It has the model of the saved columns, with the effects that the session added.

    Raises
    ------
    DocumentError
        When it is damaged, or was gathered with different joints.
    NotObservableError
        When no parameter is determined.

    """
    gathered, model, extension = from_bytes(data)
    if model.joint_names != table.joint_names:
        raise DocumentError(
            f'a saved accumulator must be of the joints {", ".join(table.joint_names)}, '
            f'this is of {", ".join(model.joint_names) or "none"}; '
            'give the table or the arm that it was gathered on',
            key='table',
        )
    options = extension.options(options)
    solution = extension.applied(solve_gathered(gathered, model, options))
    data = WindowObservations(table, gathered, model)
    return conclude(SolvedWindows(solution, data, extension), options).calibration


def _by_default(model: SensorModel, options: CalibrationOptions) -> list[slice]:
    """
    Return the parameters of each effect that is in the model without a request.

    These are arms of the accelerometers, levelling and the Earth's rate.
    """
    has_default_arms = options.accelerometer_model is None
    # An error of table or clock that the recordings support is estimated as if it were requested,
    # and with it levelling and the Earth's rate.
    is_as_described = not any(sensor == 'reference' for sensor, _ in options.added)
    has_default_reference = options.reference_model is None and is_as_described
    slices = []
    for effect in model.effects:
        is_default_arms = effect.role is Role.ARMS and has_default_arms
        is_nuisance = effect.sensor == 'reference' and effect.nuisance
        if is_default_arms or (is_nuisance and has_default_reference):
            slices.append(model.slices[effect.key])
    return slices


def _size_effect_unseen(solution: Solution) -> bool:
    """
    Return whether no arm of the accelerometer is determined, neither single ones nor the common.

    A determined arm is kept in the model: without it the bias would be wrong.
    """
    arms_held = solution.held[solution.model.part('accelerometer', Role.ARMS)]
    arm_held = solution.held[solution.model.part('accelerometer', Role.ARM)]
    return len(arms_held) > 0 and bool(arms_held.all() and arm_held.all())
