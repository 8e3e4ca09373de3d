"""Changes of the requested model by a recording: added effects, and effects that were found but rejected."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from imu_calibration.estimation.covariance_terms import REJECTED, with_term
from imu_calibration.estimation.solution import Solution
from imu_calibration.references.options import CalibrationOptions


@dataclass(frozen=True)
class ModelChanges:
    """Names of effects, the strongest first."""

    added: tuple[str, ...] = ()
    """Added to the model because the data support them."""
    denied: tuple[str, ...] = ()
    """Not added because the estimates of parts of the recording differ; the standard deviations allow for them."""
    implausible: dict[str, float] = field(default_factory=dict)
    """
    Not added because no known instrument has effects of this size -> explained share of the excess variance; the standard
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
        """Return the changes from the mapping of `to_mapping`."""
        return cls(tuple(known.get('added', ())), tuple(known.get('denied', ())), dict(known.get('implausible', {})),
                   tuple(known.get('lacking', ())))


@dataclass(frozen=True, eq=False)
class Demand:
    """Effects that a recording supports: the result of a search as needed for further solutions of the same and more windows."""

    added: tuple[tuple[str, str], ...] = ()
    """(sensor, effect) in addition to the requested ones."""
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Effect -> values of the first linearisation."""
    changes: ModelChanges = ModelChanges()
    """The same as text, for the document."""
    moves: tuple[tuple[Mapping[str, float], float], ...] = ()
    """(parameter -> its change under another choice of effects, weight of that choice)."""
    clipped: Solution | None = None
    """The solution without saturated samples if the search found a limit of a sensor."""

    def options(self, asked: CalibrationOptions) -> CalibrationOptions:
        """Return the options of the model that is solved."""
        return replace(asked, added=self.added, point=self.point)

    def disagreement(self, names: Sequence[str]) -> np.ndarray:
        """Return the covariance of the changes of parameters by other choices of effects, shape (n_params, n_params)."""
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
        """Whether the solution of the requested model is unchanged."""
        return not (self.added or self.moves or self.clipped or self.changes != ModelChanges())

    def to_mapping(self) -> dict[str, Any]:
        """Return the content that is saved with a session; the solution of a search is computed again."""
        return {'added': [list(key) for key in self.added], 'changes': self.changes.to_mapping(),
                'moves': [[dict(moved), weight] for moved, weight in self.moves]}

    @classmethod
    def from_mapping(cls, known: Mapping[str, Any], point: Mapping[str, Any]) -> 'Demand':
        """Return the Demand from the mapping of `to_mapping`, with the separately saved point of the columns."""
        added = tuple((str(sensor), str(name)) for sensor, name in known.get('added', ()))
        return cls(added, {name: np.asarray(point[name], float) for _, name in added if name in point},
                   ModelChanges.from_mapping(known.get('changes', {})),
                   tuple((moved, float(weight)) for moved, weight in known.get('moves', ())))
