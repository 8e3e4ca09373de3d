"""What a recording did to the model that was asked for: effects it demands, and effects that it was not believed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.estimation.covariance_terms import REJECTED, with_term
from imu_calibration.estimation.solution import Solution


@dataclass(frozen=True)
class ModelChanges:
    """Names of effects, the strongest first."""

    added: tuple[str, ...] = ()
    """Taken into the model because the recording demands them."""
    denied: tuple[str, ...] = ()
    """Not taken in because parts of the recording disagree on them; the standard deviations allow for them."""
    implausible: dict[str, float] = field(default_factory=dict)
    """
    Not taken in because their sizes are known of no instrument -> share of what the model leaves that each explains; the standard
    deviations allow for them.
    """
    lacking: tuple[str, ...] = ()
    """Demanded, but the motion of before is no longer kept, so that they cannot join; the standard deviations allow for them."""

    def to_mapping(self) -> dict:
        """Return the part of a document's statistics."""
        changes = (('added', list(self.added)), ('denied', list(self.denied)), ('implausible', self.implausible),
                   ('lacking', list(self.lacking)))
        return {name: value for name, value in changes if value}

    @classmethod
    def from_mapping(cls, known: Mapping[str, Any]) -> 'ModelChanges':
        """Return the changes that `to_mapping` told."""
        return cls(tuple(known.get('added', ())), tuple(known.get('denied', ())), dict(known.get('implausible', {})),
                   tuple(known.get('lacking', ())))


@dataclass(frozen=True, eq=False)
class Demand:
    """What a recording demands of the model: all that another solution of the same windows, and more, needs to know of a search."""

    added: tuple[tuple[str, str], ...] = ()
    """(sensor, effect) beyond what is asked for."""
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Effect -> values at which columns are taken first."""
    changes: ModelChanges = ModelChanges()
    """The same in words, for the document."""
    moves: tuple[tuple[Mapping[str, float], float], ...] = ()
    """(parameter -> what another choice would have moved it by, weight of that choice)."""
    clipped: Solution | None = None
    """The solution without what a limit of a sensor spoils, where the search found one."""

    def options(self, asked: CalibrationOptions) -> CalibrationOptions:
        """Return the options of the model that is solved."""
        return replace(asked, added=self.added, point=self.point)

    def disagreement(self, names: Sequence[str]) -> np.ndarray:
        """Return the covariance of what other choices would have moved parameters by, shape (n_params, n_params)."""
        total = np.zeros((len(names),) * 2)
        for moved, weight in self.moves:
            shift = np.array([moved.get(name, 0.0) for name in names])
            total += weight * np.outer(shift, shift)
        return total

    def applied(self, solution: Solution) -> Solution:
        """Return a solution of `options`, or that without clipped samples, with the covariance of rejected and collinear effects."""
        found = self.clipped or solution
        return replace(found, terms=with_term(found.terms, REJECTED, self.disagreement(found.param_names)))

    @property
    def is_nothing(self) -> bool:
        """Whether a solution of what was asked for stays as it is."""
        return not (self.added or self.moves or self.clipped or self.changes != ModelChanges())

    def to_mapping(self) -> dict[str, Any]:
        """Return what a saved session keeps of it; the solution of a search is made anew."""
        return {'added': [list(key) for key in self.added], 'changes': self.changes.to_mapping(),
                'moves': [[dict(moved), weight] for moved, weight in self.moves]}

    @classmethod
    def from_mapping(cls, known: Mapping[str, Any], point: Mapping[str, Any]) -> 'Demand':
        """Return what `to_mapping` kept, with the point of the columns that were saved beside it."""
        added = tuple((str(sensor), str(name)) for sensor, name in known.get('added', ()))
        return cls(added, {name: np.asarray(point[name], float) for _, name in added if name in point},
                   ModelChanges.from_mapping(known.get('changes', {})),
                   tuple((moved, float(weight)) for moved, weight in known.get('moves', ())))
