"""The next step of a campaign: a motion, a diagnosis, or the end with its reason."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from imu_calibration.errors import ImuCalibrationError
from imu_calibration.settings import setting

TIME_OVER = 'the time given is over'
IN_VAIN = 'motions no longer reduce the standard deviations as planned: the limit is not noise'
PATIENCE = 6
"""Motions after which the standard deviations must have decreased."""
LEAST_SHARE = 0.93
"""Largest share of the logarithms of excess over tolerance that may remain after them; otherwise further motions do not pay."""


class MotionPlanner(Protocol):
    """Interface of a planner (`planning.planner.Planner`)."""

    @property
    def excess(self) -> dict[str, float]:
        """Standard deviation over tolerance of each requested parameter."""

    def take(self, calibration: Any) -> None:
        """Replace the predicted information by the measured information."""

    def next_motion(self, position: np.ndarray) -> Any:
        """Return the NextMotion from where the joints are, and count on it."""



@dataclass(frozen=True)
class CampaignSettings:
    """When to end."""

    time_limit: float = setting(1800.0, 's', 'time given to all motions together, by the stamps of the joint states', (1.0, 1e6),
                                'too small: parameters stay outside their tolerance', live=True)
    separations: int = setting(2, '1', 'largest number of extra motions that separate collinear causes of the diagnosis; 0: none, and '
                               'no diagnosis at the end', (0, 20), 'too small: a finding remains collinear with other effects', live=True)


@dataclass(frozen=True)
class Suspect:
    """A finding of a diagnosis and the effects that are collinear with it."""

    effect: str
    """Published name."""
    mates: tuple[str, ...] = ()
    """Effects that are collinear with it."""
    sizes: dict[str, float] = field(default_factory=dict)
    """Parameter -> value, SI, of the effect and of each mate in its place."""


@dataclass(frozen=True)
class Decision:
    """The next step: exactly one of a motion, a diagnosis and the end."""

    motion: Any = None
    """PlannedMotion to be driven."""
    diagnose: bool = False
    """Whether to diagnose."""
    why: str = ''
    """One line."""


class Campaign:
    """
    Goes from motion to motion.

    Parameters
    ----------
    planner : MotionPlanner
    settings : CampaignSettings
    make_separator : callable, optional
        Returns a planner of motions that separate a Suspect from its mates, or raises an ImuCalibrationError if none exists.
    first : callable, optional
        Returns the first motion from a position, None for none.
    unwind : callable, optional
        Returns the motion that turns wound joints back from a position, None if none is needed; driven before the campaign ends.

    """

    def __init__(self, planner: MotionPlanner, settings: CampaignSettings = CampaignSettings(),
                 make_separator: Callable[[Suspect], MotionPlanner] | None = None, *,
                 first: Callable[[np.ndarray], Any] = lambda position: None,
                 unwind: Callable[[np.ndarray], Any] = lambda position: None):
        self.planner, self.settings, self._make_separator, self._unwind = planner, settings, make_separator, unwind
        self._first: Callable[[np.ndarray], Any] | None = first
        self._separator: MotionPlanner | None = None
        self.findings: list[Suspect] | None = None
        """Findings of the last diagnosis, the strongest first; None before the first diagnosis."""
        self.separations = 0
        self.told_apart: tuple[str, ...] = ()
        """The collinear class of the last separating motion."""
        self._is_asked = False
        self._left: list[float] = []

    @property
    def worst(self) -> tuple[str, float]:
        """The parameter furthest outside its tolerance, and its standard deviation over tolerance."""
        excess = self.planner.excess
        return max(excess.items(), key=lambda item: item[1]) if excess else ('', 0.0)

    def take(self, calibration: Any) -> None:
        """Replace the predicted information by that measured in the motions so far."""
        self.planner.take(calibration)
        self._left.append(sum(max(math.log(excess), 0.0) for excess in self.planner.excess.values() if excess > 0))

    def take_findings(self, findings: list[Suspect] | None) -> str:
        """Store the findings of a diagnosis, None if it failed; return the resulting action as text, '' for none."""
        self._is_asked = True
        self.findings = self.findings if findings is None else findings
        for finding in findings or []:
            if finding.mates and self.separations < self.settings.separations and self._make_separator is not None:
                what = f'{finding.effect} is collinear with {", ".join(finding.mates)} in the motion so far'
                try:
                    self._separator = self._make_separator(finding)
                except ImuCalibrationError as error:
                    return f'{what}, and no motion is known that separates them: {error}'
                self.separations, self.told_apart = self.separations + 1, (finding.effect, *finding.mates)
                self._left.clear()
                return f'{what}: planning the motion that separates them'
        return ''

    @property
    def is_separating(self) -> bool:
        """Whether the present motions separate collinear causes."""
        return self._separator is not None

    def decide(self, position: np.ndarray, elapsed: float) -> Decision:
        """
        Return what to do next.

        Parameters
        ----------
        position : ndarray, shape (n_joints,)
            Where the joints rest.
        elapsed : float
            Seconds since the first motion began.

        """
        first, self._first = self._first, None
        if first is not None and (motion := first(position)) is not None:
            return Decision(motion, why='the first motion is small and slow')
        decision = self._decide(position, elapsed)
        if decision.motion is None and not decision.diagnose and (motion := self._unwind(position)) is not None:
            return Decision(motion, why=f'{decision.why}; before the end, endless joints are unwound')
        return decision

    def _decide(self, position, elapsed):
        if elapsed >= self.settings.time_limit:
            return Decision(why=f'{TIME_OVER}{self._outside()}')
        step = None if self._separator is None else self._separator.next_motion(position)
        if step is None or step.motion is None:   # predicted only: a calibration has no information on causes that its model lacks
            has_separated, self._separator = self._separator is not None, None
            if has_separated:
                return Decision(diagnose=True, why='the causes should be separable now')
            if self._promises_in_vain:
                return self._ending(IN_VAIN)
            step = self.planner.next_motion(position)
        if step.motion is not None and elapsed + step.seconds > self.settings.time_limit:
            return Decision(why=f'{TIME_OVER}: the next motion takes {step.seconds:.0f} s{self._outside()}')
        if step.motion is not None:
            self._is_asked = False
            return Decision(step.motion, why=step.reason)
        return self._ending(step.reason)

    def _ending(self, reason):
        if self.settings.separations and not self._is_asked:
            return Decision(diagnose=True, why=reason)
        return Decision(why=reason + self._outside() + self._named())

    @property
    def _promises_in_vain(self):
        """Whether the last motions gave almost none of the predicted reduction."""
        return len(self._left) > PATIENCE and self._left[-1] > LEAST_SHARE * self._left[-1 - PATIENCE] > 0

    def _outside(self):
        missing = [name for name, excess in self.planner.excess.items() if excess > 1.0]
        if not missing:
            return ''
        return f'; outside its tolerance: {", ".join(missing[:3])}' + (f' and {len(missing) - 3} more' if missing[3:] else '')

    def _named(self):
        if not self.findings:
            return ''
        mates = [f' (collinear with {", ".join(each.mates)})' if each.mates else '' for each in self.findings]
        return '; beyond bias and matrix there is ' + ', '.join(each.effect + text for each, text in zip(self.findings, mates, strict=True))
