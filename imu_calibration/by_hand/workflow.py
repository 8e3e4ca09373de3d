"""A calibration by hand as the same document and result that a calibration on a table gives."""

from dataclasses import dataclass, replace

import numpy as np

import imu_calibration
from imu_calibration.by_hand.calibrate import calibrate_by_hand
from imu_calibration.calibration.document import Calibration
from imu_calibration.calibration.from_solution import conditions, preflight_statistics
from imu_calibration.calibration.gathered import Gathered
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.calibration.result import CalibrationResult
from imu_calibration.calibration.status import HELD, statuses, tolerances_of
from imu_calibration.calibration.verdict import judged
from imu_calibration.constants import STANDARD_GRAVITY, STANDARD_GRAVITY_SD
from imu_calibration.effects.base import SENSORS
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.named_models import parse_effects
from imu_calibration.errors import InputError
from imu_calibration.preflight.checks import Preflight
from imu_calibration.preflight.joint_checks import check_force
from imu_calibration.samples import ImuSamples
from imu_calibration.segmentation.stream_cleaning import StreamCheck


@dataclass(frozen=True, eq=False)
class HandRecording:
    """A recording without joints, cleaned."""

    imu: ImuSamples
    """Accepted samples."""
    temperature_c: np.ndarray | None
    """Temperature at the samples, degrees Celsius, shape (n,), when it was recorded."""
    counts: dict
    """Reason -> samples that could not be used."""

    @property
    def gathered(self):
        """What a document says of the recording besides its parameters."""
        imu, warm = self.imu, self.temperature_c
        return Gathered(counts=self.counts, frame_id=imu.frame_id, first_stamp_ns=int(imu.stamp_ns[0]), last_stamp_ns=int(imu.stamp_ns[-1]),
                        largest_rate=float(np.sqrt((imu.rate_s**2).sum(axis=1).max())), largest_force=float(np.abs(imu.force_s).max()),
                        temperature_c=None if warm is None else (float(warm.min()), float(warm.max())))


def read_by_hand(blocks, nominal=None):
    """
    Return the `HandRecording` of a whole stream of SampleBlock; `nominal` converts counts or volts.

    Raises
    ------
    InputError
        When no usable sample is left.

    """
    checks, parts, counts = {'imu': StreamCheck(), 'temperature': StreamCheck()}, {'imu': [], 'temperature': []}, {}
    for block in blocks:
        for reason, count in (block.dropped or {}).items():
            counts[reason] = counts.get(reason, 0) + count
        for name, check in checks.items():
            parts[name] += check.push(getattr(block, name))
    for name, check in checks.items():
        parts[name] = [samples for _, samples in parts[name] + check.finish() if len(samples)]
    if not parts['imu']:
        raise InputError('the recording must hold Imu messages that can be used, it holds none; check the topic')
    for reason, count in checks['imu'].counts.items():
        counts[f'imu {reason}'] = counts.get(f'imu {reason}', 0) + count
    imu, warm = type(parts['imu'][0]).concatenate(parts['imu']), None
    if parts['temperature']:
        known = type(parts['temperature'][0]).concatenate(parts['temperature'])
        start = imu.stamp_ns[0]  # epochs in nanoseconds do not fit a float
        warm = np.interp((imu.stamp_ns - start).astype(float), (known.stamp_ns - start).astype(float), known.temperature_c)
    return HandRecording(imu if nominal is None else nominal.apply(imu), warm, {reason: count for reason, count in counts.items() if count})


def read_imu(blocks):
    """Return (ImuSamples, counts of what was dropped) of a whole recording, cleaned; raises as `read_by_hand`."""
    recording = read_by_hand(blocks)
    return recording.imu, recording.counts


def calibrate_recording_by_hand(blocks, gravity=None, nominal=None, tolerances=None, provenance=None, accelerometer=None, gyroscope=None,
                                catalogue=CATALOGUE):
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
    accelerometer, gyroscope : tuple of str, optional
        Effects to estimate, see `calibrate_by_hand`.
    catalogue : Catalogue
        Where they are declared.

    """
    recording = read_by_hand(blocks, nominal)
    return calibrate_samples_by_hand(recording, gravity, tolerances, provenance, accelerometer, gyroscope, catalogue=catalogue)


def calibrate_samples_by_hand(recording, gravity=None, tolerances=None, provenance=None, accelerometer=None, gyroscope=None, stills=None,
                              catalogue=CATALOGUE):
    """Calibrate a HandRecording; `stills` as in `calibrate_by_hand`, the rest and what is returned as in `calibrate_recording_by_hand`."""
    gravity, gravity_sd = reference_gravity(gravity)
    hand = calibrate_by_hand(recording.imu, gravity, stills, gravity_sd=gravity_sd, accelerometer=accelerometer, gyroscope=gyroscope,
                             temperature_c=recording.temperature_c, catalogue=catalogue)
    gathered = recording.gathered
    calibration, limits = document_of_hand(hand, gathered, len(recording.imu), tolerances, provenance)
    return calibration, hand, gathered, limits


def reference_gravity(gravity):
    """Return (gravity, its sd): as given, or the standard one with what it may be off by, m/s^2."""
    return (STANDARD_GRAVITY, STANDARD_GRAVITY_SD) if gravity is None else (gravity, 0.0)


def document_of_hand(hand, gathered, n_samples, tolerances=None, provenance=None):
    """Return (Calibration, tolerances) of a HandCalibration; arguments as in `calibrate_recording_by_hand`."""
    model = hand.model.model
    order = [hand.param_names.index(name) for name in model.param_names]
    covariance = hand.covariance[np.ix_(order, order)]
    sd, held = np.sqrt(np.diag(covariance)), np.array([hand.statuses[k] == HELD for k in order])
    limits = tolerances_of(model, tolerances)
    calibration = Calibration(model, hand.values[order], covariance, statuses(sd, held, limits), gathered.frame_id, dict(hand.gauge),
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


def calibrate_without_table(sources, options=CalibrationOptions(), gravity=None, provenance=None):
    """
    Calibrate by hand: gravity is the reference (see `by_hand`).

    Raises
    ------
    InputError
        When more than one recording comes, or an effect is asked for that needs a table.

    """
    if len(sources) != 1:
        raise InputError(f'calibration by hand takes one recording, {len(sources)} came; calibrate them one by one and compare the results')
    names = {sensor: None if text is None else parse_effects(sensor, text, catalogue=options.catalogue)
             for sensor, text in zip(SENSORS, (options.accelerometer_model, options.gyroscope_model))}
    preflight = Preflight(gravity, options.nominal)
    result = result_by_hand(*calibrate_recording_by_hand(preflight.watch(sources[0]()), gravity, options.nominal, options.tolerances, provenance, **names,
                                                          catalogue=options.catalogue), options)
    result.gathered.findings = preflight.findings
    return replace(result, calibration=replace(result.calibration, statistics=result.calibration.statistics | preflight_statistics(preflight.findings)))


def result_by_hand(calibration, hand, gathered, tolerances, options=CalibrationOptions()):
    """Return the CalibrationResult of a calibration by hand, after a look at its units."""
    check_force(float(np.median(np.linalg.norm(hand.poses.force, axis=1))))
    calibration = judged(replace(calibration, conditions=conditions(gathered, None) | {'gravity': hand.gravity}), tolerances)
    return CalibrationResult(calibration, hand, gathered, None, calibration.model, calibration.model, tolerances, options)
