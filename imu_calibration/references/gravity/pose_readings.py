"""Errors of raw and of corrected readings by hand: at rest, and in the turns between rests."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_calibration.calibration.check import ReadingErrors, require_sensor
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.proof import entry_of
from imu_calibration.compensation.stream import compensate_samples
from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import BlockSource, ImuSamples, TemperatureSamples
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.change import with_kinds_by_hand
from imu_calibration.document.proof_entry import Proof, ProofEntry
from imu_calibration.effects.base import UNITS
from imu_calibration.kinematics.rotations import unit_rows
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.preprocessing.sample_recording import read_recording
from imu_calibration.references.gravity.equations import Poses, TurnData
from imu_calibration.references.gravity.hand_calibration import HandData, gather_by_hand
from imu_calibration.references.gravity.held_out_poses import (
    TURN_ANGLE_UNIT,
    TURNS_LEAST,
    turn_error,
)


def errors_by_hand(
    source: BlockSource,
    calibration: Calibration,
    options: CalibrationOptions = CalibrationOptions(),
) -> ReadingErrors:
    """
    Return the errors of a calibration on a recording of its IMU held still, and turned in between.

    The error of the accelerometer is the length of its mean reading in a pose less gravity; that of
    the gyroscope the angle between gravity rotated by its rates and gravity in the pose at the end
    of a turn, and its mean reading at rest. Before: readings unchanged; after: as corrected by
    compensation. Directions of gravity are those of the corrected accelerometer for both.

    Parameters
    ----------
    source : BlockSource
        The recording.
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
    gravity = options.gravity or calibration.conditions.get('gravity') or STANDARD_GRAVITY
    notes = ()
    if not options.gravity:
        notes = (
            f'gravity is that of the calibration, {gravity:.6g} m/s^2; give the local value if it'
            ' differs',
        )
    preflight = Preflight(options.gravity, one_sensor=True)
    recording = read_recording(source, options.nominal, preflight)
    errors = ReadingErrors(
        proof={},
        # A table compares components, rests by hand the length: only these errors are alike.
        stored=with_kinds_by_hand(calibration.proof),
        findings=recording.findings,
        lost=recording.counts,
        n_used=len(recording.imu),
        notes=notes,
    )
    try:
        data = gather_by_hand(recording.imu, temperature_c=recording.temperature_c)
    except NotObservableError as error:
        return replace(errors, why=str(error))
    check_force(float(np.median(np.linalg.norm(data.poses.force, axis=1))))

    temperature = None
    if recording.temperature_c is not None:
        temperature = TemperatureSamples(recording.imu.stamp_ns, recording.temperature_c)
    corrected = compensate_samples(calibration, recording.imu, temperature)

    # Of an absent sensor either the readings or the parameters have no meaning.
    absent = require_sensor(calibration, recording.imu.absent)
    proof = prove_hand_readings(data, recording.imu, corrected, gravity=gravity, absent=absent)
    return replace(errors, proof=proof)


def prove_hand_readings(
    data: HandData,
    before: ImuSamples,
    after: ImuSamples,
    *,
    gravity: float,
    absent: Collection[str] = (),
) -> Proof:
    """
    Return the errors of the raw samples `before` and of the corrected samples `after`, by sensor.

    Sensors in `absent` are omitted.
    """
    poses = data.poses
    raw = _rest_means(before, poses)
    corrected = _rest_means(after, poses)

    # At rest: | mean specific force | - gravity, and the mean rate.
    seconds = float(np.sum(poses.stop - poses.start) * poses.period)
    proof: dict[str, ProofEntry] = {}
    if 'accelerometer' not in absent:
        raw_norm = np.linalg.norm(raw.force, axis=1, keepdims=True) - gravity
        corrected_norm = np.linalg.norm(corrected.force, axis=1, keepdims=True) - gravity
        rest = entry_of(UNITS['accelerometer'], raw_norm, corrected_norm, seconds=seconds)
        proof['accelerometer'] = replace(rest, regimes={'rest': rest})
    if 'gyroscope' not in absent:
        rest = entry_of(UNITS['gyroscope'], raw.rate, corrected.rate, seconds=seconds)
        proof['gyroscope'] = replace(rest, regimes={'rest': rest})

    # The directions at both ends of a turn are those of the corrected accelerometer.
    turns = [turn for turn in data.turns if turn.rotation is None]
    if not absent and len(turns) >= TURNS_LEAST:
        up = unit_rows(corrected.force)
        raw_angles = _turn_errors(before, poses, turns, up)
        corrected_angles = _turn_errors(after, poses, turns, up)
        turn_seconds = float(sum(turn.time[-1] - turn.time[0] for turn in turns))
        entry = entry_of(TURN_ANGLE_UNIT, raw_angles, corrected_angles, seconds=turn_seconds)
        regimes = {**proof['gyroscope'].regimes, 'turns': entry}
        proof['gyroscope'] = replace(entry, regimes=regimes)
    return proof


@dataclass(frozen=True, eq=False)
class _RestMeans:
    """Mean readings in each pose."""

    force: np.ndarray
    """Specific force, m/s^2, shape (n_poses, 3)."""
    rate: np.ndarray
    """Angular rate, rad/s, shape (n_poses, 3)."""


def _rest_means(imu: ImuSamples, poses: Poses) -> _RestMeans:
    """Return the means in each pose of the samples that are finite."""
    force = []
    rate = []
    for start, stop in zip(poses.start, poses.stop, strict=True):
        # The first corrected readings are NaN where they need an angular acceleration.
        force.append(np.nanmean(imu.force_s[start:stop], axis=0))
        rate.append(np.nanmean(imu.rate_s[start:stop], axis=0))
    return _RestMeans(np.array(force), np.array(rate))


def _turn_errors(
    imu: ImuSamples, poses: Poses, turns: Sequence[TurnData], up: np.ndarray
) -> np.ndarray:
    """Return the angle error of each turn with the rates of some samples, rad, shape (n, 1)."""
    errors = []
    for turn in turns:
        # From the last sample of the pose before to the first of the pose after the turn.
        rates = imu.rate_s[poses.stop[turn.first] - 1 : poses.start[turn.last] + 1]
        errors.append(turn_error(poses, turn, rates, up=up))
    return np.array(errors)[:, None]
