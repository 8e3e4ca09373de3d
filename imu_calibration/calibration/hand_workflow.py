"""
A calibration by hand.

With the effects that it supports, and with the document and result of a calibration on a table.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imu_calibration.calibration.calibrate import Solved, conclude
from imu_calibration.calibration.from_solution import ModelChanges, ModelExtension
from imu_calibration.calibration.hand_recording import HandRecording, read_by_hand
from imu_calibration.calibration.pose_observations import HandResult, PoseObservations
from imu_calibration.core.errors import InputError
from imu_calibration.document.calibration import one_significant
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.solution import REJECTED, with_term
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.references.gravity.hand_calibration import (
    HandCalibration,
    HandData,
    default_gyroscope,
    solve_by_hand,
)
from imu_calibration.references.gravity.hand_parameters import (
    HandOptions,
    hand_options,
)
from imu_calibration.references.options import CalibrationOptions
from imu_calibration.selection.questions import Question

if TYPE_CHECKING:
    from imu_calibration.references.gravity.model_selection import HandInvestigation


def solve_hand_by_evidence(
    observations: PoseObservations,
    options: HandOptions = HandOptions(),
    *,
    as_asked: bool = False,
) -> Solved[HandCalibration]:
    """
    Estimate from poses and turns.

    With the supported effects in addition to the requested model (`investigate_by_hand`).

    Parameters
    ----------
    observations : PoseObservations
    options : HandOptions
    as_asked : bool
        Whether the model is exactly the requested one.

    Raises
    ------
    NotObservableError
        As `solve_by_hand`.

    """
    # Here, because its import is slow.
    from imu_calibration.references.gravity.model_selection import (
        MIN_FOLD_POSES,
        investigate_by_hand,
    )

    # The search compares both sensors in poses and turns: with one sensor it has no data.
    data = observations.data
    if as_asked or data.absent or len(data.poses.start) < MIN_FOLD_POSES:
        return Solved(solve_by_hand(data, options), observations)
    found, asked = investigate_by_hand(data, options), _asked(data, options)
    while faint := _faint(hand := _solved(data, found, options), found, asked):
        found = replace(
            found,
            named=[q for q in found.named if q not in faint],
            unstable=[*found.unstable, *faint],
        )
    added = tuple(q.name for q in found.adopted if q.name not in asked[q.sensor])
    changes = ModelChanges(
        added,
        tuple(question.name for question in found.unstable),
        {
            question.name: found.problem.explained.share(found.named, question)
            for question in found.implausible
        },
        unexplained={
            sensor: rest.entry for sensor, rest in found.unexplained.items() if rest.significant
        },
    )
    return Solved(hand, observations, ModelExtension(changes=changes), found)


def _solved(data: HandData, found: 'HandInvestigation', options: HandOptions) -> HandCalibration:
    """
    Return the calibration with the requested model and the findings.

    If the model is unchanged, the one of the search.
    """
    asked, names, base = _asked(data, options), found.names, found.baseline.model
    same = all(getattr(base, sensor) == _joined(asked[sensor], names[sensor]) for sensor in SENSORS)
    return (
        found.baseline
        if same and not (found.unstable or found.implausible)
        else extended_by_hand(data, found, options)
    )


def _faint(
    hand: HandCalibration, found: 'HandInvestigation', asked: Mapping[str, Collection[str]]
) -> list[Question]:
    """Return the effects that were added and are implausible or have no significant coefficient."""
    faint = []
    for question in found.adopted:
        effect, part = question.effect, hand.model.slices[question.effect.key]
        at = np.arange(part.start, part.start + effect.n_amplitudes)
        values, sd = hand.values[at], hand.sd[at]
        if question.name not in asked[question.sensor] and (
            effect.surpasses(values) or not one_significant(values, sd)
        ):
            faint.append(question)
    return faint


def extended_by_hand(
    data: HandData, found: 'HandInvestigation', options: HandOptions
) -> HandCalibration:
    """
    Return the calibration with the requested model and the findings.

    Unstable or implausible effects increase its covariance.
    """
    asked, names = _asked(data, options), found.names
    extended = replace(
        options,
        accelerometer=_joined(asked['accelerometer'], names['accelerometer']),
        gyroscope=_joined(asked['gyroscope'], names['gyroscope']),
    )
    hand = solve_by_hand(data, extended, found.point(found.problem, found.named))
    terms = hand.terms
    for question in (*found.unstable, *found.implausible):
        moved = found.search.moved_by(found.named, question, found.baseline.param_names)
        shift = np.array([moved.get(name, 0.0) for name in hand.param_names])
        terms = with_term(terms, REJECTED, np.outer(shift, shift))
    return replace(hand, terms=terms)


def _asked(data: HandData, options: HandOptions) -> dict[str, tuple[str, ...]]:
    return {
        'accelerometer': options.accelerometer or BASE,
        'gyroscope': options.gyroscope or default_gyroscope(data.poses)[0],
    }


def _joined(asked: tuple[str, ...], found: Iterable[str]) -> tuple[str, ...]:
    return asked + tuple(name for name in found if name not in asked)


def calibrate_without_table(
    sources: Sequence[Callable],
    options: CalibrationOptions = CalibrationOptions(),
    provenance: dict | None = None,
) -> HandResult:
    """
    Calibrate by hand and return the HandResult: gravity is the reference (see `calibrate_by_hand`).

    Parameters
    ----------
    sources : sequence of callables
        One, which returns an iterator of SampleBlock.
    options : CalibrationOptions
    provenance : dict, optional
        Bag names, hashes and options for the document.

    Raises
    ------
    InputError
        When more than one recording is given, or a requested effect needs a table.

    """
    if len(sources) != 1:
        raise InputError(
            f'calibration by hand needs one recording, got {len(sources)}; calibrate them'
            ' separately and compare the results'
        )
    preflight = Preflight(options.gravity, one_sensor=True)
    recording = read_by_hand(sources[0](), options.nominal, preflight)
    return calibrate_poses(recording, options, provenance)


def calibrate_poses(
    recording: HandRecording,
    options: CalibrationOptions = CalibrationOptions(),
    provenance: dict | None = None,
    *,
    stills: Sequence[slice] | None = None,
) -> HandResult:
    """
    Return the HandResult of a recording that was read.

    `stills` as in `calibrate_by_hand`, the other arguments as in `calibrate_without_table`.
    """
    asked = hand_options(options)
    observations = PoseObservations.of(recording, asked, stills)
    solved = solve_hand_by_evidence(observations, asked, as_asked=options.as_asked)
    return conclude(solved, options, provenance=provenance)
