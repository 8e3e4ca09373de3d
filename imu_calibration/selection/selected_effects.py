"""Result of a search of effects in a recording, for any reference."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.explained_share import Explained
from imu_calibration.selection.order_of_tests import SearchProblem
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Search
from imu_calibration.selection.unexplained import Unexplained


class SensorLimit(Protocol):
    """Range of a sensor that its outputs do not exceed."""

    @property
    def sensor(self) -> str:
        """'accelerometer' or 'gyroscope'."""


@dataclass(frozen=True)
class SelectionSettings:
    """How a solution with the findings of a search judges them."""

    joint_test: bool = True
    """
    Whether the coefficients of an effect have to be significant together, in addition to one alone.
    """
    judge_requested: bool = True
    """Whether findings that are in the requested model have to be significant, too."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SelectedEffects:
    """
    Findings of a search on data of any reference, separated by plausibility of their sizes.

    A reference that searches for more than effects overrides the properties that are empty here.
    """

    settings: ClassVar[SelectionSettings] = SelectionSettings()
    problem: SearchProblem
    """The data of the search."""
    named: Sequence[Question]
    """Questions that became findings, in the order found."""
    not_testable: list[dict]
    """Effects that could not be tested."""
    unstable: Sequence[Question] = ()
    """
    Questions that would have become findings, but the parts of the recording disagree on them.
    """
    rejected: Sequence[Question] = ()
    """
    Questions selected by likelihood but not named: their gain is too small, or the remaining excess
    too large.
    """
    limits: Sequence[SensorLimit] = ()
    """Limits at which outputs pile up."""

    @property
    def changed_at(self) -> float | None:
        """Time at which parameters change, s; None where no search looked for it."""
        return None

    @property
    def jitter_entry(self) -> Mapping[str, Any]:
        """Entry of a document for independent errors of the stamps; empty without any."""
        return {}

    @property
    def further_moves(self) -> Sequence[tuple[Mapping[str, float], float]]:
        """(changes of parameters by other causes than effects that are not named, weight)."""
        return ()

    @property
    def param_names(self) -> Sequence[str]:
        """Names of the parameters of the baseline and of the effects under test."""
        raise NotImplementedError

    @property
    def baseline_model(self) -> SensorModel:
        """The model that the search extends."""
        raise NotImplementedError

    @property
    def point_of_named(self) -> Mapping[str, np.ndarray]:
        """Effect -> values at which its columns are linearised, in the model with all findings."""
        raise NotImplementedError

    @property
    def point_of_adopted(self) -> dict[str, np.ndarray]:
        """Effect -> values at which its columns are linearised, of the adopted effects."""
        point = self.point_of_named
        adopted = [question.name for question in self.adopted]
        return {name: point[name] for name in adopted if name in point}

    def clipped_solution(self) -> Solution | None:
        """
        Return the solution of a search that found a limit of a sensor, without saturated samples.

        None where it found no limit.
        """
        return None

    def unexplained_rests(self) -> Mapping[str, Unexplained]:
        """
        Return sensor -> its residual that no finding explains.

        Intermediate results are freed.
        """
        raise NotImplementedError

    @property
    def search(self) -> Search:
        """Search in which the findings were chosen."""
        return self.problem.search

    @property
    def explained(self) -> Explained:
        """Excess over noise, and the share of it that effects remove."""
        return self.problem.explained

    @property
    def implausible(self) -> list[Question]:
        """
        Findings with sizes above those of any known instrument.

        They are reported, but added to a model only on request.
        """
        search = self.search
        return [question for question in self.named if search.implausible(self.named, question)]

    @property
    def adopted(self) -> list[Question]:
        """Findings of plausible sizes, which are added to the model."""
        implausible = self.implausible
        return [question for question in self.named if question not in implausible]
