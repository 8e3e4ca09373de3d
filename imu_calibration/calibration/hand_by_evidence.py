"""Common model selection for `calibrate` and `diagnose` by hand: the model has the effects that the poses and turns support."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from imu_calibration.calibration.from_solution import ModelChanges
from imu_calibration.document.calibration import one_significant
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.covariance_terms import REJECTED, with_term
from imu_calibration.references.gravity.hand_calibration import HandCalibration, HandData, default_gyroscope, solve_by_hand
from imu_calibration.references.gravity.hand_options import HandOptions

if TYPE_CHECKING:
    from imu_calibration.references.gravity.model_selection import HandInvestigation


@dataclass(frozen=True, eq=False)
class EvidentHand:
    """A calibration by hand with the search results of its model."""

    hand: HandCalibration
    """The calibration."""
    found: 'HandInvestigation | None' = None
    """Search result; None with too few poses, or without a search."""
    changes: ModelChanges = ModelChanges()
    """Changes of the requested model by the evidence."""


def solve_by_evidence(data: HandData, options: HandOptions = HandOptions(), *, as_asked: bool = False) -> EvidentHand:
    """
    Estimate from poses and turns, with the supported effects in addition to the requested model (`investigate_by_hand`).

    Parameters
    ----------
    data : HandData
    options : HandOptions
    as_asked : bool
        Whether the model is exactly the requested one.

    Raises
    ------
    NotObservableError
        As `solve_by_hand`.

    """
    from imu_calibration.references.gravity.model_selection import MIN_FOLD_POSES, investigate_by_hand  # here, because its import is slow
    if as_asked or len(data.poses.start) < MIN_FOLD_POSES:
        return EvidentHand(solve_by_hand(data, options))
    found, asked = investigate_by_hand(data, options), _asked(data, options)
    while faint := _faint(hand := _solved(data, found, options), found, asked):
        found = replace(found, named=[q for q in found.named if q not in faint], unstable=[*found.unstable, *faint])
    added = tuple(q.name for q in found.adopted if q.name not in asked[q.sensor])
    changes = ModelChanges(added, tuple(question.name for question in found.unstable),
                           {question.name: found.problem.explained.share(found.named, question) for question in found.implausible},
                           unexplained={sensor: rest.entry for sensor, rest in found.unexplained.items() if rest.significant})
    return EvidentHand(hand, found, changes)


def _solved(data, found, options):
    """Return the calibration with the requested model and the findings; if the model is unchanged, the one of the search."""
    asked, names, base = _asked(data, options), found.names, found.baseline.model
    same = all(getattr(base, sensor) == _joined(asked[sensor], names[sensor]) for sensor in SENSORS)
    return found.baseline if same and not (found.unstable or found.implausible) else extended_by_hand(data, found, options)


def _faint(hand, found, asked):
    """Return the effects that were added and are implausible or have no significant coefficient."""
    faint = []
    for question in found.adopted:
        effect, part = question.effect, hand.model.slices[question.effect.key]
        at = np.arange(part.start, part.start + effect.n_amplitudes)
        values, sd = hand.values[at], hand.sd[at]
        if question.name not in asked[question.sensor] and (effect.surpasses(values) or not one_significant(values, sd)):
            faint.append(question)
    return faint


def extended_by_hand(data: HandData, found: 'HandInvestigation', options: HandOptions) -> HandCalibration:
    """Return the calibration with the requested model and the findings; denied or implausible effects increase its covariance."""
    asked, names = _asked(data, options), found.names
    extended = replace(options, **{sensor: _joined(asked[sensor], names[sensor]) for sensor in SENSORS})
    hand = solve_by_hand(data, extended, found.point(found.problem, found.named))
    terms = hand.terms
    for question in (*found.unstable, *found.implausible):
        moved = found.search.moved_by(found.named, question, found.baseline.param_names)
        shift = np.array([moved.get(name, 0.0) for name in hand.param_names])
        terms = with_term(terms, REJECTED, np.outer(shift, shift))
    return replace(hand, terms=terms)


def _asked(data, options):
    return {'accelerometer': options.accelerometer or BASE,
            'gyroscope': options.gyroscope or default_gyroscope(data.poses)[0]}


def _joined(asked, found):
    return asked + tuple(name for name in found if name not in asked)
