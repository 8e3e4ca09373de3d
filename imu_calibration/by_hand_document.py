"""A calibration by hand as the same document and result that a calibration on a table gives."""

import numpy as np

import imu_calibration
from imu_calibration.by_hand import calibrate_by_hand
from imu_calibration.calibration import Calibration, statuses, tolerances_of
from imu_calibration.errors import InputError
from imu_calibration.gathering import Gathered
from imu_calibration.noise import STANDARD_GRAVITY
from imu_calibration.sensor_model import SensorModel
from imu_calibration.stream_check import StreamCheck

SENSORS = ('accelerometer', 'gyroscope')
GRAVITY_SD = 0.02
"""What the standard gravity may be off by where nobody knows the local one, m/s^2."""


def read_imu(blocks):
    """
    Return (ImuSamples, counts of what was dropped) of a whole recording, cleaned.

    Raises
    ------
    InputError
        When no usable sample is left.

    """
    check, parts, counts = StreamCheck(), [], {}
    for block in blocks:
        for reason, count in (block.dropped or {}).items():
            counts[reason] = counts.get(reason, 0) + count
        if block.imu is not None and len(block.imu):
            parts += check.push(block.imu)
    parts = [samples for _, samples in parts + check.finish() if len(samples)]
    if not parts:
        raise InputError('the recording must hold Imu messages that can be used, it holds none; check the topic')
    for reason, count in check.counts.items():
        counts[f'imu {reason}'] = counts.get(f'imu {reason}', 0) + count
    return type(parts[0]).concatenate(parts), {reason: count for reason, count in counts.items() if count}


def calibrate_recording_by_hand(blocks, gravity=None, nominal=None, tolerances=None, provenance=None):
    """
    Calibrate a recording without a table and return (Calibration, HandCalibration, Gathered, tolerances).

    Parameters
    ----------
    blocks : iterable of SampleBlock
    gravity : float, optional
        Local gravity, m/s^2; default the standard gravity, with a warning's worth of uncertainty (0.02 m/s^2).
    nominal : NominalScaling of `gathering`, optional
        Conversion from counts or volts.
    tolerances : dict, optional
        {section: {effect: tolerance}}.

    """
    imu, counts = read_imu(blocks)
    if nominal is not None:
        imu = nominal.apply(imu)
    gravity, gravity_sd = reference_gravity(gravity)
    hand = calibrate_by_hand(imu, gravity, gravity_sd=gravity_sd)
    gathered = Gathered(counts=counts, frame_id=imu.frame_id, first_stamp_ns=int(imu.stamp_ns[0]), last_stamp_ns=int(imu.stamp_ns[-1]),
                        largest_rate=float(np.sqrt((imu.rate_s**2).sum(axis=1).max())), largest_force=float(np.abs(imu.force_s).max()))
    calibration, limits = document_of_hand(hand, gathered, len(imu), tolerances, provenance)
    return calibration, hand, gathered, limits


def reference_gravity(gravity):
    """Return (gravity, its sd): as given, or the standard one with what it may be off by, m/s^2."""
    return (STANDARD_GRAVITY, GRAVITY_SD) if gravity is None else (gravity, 0.0)


def document_of_hand(hand, gathered, n_samples, tolerances=None, provenance=None):
    """Return (Calibration, tolerances) of a HandCalibration; arguments as in `calibrate_recording_by_hand`."""
    responds = any('.gyro_g_sensitivity.' in name for name in hand.param_names)
    model = SensorModel(gyroscope=('bias', 'matrix', 'gyro_g_sensitivity') if responds else ('bias', 'matrix'))
    order = [hand.param_names.index(name) for name in model.param_names]
    covariance = hand.covariance[np.ix_(order, order)]
    sd, held = np.sqrt(np.diag(covariance)), np.array([hand.statuses[k] == 'held' for k in order])
    limits = tolerances_of(model, tolerances)
    calibration = Calibration(model, hand.values[order], covariance, statuses(model, sd, held, limits), gathered.frame_id, dict(hand.gauge),
                              tuple(dict(item) for item in hand.advice), _statistics(hand, gathered.counts, n_samples), {}, {
                                  'software': imu_calibration.__version__, **(provenance or {})})
    return calibration, limits


def _statistics(hand, counts, n_samples):
    found = hand.statistics
    keys = {'accelerometer': ('force_noise_sd', 'pose_scatter_sd'), 'gyroscope': ('rate_noise_sd', 'drift_scatter_sd')}
    per_sensor = {s: {'noise_sd': [float(v) for v in found[keys[s][0]]], 'between_window_sd': float(found[keys[s][1]]), 'wander_sd': 0.0}
                  for s in SENSORS}
    return {**per_sensor, 'windows': {'static': found.get('poses', 0), 'turns': found.get('turns', 0)}, 'samples_used': {'all': n_samples},
            'by_hand': found, 'dropped': {reason: int(count) for reason, count in sorted(counts.items())}}
