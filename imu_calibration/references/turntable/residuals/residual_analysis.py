"""
The search of `calibrate` and `diagnose` on a table.

It gives the effects that the windows support, without findings that a formula, a regime or the
temperature replaces, and describes the residual of each sensor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
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


@dataclass(eq=False)
class _BlockCache:
    """Intermediate results of a `ResidualAnalysis`: computed when first needed, and large."""

    blocks: dict[str, BlockMeans] | None = None
    """Sensor -> BlockMeans; None before they are computed and after they are freed."""
    fits: dict[tuple[str, tuple[int, ...]], BlockFits] = field(default_factory=dict)
    """(sensor, numbers of the parameters in the model) -> fits of this model to the blocks."""
    formulas: dict[str, list[FormulaChoice]] = field(default_factory=dict)
    """Sensor -> likeliest formulas, which are the same for every choice of effects."""
    jitter: StampJitter | None = None
    """Errors of the stamps by the blocks, kept when these are freed."""

    def free_blocks(self) -> None:
        """Free the blocks and the fits to them."""
        if self.blocks is not None:
            self.jitter = next(iter(self.blocks.values())).jitter
        self.blocks = None
        self.fits.clear()


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualAnalysis(Investigation):
    """
    An Investigation with the residual analysis of each sensor, evaluated lazily and cached.

    Methods with an argument `chosen` concern the model with these effects; None: the findings.
    """

    replaced: Sequence[Question] = ()
    """Effects that a formula, a regime or the temperature replaces (`superseded`)."""
    _cache: _BlockCache = field(default_factory=_BlockCache, init=False, repr=False)

    @classmethod
    def of(cls, investigation: Investigation) -> 'ResidualAnalysis':
        """
        Return an Investigation as a ResidualAnalysis; a ResidualAnalysis is returned unchanged.
        """
        if isinstance(investigation, cls):
            return investigation
        # Not what is cached in it.
        parts = {part.name: getattr(investigation, part.name) for part in fields(investigation)}
        return cls(**parts)

    @cached_property
    def residual_of(self) -> dict[str, Unexplained]:
        """Sensor -> its residual with the findings, with axes and cause where it is significant."""
        residual_of = unexplained(self.problem, self.named)
        for sensor, residual in residual_of.items():
            if residual.significant:
                residual_of[sensor] = replace(
                    residual,
                    axes=self.fits(sensor).axes(),
                    correlates_with=self._measured_cause(sensor, residual.correlates_with),
                )
        return residual_of

    def _measured_cause(self, sensor: str, variable: str | None) -> str | None:
        """
        Return the variable of the largest correlation, or a course of the temperature for the time.

        A course of the temperature replaces the time unless the time predicts locked blocks better.
        """
        if variable != CURVES_IN_TIME:
            return variable
        fits = self.fits(sensor)
        time = self.blocks[sensor].time
        excess = min(fits.fit(_of_all_axes(curves)).excess for curves in curves_in_time(time))
        # Within the resolution of the search, twice in squares, the measured cause is preferred.
        return self.better_course(sensor, self.named, excess + 2 * TIE) or variable

    def better_course(self, sensor: str, chosen: Sequence[Question], excess: float) -> str | None:
        """
        Return the course of the temperature that predicts the locked blocks best.

        None if another explanation, with the `excess` of its `BlockFit`, predicts as well: by
        chance the best of n courses has squares that are smaller by 2 ln(n).
        """
        excess_with = self._excess_with_courses(sensor, chosen)
        if not excess_with:
            return None
        best = min(excess_with, key=excess_with.__getitem__)
        return best if excess_with[best] + 2 * np.log(len(excess_with)) < excess else None

    def _excess_with_courses(self, sensor: str, chosen: Sequence[Question]) -> dict[str, float]:
        """
        Return course of the temperature -> excess of the locked blocks with it in the model.

        Empty without a temperature, or with the times of several recordings.
        """
        blocks = self.blocks[sensor]
        if blocks.ref.temperature_c is None or np.ptp(self.problem.recording.session) > 0:
            return {}
        fits = self.fits(sensor, chosen)
        excess_with = {}
        for course in temperature_courses(blocks.time, blocks.means(blocks.ref.temperature_c)):
            excess_with[course.name] = fits.fit(_of_all_axes(course.values[:, None])).excess
        return excess_with

    @property
    def blocks(self) -> dict[str, BlockMeans]:
        """Sensor -> BlockMeans; computed again after `unexplained_rests` has freed them."""
        if self._cache.blocks is None:
            self._cache.blocks = residual_blocks(self.used, self.table, self.problem)
        return self._cache.blocks

    def fits(self, sensor: str, chosen: Sequence[Question] | None = None) -> BlockFits:
        """Return the fits of the model with the effects `chosen` to the blocks of a sensor."""
        space = self.problem.space
        parameters = tuple(self.search.indices(self.named if chosen is None else chosen))
        key = (sensor, parameters)
        if key not in self._cache.fits:
            self._cache.fits[key] = BlockFits(
                self.blocks[sensor],
                parameters,
                prior_sd=space.prior_sd,
                prior_mean=space.prior_mean,
            )
        return self._cache.fits[key]

    def regimes(
        self,
        sensor: str,
        chosen: Sequence[Question] | None = None,
        formula: np.ndarray | None = None,
    ) -> list[RestRegime]:
        """
        Return the regimes of a sensor's residual (`find_regimes`).

        A `formula`, columns of shape (b, k, 3), is one that a regime must exceed. For the findings
        regimes of another offset are searched only in a significant residual or with a formula.
        """
        fits = self.fits(sensor, chosen)
        offsets = chosen is not None or self.residual_of[sensor].significant or formula is not None
        return find_regimes(
            self.blocks[sensor],
            self.problem,
            sorted(fits.used),
            joint_names=self.table.joint_names,
            axes=fits.axes() if offsets else (),
            formula=formula,
        )

    def formulas(self, sensor: str) -> list[FormulaChoice]:
        """Return the likeliest formulas of a sensor for any model (`find_formulas`)."""
        if sensor not in self._cache.formulas:
            self._cache.formulas[sensor] = find_formulas(self.blocks[sensor], self.problem)
        return self._cache.formulas[sensor]

    def proposed(self, sensor: str, fits: BlockFits) -> Proposal | None:
        """Return a formula for the residual of a sensor with the model of `fits` (`propose`)."""
        return propose(self.blocks[sensor], self.problem, fits, formulas=self.formulas(sensor))

    @cached_property
    def proposals(self) -> dict[str, Proposal | None]:
        """
        Sensor -> a formula for its residual, None where it is insignificant or none is found.

        Variation within moving windows is modelled as noise; a formula that explains it shows that
        it is deterministic. It is searched from `MIN_FORMULA_SDS` on.
        """
        fits = {sensor: self.fits(sensor) for sensor in self.residual_of}
        proposals: dict[str, Proposal | None] = {}
        for sensor, residual in self.residual_of.items():
            proposals[sensor] = None
            if residual.significant or fits[sensor].sigma > MIN_FORMULA_SDS:
                proposals[sensor] = self.proposed(sensor, fits[sensor])
        return proposals

    def columns(self, sensor: str, proposal: Proposal | None) -> np.ndarray | None:
        """
        Return the means of the columns of a proposal over the blocks, shape (b, k, 3).

        None without a proposal.
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
        Sensor -> its residual with the findings, with tones, regimes and a proposal.

        A formula, a regime or loud tones make a residual significant.
        """
        report('analysing the residual')
        proposals = [proposal for proposal in self.proposals.values() if proposal is not None]
        tones = find_tones(self, proposals)
        accelerometer = SENSORS[0]
        if accelerometer in self.residual_of:
            sway = find_sway(self.blocks[accelerometer], self.fits(accelerometer))
            if sway is not None:
                tones[accelerometer] = (sway, *tones[accelerometer])
        described = {}
        for sensor, residual in self.residual_of.items():
            described[sensor] = self._described(sensor, replace(residual, tones=tones[sensor]))
        return described

    @property
    def stamp_jitter(self) -> StampJitter:
        """Errors of the stamps from the scatter in motion, which all sensors share."""
        if self._cache.jitter is None:
            self._cache.jitter = next(iter(self.blocks.values())).jitter
        return self._cache.jitter

    def _described(self, sensor: str, residual: Unexplained) -> Unexplained:
        """Return the residual of a sensor with its regimes and a proposal."""
        proposal = self.proposals[sensor]
        # The likeliest regime of each axis, which is the first: the last in reversed order stays.
        regimes = self.regimes(sensor, formula=self.columns(sensor, proposal))
        regime_of_axis = {regime.axis: regime for regime in reversed(regimes)}

        # An insignificant residual without a formula: regimes of noise that grows with the motion
        # do not count.
        if not residual.significant and proposal is None:
            scatter = scatter_in_motion(self.problem, sensor)
            for axis, regime in list(regime_of_axis.items()):
                if _is_noise_of_motion(regime, scatter):
                    del regime_of_axis[axis]
            if not regime_of_axis:
                return beyond_noise(self.problem, sensor, residual)

        # Axes of the residual; of an insignificant one those of the formula or of the regimes.
        axes = residual.axes
        if not axes:
            axes = self.fits(sensor).axes() if proposal is not None else tuple(regime_of_axis)
        described = replace(
            residual,
            regimes=tuple(regime_of_axis[axis] for axis in axes if axis in regime_of_axis),
            proposal=proposal,
            axes=axes if proposal is None else proposal.axes,
        )
        if residual.significant:
            return described

        # Significant by the formula or the regimes: the rms is that of their contributions. A
        # regime with an offset or scatter c in a share s of the blocks has the rms c sqrt(s).
        sizes: Sequence[float] = ()
        if proposal is not None:
            sizes = proposal.sizes
        else:
            sizes = [
                regime.size * np.sqrt(regime.inside.mean()) for regime in regime_of_axis.values()
            ]
        return replace(described, significant=True, rms=float(np.hypot.reduce(sizes)))

    @property
    def jitter_entry(self) -> dict[str, Any]:
        """Independent errors of the stamps, for a document."""
        return self.stamp_jitter.to_mapping()

    @property
    def further_moves(self) -> list[tuple[Mapping[str, float], float]]:
        """(parameter -> its possible error, weight) by the unexplained residual and by rivals."""
        errors_of_biases = biases_off(self.problem.baseline, self.residual_of)
        moves: list[tuple[Mapping[str, float], float]] = [
            (error, 1.0) for error in errors_of_biases
        ]
        return moves + [(rival.moves, rival.weight) for rival in self.rivals]

    def unexplained_rests(self) -> dict[str, Unexplained]:
        """
        Return `unexplained` and free the blocks and their fits, which are computed again on demand.

        The solutions that follow a search need the memory.
        """
        unexplained_of_sensors = self.unexplained
        self._cache.free_blocks()
        return unexplained_of_sensors

    def without(self, replaced: Sequence[Question]) -> 'ResidualAnalysis':
        """
        Return the ResidualAnalysis without some findings.

        They become rejected, and widen the uncertainty of all other ones.
        """
        names = {question.name for question in replaced}
        analysis = replace(
            self,
            named=[question for question in self.named if question not in replaced],
            rejected=[*self.rejected, *replaced],
            replaced=[*self.replaced, *replaced],
            rivals=[rival for rival in self.rivals if rival.question.name not in names],
        )
        # Blocks and formulas do not depend on the findings; the fits do.
        analysis._cache.blocks = self.blocks
        analysis._cache.formulas.update(self._cache.formulas)
        return analysis


def inquire(
    windows: Sequence[Window],
    table: Table,
    model: SensorModel,
    *,
    bias_processes: dict | None = None,
) -> ResidualAnalysis:
    """
    Test every effect that a model lacks (`investigate`), without findings that are `superseded`.

    Parameters
    ----------
    windows, table, model, bias_processes
        As for `investigate`.

    Raises
    ------
    NotObservableError
        As `investigate`.

    """
    investigation = investigate(windows, table, model, bias_processes=bias_processes)
    return without_superseded(ResidualAnalysis.of(investigation))


def without_superseded(analysis: ResidualAnalysis) -> ResidualAnalysis:
    """
    Return the ResidualAnalysis without findings that are superseded.

    Without them other findings may be superseded.
    """
    while analysis.named:
        replaced = superseded(analysis)
        if not replaced:
            break
        analysis = analysis.without(replaced)
    return analysis


def _is_noise_of_motion(regime: RestRegime, scatter: np.ndarray) -> bool:
    """
    Return whether a regime is noise that grows with the motion, on the other axes too.

    Then it is vibration of the drives and no error of the model, since a cause in the sensor acts
    on one axis, and a place of the table at an angle.

    Parameters
    ----------
    regime : RestRegime
    scatter : ndarray, shape (3,)
        Excess variance of moving samples of each axis over the noise at rest.

    """
    if regime.offset or not regime.is_rate:
        return False
    return bool(scatter[AXES.index(regime.axis)] < SHARED_SCATTER_RATIO * np.median(scatter))


def superseded(analysis: ResidualAnalysis) -> list[Question]:
    """
    Return the findings that a formula, a regime or a course of the temperature replaces.

    Such a finding only correlates with the true cause. A response to the cube of a force is three
    quarters a response to the force; its residual would be reported as a formula in addition to a
    wrong effect. A step at warm temperature is like a polynomial of the temperature.

    So each finding is omitted once, in all sensors on which it acts, and is kept if held-out
    windows need it in addition to a substitute: the formula for the residual of all findings, a
    formula for the residual without it, or the regimes without it. This is tested where a residual
    remains; for effects of the temperature always: settling or a step during the warm-up is so
    similar that almost no residual remains.
    """
    return [question for question in analysis.named if _is_superseded(analysis, question)]


def _of_all_axes(columns: np.ndarray) -> np.ndarray:
    """Return columns over the blocks, shape (b, k), repeated for each axis, shape (b, k, 3)."""
    return np.repeat(columns[:, :, None], len(AXES), axis=2)


def _follows_temperature(analysis: ResidualAnalysis, question: Question) -> bool:
    """
    Return whether a finding is a drift in time that a course of the temperature predicts better.

    A bias that follows a measured temperature late, as a thermal mass does, settles almost like a
    drift in time. The course must be better in each sensor of the drift.
    """
    if not question.effect.smooth or 'temperature' in question.effect.needs:
        return False
    others = [other for other in analysis.named if other is not question]
    for sensor in question.effect.sensors:
        excess_with_drift = analysis.fits(sensor, analysis.named).fit().excess
        if analysis.better_course(sensor, others, excess_with_drift) is None:
            return False
    return True


def _is_superseded(analysis: ResidualAnalysis, question: Question) -> bool:
    """
    Return whether a finding is needless in addition to a substitute.

    With E the excess of the locked blocks, summed over the sensors of the finding::

        E(substitute) - E(finding, substitute) < NOT_NEEDED (E() - E(finding))

    """
    if _follows_temperature(analysis, question):
        return True

    # Sensors in which a substitute is possible.
    sensors = question.effect.sensors
    thermal = 'temperature' in question.effect.needs
    with_substitute = []
    for sensor in sensors:
        if (
            thermal
            or analysis.residual_of[sensor].significant
            or analysis.proposals[sensor] is not None
        ):
            with_substitute.append(sensor)
    if not with_substitute:
        return False

    # Fall of the excess by the finding without a substitute.
    others = [other for other in analysis.named if other is not question]
    with_finding = {sensor: analysis.fits(sensor, analysis.named) for sensor in sensors}
    without_finding = {sensor: analysis.fits(sensor, others) for sensor in sensors}
    fall = {}
    for sensor in sensors:
        fall[sensor] = without_finding[sensor].fit().excess - with_finding[sensor].fit().excess

    # Fall of the excess with a substitute in both models. One kind at a time, because the search of
    # each is slow.
    for kind in _Substitute:
        fall_with_substitute = dict(fall)
        for sensor in with_substitute:
            columns = _columns_of_substitute(analysis, kind, sensor, others)
            if columns is not None:
                before = without_finding[sensor].fit(columns).excess
                after = with_finding[sensor].fit(columns).excess
                fall_with_substitute[sensor] = before - after
        if sum(fall_with_substitute.values()) < NOT_NEEDED * sum(fall.values()):
            return True
    return False


class _Substitute(Enum):
    """Explanations of a residual that may replace a finding."""

    FORMULA_WITH_FINDING = 'formula for the residual of all findings'
    FORMULA_WITHOUT_FINDING = 'formula for the residual without the finding'
    REGIMES_WITHOUT_FINDING = 'offsets in regimes of the residual without the finding'


def _columns_of_substitute(
    analysis: ResidualAnalysis, kind: _Substitute, sensor: str, others: Sequence[Question]
) -> np.ndarray | None:
    """
    Return the columns of a substitute over the blocks, shape (b, k, 3); None without one.

    `others` are the findings without the one that may be replaced.
    """
    if kind is _Substitute.FORMULA_WITH_FINDING:
        return analysis.columns(sensor, analysis.proposals[sensor])
    if kind is _Substitute.FORMULA_WITHOUT_FINDING:
        return analysis.columns(sensor, analysis.proposed(sensor, analysis.fits(sensor, others)))
    return _regime_columns(analysis, sensor, others)


def _regime_columns(
    analysis: ResidualAnalysis, sensor: str, chosen: Sequence[Question]
) -> np.ndarray | None:
    """
    Return 1 in the blocks of the likeliest regime of another offset of each axis, shape (b, 1, 3).

    None without such a regime.
    """
    inside_of_axis = {}
    for regime in analysis.regimes(sensor, chosen):
        if regime.offset:
            inside_of_axis.setdefault(regime.axis, regime.inside)
    if not inside_of_axis:
        return None
    no_blocks = np.zeros(len(analysis.blocks[sensor].time))
    columns = [inside_of_axis.get(axis, no_blocks) for axis in AXES]
    return np.stack(columns, axis=1)[:, None].astype(float)
