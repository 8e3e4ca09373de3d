"""
A calibration by hand.

With the effects that it supports, and with the document and result of a calibration on a table.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imu_calibration.calibration.calibrate import Solved, conclude
from imu_calibration.calibration.check_result import CheckResult
from imu_calibration.calibration.from_solution import ModelChanges, ModelExtension
from imu_calibration.calibration.hand_proof import (
    TURN_ANGLE_UNIT,
    TURNS_LEAST,
    entry_of,
    turn_error,
)
from imu_calibration.calibration.hand_recording import HandRecording, read_by_hand
from imu_calibration.calibration.pose_observations import HandResult, PoseObservations
from imu_calibration.compensation.stream import compensate_samples
from imu_calibration.core.errors import InputError, NotObservableError
from imu_calibration.core.exit_codes import dropped_text
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration import Calibration, one_significant
from imu_calibration.document.proof_entry import Proof, ProofEntry
from imu_calibration.effects.base import SENSORS, UNITS
from imu_calibration.effects.sensor_model import BASE
from imu_calibration.estimation.solution import REJECTED, with_term
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.preprocessing.checks import Preflight, unusable
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.references.gravity.hand_calibration import (
    HandCalibration,
    HandData,
    default_gyroscope,
    gather_by_hand,
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


def check_by_hand(
    source: Callable, calibration: Calibration, options: CalibrationOptions = CalibrationOptions()
) -> CheckResult:
    """
    Prove a calibration on a recording of its IMU held still in some attitudes.

    With turns between them.

    The error of the accelerometer is the length of its mean reading in a pose less gravity; that of
    the gyroscope the angle between gravity rotated by its rates and gravity in the pose at the end
    of a turn, and its mean reading at rest. Before: readings unchanged; after: as corrected by
    compensation. Directions of gravity are those of the corrected accelerometer for both.

    Parameters
    ----------
    source : callable
        Returns an iterator of SampleBlock.
    calibration : Calibration
        From a table or by hand.
    options : CalibrationOptions
        The local gravity, if it differs from that of the calibration, and the conversion of volts
        or counts.

    Raises
    ------
    InputError
        When the recording cannot be used.

    """
    preflight = Preflight(options.gravity, one_sensor=True)
    recording = read_by_hand(source(), options.nominal, preflight)
    try:
        data = gather_by_hand(recording.imu, temperature_c=recording.temperature_c)
    except NotObservableError as error:
        return CheckResult({}, recording.findings, str(error))
    lost = {**recording.counts, 'unusable': unusable(recording.findings)}
    check_force(float(np.median(np.linalg.norm(data.poses.force, axis=1))))
    warm = (
        None
        if recording.temperature_c is None
        else TemperatureSamples(recording.imu.stamp_ns, recording.temperature_c)
    )
    corrected = compensate_samples(calibration, recording.imu, warm)
    # Of an absent sensor either the readings or the parameters have no meaning.
    absent = {*calibration.absent, *recording.imu.absent}
    if absent == set(SENSORS):
        raise InputError(
            'a calibration must be of a sensor that the recording has, it is of the'
            f' {calibration.sensors[0]} only and the recording has no readings of it; give another'
            ' recording',
            code='absent',
        )
    gravity = gravity_of(calibration, options)
    return CheckResult(
        prove_hand_readings(data, recording.imu, corrected, gravity=gravity, absent=absent),
        recording.findings,
        dropped=dropped_text(lost, len(recording.imu)),
    )


def gravity_of(calibration: Calibration, options: CalibrationOptions) -> float:
    """
    Return the reference gravity for readings at rest, m/s^2.

    The given one, or that of the calibration.
    """
    return options.gravity or calibration.conditions.get('gravity') or STANDARD_GRAVITY


def prove_hand_readings(
    data: HandData,
    before: ImuSamples,
    after: ImuSamples,
    *,
    gravity: float,
    absent: Collection[str] = (),
) -> Proof:
    """
    Return the proof of corrected samples `after` against the raw ones.

    None of the sensors `absent`.
    """
    poses, turns = data.poses, [turn for turn in data.turns if turn.rotation is None]
    ranges = [slice(start, stop) for start, stop in zip(poses.start, poses.stop, strict=True)]
    (raw_force, raw_rate), (force, rate) = (_means(imu, ranges) for imu in (before, after))
    rested = float(np.sum(poses.stop - poses.start) * poses.period)
    lengths = (np.linalg.norm(mean, axis=1, keepdims=True) - gravity for mean in (raw_force, force))
    proof: dict[str, ProofEntry] = {}
    for sensor, errors in zip(SENSORS, (lengths, (raw_rate, rate)), strict=True):
        if sensor not in absent:
            rest = entry_of(errors, UNITS[sensor], seconds=rested)
            proof[sensor] = replace(rest, regimes={'rest': rest})
    # The directions at both ends of a turn are those of the corrected accelerometer.
    if not absent and len(turns) >= TURNS_LEAST:
        up = unit_rows(force)
        # the first corrected readings are NaN where they need an angular acceleration
        errors = (
            np.array(
                [
                    [
                        turn_error(
                            poses,
                            turn,
                            imu.rate_s[poses.stop[turn.first] - 1 : poses.start[turn.last] + 1],
                            up=up,
                        )
                    ]
                    for turn in turns
                ]
            )
            for imu in (before, after)
        )
        turning = float(sum(turn.time[-1] - turn.time[0] for turn in turns))
        angles = entry_of(errors, TURN_ANGLE_UNIT, seconds=turning)
        regimes = {**proof['gyroscope'].regimes, 'turns': angles}
        proof['gyroscope'] = replace(angles, regimes=regimes)
    return proof


def _means(imu: ImuSamples, ranges: Sequence[slice]) -> tuple[np.ndarray, ...]:
    return tuple(
        np.array([np.nanmean(values[part], axis=0) for part in ranges])
        for values in (imu.force_s, imu.rate_s)
    )
