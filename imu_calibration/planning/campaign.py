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
        The finding, then its collinear alternatives.
    noise : mapping
        Sensor -> NoiseModel of single samples at `rate`.
    rate : float
        Samples of the IMU per second.
    options : CalibrationOptions
        Its tolerances and catalogue.
    sizes : mapping, optional
        Parameter -> value, SI, of the alternatives as estimated in the diagnosis in place of the
        first; without an estimate, as large as they must be to pass for it on a usual session.
    limits : MotionLimits, optional
        Default: the limits of the table.

    Raises
    ------
    InputError
        When the calibration lacks the first cause, or a motion cannot show one of them.

    """
    first, *mates = causes
    if first not in calibration.model.slices:
        raise InputError(
            f"the calibration must contain '{first[1]}', which is to be separated; give that of the"
            ' diagnosis',
            key='calibration',
        )
    model = calibration.model
    for sensor, name in mates:
        if (sensor, name) not in model.slices:
            model = model.with_effect(sensor, name)
    for key in causes:
        effect = model.catalogue.find(*key, model.joint_names)
        if special(effect) or effect.smooth or 'temperature' in effect.needs:
            raise InputError(
                f"effects that motion separates must depend on it, '{key[1]}' depends on time,"
                ' temperature or range; omit it'
            )
    values = model.start_from(calibration.model, calibration.values)
    coordinates = Coordinates(model, tolerances_of(model, options.tolerances), values)
    problem = PlanningProblem(MotionLibrary(table, limits), coordinates, dict(noise), rate=rate)
    questions = len(model.catalogue.effects(model.joint_names))
    problem.goal = ToldApart(
        coordinates, suspected(problem, causes, table, sizes=sizes or {}), questions
    )
    names = {
        name: k
        for k, name in enumerate(calibration.param_names)
        if k not in _indices(calibration.model, first)
    }
    problem.known = coordinates.information_from(names, calibration.covariance)
    return Planner(problem)


def suspected(
    problem: PlanningProblem,
    causes: Sequence[tuple[str, str]],
    table: Table,
    *,
    sizes: Mapping[str, float],
) -> list[CollinearEffect]:
    """
    Return the causes with their sizes.

    The first as estimated, the mates with the size that imitates it.

    If `sizes` lacks a mate, ``theta_b = [M_bb - M_br M_rr^-1 M_rb]^-1 [M_ba - M_br M_rr^-1 M_ra]
    theta_a``, M the information of a usual session, r the baseline.
    """
    coordinates = problem.coordinates
    found = []
    for key in causes:
        places = _indices(coordinates.model, key)
        names = coordinates.model.param_names
        known = (
            coordinates.values[places]
            if not found
            else [sizes.get(names[k], np.nan) for k in places]
        )
        found.append(
            CollinearEffect(
                key, _places(coordinates, key), np.asarray(known, float) / coordinates.units[places]
            )
        )
    unknown = [cause for cause in found if np.isnan(cause.size).any()]
    passing = _imitating(problem, found, unknown, table) if unknown else {}
    return [replace(cause, size=passing.get(cause.key, cause.size)) for cause in found]


def _imitating(problem, causes, unknown, table):
    """
    Return the sizes that causes must have to pass for the first one on a usual session, by key.
    """
    windows = problem.predictor.predict([make_profile(SESSION, 0, table).segments])[0]
    times = np.array([window.middle for window in windows])
    information = problem.coordinates.prior_information + exact_information(
        windows, times, problem.noise
    )
    first = causes[0]
    found = {}
    rest = np.setdiff1d(
        np.arange(len(information)), np.concatenate([cause.places for cause in causes])
    )
    inner = np.linalg.inv(information[np.ix_(rest, rest)])
    for cause in unknown:
        across = information[np.ix_(cause.places, rest)] @ inner
        bb = (
            information[np.ix_(cause.places, cause.places)]
            - across @ information[np.ix_(rest, cause.places)]
        )
        ba = (
            information[np.ix_(cause.places, first.places)]
            - across @ information[np.ix_(rest, first.places)]
        )
        found[cause.key] = np.linalg.solve(bb, ba @ first.size)
    return found


def _indices(model, key):
    part = model.slices[key]
    return np.arange(part.start, part.stop)


def _places(coordinates, key):
    return np.array(
        [int(np.argmax(np.abs(coordinates.basis[k]))) for k in _indices(coordinates.model, key)]
    )


TIME_OVER = 'the time given is over'
IN_VAIN = 'motions no longer reduce the standard deviations as planned: the limit is not noise'
STALL_MOTIONS = 6
"""Motions after which the standard deviations must have decreased."""
MAX_REMAINING_SHARE = 0.93
"""
Largest share of the logarithms of excess over tolerance that may remain after them; otherwise
further motions do not pay.
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
class Suspect:
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
        Returns a planner of motions that separate a Suspect from its mates, or raises an
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
        make_separator: Callable[[Suspect], Planner] | None = None,
        *,
        first: Callable[[np.ndarray], Any] = lambda position: None,
        unwind: Callable[[np.ndarray], Any] = lambda position: None,
    ):
        self.planner = planner
        self.settings = settings
        self._make_separator = make_separator
        self._unwind = unwind
        self._first: Callable[[np.ndarray], Any] | None = first
        self._separator: Planner | None = None
        self.findings: list[Suspect] | None = None
        """Findings of the last diagnosis, the strongest first; None before the first diagnosis."""
        self.separations = 0
        self.told_apart: tuple[str, ...] = ()
        """The collinear class of the last separating motion."""
        self._is_asked = False
        self._left: list[float] = []

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
        self._left.append(
            sum(max(math.log(excess), 0.0) for excess in self.planner.excess.values() if excess > 0)
        )

    def take_findings(self, findings: list[Suspect] | None) -> str:
        """
        Store the findings of a diagnosis, None if it failed.

        Return the resulting action as text, '' for none.
        """
        self._is_asked = True
        self.findings = self.findings if findings is None else findings
        for finding in findings or []:
            if (
                finding.mates
                and self.separations < self.settings.separations
                and self._make_separator is not None
            ):
                what = (
                    f'{finding.effect} is collinear with {", ".join(finding.mates)} in the motion'
                    ' so far'
                )
                try:
                    self._separator = self._make_separator(finding)
                except ImuCalibrationError as error:
                    return f'{what}, and no motion is known that separates them: {error}'
                self.separations += 1
                self.told_apart = (finding.effect, *finding.mates)
                self._left.clear()
                return f'{what}: planning the motion that separates them'
        return ''

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
        first, self._first = self._first, None
        if first is not None and (motion := first(position)) is not None:
            return Decision(motion, 'the first motion is small and slow')
        decision = self._decide(position, elapsed)
        if (
            decision.motion is None
            and not decision.diagnose
            and (motion := self._unwind(position)) is not None
        ):
            return Decision(motion, f'{decision.why}; before the end, endless joints are unwound')
        return decision

    def _decide(self, position, elapsed):
        if elapsed >= self.settings.time_limit:
            return Decision(why=f'{TIME_OVER}{self._outside()}')
        step = None if self._separator is None else self._separator.next_motion(position)
        # Predicted only: a calibration has no information on causes that its model lacks.
        if step is None or step.motion is None:
            has_separated = self._separator is not None
            self._separator = None
            if has_separated:
                return Decision(diagnose=True, why='the causes should be separable now')
            if self._promises_in_vain:
                return self._ending(IN_VAIN)
            step = self.planner.next_motion(position)
        if step.motion is not None and elapsed + step.seconds > self.settings.time_limit:
            return Decision(
                why=f'{TIME_OVER}: the next motion takes {step.seconds:.0f} s{self._outside()}'
            )
        if step.motion is not None:
            self._is_asked = False
            return step
        return self._ending(step.why)

    def _ending(self, reason):
        if self.settings.separations and not self._is_asked:
            return Decision(diagnose=True, why=reason)
        return Decision(why=reason + self._outside() + self._named())

    @property
    def _promises_in_vain(self):
        """Whether the last motions gave almost none of the predicted reduction."""
        return (
            len(self._left) > STALL_MOTIONS
            and self._left[-1] > MAX_REMAINING_SHARE * self._left[-1 - STALL_MOTIONS] > 0
        )

    def _outside(self):
        missing = [name for name, excess in self.planner.excess.items() if excess > 1.0]
        if not missing:
            return ''
        return f'; outside its tolerance: {", ".join(missing[:3])}' + (
            f' and {len(missing) - 3} more' if missing[3:] else ''
        )

    def _named(self):
        if not self.findings:
            return ''
        mates = [
            f' (collinear with {", ".join(each.mates)})' if each.mates else ''
            for each in self.findings
        ]
        return '; beyond bias and matrix there is ' + ', '.join(
            each.effect + text for each, text in zip(self.findings, mates, strict=True)
        )


LONGEST_SEPARATION = 180.0
"""
Longest plan that separates causes, s; causes that need more count as one cause for this table.
"""


def separator_of(
    table: Table,
    calibration: Calibration,
    suspect: Suspect,
    *,
    noise: dict[str, NoiseModel],
    rate: float = 100.0,
    options: CalibrationOptions = CalibrationOptions(),
    limits: MotionLimits | None = None,
) -> Planner:
    """
    Return the planner of the motion that separates a suspect from its mates.

    Parameters
    ----------
    table : Table
    calibration : Calibration
        The calibration, of a model that may lack the suspect.
    suspect : Suspect
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
        for name in (suspect.effect, *suspect.mates)
    ]
    planner = make_separator(
        table,
        with_suspect(calibration, causes[0], suspect.sizes),
        causes,
        noise=noise,
        rate=rate,
        options=options,
        sizes=suspect.sizes,
        limits=limits,
    )
    planner.within(LONGEST_SEPARATION)
    return planner


def with_suspect(
    calibration: Calibration, cause: tuple[str, str], sizes: dict[str, float]
) -> Calibration:
    """
    Return the calibration with an effect at its estimated size; the other parameters do not change.
    """
    if cause in calibration.model.slices:
        return calibration
    model = calibration.model.with_effect(*cause)
    effect = next(each for each in model.effects if (each.sensor, each.name) == cause)
    values = model.start_from(calibration.model, calibration.values)
    values[model.slices[cause]] = [sizes.get(name, 0.0) for name in effect.param_names()]
    places = [model.param_names.index(name) for name in calibration.param_names]
    covariance = np.diag(model.prior()[1] ** 2)
    status = [HELD] * len(values)
    covariance[np.ix_(places, places)] = calibration.covariance
    for place, known in zip(places, calibration.status, strict=True):
        status[place] = known
    return replace(
        calibration,
        model=model.at(values),
        values=values,
        covariance=covariance,
        status=tuple(status),
    )
