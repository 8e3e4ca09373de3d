"""Use cases as plain functions: the command line, the nodes and the tests call the same ones."""

from dataclasses import dataclass, field, replace
from datetime import datetime, timezone

import numpy as np

import imu_calibration
from imu_calibration import observability
from imu_calibration.by_hand_document import calibrate_recording_by_hand
from imu_calibration.calibration import DETERMINED, Calibration, statuses, tolerances_of
from imu_calibration.errors import InputError
from imu_calibration.estimation import make_prior, solve
from imu_calibration.gathering import Gathered, restrict
from imu_calibration.preflight import Preflight, refuse, unusable, warnings
from imu_calibration.preflight.joint_checks import against_joints
from imu_calibration.sensor_model import SensorModel, coefficients, parse_effects
from imu_calibration.settings import WindowSettings
from imu_calibration.several import GatherStep, join
from imu_calibration.verdict import judge, requested

SENSORS = ('accelerometer', 'gyroscope')
G = 9.80665
PASSES = 6
"""Passes over a recording at most, when effects have to be linearised anew."""
LINEAR_STEPS = 25
"""Steps of a numerical derivative (5 ms of a delay) over which a linearisation is believed in directions that are hardly seen."""


@dataclass(frozen=True)
class CalibrationOptions:
    """What to estimate and how to judge it."""

    accelerometer_model: str | None = None
    """Named model or names joined by '+'; None: bias+matrix, and accel_size_effect when the rotation shows it."""
    gyroscope_model: str | None = None
    """The same; None: bias+matrix."""
    reference_model: str | None = None
    """Effects of table and clock joined by '+', or 'none'; None: table_tilt, and earth_rate when latitude or azimuth is unknown."""
    tolerances: dict = field(default_factory=dict)
    """{section: {effect: tolerance}}."""
    windows: WindowSettings = WindowSettings()
    """How windows are found."""
    nominal: object | None = None
    """NominalScaling for recordings in volts or counts."""


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """A calibration with what a report needs beside it."""

    calibration: Calibration
    """The document's content."""
    solution: object
    """The Solution, or the HandCalibration of a recording without a table."""
    gathered: Gathered
    """Windows, counts, kept samples."""
    table: object
    """The Table, or None."""
    model: SensorModel
    """The model that was solved."""
    gathered_model: SensorModel
    """The model whose columns were gathered; it may have more effects."""
    tolerances: np.ndarray
    """Tolerance of each parameter."""
    options: CalibrationOptions = CalibrationOptions()
    """What was asked for."""


def choose_model(options, table, temperature_c=None):
    """
    Return the model whose columns are gathered; `settle_model` takes out what the rotation does not show.

    With an unknown place of the mount, the size effect comes with a common `lever_arm` and the origin is the mean of the three
    sensitive points.
    """
    names = table.joint_names
    accelerometer = parse_effects('accelerometer', options.accelerometer_model or 'bias+matrix+accel_size_effect', names)
    gyroscope = parse_effects('gyroscope', options.gyroscope_model or 'bias+matrix', names)
    if 'accel_size_effect' in accelerometer and table.mount_xyz is None and 'lever_arm' not in accelerometer:
        accelerometer += ('lever_arm',)
    if options.reference_model is None:
        reference = ('table_tilt',) + (('earth_rate',) if table.latitude is None or table.azimuth_deg is None else ())
    else:
        reference = tuple(name for name in options.reference_model.split('+') if name not in ('', 'none'))
    reference_c = 25.0 if temperature_c is None else float(round(temperature_c))
    return SensorModel(accelerometer, gyroscope, reference, tuple(names), reference_c)


def settle_model(model, options, gathered):
    """Return the model without the size effect when nobody asked for it and the recording holds no rotation that shows it."""
    if options.accelerometer_model is not None:
        return model
    if gathered.accumulator.samples.get('spin', 0) + gathered.accumulator.samples.get('dynamic', 0) == 0:
        return model.without('accelerometer', 'accel_size_effect').without('accelerometer', 'lever_arm')
    return model


def calibrate(sources, table, options=CalibrationOptions(), provenance=None, progress=None, mapper=map, names=None):
    """
    Calibrate from one or several recordings of the same IMU on a table.

    Parameters
    ----------
    sources : sequence of callables
        Each returns an iterator of SampleBlock when called; called again when effects must be linearised anew.
    table : Table
        The reference.
    options : CalibrationOptions
    provenance : dict, optional
        Bag names, hashes and options for the document.
    progress : callable, optional
        Called with the number of IMU samples read.
    mapper : callable
        Applies the map step to the recordings; `map`, or that of a pool.
    names : sequence of str, optional
        Names of the recordings for messages.

    Returns
    -------
    CalibrationResult

    Raises
    ------
    InputError
        When a recording cannot be used or is of another frame, with its name when there are several.

    """
    names = tuple(names or (f'recording {number}' for number in range(1, len(sources) + 1)))
    model = choose_model(options, table, _first_temperature(sources, options))
    for _ in range(PASSES):
        step = GatherStep(table, model, options.windows, options.nominal, names, progress)
        gathered = join(list(mapper(step, enumerate(sources))), names, lambda part, model=model: check_units(part, model, table))
        result = finish(gathered, model, table, options, provenance)
        again = linearise_again(model, result.solution)
        if again is None:
            break
        model = again
    return result


def _first_temperature(sources, options):
    """Return the first temperature of the first recording when a thermal effect asks for a reference temperature."""
    if 'thermal' not in (options.accelerometer_model or '') + (options.gyroscope_model or ''):
        return None
    for block in sources[0]():
        if block.temperature is not None and len(block.temperature):
            return float(block.temperature.temperature_c[0])
    raise InputError('a thermal effect needs temperatures, the recording has none; record imu/temperature or leave the effect out')


def linearise_again(model, solution):
    """Return the model linearised at a solution that lies too far from where its columns were taken, else None."""
    return model.at(_values_in(model, solution, _cautious(solution))) if _needs_another_pass(model, solution) else None


def _cautious(solution):
    """
    Return values to linearise at: those of the solution, but for directions that the recording hardly shows.

    At zero a lag and a delay are the same to first order. What tells them apart, and how far, is only seen from a point where both act;
    a full step along their difference would lead anywhere. So the step is the solution's with a pull of LINEAR_STEPS towards the point.
    """
    model, values = solution.model, solution.values
    move, pull = np.zeros(len(values)), np.zeros(len(values))
    for effect in model.relinearised:
        if effect.warp is not None:
            part = model.slices[effect.sensor, effect.name]
            move[part], pull[part] = values[part] - model.warp_point(effect), (LINEAR_STEPS * effect.step)**-2
    moving = np.flatnonzero(pull)
    if not len(moving):
        return values
    known = np.linalg.inv(solution.covariance[np.ix_(moving, moving)])
    kept = values.copy()
    kept[moving] -= np.linalg.solve(known + np.diag(pull[moving]), pull[moving] * move[moving])
    return kept


def _needs_another_pass(model, solution):
    """Return whether an effect moved so far from where its columns were taken that the first derivative no longer holds."""
    for effect in model.relinearised:
        if (effect.sensor, effect.name) not in solution.model.slices:
            continue
        part = solution.model.slices[effect.sensor, effect.name]
        moved = np.abs(solution.values[part] - model.warp_point(effect))
        if np.any(moved > np.maximum(3 * solution.sd[part], 5 * effect.step)):
            return True
    return False


def _values_in(model, solution, known):
    values = model.start()
    for effect in solution.model.effects:
        values[model.slices[effect.sensor, effect.name]] = known[solution.model.slices[effect.sensor, effect.name]]
    return values


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
    names = {sensor: None if text is None else parse_effects(sensor, text)
             for sensor, text in zip(SENSORS, (options.accelerometer_model, options.gyroscope_model))}
    preflight = Preflight(gravity, options.nominal)
    result = result_by_hand(*calibrate_recording_by_hand(preflight.watch(sources[0]()), gravity, options.nominal, options.tolerances, provenance, **names), options)
    result.gathered.findings = preflight.findings
    return replace(result, calibration=replace(result.calibration, statistics=result.calibration.statistics | preflight_statistics(preflight.findings)))


def result_by_hand(calibration, hand, gathered, tolerances, options=CalibrationOptions()):
    """Return the CalibrationResult of a calibration by hand, after a look at its units."""
    check_force(float(np.median(np.linalg.norm(hand.poses.force, axis=1))))
    calibration = replace(calibration, conditions=conditions(gathered, None) | {'gravity': hand.gravity})
    return CalibrationResult(calibration, hand, gathered, None, calibration.model, calibration.model, tolerances, options)


def finish(gathered, model, table, options=CalibrationOptions(), provenance=None):
    """Solve what was gathered and judge it: the reduce step of calibration; the live node calls it after each window."""
    narrow = settle_model(model, options, gathered)
    accumulator = gathered.accumulator if narrow is model else restrict(gathered.accumulator, model, narrow)
    solution = solve(accumulator, narrow)
    if options.accelerometer_model is None and _size_effect_unseen(solution):
        smaller = narrow.without('accelerometer', 'accel_size_effect').without('accelerometer', 'lever_arm')
        solution, narrow = solve(restrict(accumulator, narrow, smaller), smaller), smaller
    tolerances = tolerances_of(narrow, options.tolerances)
    calibration = document(solution, tolerances, table, gathered, provenance)
    return CalibrationResult(calibration, solution, gathered, table, narrow, model, tolerances, options)


def _size_effect_unseen(solution):
    part = solution.model.slices.get(('accelerometer', 'accel_size_effect'))
    return part is not None and bool(solution.held[part].all())


def document(solution, tolerances, table, gathered, provenance=None):
    """Return the Calibration for a solution, with statuses, weak directions and the motions that would help."""
    model = solution.model
    covariance = with_gravity_uncertainty(solution, table)
    sd = np.sqrt(np.diag(covariance))
    prior = make_prior(model)
    status = statuses(model, sd, solution.held, tolerances)
    needed = observability.needed_motions(solution, tolerances, table.gravity_value, prior.sd)
    directions = observability.weak_directions(covariance, tolerances, model.param_names)
    undetermined = tuple({'parameters': weights, 'needs': _need(weights, needed)} for weights in directions)
    centred = ('accelerometer', 'lever_arm') in model.slices and ('accelerometer', 'accel_size_effect') in model.slices
    gauge = {'origin': 'mean_of_sensitive_points' if centred else 'mount', 'axes': 'mount'}
    return Calibration(model.at(solution.values), solution.values, covariance, status, gathered.frame_id, gauge, undetermined,
                       statistics(solution, gathered), conditions(gathered, table), {'software': imu_calibration.__version__, **(provenance or {})})


def _need(weights, needed):
    texts = [needed[name][0] for name in sorted(weights, key=lambda n: -abs(weights[n])) if name in needed]
    return texts[0] if texts else 'more of the same motion'


def with_gravity_uncertainty(solution, table):
    """Return the covariance with the uncertainty of gravity, which scales the accelerometer matrix as a whole."""
    if not table.gravity_sd:
        return solution.covariance
    direction = np.zeros(len(solution.values))
    part = solution.model.slices['accelerometer', 'matrix']
    direction[part] = solution.values[part] * table.gravity_sd / table.gravity_value
    return solution.covariance + np.outer(direction, direction)


def statistics(solution, gathered):
    """Return the statistics section: noise, residuals, chi-square, windows, what was dropped."""
    result = {}
    for sensor in SENSORS:
        noise = solution.noise[sensor]
        result[sensor] = {
            'noise_sd': noise.sample_sd(), 'low_frequency_factor': noise.inflation, 'between_window_sd': noise.offset_sd, 'wander_sd': noise.wander_sd,
            'wander_time_s': noise.wander_time if noise.wander_sd else None, 'residual_rms_moving': _finite(solution.residual_rms[sensor][0]),
            'residual_rms_window_means': solution.residual_rms[sensor][1], 'chi2_per_dof': solution.chi2_per_dof[sensor]}
        if sensor in solution.session_biases:
            result[sensor] |= {'between_recordings_sd': noise.session_sd, 'bias_of_recordings': solution.session_biases[sensor]}
    accumulator = gathered.accumulator
    result['windows'] = dict(sorted(accumulator.windows.items()))
    result['samples_used'] = dict(sorted(accumulator.samples.items()))
    result['dropped'] = dropped(gathered.counts)
    result['stream'] = {key: value for key, value in sorted(gathered.counts.items()) if key not in result['dropped']}
    return result | preflight_statistics(gathered.findings)


def preflight_statistics(findings):
    """Return the part of the statistics that says what a look at the recording found."""
    return {'preflight': [finding.to_mapping() for finding in warnings(findings)], 'unusable': unusable(findings)}


ACCEPTED = ('static', 'spin', 'dynamic', 'settling', 'not quiet', 'turn-on', 'too short', 'edge of joints')
"""Counts of samples that arrived whole; the last five are kept out of windows on purpose."""


def dropped(counts):
    """Return the counts of samples that were lost or could not be used, reason -> count, without zeros."""
    return {reason: int(count) for reason, count in sorted(counts.items()) if count and reason not in ACCEPTED}


def _finite(value):
    return float(value) if np.isfinite(value) else None


def conditions(gathered, table):
    """Return the conditions section."""
    date = datetime.fromtimestamp((gathered.first_stamp_ns or 0) // 10**9, timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')
    return {'temperature_range_c': gathered.temperature_c, 'largest_rate': gathered.largest_rate, 'largest_force': gathered.largest_force,
            'gravity': table.gravity_value if table is not None else None, 'duration_s': gathered.duration, 'date': date}


def check_units(gathered, model, table=None):
    """
    Refuse recordings whose units are plainly not SI, or whose axes are not those of the table.

    Compares the length of the specific force at rest with gravity, and rates and forces with those that the joints imply.

    Raises
    ------
    InputError
        Naming the likely unit, or how the axes lie.

    """
    rows = gathered.accumulator.rows
    static = [row for row in rows if row.kind == 'static']
    if static:
        length = float(np.median([np.linalg.norm(row.sensors['accelerometer'].mean[-3:]) for row in static]))
        check_force(length)
    refuse(against_joints(gathered, model, table))


def check_force(length):
    """Refuse a median length of the specific force at rest (what should be m/s^2) that is plainly g, counts or volts."""
    if 0.8 < length < 1.25:
        raise InputError(f'specific force must be in m/s^2, its length at rest is {length:.3f}: it looks like g; convert it in the driver or '
                         f'give --nominal with accelerometer_scale {1 / G:.6f}')
    if not 3.0 < length < 30.0:
        raise InputError(f'specific force must be in m/s^2, its length at rest is {length:.4g}: counts or volts?; give --nominal with offset and scale')


def summary(result):
    """Return (verdict, lines): 'good', 'weak' or 'bad' with reasons and next steps, for people (see `verdict`)."""
    found = judge(result.calibration, result.tolerances)
    return found.word, found.lines


def exit_code(result):
    """Return 0 when every requested parameter is determined and nothing was lost, else 3."""
    calibration = result.calibration
    lacking = any(status != DETERMINED for name, status in zip(calibration.param_names, calibration.status) if requested(name))
    return 3 if lacking or calibration.statistics.get('dropped') or calibration.statistics.get('unusable') else 0


def window_residuals(result):
    """
    Return residuals per window before and after: what a nominal sensor would show, and what the model leaves.

    Returns
    -------
    dict
        'time', 'kind', 'count', and per sensor 'before', 'after', each shape (n_windows, 3): residuals of window means.

    """
    solution, rows = result.solution, result.gathered.accumulator.rows
    wide, narrow = result.gathered_model, result.model
    accumulator = result.gathered.accumulator if wide is narrow else restrict(result.gathered.accumulator, wide, narrow)
    found = {'time': np.array([r.time for r in rows]), 'kind': [r.kind for r in rows], 'count': np.array([r.count for r in rows])}
    nominal = narrow.start()
    for sensor in SENSORS:
        means = np.array([row.sensors[sensor].mean for row in accumulator.rows])
        after, before = coefficients(narrow, sensor, solution.values), coefficients(narrow, sensor, np.where(np.isfinite(nominal), nominal, 0.0))
        found[sensor] = {'before': means[:, -3:] - means[:, :-3] @ before, 'after': means[:, -3:] - means[:, :-3] @ after,
                         'measured': means[:, -3:], 'predicted': means[:, :-3] @ after}
    return found
