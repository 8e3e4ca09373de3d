"""Verification of a calibration on a recording without a table: gravity at rest, rates at rest, and turns between poses."""

from collections.abc import Callable

import numpy as np

from imu_calibration.calibration.hand_proof import PER_TURN, TURNS_LEAST, entry_of, turn_error
from imu_calibration.calibration.hand_workflow import read_by_hand
from imu_calibration.calibration.table_calibration import CheckResult
from imu_calibration.compensation.stream import compensate_readings
from imu_calibration.core.errors import NotObservableError
from imu_calibration.core.samples import ImuSamples, TemperatureSamples
from imu_calibration.core.units import STANDARD_GRAVITY
from imu_calibration.document.calibration import Calibration
from imu_calibration.effects.base import SENSORS, UNIT
from imu_calibration.preprocessing.checks import Preflight
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.references.gravity.hand_calibration import HandData, gather_by_hand
from imu_calibration.references.options import CalibrationOptions


def check_by_hand(source: Callable, calibration: Calibration, options: CalibrationOptions = CalibrationOptions()) -> CheckResult:
    """
    Prove a calibration on a recording of its IMU held still in some attitudes, with turns between them.

    The error of the accelerometer is the length of its mean reading in a pose less gravity; that of the gyroscope the angle between gravity
    rotated by its rates and gravity in the pose at the end of a turn, and its mean reading at rest. Before: readings unchanged; after: as
    corrected by compensation. Directions of gravity are those of the corrected accelerometer for both.

    Parameters
    ----------
    source : callable
        Returns an iterator of SampleBlock.
    calibration : Calibration
        From a table or by hand.
    options : CalibrationOptions
        The local gravity, if it differs from that of the calibration, and the conversion of volts or counts.

    Raises
    ------
    InputError
        When the recording cannot be used.

    """
    preflight = Preflight(options.gravity)
    recording = read_by_hand(source(), options.nominal, [preflight])
    try:
        data = gather_by_hand(recording.imu, temperature_c=recording.temperature_c)
    except NotObservableError as error:
        return CheckResult({}, preflight.findings, str(error))
    check_force(float(np.median(np.linalg.norm(data.poses.force, axis=1))))
    warm = None if recording.temperature_c is None else TemperatureSamples(recording.imu.stamp_ns, recording.temperature_c)
    corrected = compensate_readings(calibration, recording.imu, temperature_c=warm)
    return CheckResult(prove_readings(data, recording.imu, corrected, gravity=gravity_of(calibration, options)), preflight.findings)


def gravity_of(calibration: Calibration, options: CalibrationOptions) -> float:
    """Return the reference gravity for readings at rest, m/s^2: the given one, or that of the calibration."""
    return options.gravity or calibration.conditions.get('gravity') or STANDARD_GRAVITY


def prove_readings(data: HandData, before: ImuSamples, after: ImuSamples, *, gravity: float) -> dict:
    """Return the proof of corrected samples `after` against the raw ones: sensor -> entry of a document (see `calibration.proof`)."""
    poses, turns = data.poses, [turn for turn in data.turns if turn.rotation is None]
    ranges = [slice(start, stop) for start, stop in zip(poses.start, poses.stop, strict=True)]
    (raw_force, raw_rate), (force, rate) = (_means(imu, ranges) for imu in (before, after))
    rested = float(np.sum(poses.stop - poses.start) * poses.period)
    lengths = (np.linalg.norm(mean, axis=1, keepdims=True) - gravity for mean in (raw_force, force))
    norms, rest = (entry_of(errors, UNIT[sensor]) | {'seconds': rested} for sensor, errors in zip(SENSORS, (lengths, (raw_rate, rate))))
    proof = {'accelerometer': norms | {'regimes': {'rest': norms}}, 'gyroscope': rest | {'regimes': {'rest': rest}}}
    if len(turns) >= TURNS_LEAST:
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        # the first corrected readings are NaN where they need an angular acceleration
        errors = (np.array([[turn_error(poses, turn, imu.rate_s[poses.stop[turn.first] - 1:poses.start[turn.last] + 1], up=up)]
                            for turn in turns])
                  for imu in (before, after))
        angles = entry_of(errors, PER_TURN) | {'seconds': float(sum(turn.time[-1] - turn.time[0] for turn in turns))}
        proof['gyroscope'] = angles | {'regimes': {'rest': rest, 'turns': angles}}
    return proof


def _means(imu, ranges):
    return tuple(np.array([np.nanmean(values[part], axis=0) for part in ranges]) for values in (imu.force_s, imu.rate_s))
