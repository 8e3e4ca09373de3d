"""
The search of `calibrate` and `diagnose`.

Supported effects, without findings that a formula or a regime replaces.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from imu_calibration.core.progress import report
from imu_calibration.effects.base import AXES, SENSORS
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.kinematics.table import Table
from imu_calibration.preprocessing.window import Window
from imu_calibration.references.turntable.residuals.formulas import FormulaChoice
from imu_calibration.references.turntable.residuals.proposals import (
    Proposal,
    find_formulas,
    propose,
)
from imu_calibration.references.turntable.residuals.residual_blocks import (
    BlockFits,
    BlockMeans,
    residual_blocks,
)
from imu_calibration.references.turntable.residuals.spectrum import find_sway, find_tones
from imu_calibration.references.turntable.residuals.unexplained_windows import (
    beyond_noise,
    scatter_in_motion,
    unexplained,
)
from imu_calibration.references.turntable.residuals.window_regimes import find_regimes
from imu_calibration.references.turntable.selection.investigation import Investigation, investigate
from imu_calibration.selection.bias_courses import temperature_courses
from imu_calibration.selection.questions import Question
from imu_calibration.selection.regimes import RestRegime
from imu_calibration.selection.search import TIE
from imu_calibration.selection.stamp_jitter import StampJitter
from imu_calibration.selection.unexplained import (
    CURVES_IN_TIME,
    Unexplained,
    biases_off,
    curves_in_time,
)

MIN_FORMULA_SDS = 10.0
"""Standard deviations above noise at rest from which a formula is searched in moving blocks."""
SHARED_SCATTER_RATIO = 3.0
"""Scatter in motion of an axis over that of the middle axis, up to which all axes share it."""
NOT_NEEDED = 0.05
"""
Least share of a finding's reduction of the residual that must remain with a formula or a regime in
the model.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualAnalysis(Investigation):
    """An Investigation with the residual analysis of each sensor, evaluated lazily and cached."""

    table: Table
    """The reference."""
    replaced: Sequence[Question] = ()
    """Effects that a formula, a regime or the temperature replaces (`superseded`)."""
    _fits: dict = field(default_factory=dict, init=False, repr=False)
    _formulas: dict = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, found: Investigation, table: Table) -> 'ResidualAnalysis':
        """
        Return an Investigation as a ResidualAnalysis; a ResidualAnalysis is returned unchanged.
        """
        return (
            found
            if isinstance(found, cls)
            else cls(
                **{each.name: getattr(found, each.name) for each in fields(found)}, table=table
            )
        )

    @cached_property
    def rests(self) -> dict[str, Unexplained]:
        """Sensor -> Unexplained, with the axes that carry it where it is significant."""
        found = unexplained(self.problem, self.explained, self.named)
        for sensor, rest in found.items():
            if rest.significant:
                found[sensor] = replace(
                    rest,
                    axes=self.fits(sensor).axes(),
                    correlates_with=self._measured_cause(sensor, rest.correlates_with),
                )
        return found

    def _measured_cause(self, sensor: str, name: str | None) -> str | None:
        """
        Return the variable of the largest correlation; the time is judged on locked blocks.

        There a course of the temperature takes its place unless the time predicts better.
        """
        if name != CURVES_IN_TIME:
            return name
        fits = self.fits(sensor)
        time = self.blocks[sensor].time
        excess = min(fits.fit(_of_all_axes(curves)).excess for curves in curves_in_time(time))
        # Within the resolution of the search, twice in squares, the measured cause is preferred.
        return self.late_temperature(sensor, self.named, excess + 2 * TIE) or name

    def late_temperature(
        self, sensor: str, chosen: Sequence[Question], excess: float
    ) -> str | None:
        """
        Return the course of the temperature that predicts locked blocks best beside a choice.

        None if another explanation, which leaves `excess` (`BlockFit.excess`), predicts as well: of
        n courses the best one has smaller squares by 2 ln(n).
        """
        courses = self._excess_with_courses(sensor, chosen)
        if not courses:
            return None
        best = min(courses, key=courses.__getitem__)
        return best if courses[best] + 2 * np.log(len(courses)) < excess else None

    def _excess_with_courses(self, sensor: str, chosen: Sequence[Question]) -> dict[str, float]:
        """
        Return course of the temperature -> excess of the locked blocks with it beside a choice.

        Empty without a temperature, or with the times of several recordings.
        """
        blocks = self.blocks[sensor]
        if blocks.ref.temperature_c is None or np.ptp(self.problem.recording.session) > 0:
            return {}
        fits = self.fits(sensor, chosen)
        found = {}
        for course in temperature_courses(blocks.time, blocks.means(blocks.ref.temperature_c)):
            found[course.name] = fits.fit(_of_all_axes(course.values[:, None])).excess
        return found

    @cached_property
    def blocks(self) -> dict[str, BlockMeans]:
        """Sensor -> BlockMeans."""
        return residual_blocks(self.used, self.table, self.problem, explained=self.explained)

    def fits(self, sensor: str, chosen: Sequence[Question] | None = None) -> BlockFits:
        """
        Return the fits of a choice, of the findings where not given, to the blocks of a sensor.
        """
        space = self.problem.space
        used = tuple(self.search.indices(self.named if chosen is None else chosen))
        if (sensor, used) not in self._fits:
            self._fits[sensor, used] = BlockFits(
                self.blocks[sensor], used, prior_sd=space.prior_sd, prior_mean=space.prior_mean
            )
        return self._fits[sensor, used]

    def regimes(
        self,
        sensor: str,
        chosen: Sequence[Question] | None = None,
        formula: np.ndarray | None = None,
    ) -> list[RestRegime]:
        """
        Return the regimes of a sensor's residual with a choice in the model.

        Return the findings where no choice is given (`find_regimes`).
        """
        fits = self.fits(sensor, chosen)
        offsets = chosen is not None or self.rests[sensor].significant or formula is not None
        return find_regimes(
            self.blocks[sensor],
            self.problem,
            sorted(fits.used),
            joint_names=self.table.joint_names,
            axes=fits.axes() if offsets else (),
            formula=formula,
        )

    def formulas(self, sensor: str) -> list[FormulaChoice]:
        """
        Return the likeliest formulas for the residual of a sensor.

        For any choice of effects (`find_formulas`).
        """
        if sensor not in self._formulas:
            self._formulas[sensor] = find_formulas(self.blocks[sensor], self.problem)
        return self._formulas[sensor]

    def proposed(self, sensor: str, fits: BlockFits) -> Proposal | None:
        """
        Return a formula for the residual of a sensor with the choice of some fits (`propose`).
        """
        return propose(self.blocks[sensor], self.problem, fits, formulas=self.formulas(sensor))

    @cached_property
    def proposals(self) -> dict[str, Proposal | None]:
        """
        Sensor -> a formula for its residual.

        Where it is significant or clear within moving windows.

        Variation within moving windows is modelled as noise; a formula that explains it shows that
        it is deterministic.
        """
        fits = {sensor: self.fits(sensor) for sensor in self.rests}
        found = {}
        for sensor, rest in self.rests.items():
            found[sensor] = (
                self.proposed(sensor, fits[sensor])
                if rest.significant or fits[sensor].sigma > MIN_FORMULA_SDS
                else None
            )
        return found

    def columns(self, sensor: str, proposal: Proposal | None) -> np.ndarray | None:
        """
        Return the columns of the formulas of a proposal over the blocks of a sensor.

        Shape (b, k, 3), or None without one.
        """
        if proposal is None:
            return None
        blocks = self.blocks[sensor]
        groups = list(chain.from_iterable(effect.groups for effect in proposal.effects))
        known = {'temperature_ref_c': self.problem.recording.model.temperature_ref_c}
        means = [blocks.means(group.columns(blocks.ref, known)) for group in groups]
        return np.stack([np.broadcast_to(mean, (len(mean), 3)) for mean in means], axis=1)

    @cached_property
    def unexplained(self) -> dict[str, Unexplained]:
        """
        Sensor -> the unexplained excess with its tones.

        It includes regimes and a proposal where the excess is significant.
        """
        report('analysing the residual')
        tones = find_tones(
            self,
            self.table,
            [proposal for proposal in self.proposals.values() if proposal is not None],
        )
        accelerometer = SENSORS[0]
        if accelerometer in self.rests:
            sway = find_sway(self.blocks[accelerometer], self.fits(accelerometer))
            if sway is not None:
                tones[accelerometer] = (sway, *tones[accelerometer])
        return {
            sensor: self._unexplained(sensor, replace(rest, tones=tones[sensor]))
            for sensor, rest in self.rests.items()
        }

    @cached_property
    def stamp_jitter(self) -> StampJitter:
        """Errors of the stamps from the scatter in motion."""
        return next(iter(self.blocks.values())).jitter

    def _unexplained(self, sensor: str, rest: Unexplained) -> Unexplained:
        proposal = self.proposals[sensor]
        regimes = self.regimes(sensor, formula=self.columns(sensor, proposal))
        first = {regime.axis: regime for regime in reversed(regimes)}
        if not rest.significant and proposal is None:
            scatter = scatter_in_motion(self.problem, sensor)
            for axis, regime in list(first.items()):
                if _is_noise_of_motion(regime, scatter):
                    del first[axis]
        if not rest.significant and proposal is None and not first:
            return beyond_noise(self.problem, sensor, rest)
        axes = rest.axes or (self.fits(sensor).axes() if proposal is not None else tuple(first))
        found = replace(
            rest,
            regimes=tuple(first[axis] for axis in axes if axis in first),
            proposal=proposal,
            axes=axes if proposal is None else proposal.axes,
        )
        if rest.significant:
            return found
        sizes = (
            proposal.sizes
            if proposal is not None
            else [regime.size * np.sqrt(regime.inside.mean()) for regime in first.values()]
        )
        return replace(found, significant=True, rms=float(np.hypot.reduce(sizes)))

    @property
    def jitter_entry(self) -> dict[str, Any]:
        """Independent errors of the stamps, for a document."""
        return self.stamp_jitter.to_mapping()

    @property
    def further_moves(self) -> list[tuple[Mapping[str, float], float]]:
        """(changes of parameters, weight) by the unexplained residual and by rivals."""
        moves: list[tuple[Mapping[str, float], float]] = []
        for moved in biases_off(self.problem.baseline, self.rests):
            moves.append((moved, 1.0))
        for rival in self.rivals:
            moves.append((rival.moves, rival.weight))
        return moves

    def unexplained_rests(self) -> dict[str, Unexplained]:
        """
        Return `unexplained` and free the blocks and their fits, which are computed again on demand.

        Solutions need that memory.
        """
        found, _ = self.unexplained, self.stamp_jitter
        self.__dict__.pop('blocks', None)
        self._fits.clear()
        return found

    def without(self, gone: Sequence[Question]) -> 'ResidualAnalysis':
        """
        Return the ResidualAnalysis without some findings.

        They become rejected, and widen the uncertainty of all other ones.
        """
        names = {question.name for question in gone}
        other = replace(
            self,
            named=[question for question in self.named if question not in gone],
            rejected=[*self.rejected, *gone],
            replaced=[*self.replaced, *gone],
            rivals=[rival for rival in self.rivals if rival.question.name not in names],
        )
        other.__dict__['blocks'] = self.blocks
        other._formulas.update(self._formulas)
        return other


def inquire(
    windows: Sequence[Window],
    table: Table,
    model: SensorModel,
    *,
    bias_processes: dict | None = None,
) -> ResidualAnalysis:
    """
    Test every effect that a model lacks (`investigate`).

    Findings that a formula or a regime replaces are withdrawn.

    Parameters
    ----------
    windows, table, model, bias_processes
        As for `investigate`.

    Raises
    ------
    NotObservableError
        As `investigate`.

    """
    return without_superseded(
        ResidualAnalysis.of(
            investigate(windows, table, model, bias_processes=bias_processes), table
        )
    )


def without_superseded(found: ResidualAnalysis) -> ResidualAnalysis:
    """Return the ResidualAnalysis without findings that a formula or a place does without."""
    while found.named and (gone := superseded(found)):
        found = found.without(gone)
    return found


def _is_noise_of_motion(regime: RestRegime, scatter: np.ndarray) -> bool:
    """
    Return whether a regime is noise that grows with the motion, on the other axes too.

    Vibration of the drives, no error of the model: a cause in the sensor acts on one axis, a place
    of the table at an angle.

    Parameters
    ----------
    regime : RestRegime
    scatter : ndarray, shape (3,)
        Excess variance of moving samples of each axis over the noise at rest.

    """
    if regime.offset or not regime.is_rate:
        return False
    return bool(scatter[AXES.index(regime.axis)] < SHARED_SCATTER_RATIO * np.median(scatter))


def superseded(found: ResidualAnalysis) -> list[Question]:
    """
    Return the findings that a formula or a regime replaces.

    They approximated the part that correlates with them.

    A response to the cube of a force is three quarters a response to the force; its residual would
    be reported as a formula in addition to a wrong effect; a step at warm temperature is like a
    polynomial of the temperature. So each finding is omitted once, in all sensors on which it acts,
    and is kept if held-out windows need it in addition to the substitute: the formula for the
    residual of all findings, a formula for the residual without it, or the regimes of that. This is
    tested where a residual remains; for effects of the temperature always: settling or a step
    during the warm-up is so similar that hardly any residual remains.
    """
    return [question for question in found.named if _done_without(found, question)]


def _of_all_axes(columns: np.ndarray) -> np.ndarray:
    """Return columns of blocks, shape (b, k), for each axis, shape (b, k, 3)."""
    return np.repeat(columns[:, :, None], len(AXES), axis=2)


def _follows_temperature(found: ResidualAnalysis, question: Question) -> bool:
    """
    Return whether a course of the temperature explains more than a drift.

    A bias that follows a measured temperature late, as a thermal mass does, settles almost like a
    drift in time.
    """
    if not question.effect.smooth or 'temperature' in question.effect.needs:
        return False
    others = [other for other in found.named if other is not question]
    for sensor in question.effect.sensors:
        with_drift = found.fits(sensor, found.named).fit().excess
        if found.late_temperature(sensor, others, with_drift) is None:
            return False
    return True


def _done_without(found: ResidualAnalysis, question: Question) -> bool:
    """
    Return whether a finding hardly reduces the residual with a substitute.

    The residual is that of the finding's sensors, and the substitute is in some of them.
    """
    if _follows_temperature(found, question):
        return True

    # Sensors in which a substitute is possible.
    sensors = question.effect.sensors
    thermal = 'temperature' in question.effect.needs
    with_substitute = []
    for sensor in sensors:
        if thermal or found.rests[sensor].significant or found.proposals[sensor]:
            with_substitute.append(sensor)
    if not with_substitute:
        return False

    # Fall of the excess by the finding without a substitute.
    others = [other for other in found.named if other is not question]
    with_finding = {sensor: found.fits(sensor, found.named) for sensor in sensors}
    without_finding = {sensor: found.fits(sensor, others) for sensor in sensors}
    fall = {}
    for sensor in sensors:
        fall[sensor] = without_finding[sensor].fit().excess - with_finding[sensor].fit().excess

    # And with the columns of one in both models: the formulas of the residual with the finding,
    # those of the residual without it, and offsets in regimes.
    for substitute in (
        lambda sensor: found.columns(sensor, found.proposals[sensor]),
        lambda sensor: found.columns(sensor, found.proposed(sensor, without_finding[sensor])),
        lambda sensor: _places(found, sensor, others),
    ):
        fall_with_substitute = dict(fall)
        for sensor in with_substitute:
            columns = substitute(sensor)
            if columns is not None:
                before = without_finding[sensor].fit(columns).excess
                after = with_finding[sensor].fit(columns).excess
                fall_with_substitute[sensor] = before - after
        if sum(fall_with_substitute.values()) < NOT_NEEDED * sum(fall.values()):
            return True
    return False


def _places(
    found: 'ResidualAnalysis', sensor: str, chosen: Sequence[Question]
) -> np.ndarray | None:
    """
    Return an indicator column of the regimes where an offset explains most of an axis' residual.

    Shape (b, 1, 3), or None.
    """
    inside_of_axis = {}  # of the likeliest regime
    for regime in found.regimes(sensor, chosen):
        if regime.offset:
            inside_of_axis.setdefault(regime.axis, regime.inside)
    if not inside_of_axis:
        return None
    nowhere = np.zeros(len(found.blocks[sensor].time))
    columns = [inside_of_axis.get(axis, nowhere) for axis in AXES]
    return np.stack(columns, axis=1)[:, None].astype(float)
