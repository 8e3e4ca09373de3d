"""A campaign: plan, drive, calibrate, plan again; motions that separate two effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.errors import ImuCalibrationError, InputError
from imu_calibration.core.settings import setting
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import HELD, tolerances_of
from imu_calibration.kinematics.motion_limits import MotionLimits
from imu_calibration.kinematics.table import Table
from imu_calibration.planning.coordinates import CollinearEffect, Coordinates, ToldApart
from imu_calibration.planning.motion_library import MotionLibrary
from imu_calibration.planning.planner import Decision, Planner
from imu_calibration.planning.planning_problem import PlanningProblem
from imu_calibration.planning.posterior import exact_information
from imu_calibration.references.turntable.noise_model import NoiseModel
from imu_calibration.selection.questions import special
from imu_calibration.simulation.profiles import make_profile

SESSION = 'quick'
"""Profile on which the sizes of collinear effects are derived from the size of the finding."""


def make_separator(
    table: Table,
    calibration: Calibration,
    causes: Sequence[tuple[str, str]],
    *,
    noise: Mapping[str, NoiseModel],
    rate: float = 100.0,
    options: CalibrationOptions = CalibrationOptions(),
    sizes: Mapping[str, float] | None = None,
    limits: MotionLimits | None = None,
) -> Planner:
    """
    Return a planner whose goal is to separate causes.

    Parameters
    ----------
    table : Table
    calibration : Calibration
        Calibration of the extended model of a diagnosis, with the size of the first cause.
    causes : sequence of (sensor, effect name)
        The finding, then its mates: the effects that are collinear with it.
    noise : mapping
        Sensor -> NoiseModel of single samples at `rate`.
    rate : float
        Samples of the IMU per second.
    options : CalibrationOptions
        Its tolerances and catalogue.
    sizes : mapping, optional
        Parameter -> value, SI, of the mates as estimated in the diagnosis in place of the finding;
        without an estimate, as large as they must be to imitate it on a usual session.
    limits : MotionLimits, optional
        Default: the limits of the table.

    Raises
    ------
    InputError
        When the calibration lacks the first cause, or a motion cannot show one of them.

    """
    # The model with all causes, at the values of the calibration.
    finding, *mates = causes
    if finding not in calibration.model.slices:
        raise InputError(
            f"the calibration must contain '{finding[1]}', which is to be separated; give that of"
            ' the diagnosis',
            key='calibration',
        )
    model = calibration.model
    for sensor, name in mates:
        if (sensor, name) not in model.slices:
            model = model.with_effect(sensor, name)
    for cause in causes:
        effect = model.catalogue.find(*cause, model.joint_names)
        no_motion_shows = special(effect) or effect.smooth or 'temperature' in effect.needs
        if no_motion_shows:
            raise InputError(
                f"effects that motion separates must depend on it, '{cause[1]}' depends on time,"
                ' temperature or range; omit it'
            )
    values = model.start_from(calibration.model, calibration.values)
    coordinates = Coordinates(model, tolerances_of(model, options.tolerances), values)
    problem = PlanningProblem(MotionLibrary(table, limits), coordinates, dict(noise), rate=rate)
    # The goal: each cause is found and preferred in a search among all effects of the catalogue.
    n_candidates = len(model.catalogue.effects(model.joint_names))
    collinear = causes_with_sizes(problem, causes, table, sizes=sizes or {})
    problem.goal = ToldApart(coordinates, collinear, n_candidates)
    # Known is what the calibration determines, except for the parameters of the finding: their
    # estimate assumes that it is the true cause.
    rows = {name: k for k, name in enumerate(calibration.param_names)}
    for k in _indices(calibration.model, finding):
        del rows[calibration.param_names[k]]
    problem.known_information = coordinates.information_from(rows, calibration.covariance)
    return Planner(problem)


def causes_with_sizes(
    problem: PlanningProblem,
    causes: Sequence[tuple[str, str]],
    table: Table,
    *,
    sizes: Mapping[str, float],
) -> list[CollinearEffect]:
    """
    Return the causes with their sizes: the first has its value in the model.

    The other ones have the values of `sizes` (parameter -> SI), or where these lack one the size
    that imitates the first cause (`_imitating_sizes`).
    """
    coordinates = problem.coordinates
    names = coordinates.model.param_names
    effects = []
    for key in causes:
        parameters = _indices(coordinates.model, key)
        if not effects:
            values = coordinates.values[parameters]
        else:
            values = np.array([sizes.get(names[k], np.nan) for k in parameters], float)
        size = values / coordinates.units[parameters]
        effects.append(CollinearEffect(key, _places(coordinates, key), size))
    unknown = [effect for effect in effects if np.isnan(effect.size).any()]
    if not unknown:
        return effects
    imitating = _imitating_sizes(problem, effects, unknown, table)
    return [replace(effect, size=imitating.get(effect.key, effect.size)) for effect in effects]


def _imitating_sizes(
    problem: PlanningProblem,
    effects: Sequence[CollinearEffect],
    unknown: Sequence[CollinearEffect],
    table: Table,
) -> dict[tuple[str, str], np.ndarray]:
    """
    Return key -> size of each effect b of `unknown` that imitates the first of `effects`, a.

    The estimate of b on a usual session with a as the true cause and b in the model::

        theta_b = [M_bb - M_br M_rr^-1 M_rb]^-1 [M_ba - M_br M_rr^-1 M_ra] theta_a

    with M the information of the session and r the baseline, which has none of the `effects`.
    """
    windows = problem.predictor.predict([make_profile(SESSION, 0, table).segments])[0]
    times = np.array([window.middle for window in windows])
    information = problem.coordinates.prior_information + exact_information(
        windows, times, problem.noise
    )
    a = effects[0].places
    all_places = np.concatenate([effect.places for effect in effects])
    r = np.setdiff1d(np.arange(len(information)), all_places)
    inverse_rr = np.linalg.inv(information[np.ix_(r, r)])
    sizes = {}
    for effect in unknown:
        b = effect.places
        regression = information[np.ix_(b, r)] @ inverse_rr
        reduced_bb = information[np.ix_(b, b)] - regression @ information[np.ix_(r, b)]
        reduced_ba = information[np.ix_(b, a)] - regression @ information[np.ix_(r, a)]
        sizes[effect.key] = np.linalg.solve(reduced_bb, reduced_ba @ effects[0].size)
    return sizes


def _indices(model: SensorModel, key: tuple[str, str]) -> np.ndarray:
    """Return the indexes of the parameters of an effect in its model."""
    parameters = model.slices[key]
    return np.arange(parameters.start, parameters.stop)


def _places(coordinates: Coordinates, key: tuple[str, str]) -> np.ndarray:
    """Return the coordinate z of each parameter of an effect."""
    basis = coordinates.basis[_indices(coordinates.model, key)]
    return np.argmax(np.abs(basis), axis=1)


TIME_OVER = 'the time given is over'
IN_VAIN = 'motions no longer reduce the standard deviations as planned: the limit is not noise'
STALL_MOTIONS = 6
"""Motions after which the standard deviations must have decreased."""
MAX_REMAINING_SHARE = 0.93
"""
Largest share of the distance to the tolerances that may remain after them; otherwise further
motions do not pay.
"""


@dataclass(frozen=True)
class CampaignSettings:
    """When to end."""

    time_limit: float = setting(
        1800.0,
        's',
        'time given to all motions together, by the stamps of the joint states',
        (1.0, 1e6),
        'too small: parameters stay outside their tolerance',
        live=True,
    )
    separations: int = setting(
        2,
        '1',
        'largest number of extra motions that separate collinear causes of the diagnosis; 0: none,'
        ' and no diagnosis at the end',
        (0, 20),
        'too small: a finding remains collinear with other effects',
        live=True,
    )


@dataclass(frozen=True)
class CollinearFinding:
    """A finding of a diagnosis and the effects that are collinear with it."""

    effect: str
    """Published name."""
    mates: tuple[str, ...] = ()
    """Effects that are collinear with it."""
    sizes: dict[str, float] = field(default_factory=dict)
    """Parameter -> value, SI, of the effect and of each mate in its place."""


class Campaign:
    """
    A sequence of motions, each chosen after the one before.

    Parameters
    ----------
    planner : Planner
    settings : CampaignSettings
    make_separator : callable, optional
        Returns a planner of motions that separate a CollinearFinding from its mates, or raises an
        ImuCalibrationError if none exists.
    first : callable, optional
        Returns the first motion from a position, None for none.
    unwind : callable, optional
        Returns the motion that turns wound joints back from a position, None if none is needed;
        driven before the campaign ends.

    """

    def __init__(
        self,
        planner: Planner,
        settings: CampaignSettings = CampaignSettings(),
        make_separator: Callable[[CollinearFinding], Planner] | None = None,
        *,
        first: Callable[[np.ndarray], Any] = lambda position: None,
        unwind: Callable[[np.ndarray], Any] = lambda position: None,
    ):
        self.planner = planner
        self.settings = settings
        self._make_separator = make_separator
        self._unwind = unwind
        self._first: Callable[[np.ndarray], Any] | None = first
        """Returns the first motion; None after the first decision."""
        self._separator: Planner | None = None
        """Planner of the present separating motions; None while there are none."""
        self.findings: list[CollinearFinding] | None = None
        """Findings of the last diagnosis, the strongest first; None before the first diagnosis."""
        self.separations = 0
        """Number of separations that were begun."""
        self.told_apart: tuple[str, ...] = ()
        """The collinear class of the last separating motion."""
        self._is_diagnosed = False
        """Whether a diagnosis was made since the last motion."""
        self._distances: list[float] = []
        """Distance to the tolerances after each calibration, sum of ln(sd / tolerance) above 0."""

    @property
    def worst(self) -> tuple[str, float]:
        """
        The parameter furthest outside its tolerance, and its standard deviation over tolerance.
        """
        excess = self.planner.excess
        return max(excess.items(), key=lambda item: item[1]) if excess else ('', 0.0)

    def take(self, calibration: Any) -> None:
        """Replace the predicted information by that measured in the motions so far."""
        self.planner.take(calibration)
        excess = self.planner.excess.values()
        self._distances.append(sum(max(math.log(ratio), 0.0) for ratio in excess if ratio > 0))

    def take_findings(self, findings: list[CollinearFinding] | None) -> str:
        """
        Store the findings of a diagnosis, None if it failed.

        Return the resulting action as text, '' for none.
        """
        self._is_diagnosed = True
        if findings is None:
            return ''
        self.findings = findings
        if self.separations >= self.settings.separations or self._make_separator is None:
            return ''
        collinear = [finding for finding in findings if finding.mates]
        if not collinear:
            return ''
        finding = collinear[0]  # the strongest
        reason = (
            f'{finding.effect} is collinear with {", ".join(finding.mates)} in the motion so far'
        )
        try:
            self._separator = self._make_separator(finding)
        except ImuCalibrationError as error:
            return f'{reason}, and no motion is known that separates them: {error}'
        self.separations += 1
        self.told_apart = (finding.effect, *finding.mates)
        # A separating motion need not reduce the distances to the tolerances.
        self._distances.clear()
        return f'{reason}: planning the motion that separates them'

    @property
    def is_separating(self) -> bool:
        """Whether the present motions separate collinear causes."""
        return self._separator is not None

    def decide(self, position: np.ndarray, elapsed: float) -> Decision:
        """
        Return the next decision.

        Parameters
        ----------
        position : ndarray, shape (n_joints,)
            Where the joints rest.
        elapsed : float
            Seconds since the first motion began.

        """
        if self._first is not None:
            first = self._first
            self._first = None
            motion = first(position)
            if motion is not None:
                return Decision(motion, 'the first motion is small and slow')
        decision = self._decide(position, elapsed)
        if decision.motion is None and not decision.diagnose:
            motion = self._unwind(position)
            if motion is not None:
                why = f'{decision.why}; before the end, endless joints are unwound'
                return Decision(motion, why)
        return decision

    def _decide(self, position: np.ndarray, elapsed: float) -> Decision:
        """Return the next decision, without the first motion and the unwinding."""
        if elapsed >= self.settings.time_limit:
            return Decision(why=f'{TIME_OVER}{self._outside()}')
        if self._separator is not None:
            # By prediction only: a calibration has no information on causes that its model lacks.
            step = self._separator.next_motion(position)
            if step.motion is None:
                self._separator = None
                return Decision(diagnose=True, why='the causes should be separable now')
        elif self._has_stalled:
            return self._ending(IN_VAIN)
        else:
            step = self.planner.next_motion(position)
            if step.motion is None:
                return self._ending(step.why)
        if elapsed + step.seconds > self.settings.time_limit:
            return Decision(
                why=f'{TIME_OVER}: the next motion takes {step.seconds:.0f} s{self._outside()}'
            )
        self._is_diagnosed = False
        return step

    def _ending(self, reason: str) -> Decision:
        """Return the end for a reason, or the diagnosis that must precede it."""
        if self.settings.separations and not self._is_diagnosed:
            return Decision(diagnose=True, why=reason)
        return Decision(why=reason + self._outside() + self._findings_text())

    @property
    def _has_stalled(self) -> bool:
        """Whether the last motions gave almost none of the predicted reduction."""
        if len(self._distances) <= STALL_MOTIONS:
            return False
        earlier = self._distances[-1 - STALL_MOTIONS]
        return self._distances[-1] > MAX_REMAINING_SHARE * earlier > 0

    def _outside(self) -> str:
        """Return the parameters outside their tolerance as the end of a sentence, '' for none."""
        missing = [name for name, excess in self.planner.excess.items() if excess > 1.0]
        if not missing:
            return ''
        text = f'; outside its tolerance: {", ".join(missing[:3])}'
        if len(missing) > 3:
            text += f' and {len(missing) - 3} more'
        return text

    def _findings_text(self) -> str:
        """Return the findings as the end of a sentence, '' for none."""
        if not self.findings:
            return ''
        texts = []
        for finding in self.findings:
            text = finding.effect
            if finding.mates:
                text += f' (collinear with {", ".join(finding.mates)})'
            texts.append(text)
        return f'; beyond bias and matrix there is {", ".join(texts)}'


LONGEST_SEPARATION = 180.0
"""
Longest plan that separates causes, s; causes that need more count as one cause for this table.
"""


def separator_of(
    table: Table,
    calibration: Calibration,
    finding: CollinearFinding,
    *,
    noise: dict[str, NoiseModel],
    rate: float = 100.0,
    options: CalibrationOptions = CalibrationOptions(),
    limits: MotionLimits | None = None,
) -> Planner:
    """
    Return the planner of the motion that separates a finding from its mates.

    Parameters
    ----------
    table : Table
    calibration : Calibration
        The calibration, of a model that may lack the finding.
    finding : CollinearFinding
    noise : mapping
        Sensor -> NoiseModel of single samples at `rate`.
    rate : float
        Samples of the IMU per second.
    options : CalibrationOptions
        Tolerances and catalogue.
    limits : MotionLimits, optional
        Default: the limits of the table.

    Raises
    ------
    InputError
        When an effect is unknown, or no motion can show it.

    """
    causes = [
        (options.catalogue.owner_of(name, table.joint_names), name)
        for name in (finding.effect, *finding.mates)
    ]
    planner = make_separator(
        table,
        with_finding(calibration, causes[0], finding.sizes),
        causes,
        noise=noise,
        rate=rate,
        options=options,
        sizes=finding.sizes,
        limits=limits,
    )
    planner.drop_inseparable(LONGEST_SEPARATION)
    return planner


def with_finding(
    calibration: Calibration, cause: tuple[str, str], sizes: dict[str, float]
) -> Calibration:
    """
    Return the calibration with an effect at its estimated size; the other parameters do not change.

    The covariance of the effect is that of its prior. `sizes`: parameter -> value, SI; 0 for a
    parameter without one.
    """
    if cause in calibration.model.slices:
        return calibration
    model = calibration.model.with_effect(*cause)
    effect = next(each for each in model.effects if (each.sensor, each.name) == cause)
    values = model.start_from(calibration.model, calibration.values)
    values[model.slices[cause]] = [sizes.get(name, 0.0) for name in effect.param_names()]
    # Covariance and status: of the prior for the effect, of the calibration for known parameters.
    known = [model.param_names.index(name) for name in calibration.param_names]
    covariance = np.diag(model.prior()[1] ** 2)
    status = [HELD] * len(values)
    covariance[np.ix_(known, known)] = calibration.covariance
    for index, known_status in zip(known, calibration.status, strict=True):
        status[index] = known_status
    return replace(
        calibration,
        model=model.at(values),
        values=values,
        covariance=covariance,
        status=tuple(status),
    )
